"""Skin samples for stage keyframes: of the whole body, and of the parts that may touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from video2anim.body.contact import skin_of
from video2anim.body.shaped_body import ShapedBody
from video2anim.geometry.sampling import farthest_points
from video2anim.types import BodyMotion
from video2anim.types.skeleton import TOUCHING_PARTS, forward_kinematics

TOUCHING = tuple(TOUCHING_PARTS.values())
"""Joints of the parts that may touch."""
POINTS = 500
"""Points per frame: vertices of the skin, spread by farthest-point sampling, that are tested for penetration. They are
about 6 cm apart on the body."""


@dataclass(frozen=True, slots=True, eq=False)
class SkinPoints:
    """Sampled skin of every frame, world frame."""

    spread_m: Float[np.ndarray, "frames spread 3"]
    parts_m: dict[int, Float[np.ndarray, "frames part 3"]]
    """By contact joint."""

    def touching_m(self, joints: tuple[int, ...]) -> Float[np.ndarray, "frames vertices 3"]:
        """Skin of the joints of one part."""
        return np.concatenate([self.parts_m[joint] for joint in joints], axis=1)


class SkinSample:
    """Sampled vertices of a body."""

    def __init__(self, body: ShapedBody) -> None:
        """Choose `POINTS` vertices of the whole body, and the skin of the parts that may touch."""
        self._body = body
        self._spread = farthest_points(body.rest_vertices_m, POINTS)
        self._parts = {joint: skin_of(body, (joint,)) for joints in TOUCHING for joint in joints}

    def on(self, motion: BodyMotion) -> SkinPoints:
        """The chosen vertices of a motion's every frame."""
        index = np.concatenate([self._spread, *self._parts.values()])
        root_m = motion.T_world_root[:, :3, 3]
        # Skinned at the origin, then translated: single precision is too coarse far from it.
        joints_m, R_world_joint = forward_kinematics(motion.R_parent_joint, np.zeros_like(root_m), motion.rest_joints_m)
        skin_m = self._body.vertices(R_world_joint, joints_m, index).astype(np.float64) + root_m[:, None]
        ends = np.cumsum([len(self._spread), *(len(part) for part in self._parts.values())])
        spread_m, *parts_m = np.split(skin_m, ends[:-1], axis=1)
        return SkinPoints(spread_m, dict(zip(self._parts, parts_m, strict=True)))
