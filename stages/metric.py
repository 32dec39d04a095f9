"""Stage metric: one scale and one offset make the clip's relative depth metric (paper 8.1).

The body is the yardstick: its visible vertices and the person's reliable depth pixels are brought together by Chamfer
distance over all sampled frames at once. For networks' depth the floor is further evidence: pixels that a segmentation
network calls floor, and the places where feet stood, must lie on it. That fixes the offset where the person stays at
one distance, which the person alone cannot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float

from video2anim.errors import StageError
from video2anim.pipeline.options import limits, model_of, only_without
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import BackgroundPlate, BodyTracks, DepthClip, Intrinsics, MetricDepth

if TYPE_CHECKING:
    from video2anim.geometry.depth_fit import DepthFit, FrameEvidence, GroundEvidence

_LARGEST_LOG_FACTOR = 0.4
"""People's depth is not moved farther than this; one of the two is wrong then."""
_FLAT = "what the person's depth tells would make the whole scene flat"
"""Reason of fits that are taken only where there is no other."""


@dataclass(frozen=True)
class MetricConfig:
    """Samples and limits of the fit."""

    frames: Annotated[int, limits(ge=1, le=10_000)] = 24
    """At most so many frames enter the fit, spread over the clip."""
    points: Annotated[int, limits(ge=1, le=1_000_000)] = 300
    """At most so many vertices and so many pixels per frame."""
    least_pixels: Annotated[int, limits(ge=1, le=1_000_000)] = 40
    """Frames with fewer reliable person pixels are left out."""
    least_frames: Annotated[int, limits(ge=1, le=10_000)] = 3
    """Fewer frames than this do not fix the scale."""
    least_range_ratio: Annotated[float, limits(ge=0, le=10)] = 0.15
    """Range of the person's depth, as a share of its median, that is needed to tell offset from scale."""
    largest_chamfer_m: Annotated[float, limits("m", ge=0, le=100)] = 0.35
    """A worse agreement than this is not trusted."""
    evidence: Literal["body", "ground", "both"] = "both"
    """What the fit rests on; depth of provider `geometric` contains the floor already and takes `body` always."""
    segment_model: Annotated[str, model_of("segment"), only_without("evidence", "body")] = "room-segment"
    """Model of slot `segment` that tells where the floor is."""
    ground_weight: Annotated[float, limits(ge=0, le=1_000_000), only_without("evidence", "body")] = 50.0
    """Weight of the floor's mean miss beside the body's, which decides where the floor leaves a choice."""
    ground_pixels: Annotated[int, limits(ge=1, le=1_000_000), only_without("evidence", "body")] = 1500
    """At most so many floor pixels."""
    least_ground_ratio: Annotated[float, limits(gt=0, le=1), only_without("evidence", "body")] = 0.02
    """Less floor than this share of the picture is no evidence."""
    largest_ground_miss_m: Annotated[float, limits("m", ge=0, le=100), only_without("evidence", "body")] = 0.3
    """Floor that stays farther than this from the floor, in the median, contradicts itself."""
    snap_ratio: Annotated[float, limits(ge=0, le=10), only_without("evidence", "body")] = 0.25
    """Recognised floor whose depth is off the floor's by less than this share is put onto it; 0 leaves all as it is."""
    farthest_ground_m: Annotated[float, limits("m", gt=0, le=10_000), only_without("evidence", "body")] = 12.0
    """Floor beyond this tells nothing of scale."""


@dataclass(frozen=True, slots=True, eq=False)
class _Floor:
    """The floor in the plate, at the working resolution."""

    evidence: GroundEvidence
    seen: Bool[np.ndarray, "small_height small_width"]
    depth_m: Float[np.ndarray, "small_height small_width"]
    """Depth of the floor's plane, seen or not."""


@dataclass(frozen=True, slots=True)
class _Verdict:
    fit: DepthFit
    trusted: bool
    reason: str
    metric: bool = True
    """False where not even the floor says how large things are."""


def fit_metric(
    depth: DepthClip, plate: BackgroundPlate, bodies: BodyTracks, config: MetricConfig, ctx: StageContext
) -> MetricDepth:
    """Metric depth of plate and samples.

    Where the person covers too small a range of depth, the offset stays 0 and only the scale is fitted; where it
    gives too little evidence, the floor plane of the body's world gives the scale and the result is not trusted. The
    reason says which.

    Raises:
        StageError: there is no body.
    """
    if not bodies.people:
        raise StageError("metric: want at least one fitted body, got none; check stage humans")
    ground = _ground(depth, plate, bodies, config, ctx)
    frames = [] if ground is not None and config.evidence == "ground" else _evidence(depth, plate, bodies, config, ctx)
    verdict = _fit_to_person(frames, depth, config, ctx) if ground is None else None
    if ground is not None:
        verdict = _fit_with_ground(frames, ground.evidence, depth, config, ctx)
        by_body = None if verdict is not None and verdict.trusted else _fit_to_person(frames, depth, config, ctx)
        if by_body is not None and (by_body.trusted or (verdict is not None and verdict.reason == _FLAT)):
            # What was taken for the floor is another surface, or the network's depth bends between the two.
            verdict, ground = by_body, None
    if verdict is None:
        verdict = _fit_to_floor(depth, bodies, len(frames))
    fit = verdict.fit
    if not verdict.trusted:
        ctx.warn(f"depth scale is not trusted: {verdict.reason}")
    if np.isfinite(fit.chamfer_before_m):
        ctx.quality("chamfer_before", fit.chamfer_before_m, "m", "lower")
        ctx.quality("chamfer_after", fit.chamfer_after_m, "m", "lower")
    ctx.quality("scale_sigma_ratio", fit.scale_sigma / fit.scale, "1", "lower")
    if np.isfinite(fit.ground_miss_m):
        ctx.quality("ground_miss", fit.ground_miss_m, "m", "lower")
    ctx.quality("frames_used", len(frames), "frames", "higher")
    ctx.quality("trusted", verdict.trusted, "1", "higher")
    metric = _apply(depth, bodies, verdict)
    if ground is None or not verdict.trusted:
        return metric
    factor = _people_factor(frames, depth.kind, fit, config)
    ctx.quality("body over people's depth", factor, "1")
    return _with_people(_on_the_floor(metric, ground, config), plate.person_mask, factor)


def _evidence(
    depth: DepthClip, plate: BackgroundPlate, bodies: BodyTracks, config: MetricConfig, ctx: StageContext
) -> list[FrameEvidence]:
    """Frames in which both the body and enough reliable person pixels are known."""
    from video2anim.body.anny_body import shaped_body
    from video2anim.body.skeleton import forward_kinematics
    from video2anim.geometry.depth_fit import FrameEvidence
    from video2anim.geometry.projection import invert_rigid, pixel_rays, transform_points
    from video2anim.geometry.visible import visible_vertices

    body = bodies.people[0]
    reliable = plate.selected_mask & depth.valid
    usable = (reliable.sum((1, 2)) >= config.least_pixels) & body.valid[depth.frame_index]
    samples = np.flatnonzero(usable)
    if not len(samples):
        return []
    samples = samples[np.unique(np.linspace(0, len(samples) - 1, config.frames).round().astype(int))]
    index = depth.frame_index[samples]
    _, R_world_joint = forward_kinematics(
        body.R_parent_joint[index], body.T_world_root[index, :3, 3], body.rest_joints_m
    )
    shaped = shaped_body(body.shape)
    vertices_world_m = shaped.vertices(R_world_joint, body.joints_world_m[index])
    rays = pixel_rays(body.intrinsics.resized(*depth.value.shape[:0:-1]))
    rng = ctx.rng("metric/points")
    frames = []
    for sample, frame, vertices in zip(samples, index, vertices_world_m, strict=True):
        vertices_camera_m = transform_points(invert_rigid(body.T_world_camera[frame]), vertices.astype(np.float64))
        seen = np.flatnonzero(visible_vertices(vertices_camera_m, shaped.faces, body.intrinsics))
        pixels = np.argwhere(reliable[sample])
        if len(seen) < config.least_pixels:
            continue
        seen = rng.permutation(seen)[: config.points]
        rows, columns = rng.permutation(pixels)[: config.points].T
        value = depth.value[sample, rows, columns].astype(np.float64)
        frames.append(FrameEvidence(vertices_camera_m[seen], rays[rows, columns], value))
    return frames


def _fit_to_person(
    frames: list[FrameEvidence], depth: DepthClip, config: MetricConfig, ctx: StageContext
) -> _Verdict | None:
    """Fit to the body; None where the evidence is too little or contradicts every positive scale."""
    from video2anim.geometry.depth_fit import NoScaleError, fit_depth
    from video2anim.geometry.flat_depth import fit_at_usual_offset, is_flat

    kind, background = depth.kind, depth.background_value
    if len(frames) < config.least_frames:
        return None
    middle = np.array([np.median(frame.body_camera_m[:, 2]) for frame in frames])
    spread = np.ptp(np.percentile(middle, [5, 95])) / np.median(middle)
    ctx.quality("person_depth_range_ratio", float(spread), "1", "higher")
    try:
        plain = fit_depth(frames, kind, with_offset=False, rng=ctx.rng("metric/scale"))
    except NoScaleError:
        return None
    fit, reason = plain, f"offset fixed at 0: the person's depth varies by {spread:.0%} only"
    if spread >= config.least_range_ratio:
        full = fit_depth(frames, kind, with_offset=True, rng=ctx.rng("metric/scale and offset"))
        fit, reason = _simpler(plain, full)
    if is_flat(fit, kind, background):
        usual = fit_at_usual_offset(frames, background, depth.provider, rng=ctx.rng("metric/usual offset"))
        if usual is None:
            return _Verdict(fit, False, _FLAT)
        fit, reason = usual, f"{_FLAT}: scale fitted to the person, the offset is the network's usual one"
    if fit.chamfer_after_m > config.largest_chamfer_m:
        problem = f"body and depth stay {fit.chamfer_after_m:.2f} m apart (limit {config.largest_chamfer_m} m)"
        return _Verdict(fit, False, f"{problem}; {reason}")
    return _Verdict(fit, True, reason)


def _ground(
    depth: DepthClip, plate: BackgroundPlate, bodies: BodyTracks, config: MetricConfig, ctx: StageContext
) -> _Floor | None:
    """Floor pixels of the plate near enough to tell, and what stood on them; None where there are too few."""
    import cv2

    from video2anim.geometry.depth_fit import GroundEvidence, evenly_far
    from video2anim.geometry.projection import pixel_rays
    from video2anim.models.segmentation import CLASSES

    if depth.provider == "geometric" or config.evidence == "body":
        return None
    body = bodies.people[0]
    T_world_camera = body.T_world_camera[0]
    height, width = depth.background_value.shape
    intrinsics = body.intrinsics.resized(width, height)
    ray_up = pixel_rays(intrinsics) @ T_world_camera[1, :3]
    reach_m = T_world_camera[1, 3] / np.maximum(-ray_up, 1e-6)
    if T_world_camera[1, 3] <= 0.05:
        return None
    semantic = ctx.model(config.segment_model).segment(plate.plate_rgb).semantic
    named = (semantic == CLASSES.index("floor")).astype(np.uint8)
    named = cv2.resize(named, (width, height), interpolation=cv2.INTER_NEAREST)
    sure = (cv2.erode(named, np.ones((5, 5), np.uint8)) > 0) | _stood_on(bodies, intrinsics)
    near = depth.background_valid & (ray_up < -0.02) & (reach_m < config.farthest_ground_m)
    chosen = near & sure
    ctx.quality("floor_seen_ratio", float(chosen.mean()), "1", "higher")
    if chosen.mean() < config.least_ground_ratio:
        return None
    pixels = evenly_far(np.flatnonzero(chosen), reach_m.reshape(-1), config.ground_pixels)
    value = depth.background_value.reshape(-1)[pixels].astype(np.float64)
    evidence = GroundEvidence(ray_up.reshape(-1)[pixels], value, float(T_world_camera[1, 3]), config.ground_weight)
    return _Floor(evidence, near & (named > 0), reach_m)


def _stood_on(bodies: BodyTracks, intrinsics: Intrinsics) -> Bool[np.ndarray, "small_height small_width"]:
    """Plate pixels where somebody's foot stood."""
    import cv2

    from video2anim.geometry.figure_depth import standing_feet
    from video2anim.geometry.projection import invert_rigid, project, transform_points

    there = np.zeros((intrinsics.height_px, intrinsics.width_px), np.uint8)
    for body in bodies.people:
        feet, on = standing_feet(body, 0.5)
        camera_m = transform_points(invert_rigid(body.T_world_camera[0]), feet[on] * np.array([1.0, 0.0, 1.0]))
        for x, y in project(camera_m[camera_m[:, 2] > 0.1], intrinsics):
            if 0 <= x < intrinsics.width_px and 0 <= y < intrinsics.height_px:
                cv2.circle(there, (round(float(x)), round(float(y))), 2, 1, -1)
    return there > 0


def _fit_with_ground(
    frames: list[FrameEvidence], ground: GroundEvidence, depth: DepthClip, config: MetricConfig, ctx: StageContext
) -> _Verdict | None:
    """Fit to the floor and, given enough frames, the body; None where they contradict every positive scale. Where a
    floor that decides gives what cannot be trusted, floor and body are tried as equals."""
    verdict = _fit_as_weighed(frames, ground, depth, config, ctx)
    if verdict is None or verdict.trusted or ground.weight <= 1:
        return verdict
    equal = _fit_as_weighed(frames, replace(ground, weight=1.0), depth, config, ctx)
    return equal if equal is not None and equal.trusted else verdict


def _fit_as_weighed(
    frames: list[FrameEvidence], ground: GroundEvidence, depth: DepthClip, config: MetricConfig, ctx: StageContext
) -> _Verdict | None:
    from video2anim.geometry.depth_fit import NoScaleError, fit_depth, mean_chamfer_m
    from video2anim.geometry.flat_depth import is_flat

    kind = depth.kind
    frames = frames if len(frames) >= config.least_frames else []
    try:
        fit = fit_depth(frames, kind, with_offset=True, rng=ctx.rng("metric/with ground"), ground=ground)
    except NoScaleError:
        return None
    if is_flat(fit, kind, depth.background_value):
        return _Verdict(fit, False, _FLAT)
    if fit.ground_miss_m > config.largest_ground_miss_m:
        problem = (
            f"the floor's depth stays {fit.ground_miss_m:.2f} m off the floor (limit {config.largest_ground_miss_m} m)"
        )
        return _Verdict(fit, False, problem)
    if frames:
        factor = _people_factor(frames, kind, fit, config)
        factor = factor if kind == "depth" else 1 / factor
        fit = replace(fit, chamfer_after_m=mean_chamfer_m(frames, kind, factor * fit.scale, factor * fit.offset))
    if frames and fit.chamfer_after_m > config.largest_chamfer_m:
        problem = f"body and depth stay {fit.chamfer_after_m:.2f} m apart (limit {config.largest_chamfer_m} m)"
        return _Verdict(fit, False, problem)
    on = "person and floor" if frames else "floor; the person's depth is reliable in too few frames"
    return _Verdict(fit, True, f"scale and offset fitted to the {on}")


def _simpler(plain: DepthFit, full: DepthFit) -> tuple[DepthFit, str]:
    """The offset is kept only where it is sure and improves the fit."""
    sure = abs(full.offset) > 2 * full.offset_sigma
    if sure and full.chamfer_after_m < 0.99 * plain.chamfer_after_m:
        return full, "scale and offset fitted to the person"
    return plain, "scale fitted to the person; the offset is 0 within its uncertainty"


def _fit_to_floor(depth: DepthClip, bodies: BodyTracks, frames: int) -> _Verdict:
    """Scale that puts the lower half of the plate onto the floor y = 0 at best: a fallback that is never trusted."""
    from video2anim.geometry.depth_fit import DepthFit
    from video2anim.geometry.projection import pixel_rays

    body = bodies.people[0]
    T_world_camera = body.T_world_camera[0]
    height, width = depth.background_value.shape
    ray_up = pixel_rays(body.intrinsics.resized(width, height)) @ T_world_camera[1, :3]
    floor_m = T_world_camera[1, 3] / np.maximum(-ray_up, 1e-6)
    low = depth.background_valid & (ray_up < -0.05) & (np.arange(height)[:, None] > 0.7 * height) & (floor_m < 30)
    value = depth.background_value[low].astype(np.float64)
    ratio = floor_m[low] / value if depth.kind == "depth" else 1.0 / np.maximum(floor_m[low] * value, 1e-9)
    ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
    why = f"the person is seen standing with reliable depth in {frames} sampled frames only"
    if T_world_camera[1, 3] <= 0.05 or ratio.size < 50:
        reason = f"{why}, and the floor is not in the picture: no depth is metric"
        return _Verdict(DepthFit(1.0, 0.0, 1.0, 1.0, np.nan, np.nan), False, reason, metric=False)
    low_scale, scale, high_scale = np.percentile(ratio, [16, 50, 84])
    sigma = float(max(high_scale - low_scale, 0.1 * scale))
    fit = DepthFit(float(scale), 0.0, sigma, 0.0, np.nan, np.nan)
    return _Verdict(fit, False, f"{why}; the scale is that of the floor below the camera")


def _apply(depth: DepthClip, bodies: BodyTracks, verdict: _Verdict) -> MetricDepth:
    fit = verdict.fit
    background_m, background_valid = _finite_depth(depth, depth.background_value, depth.background_valid, fit)
    depth_m = np.empty(depth.value.shape, dtype=np.float32)
    valid = np.empty(depth.value.shape, dtype=bool)
    for sample in range(len(depth.value)):
        depth_m[sample], valid[sample] = _finite_depth(depth, depth.value[sample], depth.valid[sample], fit)
    return MetricDepth(
        scale=fit.scale,
        offset_m=fit.offset,
        scale_sigma=fit.scale_sigma,
        offset_sigma=fit.offset_sigma,
        chamfer_before_m=_if_measured(fit.chamfer_before_m),
        chamfer_after_m=_if_measured(fit.chamfer_after_m),
        trusted=verdict.trusted,
        reason=verdict.reason,
        frame_index=depth.frame_index,
        depth_m=depth_m,
        valid=valid & verdict.metric,
        background_depth_m=background_m,
        background_valid=background_valid & verdict.metric,
        T_world_camera=bodies.people[0].T_world_camera,
    )


def _on_the_floor(metric: MetricDepth, floor: _Floor, config: MetricConfig) -> MetricDepth:
    """Recognised floor that lies near the floor is put onto it: its plane is known better than any network's depth."""
    off = np.abs(metric.background_depth_m / floor.depth_m - 1)
    snapped = floor.seen & (off < config.snap_ratio)
    background_m = np.where(snapped, floor.depth_m, metric.background_depth_m).astype(np.float32)
    depth_m = metric.depth_m.copy()
    for own in depth_m:
        # A still camera's frames have the plate's depth where nobody stands; those of a moving one are left alone.
        same = snapped & (own == metric.background_depth_m)
        own[same] = background_m[same]
    return replace(metric, background_depth_m=background_m, depth_m=depth_m)


def _people_factor(frames: list[FrameEvidence], kind: str, fit: DepthFit, config: MetricConfig) -> float:
    """What people's depth is to be multiplied by for the main person to be where their body is: a network sees people
    nearer or farther than the floor they stand on, and the floor has most say in scale and offset."""
    from video2anim.geometry.depth_fit import metric_depth

    if len(frames) < config.least_frames:
        return 1.0
    seen_m = [np.nanmedian(metric_depth(kind, frame.value, fit.scale, fit.offset)) for frame in frames]
    body_m = [np.median(frame.body_camera_m[:, 2]) for frame in frames]
    factor = float(np.nanmedian(np.array(body_m) / np.array(seen_m)))
    return factor if abs(np.log(factor)) < _LARGEST_LOG_FACTOR else 1.0


def _with_people(
    metric: MetricDepth, people: Bool[np.ndarray, "samples small_height small_width"], factor: float
) -> MetricDepth:
    """People, by the masks of the plate's frames, at their bodies' distance; all else is left."""
    return replace(metric, depth_m=np.where(people, factor * metric.depth_m, metric.depth_m).astype(np.float32))


def _finite_depth(
    depth: DepthClip, value: np.ndarray, valid: np.ndarray, fit: DepthFit
) -> tuple[Float[np.ndarray, "small_height small_width"], np.ndarray]:
    """Metres, with pixels that the fit sends nowhere marked invalid and held at the farthest sensible depth."""
    from video2anim.geometry.depth_fit import metric_depth

    depth_m = metric_depth(depth.kind, value, fit.scale, fit.offset)
    sane = np.isfinite(depth_m)
    return np.where(sane, depth_m, 1e3).astype(np.float32), valid & sane


def _if_measured(value_m: float) -> float | None:
    return float(value_m) if np.isfinite(value_m) else None


STAGE = StageSpec("metric", fit_metric, version=10, models=("segment",))
