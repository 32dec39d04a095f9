"""Forward kinematics of feature windows, fast enough for a loss: joints of one depth of the tree together."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from scenemi.features import ROTATIONS, TRANSLATION
from video2anim.types.skeleton import PARENTS


def _levels() -> tuple[tuple[list[int], list[int]], ...]:
    depth = [0]
    for parent in PARENTS[1:]:
        depth.append(depth[int(parent)] + 1)
    levels = []
    for d in range(1, max(depth) + 1):
        joints = [j for j, level in enumerate(depth) if level == d]
        levels.append((joints, [int(PARENTS[j]) for j in joints]))
    return tuple(levels)


LEVELS = _levels()
"""Joints below the root by depth, with their parents."""
_MIN_NORM = 1e-6
"""Of a 6D column, so that zeros make no NaN."""


def matrices(rot6d: Float[Tensor, "... 6"]) -> Float[Tensor, "... 3 3"]:
    """Rotations from two columns by Gram-Schmidt, finite for any input."""
    first = torch.nn.functional.normalize(rot6d[..., :3], dim=-1, eps=_MIN_NORM)
    second = rot6d[..., 3:]
    second = second - (first * second).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1, eps=_MIN_NORM)
    return torch.stack([first, second, torch.linalg.cross(first, second)], -1)


def joints_of(
    features: Float[Tensor, "batch frames 201"], rest_joints_m: Float[Tensor, "batch 22 3"]
) -> Float[Tensor, "batch frames 22 3"]:
    """Joint positions (m, canonical frame) of the rotations and translation in denormalized features."""
    R = matrices(features[..., ROTATIONS].unflatten(-1, (22, 6)))
    return posed_joints(R, features[..., TRANSLATION], rest_joints_m)


def posed_joints(
    R_parent_joint: Float[Tensor, "batch frames 22 3 3"],
    translation_m: Float[Tensor, "batch frames 3"],
    rest_joints_m: Float[Tensor, "batch 22 3"],
) -> Float[Tensor, "batch frames 22 3"]:
    """Joint positions of local rotations; the same as `skeleton.forward_kinematics`."""
    orientation: list[Tensor] = [R_parent_joint[:, :, 0]] + [torch.empty(0)] * 21
    position: list[Tensor] = [translation_m + rest_joints_m[:, None, 0]] + [torch.empty(0)] * 21
    bones = rest_joints_m[:, 1:] - rest_joints_m[:, PARENTS[1:].tolist()]
    for joints, parents in LEVELS:
        above = torch.stack([orientation[p] for p in parents], 2)
        at = torch.stack([position[p] for p in parents], 2)
        along = (above @ bones[:, None, [j - 1 for j in joints], :, None])[..., 0]
        turned = above @ R_parent_joint[:, :, joints]
        for k, j in enumerate(joints):
            position[j] = at[:, :, k] + along[:, :, k]
            orientation[j] = turned[:, :, k]
    return torch.stack(position, 2)
