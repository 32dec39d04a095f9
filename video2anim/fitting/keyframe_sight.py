"""The line of sight to a root, and how far the picture lets the root go across it: part of the keyframes stage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from video2anim.types import BodyMotion


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Where the camera sees one person's roots, world frame.

    A root displaced along its line of sight stays at its pixel, and the picture can say nothing against it. Displaced
    across, it leaves that pixel, where the person was seen: to a few percent of the body's height, whatever the scene
    says. Scenes from one camera are often wrong about what they did not see (a hull that closes over a bed and everyone
    who jumps on it), and as no weight of the other losses is small against a body deep in a wrong solid, the limit is
    none of the losses: displacements are put back onto it after every step. Below it the quadratic cost of a
    displacement across the sight rules, so a problem that stays below is solved as if there were no limit.
    """

    direction: Float[np.ndarray, "keyframes 3"]
    """Unit vector from the camera to the root."""
    limit_m: Float[np.ndarray, "keyframes"]
    """Longest displacement across it."""


def sight_of(
    motion: BodyMotion,
    frames: np.ndarray,
    *,
    stature_m: float,
    limit_ratio: float,
    reprojection_px: float,
) -> Sight:
    """Lines of sight to the roots at some frames.

    The limit is `limit_ratio` of the height that the body has in the picture when it stands at the root's depth, plus
    the error that its landmarks have there, both carried from pixels to meters by depth / focal length.

    Args:
        stature_m: height of the standing body; at depth z it is f * stature / z pixels high.
        reprojection_px: 2D error of the fit (median over landmarks); 0 where it is not known.
    """
    offset_m = motion.T_world_root[frames, :3, 3] - motion.T_world_camera[frames, :3, 3]
    depth_m = np.maximum(np.einsum("kd,kd->k", offset_m, motion.T_world_camera[frames, :3, 2]), 0.0)
    pixels_per_m = 0.5 * (motion.intrinsics.fx_px + motion.intrinsics.fy_px) / np.maximum(depth_m, 1e-6)
    limit_px = limit_ratio * stature_m * pixels_per_m + reprojection_px
    distance_m = np.linalg.norm(offset_m, axis=-1, keepdims=True)
    return Sight(offset_m / np.maximum(distance_m, 1e-6), limit_px / pixels_per_m)


def split_by_sight(displacement_m: Any, direction: Any) -> tuple[Any, Any]:
    """Signed length along (..., 1) and vector across (..., 3) unit directions (..., 3). numpy or torch."""
    along_m = (displacement_m * direction).sum(-1)[..., None]
    return along_m, displacement_m - along_m * direction


def across_sight_m(
    displacement_m: Float[np.ndarray, "keyframes 3"], direction: Float[np.ndarray, "keyframes 3"]
) -> Float[np.ndarray, "keyframes"]:
    """Length of displacements across the sight."""
    return np.linalg.norm(split_by_sight(displacement_m, direction)[1], axis=-1)
