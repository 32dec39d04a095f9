"""A body of one shape, independent of the body model, ready to be posed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from video2anim.types.motion import BodyShape

CHUNK_FRAMES = 30
"""Frames skinned at once: 10 MB per person; more are not faster."""


@dataclass(frozen=True, slots=True, eq=False)
class ShapedBody:
    """A body of one shape, ready to be posed. Rest mesh +Y up, facing +Z, pelvis at the origin.

    Anny's rest mesh is in the A-pose, that of the SMPL family in the T-pose.
    """

    shape: BodyShape
    rest_vertices_m: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    skin_weights: Float[np.ndarray, "vertices 22"]
    inverse_bind: Float[np.ndarray, "22 4 4"]
    """Transforms from the rest mesh to the T-pose frame of each joint."""
    rest_joints_m: Float[np.ndarray, "22 3"]

    @property
    def height_m(self) -> float:
        """Height of the rest mesh, sole to crown."""
        return float(np.ptp(self.rest_vertices_m[:, 1]))

    @property
    def vertex_part(self) -> Int[np.ndarray, "vertices"]:
        """Joint with the largest weight for each vertex."""
        return self.skin_weights.argmax(1)

    def vertices(
        self,
        R_world_joint: Float[np.ndarray, "frames 22 3 3"],
        joints_m: Float[np.ndarray, "frames 22 3"],
        index: Int[np.ndarray, "chosen"] | None = None,
    ) -> Float[np.ndarray, "frames chosen 3"]:
        """Vertices (all, or those of `index`) by linear blend skinning, in the frame of the joints, meters."""
        weights = self.skin_weights if index is None else self.skin_weights[index]
        rest = self.rest_vertices_m if index is None else self.rest_vertices_m[index]
        rotation = R_world_joint @ self.inverse_bind[:, :3, :3]
        shift = (R_world_joint @ self.inverse_bind[:, :3, 3, None])[..., 0] + joints_m
        transforms = np.concatenate([rotation, shift[..., None]], -1).astype(np.float32)
        rest_h = np.concatenate([rest, np.ones((len(rest), 1))], 1).astype(np.float32)
        out = np.empty((len(transforms), len(rest), 3), np.float32)
        weights32 = weights.astype(np.float32)
        for t, transform in enumerate(transforms):
            blended = (weights32 @ transform.reshape(22, 12)).reshape(-1, 3, 4)
            out[t] = np.einsum("vij,vj->vi", blended, rest_h)
        return out
