"""Stage 4: bodies in meters, fitted to the landmarks of all frames together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Float

from video2anim.pipeline.options import Heights, limits, model_of
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BodyMotion,
    BodyTracks,
    CameraEstimate,
    PersonQuality,
    PersonTrack,
    PersonTracks,
    VideoClip,
)

if TYPE_CHECKING:
    from video2anim.humans.lifter_input import LiftedBody
    from video2anim.humans.problem import FittedBody, Observations


_GUESSED_M = 0.15
"""Expected error of ankles or wrists above which a warning says that limbs are guessed. The medians of limbs in view
are 0.07 to 0.15 m on nine real clips and 0.2 to 0.4 m on a breakdance, of hidden ankles 0.13 to 0.25 m
(`benchmarks/altered_clips.py`)."""


@dataclass(frozen=True)
class HumansConfig:
    """Settings of the stage."""

    model: Annotated[str, model_of("lifter")] = "lifter"
    """Model that lifts landmarks to bodies; `lifter@FILE` for weights of your own."""
    height_m: Heights | None = None
    """Known standing height in meters: of the main person, or by person's ID. The prior of all others is the mean
    height of adults."""
    iterations: Annotated[int, limits(ge=1, le=100_000)] = 100
    """Steps of the fit. With 160 it follows the errors of landmarks: root-relative MPJPE of stage humans, mean of the
    four clips of `benchmarks/real_clips.py` with truth, 71.8 instead of 69.0 mm."""
    cutoff_hz: Annotated[float, limits("Hz", ge=0, le=1000)] = 6.0
    """Cutoff of the low-pass filter of the fitted motion (6 Hz is usual for gait; raise it for throws and strikes; 0:
    no filter)."""


def recover_humans(
    clip: VideoClip, tracks: PersonTracks, camera: CameraEstimate, config: HumansConfig, ctx: StageContext
) -> BodyTracks:
    """Fit the selected persons and put them into a world with +Y up and the floor under the main person's feet."""
    from video2anim.humans.body_height import expect_heights, height_of
    from video2anim.humans.lifting import lift
    from video2anim.humans.objective import FitConfig
    from video2anim.humans.observe import at_frame_times, observations
    from video2anim.humans.quality import person_quality
    from video2anim.humans.world import world_motion, world_poses

    expect_heights(config.height_m, tracks.selected_ids)
    selected = tuple(at_frame_times(track.whole(clip.frame_count), clip) for track in tracks.selected())
    observed = [observations(track, clip.frame_time_s, camera.intrinsics, camera.up_in_frames) for track in selected]
    network = ctx.model(config.model)
    lifted = [lift(one, network) for one in observed]
    heights_m = [height_of(config.height_m, track.person_id, tracks.selected_ids[0]) for track in selected]
    fits = [
        _fit(seen, raised, height_m, config, ctx)
        for seen, raised, height_m in zip(observed, lifted, heights_m, strict=True)
    ]
    T_first_camera, path_log_sigma = _in_meters(camera, fits[0], lifted[0], selected[0], clip.fps, ctx)
    T_world_camera, spread_m = world_poses(fits[0], selected[0].valid, camera.up_camera, T_first_camera, clip.fps)
    people = tuple(
        world_motion(fit, raised, track, camera, T_world_camera, clip.frame_time_s, clip.fps)
        for track, fit, raised in zip(selected, fits, lifted, strict=True)
    )
    quality = tuple(
        person_quality(track, seen, fit, motion, clip.fps, FitConfig.for_height(height_m).body_height_sigma_m)
        for track, seen, fit, motion, height_m in zip(selected, observed, fits, people, heights_m, strict=True)
    )
    _record(people[0], quality[0], spread_m, ctx)
    for motion, raised in zip(people, lifted, strict=True):
        warn_of_guesses(motion, raised, ctx)
    for motion, judged in zip(people, quality, strict=True):
        for doubt in judged.doubts:
            ctx.warn(f"person {motion.person_id} should not be trusted: {doubt}")
    return BodyTracks(people, quality, path_log_sigma)


def _fit(
    observed: Observations,
    lifted: LiftedBody,
    height_m: float | None,
    config: HumansConfig,
    ctx: StageContext,
) -> FittedBody:
    """One person's fit in the camera, low-passed."""
    from video2anim.humans.long_clip import fit_long
    from video2anim.humans.objective import FitConfig
    from video2anim.humans.smoothing import smoothed_fit

    config_of_fit = FitConfig.for_height(height_m)
    fit = fit_long(observed, lifted, config_of_fit, iterations=config.iterations, on_step=ctx.progress)
    return smoothed_fit(observed, fit, config.cutoff_hz)


def _in_meters(
    camera: CameraEstimate, fit: FittedBody, lifted: LiftedBody, track: PersonTrack, fps: float, ctx: StageContext
) -> tuple[Float[np.ndarray, "frames 4 4"], float]:
    """Path of the camera in meters, by what the main person rests on, and the standard deviation of the logarithm of
    its length."""
    from video2anim.humans.camera_scale import camera_scale_m

    T_first_camera, log_sigma = camera.T_first_camera.copy(), 0.0
    if camera.travels:
        scale_m, log_sigma = camera_scale_m(fit.joints_camera_m, lifted.contact, track.valid, T_first_camera, fps)
        T_first_camera[:, :3, 3] *= scale_m
        ctx.quality("camera_path_uncertainty", log_sigma, "ratio", "lower")
        ctx.quality("camera_path", float(np.ptp(T_first_camera[:, :3, 3], axis=0).max()), "m")
    return T_first_camera, log_sigma


def warn_of_guesses(motion: BodyMotion, lifted: LiftedBody, ctx: StageContext) -> None:
    """Say which limbs are hidden, or posed as nobody in the training motion, most of the time."""
    from video2anim.types.skeleton import JOINT_INDEX

    for limbs, joint in (("legs", "ankle"), ("arms", "wrist")):
        ends = [JOINT_INDEX[f"{side}_{joint}"] for side in ("left", "right")]
        error_m = float(np.median(lifted.error_m[motion.valid][:, ends]))
        ctx.quality(f"{limbs}_uncertainty", error_m, "m", "lower", person_id=motion.person_id)
        if error_m > _GUESSED_M:
            ctx.warn(
                f"person {motion.person_id}: the {limbs} are hidden or in an unusual pose most of the time, and their "
                f"{joint}s are expected to be {error_m:.2f} m off"
            )


def _record(motion: BodyMotion, quality: PersonQuality, spread_m: float, ctx: StageContext) -> None:
    """Quality numbers of the main person."""
    from video2anim.body.contact import LIKELY
    from video2anim.types.skeleton import FEET

    ctx.quality("reprojection", quality.reprojection_px, "px", "lower")
    ctx.quality("reprojection_over_height", 100 * quality.reprojection_ratio, "%", "lower")
    ctx.quality("valid_frames", 100 * quality.valid_share, "%", "higher")
    ctx.quality("jerk", quality.jerk_m_s3, "m/s^3", "lower")
    ctx.quality("foot_skating_gmd", quality.skating_gmd, "ratio", "lower")
    ctx.quality("bone_length_spread", 100 * quality.bone_spread, "%", "lower")
    ctx.quality("foot_contact", 100 * float((motion.contact[:, list(FEET)].max(1) > LIKELY).mean()), "%")
    ctx.quality("floor_spread", spread_m, "m", "lower")
    ctx.quality("skeleton_height", quality.body_height_m, "m")


STAGE = StageSpec("humans", recover_humans, version=28, models=("lifter",))
