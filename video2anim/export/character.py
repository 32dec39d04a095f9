"""A person ready for export: motion, skin with four influences per vertex, and rotations as smooth quaternions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from video2anim.body.anny_body import ShapedBody, shaped_body
from video2anim.body.skeleton import PARENTS
from video2anim.errors import StageError
from video2anim.geometry.rotations import continuous_quaternions, quaternion_from_matrix
from video2anim.types import BodyMotion
from video2anim.viewer.normals import vertex_normals

INFLUENCES = 4
"""Joints per vertex in the files; game engines and glTF viewers read no more."""
_REST_TOLERANCE_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Character:
    """One person's body mesh bound to the 22-joint skeleton, and its motion."""

    motion: BodyMotion
    vertices_m: Float[np.ndarray, "vertices 3"]
    """Bind pose (the body model's own, an A-pose for Anny), +Y up, facing +Z."""
    normals: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    joint_index: Int[np.ndarray, "vertices 4"]
    joint_weight: Float[np.ndarray, "vertices 4"]
    """Sum to 1 along each row."""
    inverse_bind: Float[np.ndarray, "22 4 4"]
    """Bind-pose vertices into joint frames."""

    @property
    def joint_offsets_m(self) -> Float[np.ndarray, "22 3"]:
        """Each joint in its parent's frame; row 0 is the rest position of the root."""
        rest = self.motion.rest_joints_m
        offsets = rest.copy()
        offsets[1:] -= rest[PARENTS[1:]]
        return offsets

    @property
    def root_translation_m(self) -> Float[np.ndarray, "frames 3"]:
        """Pelvis in the world."""
        return self.motion.T_world_root[:, :3, 3] + self.motion.rest_joints_m[0]

    def quaternions_wxyz(self) -> Float[np.ndarray, "frames 22 4"]:
        """Local joint rotations, neighbours in time on the same half sphere."""
        return continuous_quaternions(quaternion_from_matrix(self.motion.R_parent_joint))


def character_of(motion: BodyMotion) -> Character:
    """Bind the body model's mesh to a motion.

    Raises:
        StageError: the motion's skeleton is not that of its own shape.
    """
    body: ShapedBody = shaped_body(motion.shape)
    difference_m = float(np.abs(body.rest_joints_m - motion.rest_joints_m).max())
    if difference_m > _REST_TOLERANCE_M:
        raise StageError(
            f"rest joints of person {motion.person_id} are up to {difference_m:.3f} m from those of their "
            f"{motion.shape.model} shape; run the humans stage again"
        )
    used, faces = _referenced(np.asarray(body.faces))
    vertices_m = np.asarray(body.rest_vertices_m, np.float64)[used]
    joint_index, joint_weight = strongest_influences(np.asarray(body.skin_weights)[used])
    return Character(
        motion=motion,
        vertices_m=vertices_m,
        normals=vertex_normals(vertices_m, faces),
        faces=faces,
        joint_index=joint_index,
        joint_weight=joint_weight,
        inverse_bind=np.asarray(body.inverse_bind, np.float64),
    )


def strongest_influences(
    skin_weights: Float[np.ndarray, "vertices joints"],
) -> tuple[Int[np.ndarray, "vertices 4"], Float[np.ndarray, "vertices 4"]]:
    """The four largest weights of each vertex, scaled to sum 1; unused slots are joint 0 with weight 0."""
    index = np.argsort(-skin_weights, axis=1, kind="stable")[:, :INFLUENCES]
    weight = np.take_along_axis(skin_weights, index, axis=1)
    weight = weight / weight.sum(1, keepdims=True)
    return np.where(weight > 0, index, 0), weight


def _referenced(faces: Int[np.ndarray, "faces 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Indices of vertices in use, and the faces renumbered to them."""
    used, renumbered = np.unique(faces, return_inverse=True)
    return used, renumbered.reshape(faces.shape)
