"""Stage metric: one fit of the floor, body heights, depth's scale and offset, and objects' distances (supplement 8.1,
`video2anim.calibration`): the relative depth of the clip becomes metric, and everybody gets their size and place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from video2anim.pipeline.options import limits
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BackgroundImage,
    BodyTracks,
    CameraEstimate,
    DepthClip,
    InstanceMasks,
    MetricDepth,
    VideoClip,
)

if TYPE_CHECKING:
    from video2anim.calibration.evidence import Evidence
    from video2anim.calibration.fit import Calibration

_UNSURE_PATH = 0.3
"""Standard deviation of the length of a camera's path above which a warning says so."""


@dataclass(frozen=True)
class MetricConfig:
    """When the result of the fit is not trusted."""

    conflict_sigmas: Annotated[float, limits(gt=0, le=1000)] = 3.0
    """Evidence that is off by more than so many standard deviations (root mean square) contradicts the rest. The scale
    of depth is not trusted if 0 is within so many standard deviations of it."""


def fit_metric(
    clip: VideoClip,
    depth: DepthClip,
    background: BackgroundImage,
    camera: CameraEstimate,
    bodies: BodyTracks,
    masks: InstanceMasks,
    config: MetricConfig,
    ctx: StageContext,
) -> MetricDepth:
    """Metric depth of background image and samples, and the calibrated people with their camera.

    Where neither floor nor person shows reliable depth, no depth is valid: only the sizes of people are known then.

    Raises:
        StageError: there is no body, or none in any frame.
    """
    from video2anim.calibration.fit import calibrate
    from video2anim.calibration.gather import picture_evidence, with_objects, with_points
    from video2anim.calibration.metric import applied
    from video2anim.geometry.masks import shrunk
    from video2anim.humans.ground import LEVEL_GAP_M

    floor = shrunk(masks.floor_mask, depth.background_value.shape)
    evidence = with_objects(
        picture_evidence(depth, background, bodies, floor, clip.fps, ctx.rng("metric/points")),
        depth, bodies.main, masks,
    )  # fmt: skip
    evidence = with_points(evidence, depth, camera, bodies.main, masks)
    found = calibrate(evidence)
    problem = _problem(evidence, found, config)
    if problem:
        ctx.warn(f"depth scale is not trusted: {problem}")
    if found.path_log_sigma > _UNSURE_PATH:
        ctx.warn(
            f"the camera travels, and the length of its path is known to {found.path_log_sigma:.0%} only, since "
            "neither the ground nor what the main person rests on tells it: the paths of people have this error"
        )
    conflicts = [
        kind
        for kind, off in found.residuals.items()
        if off > config.conflict_sigmas and kind != "support on other levels"
    ]
    if conflicts:
        ctx.warn(f"evidence that contradicts the rest and has little weight: {', '.join(conflicts)}")
    for body, above_m in zip(bodies.people[1:], found.above_floor_m[1:], strict=True):
        if abs(above_m) > LEVEL_GAP_M:
            ctx.warn(f"person {body.person_id} stands {above_m:+.2f} m from the floor: a child, or on other ground")
    _record(found, ctx)
    return applied(depth, background, masks, bodies, evidence, found, problem)


def _problem(evidence: Evidence, found: Calibration, config: MetricConfig) -> str:
    """Why the scale of depth is not trusted; empty if it is."""
    if not evidence.skin and not len(evidence.floor.value):
        return "neither the person nor floor has valid depth: no depth is metric"
    if found.scale_log_sigma * config.conflict_sigmas > 1:
        return f"it is known to {found.scale_log_sigma:.0%} only (limit {1 / config.conflict_sigmas:.0%})"
    return ""


def _record(found: Calibration, ctx: StageContext) -> None:
    if np.isfinite(found.chamfer_after_m):
        ctx.quality("chamfer_before", found.chamfer_before_m, "m", "lower")
        ctx.quality("chamfer_after", found.chamfer_after_m, "m", "lower")
    ctx.quality("scale_sigma_ratio", found.scale_log_sigma, "ratio", "lower")
    ctx.quality("camera_height", found.camera_height_m, "m")
    ctx.quality("camera_height_uncertainty", found.camera_height_sigma_m, "m", "lower")
    ctx.quality("size_over_that_of_stage_humans", float(found.body_height_ratio[0]), "ratio")
    ctx.quality("size_uncertainty", float(found.body_height_log_sigma[0]), "ratio", "lower")
    if found.path_log_sigma:
        ctx.quality("camera_path_over_that_of_stage_humans", found.path_ratio, "ratio")
        ctx.quality("camera_path_uncertainty", found.path_log_sigma, "ratio", "lower")
    ctx.quality("person_over_their_depth", float(np.exp(found.person_depth_log)), "ratio")
    for kind, off in found.residuals.items():
        ctx.quality("residual_" + kind.replace("'", "").replace(" ", "_"), off, "ratio", "lower")


STAGE = StageSpec("metric", fit_metric, version=24)
