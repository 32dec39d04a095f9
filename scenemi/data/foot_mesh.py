"""How low the skin of a posed foot or other part reaches: few vertices instead of the whole mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from video2anim.body.legs import Leg
from video2anim.body.shaped_body import ShapedBody


@dataclass(frozen=True, slots=True, eq=False)
class Sole:
    """Lower hull of one foot, blended between ankle and toe joint."""

    ankle_points_m: Float[np.ndarray, "points 3"]
    """Each point in the ankle's frame times its ankle weight."""
    toe_points_m: Float[np.ndarray, "points 3"]
    """Each point in the toe joint's frame times its toe weight."""
    toe_weight: Float[np.ndarray, "points"]
    toe_offset_m: Float[np.ndarray, "3"]
    """Toe joint in the ankle's frame."""
    flat_m: float
    """Height of the ankle when the sole lies flat on the floor."""

    def lowest_m(
        self, R_world_ankle: Float[np.ndarray, "frames 3 3"], R_world_toe: Float[np.ndarray, "frames 3 3"]
    ) -> Float[np.ndarray, "frames"]:
        """Height of the lowest point relative to the ankle joint (negative)."""
        toe_m = R_world_ankle[:, 1] @ self.toe_offset_m
        heights = R_world_ankle[:, 1] @ self.ankle_points_m.T + R_world_toe[:, 1] @ self.toe_points_m.T
        return (heights + toe_m[:, None] * self.toe_weight).min(axis=1)


def sole_of(body: ShapedBody, leg: Leg) -> Sole:
    """The sole of one foot of a body."""
    weights = body.skin_weights[:, [leg.ankle, leg.toe]]
    chosen = np.flatnonzero(weights.sum(1) > 0.9)
    posed = [_in_joint(body, chosen, joint) for joint in (leg.ankle, leg.toe)]
    share = weights[chosen] / weights[chosen].sum(1, keepdims=True)
    offset_m = body.rest_joints_m[leg.toe] - body.rest_joints_m[leg.ankle]
    rest = posed[0] * share[:, :1] + (posed[1] + offset_m) * share[:, 1:]
    hull = ConvexHull(rest).vertices
    hull = hull[rest[hull, 1] < rest[:, 1].min() + 0.6 * np.ptp(rest[:, 1])]
    return Sole(
        posed[0][hull] * share[hull, :1],
        posed[1][hull] * share[hull, 1:],
        share[hull, 1],
        offset_m,
        float(-rest[:, 1].min()),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PartHull:
    """Hull points of some body parts, each moved by its main joint."""

    points_m: Float[np.ndarray, "points 3"]
    joint: Float[np.ndarray, "points"]

    def lowest_m(
        self, joints_m: Float[np.ndarray, "frames 22 3"], R_world_joint: Float[np.ndarray, "frames 22 3 3"]
    ) -> Float[np.ndarray, "frames"]:
        """Height of the lowest point in the world."""
        heights = np.einsum("tpd,pd->tp", R_world_joint[:, self.joint, 1], self.points_m)
        return (heights + joints_m[:, self.joint, 1]).min(axis=1)


def hull_of(body: ShapedBody, parts: tuple[int, ...]) -> PartHull:
    """Hull points of the skin around these joints."""
    part = body.vertex_part
    points, joints = [], []
    for joint in parts:
        chosen = np.flatnonzero((part == joint) & (body.skin_weights.max(1) > 0.6))
        if len(chosen) < 8:
            continue
        local = _in_joint(body, chosen, joint)
        hull = ConvexHull(local).vertices[::3]
        points.append(local[hull])
        joints.append(np.full(len(hull), joint))
    return PartHull(np.concatenate(points), np.concatenate(joints))


def _in_joint(body: ShapedBody, chosen: np.ndarray, joint: int) -> Float[np.ndarray, "points 3"]:
    bind = body.inverse_bind[joint]
    return body.rest_vertices_m[chosen] @ bind[:3, :3].T + bind[:3, 3]
