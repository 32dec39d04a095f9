"""How each source's joint frames lie when its figure stands in the SMPL T-pose.

Rest poses of motion sources differ and often are no posture at all. Here every family of skeletons has a table of
local axes: which direction in a source joint's own frame is the body's left, up and front when the limb is in the
T-pose. Limbs take the bone from the skeleton itself and need the hinge axis of the knee or elbow only; these axes are
constant within a family (measured on the clips, spread below 1 degree; 8 degrees for Bandai's forearms).

ACCAD and MHAD are re-based on a posture of each person, so their axes are those of that posture. ACCAD's knees and
elbows are exact hinges (0.1 degree), but the axes of its people are up to 40 degrees apart: each is a family. MHAD's
people stood alike and are one (knees within 11, elbows within 17 degrees of the axes here), but their elbows are no
clean hinges: in the clips of one person the axis strays by 1 to 22 degrees (median).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scenemi.data.container import SourceSkeleton
from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_axis_angle, nearest_rotation
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES

Vector = tuple[float, float, float]
TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head", "left_collar", "right_collar")
_LIMBS = (
    ("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"),
)  # fmt: skip
"""Joint and the child its bone leads to."""


@dataclass(frozen=True, slots=True)
class Family:
    """Joint frames of one kind of skeleton, in each joint's local coordinates."""

    signature: str
    """A joint name that no other family has, or how the names of the family's skeletons begin."""
    trunk: dict[str, Float[np.ndarray, "3 3"]]
    """Local directions of the body's left, up and front (columns), for `TRUNK`; key "" is for all others."""
    knee_hinge: tuple[Vector, Vector]
    """Axis about which the left and right knee bend."""
    elbow_hinge: tuple[Vector, Vector]
    """Axis about which the left and right elbow bend forward."""
    foot_up: tuple[Vector, Vector]
    """Up in the ankle's frame while the left and right sole lies flat."""


def _columns(left: Vector, up: Vector, front: Vector) -> Float[np.ndarray, "3 3"]:
    return nearest_rotation(np.array([left, up, front], float).T)


def _turned(x: float, y: float = 0.0, z: float = 0.0) -> Float[np.ndarray, "3 3"]:
    """Frame whose joint stands turned against the body by this rotation vector, degrees."""
    return matrix_from_axis_angle(np.radians([x, y, z])).T


_SAME = np.eye(3)
"""Axes as those of our body."""
_BANDAI_SPINE = _columns((0, 0, 1), (1, 0, 0), (0, 1, 0))
_FAMILIES = (
    Family(
        "lfemur",
        {"": _SAME},
        ((0.94, 0.342, 0.0), (0.94, -0.342, 0.0)),
        ((0.0, -0.866, 0.5), (0.0, 0.866, -0.5)),
        ((-0.40, 0.915, -0.045), (0.40, 0.915, -0.045)),
    ),
    Family(
        "LeftFingerBase",
        {"": _SAME, "neck": _turned(4.0), "head": _turned(8.0)},
        ((0.94, 0.342, 0.0), (0.94, -0.342, 0.0)),
        ((0.0, -0.866, 0.5), (0.0, 0.866, -0.5)),
        ((-0.41, 0.911, -0.05), (0.41, 0.911, -0.045)),
    ),
    Family(
        "CC_Base_Hip",
        {
            "": _SAME,
            "pelvis": _turned(5.0),
            "spine1": _turned(16.0),
            "spine2": _turned(-5.5),
            "spine3": _turned(-8.0),
            "neck": _turned(-8.0, -4.0, -9.6),
            "head": _turned(10.0, -7.0, 11.0),
            "left_collar": _columns((0.027, 0.966, 0.258), (-0.998, 0.039, -0.041), (-0.05, -0.257, 0.965)),
            "right_collar": _columns((0.027, -0.966, -0.258), (0.998, 0.039, -0.041), (0.05, -0.257, 0.965)),
        },
        ((-1.0, -0.005, 0.0), (-1.0, 0.005, 0.0)),
        ((0.857, 0.03, 0.515), (0.857, -0.03, -0.515)),
        ((0.08, -0.247, 0.966), (-0.09, -0.24, 0.966)),
    ),
    Family(
        "lButtock",
        {"": _SAME},
        ((1.0, 0.0, -0.013), (1.0, 0.0, 0.013)),
        ((-0.061, -0.86, 0.506), (-0.061, 0.86, -0.506)),
        ((0.0, 0.999, 0.03), (0.0, 0.999, 0.03)),
    ),
    Family(
        "left_toe_end",
        {"": _columns((0, 0, -1), (0, 1, 0), (1, 0, 0))},
        ((0.0, 0.0, -1.0), (0.0, 0.0, -1.0)),
        ((0.0, 0.0, 1.0), (0.0, 0.0, 1.0)),
        ((-0.08, 0.996, 0.0), (-0.08, 0.996, 0.0)),
    ),
    Family(
        "UpperLeg_L",
        {
            "": _BANDAI_SPINE @ _turned(5.0),
            "spine1": _BANDAI_SPINE @ _turned(3.0),
            "pelvis": _columns((0, -1, 0), (1, 0, 0), (0, 0, 1)),
            "left_collar": _columns((0.97, 0, 0.23), (0, 1, 0), (-0.23, 0, 0.97)),
            "right_collar": _columns((0.97, 0, 0.23), (0, -1, 0), (0.23, 0, -0.97)),
        },
        ((0.0, 1.0, 0.0), (0.0, 1.0, 0.0)),
        ((0.0, -1.0, 0.0), (0.0, -1.0, 0.0)),
        ((-0.637, 0.0, 0.77), (0.637, 0.0, -0.77)),
    ),
    Family(
        "accad_female1",
        {"": _SAME},
        ((0.994, -0.003, -0.11), (0.991, 0.003, 0.135)),
        ((-0.826, -0.222, -0.518), (-0.833, 0.192, 0.52)),
        ((-0.008, 0.999, -0.033), (-0.047, 0.995, -0.092)),
    ),
    Family(
        "accad_male1",
        {"": _SAME},
        ((0.993, 0.001, -0.118), (0.997, 0.051, 0.061)),
        ((-0.978, -0.157, 0.137), (-0.978, 0.208, 0.03)),
        ((-0.01, 0.99, -0.139), (0.035, 0.999, -0.038)),
    ),
    Family(
        "accad_male2",
        {"": _SAME},
        ((0.98, 0.054, -0.19), (0.989, -0.038, 0.143)),
        ((-0.839, -0.185, -0.511), (-0.864, 0.179, 0.471)),
        ((-0.033, 0.997, -0.071), (0.017, 1.0, 0.023)),
    ),
    Family(
        "mhad_",
        {
            "": _SAME,
            "neck": _turned(-4.0),
            "head": _turned(-7.0),
            # MHAD's shoulders are raised in its T-pose, those of the body model are not.
            "left_collar": _turned(3.0, -8.0, -19.0),
            "right_collar": _turned(3.0, 8.0, 23.0),
        },
        ((0.998, 0.046, 0.028), (0.998, -0.046, -0.028)),
        ((-0.17, -0.635, 0.735), (-0.17, 0.635, -0.735)),
        ((0.0, 1.0, 0.0), (0.0, 1.0, 0.0)),
    ),
)
"""Directions of joint axes, from the files of each family at rest."""


def rest_axes(skeleton: SourceSkeleton) -> Float[np.ndarray, "22 3 3"]:
    """R_source_body of each SMPL joint's rotation source: `R_world_smpl = R_world_source @ R_source_body`.

    Its columns are the body's left, up and front in the source joint's frame when the figure stands in the T-pose.
    Joints without a rotation source are NaN. A skeleton of the 22 SMPL joints themselves needs no change.

    Raises:
        InputError: a skeleton of an unknown family.
    """
    if skeleton.names == JOINT_NAMES:
        return np.tile(_SAME, (22, 1, 1))
    family = _family(skeleton)
    axes = np.full((22, 3, 3), np.nan)
    for name in TRUNK:
        axes[JOINT_INDEX[name]] = family.trunk.get(name, family.trunk[""])
    for number, side in enumerate(("left", "right")):
        for joint, child in _LIMBS:
            is_leg = joint in ("hip", "knee")
            bone = _bone(skeleton, f"{side}_{joint}", f"{side}_{child}")
            hinge = np.array((family.knee_hinge if is_leg else family.elbow_hinge)[number])
            axes[JOINT_INDEX[f"{side}_{joint}"]] = (_leg_axes if is_leg else _ARM_AXES[side])(bone, hinge)
        axes[JOINT_INDEX[f"{side}_wrist"]] = axes[JOINT_INDEX[f"{side}_elbow"]]
        foot = _bone(skeleton, f"{side}_ankle", f"{side}_foot")
        axes[JOINT_INDEX[f"{side}_ankle"]] = foot_axes(foot, np.array(family.foot_up[number]))
    axes[skeleton.smpl_rotation < 0] = np.nan
    return axes


def foot_axes(bone: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Columns left, up, front of a foot with this local up; front is where its bone points on the ground."""
    up = _unit(up)
    front = _unit(bone - (bone @ up) * up)
    return np.stack([np.cross(up, front), up, front], -1)


def _family(skeleton: SourceSkeleton) -> Family:
    for family in _FAMILIES:
        if family.signature in skeleton.names or skeleton.name.startswith(family.signature):
            return family
    known = ", ".join(f"{family.signature!r}" for family in _FAMILIES)
    raise InputError(
        f"skeleton {skeleton.name!r}: want the 22 SMPL joints or a known family (with a joint, or named, {known}), "
        f"got {', '.join(skeleton.names[:4])}...; add its joint axes to scenemi/data/rest_pose.py"
    )


def _bone(skeleton: SourceSkeleton, joint: str, child: str) -> Float[np.ndarray, "3"]:
    """Vector from a joint to the next SMPL joint in the local frame; joints between count as straight."""
    start = int(skeleton.smpl_rotation[JOINT_INDEX[joint]])
    step = int(skeleton.smpl_position[JOINT_INDEX[child]])
    bone = np.zeros(3)
    while step != start:
        if step < 0:
            raise InputError(f"skeleton {skeleton.name!r}: {child} does not descend from {joint}; check its tables")
        bone += skeleton.offsets_m[step]
        step = int(skeleton.parents[step])
    return bone


def _unit(vector: np.ndarray) -> Float[np.ndarray, "3"]:
    return vector / np.linalg.norm(vector)


def _leg_axes(bone: np.ndarray, hinge: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """The T-pose leg points down and its knee bends about the body's left."""
    up = -_unit(bone)
    left = _unit(hinge - (hinge @ up) * up)
    return np.stack([left, up, np.cross(left, up)], -1)


def _left_arm_axes(bone: np.ndarray, hinge: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """The T-pose arm points left and its elbow bends about down."""
    left = _unit(bone)
    up = -_unit(hinge - (hinge @ left) * left)
    return np.stack([left, up, np.cross(left, up)], -1)


def _right_arm_axes(bone: np.ndarray, hinge: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """The T-pose arm points right and its elbow bends about up."""
    left = -_unit(bone)
    up = _unit(hinge - (hinge @ left) * left)
    return np.stack([left, up, np.cross(left, up)], -1)


_ARM_AXES: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "left": _left_arm_axes,
    "right": _right_arm_axes,
}
