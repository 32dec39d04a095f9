"""The body's volume as spheres carried by the joints: fast to keep clear of boxes, close to the true skin."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import JOINT_INDEX

_SKIN_SAMPLES = 1500
"""Points of the skin that are covered, some 3 cm apart."""
_SLACK_M = 0.013
"""Skin farther outside of a sphere than this is not covered by it."""
_GROWTH_M = 0.006
"""Spheres are larger by this than those that fit inside the skin."""
_MAX_RADIUS_M = 0.12
"""Half the depth of a trunk."""
_HEAD_SKIN_M = 0.02
"""The head's skin lies this near its convex hull."""
_SEED = 0


@dataclass(frozen=True, slots=True, eq=False)
class BodySpheres:
    """Spheres fixed in the T-pose frames of joints."""

    joint: Int[np.ndarray, "spheres"]
    center_joint_m: Float[np.ndarray, "spheres 3"]
    radius_m: Float[np.ndarray, "spheres"]

    def placed(
        self, joints_m: Float[np.ndarray, "frames 22 3"], R_world_joint: Float[np.ndarray, "frames 22 3 3"]
    ) -> Float[np.ndarray, "3 frames spheres"]:
        """Centers in the frame of the joints, coordinates first, float32."""
        rotation = np.asarray(R_world_joint, np.float32)[:, self.joint]
        offset = (rotation @ self.center_joint_m[:, :, None])[..., 0]
        return np.ascontiguousarray(np.moveaxis(np.asarray(joints_m, np.float32)[:, self.joint] + offset, -1, 0))


def fit_spheres(body: ShapedBody) -> BodySpheres:
    """Spheres inside the T-posed skin, each touching it twice, as few as come within 13 mm of all of it; then 6 mm
    larger.

    In captured clips of the same body 1 % of the skin lies more than 13 mm outside of all spheres, the farthest 2.6 cm
    (in front of the shoulders, where linear blending folds); bodies of other shapes differ by up to 7 cm.
    """
    skin_m, part, normal = _outer_skin(body)
    chosen = np.random.default_rng(_SEED).permutation(len(skin_m))[:_SKIN_SAMPLES]
    skin_m, part, normal = skin_m[chosen], part[chosen], normal[chosen]
    radius_m = _inscribed_radius(skin_m, normal)
    center_m = skin_m - radius_m[:, None] * normal
    gap_m = np.linalg.norm(skin_m[None] - center_m[:, None], axis=-1) - radius_m[:, None]
    covers = (gap_m <= _SLACK_M) & _kin(part)
    open_skin, kept = np.ones(len(skin_m), bool), []
    while open_skin.any():
        best = int(covers[:, open_skin].sum(1).argmax())
        kept.append(best)
        open_skin &= ~covers[best]
    joint = part[kept]
    local_m = center_m[kept] - body.rest_joints_m[joint]
    return BodySpheres(joint, local_m.astype(np.float32), (radius_m[kept] + _GROWTH_M).astype(np.float32))


@functools.lru_cache(maxsize=1)
def adult_spheres() -> BodySpheres:
    """Spheres of the middle adult."""
    return fit_spheres(shaped_body(BodyShape("anny", dict(ADULT))))


def _kin(part: Int[np.ndarray, "points"]) -> np.ndarray:
    """Whether two points belong to the same joint: a sphere covers only skin that moves with it."""
    return part[:, None] == part[None]


def _outer_skin(body: ShapedBody) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T-posed vertices on faces, the joint each follows most, and outward unit normals; eyes and mouth left out."""
    upright = np.broadcast_to(np.eye(3), (1, 22, 3, 3))
    vertices_m = body.vertices(upright, body.rest_joints_m[None])[0].astype(np.float64)
    triangles_m = vertices_m[body.faces]
    face_normal = np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])
    normal = np.zeros_like(vertices_m)
    for corner in range(3):
        np.add.at(normal, body.faces[:, corner], face_normal)
    length = np.linalg.norm(normal, axis=1)
    used = length > 0
    head = np.flatnonzero(body.vertex_part == JOINT_INDEX["head"])
    planes = ConvexHull(vertices_m[head]).equations
    used[head] &= (vertices_m[head] @ planes[:, :3].T + planes[:, 3]).max(axis=1) > -_HEAD_SKIN_M
    return vertices_m[used], body.vertex_part[used], normal[used] / length[used, None]


def _inscribed_radius(points_m: np.ndarray, normal: np.ndarray) -> Float[np.ndarray, "points"]:
    """Radius of the largest sphere that touches the skin at each point from inside and holds no other point."""
    toward = points_m[None] - points_m[:, None]
    depth = -np.einsum("pqd,pd->pq", toward, normal)
    gap2 = np.einsum("pqd,pqd->pq", toward, toward)
    radius = np.where(depth > 1e-6, gap2 / np.maximum(2 * depth, 1e-12), np.inf)
    return np.clip(radius.min(axis=1), 0.0, _MAX_RADIUS_M)
