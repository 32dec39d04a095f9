"""Depth in meters by the result of the fit."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from video2anim.calibration.bodies import calibrated
from video2anim.calibration.evidence import Evidence
from video2anim.calibration.fit import Calibration
from video2anim.calibration.line import metric_depth
from video2anim.geometry.masks import shrunk
from video2anim.types import BackgroundImage, BodyTracks, DepthClip, InstanceMasks, MetricDepth


def applied(
    depth: DepthClip,
    background: BackgroundImage,
    masks: InstanceMasks,
    bodies: BodyTracks,
    evidence: Evidence,
    found: Calibration,
    problem: str,
) -> MetricDepth:
    """Depth of background image and samples in meters, each object and the people at their own distance, and the
    calibrated people.

    No depth is valid where the fit had neither floor pixels nor the main person's skin.

    Args:
        problem: Why the scale of depth is unreliable; empty if it is not.
    """
    measured = bool(evidence.skin) or len(evidence.floor.value) > 0
    shape = depth.background_value.shape
    factor = np.ones(shape)
    for instance, log in zip(masks.instances, found.object_depth_log, strict=True):
        factor[shrunk(instance.mask, shape)] = np.exp(log)
    background_m, background_valid = _meters(depth.kind, depth.background_value, depth.background_valid, found)
    depth_m, valid = _meters(depth.kind, depth.value, depth.valid, found)
    people = background.of_frames(depth.frame_index).person_mask
    own = np.where(people, np.exp(found.person_depth_log), factor)
    sigmas = zip(masks.instances, found.object_depth_log_sigma, strict=True)
    return MetricDepth(
        scale=found.scale,
        offset_m=found.offset,
        scale_sigma=found.scale * found.scale_log_sigma,
        offset_sigma=found.offset_sigma,
        chamfer_before_m=_if_measured(found.chamfer_before_m),
        chamfer_after_m=_if_measured(found.chamfer_after_m),
        trusted=not problem,
        reason=problem or "fitted together with camera, floor and people",
        frame_index=depth.frame_index,
        depth_m=(own * depth_m).astype(np.float32),
        valid=valid & measured,
        background_depth_m=(factor * background_m).astype(np.float32),
        background_valid=background_valid & measured,
        object_sigma={str(one.object_id): float(sigma) for one, sigma in sigmas},
        bodies=calibrated(bodies, found),
    )


def _meters(
    kind: str, value: Float[np.ndarray, "..."], valid: Bool[np.ndarray, "..."], found: Calibration
) -> tuple[Float[np.ndarray, "..."], Bool[np.ndarray, "..."]]:
    """Depth and where it is known; elsewhere it is 1 km."""
    depth_m = metric_depth(kind, value, found.scale, found.offset)
    known = np.isfinite(depth_m)
    return np.where(known, depth_m, 1e3), valid & known


def _if_measured(value_m: float) -> float | None:
    return float(value_m) if np.isfinite(value_m) else None
