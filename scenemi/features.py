"""The 201 motion features of a frame, their canonical frame and statistics (paper 3, "motion representation").

| columns | content |
|---|---|
| 0:3 | root translation, m |
| 3:9 | root orientation, 6D (first two columns of the matrix; Zhou et al. 2019) |
| 9:135 | local rotations of joints 1 to 21, 6D each |
| 135:201 | positions of the 22 joints, m |

All in the canonical frame of the window: its origin is the first frame's root dropped on the ground (y = 0 stays the
floor), +Z the first frame's facing, +Y up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from video2anim.body.shaped_body import ShapedBody
from video2anim.geometry.rotations import matrix_from_rot6d, rot6d_from_matrix
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES, forward_kinematics

WIDTHS = (3, 6, 6 * (len(JOINT_NAMES) - 1), 3 * len(JOINT_NAMES))
"""Of the blocks of the table above; all else about the layout follows."""
TRANSLATION, ROOT_ROTATION, BODY_ROTATIONS, JOINTS = (
    slice(int(stop) - width, int(stop)) for width, stop in zip(WIDTHS, np.cumsum(WIDTHS), strict=True)
)
ROTATIONS = slice(ROOT_ROTATION.start, BODY_ROTATIONS.stop)
"""Root and body 6D rotations together: 22 x 6."""
FEATURE_COUNT = sum(WIDTHS)


def _columns_along(axis: int) -> list[int]:
    """Columns that are a coordinate of a vector of the canonical frame: translation, root orientation, joints."""
    vectors = (TRANSLATION, ROOT_ROTATION, JOINTS)
    return [column for block in vectors for column in range(block.start + axis, block.stop, 3)]


LEVEL_X, LEVEL_Z = _columns_along(0), _columns_along(2)
"""Columns that turn with the heading."""
_SPANS = (
    ("pelvis", "head"), ("left_shoulder", "right_shoulder"), ("left_shoulder", "left_wrist"), ("left_hip", "right_hip"),
    ("pelvis", "left_foot"),
)  # fmt: skip
_DEPTHS = (("spine3", "left_collar", "right_collar"), ("pelvis",))
"""Parts of the skin that are measured from front to back."""
BODY_LENGTHS = len(_SPANS) + len(_DEPTHS)
MIN_STD = np.where(np.isin(np.arange(FEATURE_COUNT), np.r_[ROTATIONS]), 0.1, 0.05)
"""Columns that hardly vary in most clips (collars, say) are not blown up where they do: meters, and 6D entries (0.1 is
6 degrees)."""
_MIN_BODY_STD = 0.01
"""Meters: one body alone has no deviation."""
LYING = 0.1
"""A root that faces up or down within this (sine) also counts by where its head points."""


def canonical_frame(R_root: np.ndarray, root_m: np.ndarray) -> Float[np.ndarray, "... 4 4"]:
    """`T_world_canonical` of a root pose: origin below the root on the ground, +Z where the body faces.

    A body that faces nearly straight up or down (lying) also counts by the direction of its feet (face down: its head),
    the more so the straighter.

    Args:
        R_root: (..., 3, 3) root orientation in the world (+Y up).
        root_m: (..., 3) root position in the world.
    """
    facing, upward = R_root[..., [0, 2], 2], R_root[..., [0, 2], 1]
    lying = np.maximum(0.0, 1.0 - np.linalg.norm(facing, axis=-1, keepdims=True) / LYING)
    heading = facing - lying * np.sign(R_root[..., 1, 2, None]) * upward
    heading = heading / np.maximum(np.linalg.norm(heading, axis=-1, keepdims=True), 1e-12)
    s, c = heading[..., 0], heading[..., 1]
    T = np.zeros((*R_root.shape[:-2], 4, 4))
    T[..., 0, 0], T[..., 0, 2], T[..., 2, 0], T[..., 2, 2] = c, s, -s, c
    T[..., 1, 1] = T[..., 3, 3] = 1.0
    T[..., 0, 3], T[..., 2, 3] = root_m[..., 0], root_m[..., 2]
    return T


def to_canonical(
    R_parent_joint: Float[np.ndarray, "... frames 22 3 3"],
    translation_m: Float[np.ndarray, "... frames 3"],
    T_world_canonical: Float[np.ndarray, "... 4 4"] | None = None,
) -> tuple[Float[np.ndarray, "... frames 22 3 3"], Float[np.ndarray, "... frames 3"]]:
    """A motion of the world in a canonical frame, that of its first pose unless given; inverse of `to_world`."""
    if T_world_canonical is None:
        T_world_canonical = canonical_frame(R_parent_joint[..., 0, 0, :, :], translation_m[..., 0, :])
    R = np.swapaxes(T_world_canonical[..., None, :3, :3], -1, -2)
    local = R_parent_joint.copy()
    local[..., 0, :, :] = R @ R_parent_joint[..., 0, :, :]
    return local, (R @ (translation_m - T_world_canonical[..., None, :3, 3])[..., None])[..., 0]


def encode(
    R_parent_joint: Float[np.ndarray, "... frames 22 3 3"],
    translation_m: Float[np.ndarray, "... frames 3"],
    rest_joints_m: Float[np.ndarray, "... 22 3"],
    T_world_canonical: Float[np.ndarray, "... 4 4"] | None = None,
) -> Float[np.ndarray, "... frames 201"]:
    """Features of a motion in the world frame; the canonical frame is that of its first frame unless given.

    Args:
        R_parent_joint: local rotations, joint 0 the root in the world.
        translation_m: root translation in the world.
        rest_joints_m: T-pose joints of the body.
        T_world_canonical: frame to express the motion in.
    """
    local, moved = to_canonical(R_parent_joint, translation_m, T_world_canonical)
    joints_m, _ = forward_kinematics(local, moved, rest_joints_m[..., None, :, :])
    lead = moved.shape[:-1]
    return np.concatenate([moved, rot6d_from_matrix(local).reshape(*lead, 132), joints_m.reshape(*lead, 66)], -1)


def decode(features: Any) -> tuple[Any, Any]:
    """Local rotations (..., 22, 3, 3) and root translation (..., 3) in the canonical frame; numpy or torch.

    The joint columns are not used: rotations and translation are the motion, joints follow by forward kinematics.
    """
    rotations = features[..., ROTATIONS]
    return matrix_from_rot6d(rotations.reshape(*rotations.shape[:-1], 22, 6)), features[..., TRANSLATION]


def to_world(
    R_parent_joint: np.ndarray, translation_m: np.ndarray, T_world_canonical: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A canonical motion (..., frames, 22, 3, 3), (..., frames, 3) in the world frame."""
    R = T_world_canonical[..., None, :3, :3]
    world = R_parent_joint.copy()
    world[..., 0, :, :] = R @ R_parent_joint[..., 0, :, :]
    return world, (R @ translation_m[..., None])[..., 0] + T_world_canonical[..., None, :3, 3]


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """Mean and standard deviation of the features over the training windows, and of the body lengths."""

    mean: Float[np.ndarray, "201"]
    std: Float[np.ndarray, "201"]
    body_mean: Float[np.ndarray, "7"]
    body_std: Float[np.ndarray, "7"]

    @classmethod
    def of(cls, features: Float[np.ndarray, "frames 201"], lengths_m: Float[np.ndarray, "bodies 7"]) -> Statistics:
        """From training data only; floors keep nearly constant columns from being blown up. x and z have the same
        deviation, so that directions can be turned when normalized."""
        std, body_std = features.std(0), lengths_m.std(0)
        std[LEVEL_X] = std[LEVEL_Z] = np.sqrt((std[LEVEL_X] ** 2 + std[LEVEL_Z] ** 2) / 2)
        return cls(
            features.mean(0).astype(np.float32),
            np.maximum(std, MIN_STD).astype(np.float32),
            lengths_m.mean(0).astype(np.float32),
            np.maximum(body_std, _MIN_BODY_STD).astype(np.float32),
        )

    def normalize(self, features: Any) -> Any:
        """Features in standard deviations; numpy or torch."""
        mean, std = self._like(features)
        return (features - mean) / std

    def denormalize(self, features: Any) -> Any:
        """The inverse."""
        mean, std = self._like(features)
        return features * std + mean

    def normalize_body(self, lengths_m: np.ndarray) -> np.ndarray:
        """Body lengths (..., 7) in standard deviations."""
        return (lengths_m - self.body_mean) / self.body_std

    def _like(self, features: Any) -> tuple[Any, Any]:
        if isinstance(features, np.ndarray):
            return self.mean, self.std
        return features.new_tensor(self.mean), features.new_tensor(self.std)


def body_lengths(body: ShapedBody) -> Float[np.ndarray, "7"]:
    """The body shape b in meters (paper 7.3): root to head, shoulder to shoulder, shoulder to wrist, hip to hip, pelvis
    to foot, and the thickness of chest and hips from front to back."""
    vertices, lengths = body.rest_vertices_m, list(lengths_of_skeleton(body.rest_joints_m))
    part = body.vertex_part
    for names in _DEPTHS:
        depth = vertices[np.isin(part, [JOINT_INDEX[name] for name in names]), 2]
        lengths.append(np.ptp(depth))
    return np.array(lengths)


def lengths_of_skeleton(rest_joints_m: Float[np.ndarray, "22 3"]) -> Float[np.ndarray, "5"]:
    """The five lengths that need no skin."""
    joint = {name: rest_joints_m[index] for name, index in JOINT_INDEX.items()}
    return np.array([np.linalg.norm(joint[a] - joint[b]) for a, b in _SPANS])
