"""A person ready for export: motion, skin with four influences per vertex, bones along the limbs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from video2anim.body.anny_body import shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import StageError
from video2anim.geometry.rotations import continuous_quaternions, quaternion_from_matrix
from video2anim.geometry.vertex_normals import vertex_normals
from video2anim.types import BodyMotion
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES, PARENTS

INFLUENCES = 4
"""Joints per vertex in the files; game engines and glTF viewers read no more."""
_REST_TOLERANCE_M = 1e-3
"""Joints of a shape that differ by more are of another one: files hold them in single precision."""


_MAIN_CHILD = {"pelvis": "spine1", "spine3": "neck"}
"""Child that the frame of a joint with several children points to."""
_FORWARD, _UP = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
_POINTS_FORWARD = 0.7
"""Cosine to the forward axis above which a bone (the foot) takes the up axis as reference of its frame instead."""


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """The 22-joint skeleton in frames of its own, one for each bone: y along the limb.

    Joints are where they are in the motion; only the axes differ from its own, which are parallel to the body in the
    T-pose.
    """

    offsets_m: Float[np.ndarray, "22 3"]
    """Each joint in its parent's frame in the T-pose; row 0 is the rest position of the root."""
    rest_wxyz: Float[np.ndarray, "22 4"]
    """Frames in that of the parent in the T-pose."""
    inverse_bind: Float[np.ndarray, "22 4 4"]
    """Bind-pose vertices into the frames."""
    rotations_wxyz: Float[np.ndarray, "frames 22 4"]
    """Frames in that of the parent; neighbors in time on the same half sphere."""


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

    @property
    def tips_m(self) -> Float[np.ndarray, "22 3"]:
        """Far end of the mesh that each joint moves, from the joint towards the middle of that mesh, in joint frames.

        0 for joints without mesh of their own.
        """
        strongest = self.joint_index[:, 0]
        tips_m = np.zeros((len(PARENTS), 3))
        for joint in np.unique(strongest):
            T_joint_bind = self.inverse_bind[joint]
            points_m = self.vertices_m[strongest == joint] @ T_joint_bind[:3, :3].T + T_joint_bind[:3, 3]
            center = 0.5 * (points_m.min(0) + points_m.max(0))
            direction = center / np.linalg.norm(center)
            tips_m[joint] = direction * float((points_m @ direction).max())
        return tips_m

    def rig(self) -> Rig:
        """The skeleton with frames along the limbs, as programs that draw bones expect it."""
        R_joint_bone = self._bone_frames()
        R_parent_bone = R_joint_bone.copy()
        offsets_m = self.joint_offsets_m.copy()
        R_local = self.motion.R_parent_joint @ R_joint_bone
        for joint, parent in enumerate(PARENTS.tolist()):
            if parent >= 0:
                R_bone_parent = R_joint_bone[parent].T
                R_parent_bone[joint] = R_bone_parent @ R_joint_bone[joint]
                offsets_m[joint] = R_bone_parent @ offsets_m[joint]
                R_local[:, joint] = R_bone_parent @ R_local[:, joint]
        T_bone_joint = np.tile(np.eye(4), (len(PARENTS), 1, 1))
        T_bone_joint[:, :3, :3] = R_joint_bone.swapaxes(1, 2)
        return Rig(
            offsets_m=offsets_m,
            rest_wxyz=quaternion_from_matrix(R_parent_bone),
            inverse_bind=T_bone_joint @ self.inverse_bind,
            rotations_wxyz=continuous_quaternions(quaternion_from_matrix(R_local)),
        )

    def _bone_frames(self) -> Float[np.ndarray, "22 3 3"]:
        """R_joint_bone: y from the joint to where its limb goes on, or to the tip of its mesh; x, the axis that knees
        and elbows bend about, at right angles to the body's forward axis, or to up where the limb points forward."""
        rest_m, tips_m = self.motion.rest_joints_m, self.tips_m
        frames = np.empty((len(PARENTS), 3, 3))
        for joint, name in enumerate(JOINT_NAMES):
            children = np.flatnonzero(joint == PARENTS).tolist()
            if children:
                onward = JOINT_INDEX[_MAIN_CHILD[name]] if len(children) > 1 else children[0]
                along = rest_m[onward] - rest_m[joint]
            elif tips_m[joint].any():
                along = tips_m[joint]
            else:
                along = rest_m[joint] - rest_m[PARENTS[joint]]
            y = along / np.linalg.norm(along)
            x = np.cross(y, _UP if abs(y @ _FORWARD) > _POINTS_FORWARD else _FORWARD)
            x /= np.linalg.norm(x)
            frames[joint] = np.stack([x, y, np.cross(x, y)], -1)
        return frames


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
