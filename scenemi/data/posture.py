"""Any skeleton onto the 22 SMPL joints, from one frame in which it stands upright with straight legs.

The figure may hold its arms out, hanging or anywhere between: each limb is turned the shortest way into the T-pose.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from scenemi.data.rest_pose import foot_axes
from scenemi.data.retarget import carried_over
from scenemi.data.source_clip import SourceClip, SourceSkeleton
from video2anim.geometry.rotations import (
    continuous_quaternions,
    nearest_rotation,
    quaternion_from_matrix,
    rotation_between,
)
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES, PARENTS

_MAX_LEG_RAD = np.radians(30)
"""Thigh and shin of an upright rest pose from straight down (not measured)."""
_MAX_ELBOW_RAD = np.radians(45)
"""Bend of the elbows in a rest pose (not measured)."""
_SNAP_RAD = np.radians(20)
"""A trunk so near to an axis of the file counts as upright along it."""
_BONES = (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
_SPINE = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_SIDES = ("left", "right")
_HEAD_SHARE, _COLLAR_SHARE = 0.2, 0.35
"""Of the trunk for head above neck, of the way from chest to shoulder for the collar (not measured)."""


def body_axes(named_m: Float[np.ndarray, "22 3"]) -> Float[np.ndarray, "3 3"]:
    """Left, up and front (columns) of a figure that stands upright."""
    hips = named_m[[JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]]
    top = named_m[JOINT_INDEX["neck"]]
    top = named_m[JOINT_INDEX["head"]] if np.isnan(top).any() else top
    up = _unit(top - hips.mean(0))
    nearest = np.zeros(3)
    nearest[np.abs(up).argmax()] = np.sign(up[np.abs(up).argmax()])
    if np.arccos(np.clip(up @ nearest, -1, 1)) < _SNAP_RAD:
        up = nearest
    left = hips[0] - hips[1]
    left = _unit(left - (left @ up) * up)
    return np.stack([left, up, np.cross(left, up)], -1)


def posture_problem(named_m: Float[np.ndarray, "22 3"]) -> str | None:
    """Why a pose cannot serve as rest pose; None where it can. SMPL joints, NaN where the source has none."""
    bones = [named_m[JOINT_INDEX[f"{s}_{b}"]] - named_m[JOINT_INDEX[f"{s}_{a}"]] for s in _SIDES for a, b in _BONES]
    if min(float(np.linalg.norm(bone)) for bone in bones) < 1e-6:
        return "a limb has no length"
    axes = body_axes(named_m)
    left, up, front = axes.T
    for number, side in enumerate(_SIDES):
        thigh, shin, upper, fore = (_unit(bone) for bone in bones[4 * number : 4 * number + 4])
        if max(_angle(thigh, -up), _angle(shin, -up)) > _MAX_LEG_RAD:
            return f"the {side} leg does not point down"
        if _angle(upper, fore) > _MAX_ELBOW_RAD:
            return f"the {side} elbow is bent"
        if upper @ (left if side == "left" else -left) < -0.3:
            return f"the {side} arm points to the other side"
        foot = named_m[JOINT_INDEX[f"{side}_foot"]] - named_m[JOINT_INDEX[f"{side}_ankle"]]
        if foot @ front < 0.3 * np.linalg.norm(foot):
            return f"the {side} foot does not point forward (are left and right exchanged?)"
    return None


def posture_axes(
    named_m: Float[np.ndarray, "22 3"], R_world_joint: Float[np.ndarray, "joints 3 3"], skeleton: SourceSkeleton
) -> Float[np.ndarray, "22 3 3"]:
    """`R_source_body` as in `scenemi.data.rest_pose.rest_axes`, from a frame in which the figure stands upright.

    Args:
        named_m: SMPL joints in that frame.
        R_world_joint: orientations of the source's joints in that frame.
        skeleton: its table `smpl_rotation` is used.
    """
    axes = body_axes(named_m)
    left, up, _ = axes.T
    in_world = np.tile(axes, (22, 1, 1))
    for side, sign in zip(_SIDES, (1.0, -1.0), strict=True):
        for joint, child in _BONES:
            straight = -up if joint in ("hip", "knee") else sign * left
            bone = named_m[JOINT_INDEX[f"{side}_{child}"]] - named_m[JOINT_INDEX[f"{side}_{joint}"]]
            in_world[JOINT_INDEX[f"{side}_{joint}"]] = rotation_between(straight, bone) @ axes
        in_world[JOINT_INDEX[f"{side}_wrist"]] = in_world[JOINT_INDEX[f"{side}_elbow"]]
        ankle, toe = JOINT_INDEX[f"{side}_ankle"], JOINT_INDEX[f"{side}_foot"]
        in_world[ankle] = in_world[toe] = foot_axes(named_m[toe] - named_m[ankle], up)
    result = np.swapaxes(R_world_joint[skeleton.smpl_rotation], -1, -2) @ in_world
    result[skeleton.smpl_rotation < 0] = np.nan
    return result


def on_smpl_joints(clip: SourceClip, axes: Float[np.ndarray, "22 3 3"]) -> SourceClip:
    """The clip on a skeleton of the 22 SMPL joints with the source's own proportions.

    Joints that the source lacks lie between their neighbors. Where a source joint does not move rigidly with the one
    that gives its parent's orientation (spines), the mean offset is taken.
    """
    joints_m, R_source = clip.forward()
    table = clip.skeleton.smpl_position
    named_m = joints_m[:, table]
    named_m[:, table < 0] = np.nan
    _fill(named_m)
    R_world = nearest_rotation(carried_over(R_source, clip.skeleton.smpl_rotation, axes))
    parents = PARENTS[1:]
    bones = named_m[:, 1:] - named_m[:, parents]
    offsets_m = np.zeros((22, 3))
    offsets_m[1:] = np.einsum("tjba,tjb->ja", R_world[:, parents], bones) / len(bones)
    R_parent_joint = np.swapaxes(R_world[:, PARENTS], -1, -2) @ R_world
    R_parent_joint[:, 0] = R_world[:, 0]
    same = np.arange(22)
    skeleton = SourceSkeleton(f"smpl22_{clip.skeleton.name}", JOINT_NAMES, PARENTS.copy(), offsets_m, same, same.copy())
    return replace(
        clip,
        skeleton=skeleton,
        root_position_m=named_m[:, 0].copy(),
        rotation_wxyz=continuous_quaternions(quaternion_from_matrix(R_parent_joint)),
    )


def _fill(named_m: Float[np.ndarray, "frames 22 3"]) -> None:
    """Positions for the joints that the source lacks."""
    known = ~np.isnan(named_m[0, :, 0])
    pelvis, neck, head, chest = (JOINT_INDEX[name] for name in ("pelvis", "neck", "head", "spine3"))
    if not known[head]:
        named_m[:, head] = named_m[:, neck] + _HEAD_SHARE * (named_m[:, neck] - named_m[:, pelvis])
    if not known[neck]:
        named_m[:, neck] = named_m[:, head] + _HEAD_SHARE * (named_m[:, pelvis] - named_m[:, head])
    numbers = [JOINT_INDEX[name] for name in _SPINE]
    at = [i for i, joint in enumerate(numbers) if not np.isnan(named_m[0, joint, 0])]
    for i, joint in enumerate(numbers):
        if i not in at:
            low, high = max(k for k in at if k < i), min(k for k in at if k > i)
            share = (i - low) / (high - low)
            named_m[:, joint] = (1 - share) * named_m[:, numbers[low]] + share * named_m[:, numbers[high]]
    for side in _SIDES:
        collar, shoulder = JOINT_INDEX[f"{side}_collar"], JOINT_INDEX[f"{side}_shoulder"]
        if not known[collar]:
            base = 0.5 * (named_m[:, chest] + named_m[:, neck])
            named_m[:, collar] = base + _COLLAR_SHARE * (named_m[:, shoulder] - base)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arccos(np.clip(a @ b, -1.0, 1.0)))
