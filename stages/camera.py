"""Stage 3: focal length and up direction, from the user, metadata, the picture's perspective and the person's geometry.

A network's perspective field (paper 8.1) says what lens and gravity the room suggests, with its uncertainty. It is the
prior of the fit to the person, whose perspective, motion and balance are further evidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np

from video2anim.errors import UsageError
from video2anim.pipeline.options import Heights, limits, model_of, only_without
from video2anim.pipeline.stage import NO_MODEL, StageContext, StageSpec
from video2anim.types import CameraEstimate, Intrinsics, PersonTrack, PersonTracks, VideoClip
from video2anim.types.camera import UpEvidence

if TYPE_CHECKING:
    from video2anim.geometry.perspective_field import FieldCamera
    from video2anim.humans.ground import UpEstimate
    from video2anim.humans.lifter_input import LiftedBody
    from video2anim.humans.problem import FittedBody

_WRONG_FACTOR = 3.0
"""Metadata that differs from what the person's perspective says by more than this factor is wrong. Estimates from a
person alone are themselves off by up to a factor of 2.2 (V2A-Bench, `benchmarks/human_fit.py`)."""
_LIFTER_UP_SIGMA_RAD = 0.1
"""Error of gravity by people's poses."""
_LEVEL_SIGMA_RAD = 0.35
"""Cameras are held level to about 20 degrees."""
_SURE_FRAMES = 30
"""People seen for less tell less of gravity."""
FULL_FRAME_DIAGONAL_MM = 43.267
"""Diagonal of the 36 x 24 mm frame that equivalent focal lengths refer to."""


@dataclass(frozen=True)
class CameraConfig:
    """Settings of the stage."""

    focal_px: Annotated[float, limits("px", gt=0, le=1_000_000)] | None = None
    """Known focal length in pixels of the upright video; nothing is estimated then."""
    height_m: Heights | None = None
    """Known standing height in meters: of the main person, or by person's ID. The lens is fitted to the main person."""
    frames: Annotated[int, limits(ge=1, le=10_000)] = 24
    """Frames the lens is fitted to, spread over the clip."""
    iterations: Annotated[int, limits(ge=2, le=100_000)] = 200
    """Steps of the fit."""
    model: Annotated[str, model_of("lifter")] = "lifter"
    """Model that lifts landmarks to bodies, where the fit starts and what it stays near."""
    camera_model: Annotated[str, model_of("camera", also=(NO_MODEL,))] = "room-camera"
    """Model of slot `camera` that gives perspective fields; `none` leaves the camera to the person alone."""
    field_frames: Annotated[int, limits(ge=1, le=1000), only_without("camera_model", NO_MODEL)] = 3
    """Pictures whose fields are fitted together; one for a moving camera."""
    line_segments: Annotated[bool, only_without("camera_model", NO_MODEL)] = True
    """Correct what the fields say by the straight edges of the room."""


def estimate_camera(clip: VideoClip, tracks: PersonTracks, config: CameraConfig, ctx: StageContext) -> CameraEstimate:
    """Intrinsics and gravity of the first frame's camera.

    The focal length of a person's video shows in the perspective of the body itself and in how its size changes with
    depth; both are weak, so it is fitted jointly with the body under a lens prior and its uncertainty is stated. A
    focal length of the file's metadata is used unless the person's perspective contradicts it grossly.

    Raises:
        UsageError: a focal length that no camera has.
    """
    from video2anim.geometry.perspective_field import pitch_roll_of
    from video2anim.humans.body_height import expect_heights
    from video2anim.humans.problem import evenly_spread

    _expect_sane(config, clip)
    expect_heights(config.height_m, tracks.selected_ids)
    main = tracks.selected()[0].whole(clip.frame_count)
    frames = evenly_spread(np.flatnonzero(main.valid), config.frames)
    lifted = _lifted(clip, main, config, ctx)
    picture = _picture_camera(clip, config, ctx)
    focal_px, sigma, source, body = _focal(clip, main, frames, lifted, picture, config, ctx)
    others = (track for track in tracks.people if track.person_id != main.person_id)
    seen = _up_seen([(lifted, main), *((_lifted(clip, other, config, ctx), other) for other in others)])
    up = _with_picture(_up(body, seen, float(np.ptp(clip.frame_time_s[frames]))), picture)
    if not clip.camera_is_static:
        ctx.warn(
            "the camera moves, but is taken as fixed: the person's path in the world will contain its motion; "
            "film from a tripod for a true path"
        )
    if picture is not None:
        ctx.quality("focal_of_image", picture.focal_ratio * clip.height_px, "px")
        ctx.quality("focal_of_image_uncertainty", picture.focal_log_sigma, "ratio", "lower")
    if sigma > 0.2:
        ctx.warn(f"focal length is uncertain ({sigma:.0%}); give --focal-px if you know it")
    pitch, roll = pitch_roll_of(up.up)
    ctx.quality("focal", focal_px, "px")
    ctx.quality("focal_uncertainty", sigma, "ratio", "lower")
    ctx.quality("pitch", math.degrees(pitch), "deg")
    ctx.quality("roll", math.degrees(roll), "deg")
    ctx.quality("up_uncertainty", math.degrees(up.sigma_rad), "deg", "lower")
    return CameraEstimate(
        intrinsics=Intrinsics.centered(focal_px, clip.width_px, clip.height_px),
        focal_source=source,
        focal_sigma_ratio=sigma,
        up_camera=up.up,
        up_source="human" if picture is None else "picture",
        up_sigma_rad=up.sigma_rad,
        is_static=clip.camera_is_static,
        R_first_camera=np.tile(np.eye(3), (clip.frame_count, 1, 1)),
        up_evidence=_up_evidence(seen, picture),
    )


def _up_evidence(seen: np.ndarray, picture: FieldCamera | None) -> tuple[UpEvidence, ...]:
    """Every source on its own, most certain first."""
    sources = [] if picture is None else [UpEvidence("picture", picture.up_camera, picture.up_sigma_rad)]
    sources.append(UpEvidence("lifter", seen, _LIFTER_UP_SIGMA_RAD))
    sources.append(UpEvidence("level camera", np.array([0.0, -1.0, 0.0]), _LEVEL_SIGMA_RAD))
    return tuple(sources)


def _lifted(clip: VideoClip, track: PersonTrack, config: CameraConfig, ctx: StageContext) -> LiftedBody:
    """The lifter's answer under the first guess of the lens, on which it depends little."""
    from video2anim.humans.lifting import lift
    from video2anim.humans.observe import observations

    intrinsics = Intrinsics.centered(config.focal_px or _usual_focal_px(clip), clip.width_px, clip.height_px)
    times_s = clip.frame_time_s[track.first_frame : track.first_frame + len(track.valid)]
    return lift(observations(track, times_s, intrinsics), ctx.model(config.model))


def _picture_camera(clip: VideoClip, config: CameraConfig, ctx: StageContext) -> FieldCamera | None:
    """Lens and gravity by the perspective fields and straight edges of a few pictures of the same view."""
    from video2anim.geometry.line_segments import camera_with_edges, detect_line_segments
    from video2anim.geometry.perspective_field import fit_camera
    from video2anim.video import read_frames

    if config.camera_model == NO_MODEL:
        return None
    model = ctx.model(config.camera_model)
    count = config.field_frames if clip.camera_is_static else 1
    chosen = np.unique(np.linspace(0, clip.frame_count - 1, count).astype(int))
    pictures = [next(iter(read_frames(clip, int(frame), int(frame) + 1))) for frame in chosen]
    known = None if config.focal_px is None else config.focal_px / clip.height_px
    fields = [model.field(picture) for picture in pictures]
    camera = fit_camera(fields, clip.width_px / clip.height_px, focal_ratio=known)
    if not config.line_segments:
        return camera
    edges = [detect_line_segments(picture) for picture in pictures]
    ctx.quality("line_segments", float(np.mean([len(one.ends) for one in edges])), "count")
    ctx.quality("focal_of_perspective_field", camera.focal_ratio * clip.height_px, "px")
    return camera_with_edges(camera, edges, focal_known=known is not None)


def _focal_prior(clip: VideoClip, picture: FieldCamera | None) -> tuple[float, float]:
    """Focal length over the longer side before the person is looked at, and the deviation of its logarithm."""
    from video2anim.humans.objective import FitConfig

    usual, sigma = math.log(FitConfig().focal_ratio), FitConfig().focal_log_sigma
    if picture is None:
        return math.exp(usual), sigma
    seen = math.log(picture.focal_ratio * clip.height_px / max(clip.width_px, clip.height_px))
    weights = np.array([sigma**-2, picture.focal_log_sigma**-2])
    return math.exp(float(weights @ [usual, seen] / weights.sum())), float(weights.sum() ** -0.5)


def _with_picture(up: UpEstimate, picture: FieldCamera | None) -> UpEstimate:
    """Up of the person and of the picture, each by its certainty."""
    if picture is None:
        return up
    weights = np.array([up.sigma_rad**-2, picture.up_sigma_rad**-2])
    together = weights @ np.stack([up.up, picture.up_camera]) / weights.sum()
    apart_rad = math.acos(float(np.clip(up.up @ picture.up_camera, -1, 1)))
    # Where the two contradict each other, neither is as sure as it says.
    sigma_rad = max(float(weights.sum() ** -0.5), 0.5 * apart_rad * float(min(weights) / max(weights)) ** 0.5)
    return replace(up, up=together / np.linalg.norm(together), sigma_rad=sigma_rad)


def _metadata_focal_px(clip: VideoClip) -> float | None:
    if clip.source.focal_35mm <= 0:
        return None
    return clip.source.focal_35mm * math.hypot(clip.width_px, clip.height_px) / FULL_FRAME_DIAGONAL_MM


def _usual_focal_px(clip: VideoClip) -> float:
    from video2anim.humans.objective import FitConfig

    return FitConfig().focal_ratio * max(clip.width_px, clip.height_px)


def _focal(
    clip: VideoClip,
    track: PersonTrack,
    frames: np.ndarray,
    lifted: LiftedBody,
    picture: FieldCamera | None,
    config: CameraConfig,
    ctx: StageContext,
) -> tuple[float, float, str, FittedBody]:
    """Focal length, its relative sigma, where it comes from, and the body fitted under it."""
    from video2anim.humans.body_height import KNOWN_SIGMA_M, height_of
    from video2anim.humans.objective import FitConfig
    from video2anim.humans.observe import observations
    from video2anim.humans.optimize import fit_body

    ratio, log_sigma = _focal_prior(clip, picture)
    fit_config = replace(FitConfig(), focal_ratio=ratio, focal_log_sigma=log_sigma)
    height_m = height_of(config.height_m, track.person_id, main_id=track.person_id)
    if height_m is not None:
        fit_config = replace(fit_config, body_height_m=height_m, body_height_sigma_m=KNOWN_SIGMA_M)

    def fit(focal_px: float, free: bool, warm: FittedBody | None = None) -> FittedBody:
        intrinsics = Intrinsics.centered(focal_px, clip.width_px, clip.height_px)
        observed = observations(track, clip.frame_time_s, intrinsics, frames)
        return fit_body(
            observed, fit_focal=free, config=fit_config, warm=warm, lifted=lifted.rows(frames), on_step=ctx.progress,
            iterations=config.iterations if warm is None else config.iterations // 2,
        )  # fmt: skip

    if config.focal_px is not None:
        return config.focal_px, 0.01, "user", fit(config.focal_px, free=False)
    body = fit(ratio * max(clip.width_px, clip.height_px), free=True)
    named = _metadata_focal_px(clip)
    if named is not None and abs(math.log(named / body.focal_px)) < math.log(_WRONG_FACTOR):
        return named, 0.05, "metadata", fit(named, free=False)
    if named is not None:
        ctx.warn(
            f"the file says focal length {named:.0f} px ({clip.source.focal_35mm:.0f} mm on full frame), which the "
            f"person's perspective contradicts (about {body.focal_px:.0f} px): not used; --focal-px overrules this"
        )
    best = body.focal_px
    step = 1.25
    costs = [fit(best * factor, free=False, warm=body).cost for factor in (1 / step, 1.0, step)]
    curvature = (costs[0] - 2 * costs[1] + costs[2]) / math.log(step) ** 2
    # The posterior is tempered as the fit's priors are: errors of one clip do not average out.
    per_frame = max(1.0, fit_config.prior_share * len(frames))
    tempered = curvature / per_frame
    prior = fit_config.focal_log_sigma
    sigma = prior if tempered <= prior**-2 else tempered**-0.5
    return best, sigma, "human" if picture is None else "picture", body


def _up_seen(people: list[tuple[LiftedBody, PersonTrack]]) -> np.ndarray:
    """Up as the lifter sees it in everybody, most in those whose pose it is surest of: somebody who stands by tells
    more than somebody who turns a somersault."""
    total = np.zeros(3)
    for lifted, track in people:
        up = np.median(lifted.up_camera[track.valid], axis=0)
        share = min(int(track.valid.sum()), _SURE_FRAMES) / _SURE_FRAMES
        # Poses that the lifter does not know mislead it about gravity more than in proportion.
        total += share * float(np.median(lifted.error_m[track.valid])) ** -4 * up / np.linalg.norm(up)
    return total / np.linalg.norm(total)


def _up(body: FittedBody, seen: np.ndarray, duration_s: float) -> UpEstimate:
    """Up as the body's balance and the lifter see it, with equal weight."""
    from video2anim.humans.ground import UpEstimate, up_from_static_equilibrium

    balance = up_from_static_equilibrium(body.joints_camera_m, duration_s)
    together = seen + balance.up
    apart_rad = math.acos(float(np.clip(seen @ balance.up, -1, 1)))
    # Two estimates of one direction: half their distance is the least that the mean may be wrong.
    sigma_rad = math.hypot(0.5 * apart_rad, balance.sigma_rad / math.sqrt(2))
    return UpEstimate(together / np.linalg.norm(together), sigma_rad, balance.support)


def _expect_sane(config: CameraConfig, clip: VideoClip) -> None:
    long_side = max(clip.width_px, clip.height_px)
    if config.focal_px is not None and not 0.2 * long_side <= config.focal_px <= 20 * long_side:
        raise UsageError(
            f"--focal-px: want {0.2 * long_side:.0f} to {20 * long_side:.0f} for this video of "
            f"{clip.width_px}x{clip.height_px}, got {config.focal_px:g}"
        )


STAGE = StageSpec("camera", estimate_camera, version=14, models=("lifter", "camera"))
