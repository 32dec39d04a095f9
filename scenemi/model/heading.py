"""Local frame features: directions of a motion turned into the heading of each frame.

Where in the room a person walks, and which way, does not change how; with positions and directions in the frame of a
window's first pose a network has to learn that from data. So what it reads of the interpolated keyframes is relative to
their own root and heading, and what it answers is turned back. The place in the room is given beside it.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from scenemi.features import (
    BODY_ROTATIONS,
    FEATURE_COUNT,
    JOINTS,
    LEVEL_X,
    LEVEL_Z,
    LYING,
    ROOT_ROTATION,
    TRANSLATION,
    WIDTHS,
)
from scenemi.model.kinematics import matrices
from video2anim.types.clip import FPS

VIEW = FEATURE_COUNT + WIDTHS[0] + WIDTHS[-1] + 2 + 2
"""Channels of `view`, 274: the features with the place last, speeds of root and joints, turn, heading."""


def _columns(columns: list[int], value: float = 1.0) -> Tensor:
    """1 in some columns of the features."""
    return torch.zeros(FEATURE_COUNT).index_fill(0, torch.tensor(columns), value)


_LEVEL_COLUMNS = _columns(LEVEL_X + LEVEL_Z)
_SIDE = _columns(LEVEL_Z) - _columns(LEVEL_X)
_JOINT_X, _JOINT_Z = _columns(LEVEL_X[3:]), _columns(LEVEL_Z[3:])
_PARTNER = torch.arange(FEATURE_COUNT)
_PARTNER[LEVEL_X], _PARTNER[LEVEL_Z] = torch.tensor(LEVEL_Z), torch.tensor(LEVEL_X)
"""The z of each x and the x of each z."""


def headings(raw: Float[Tensor, "batch frames 201"]) -> Float[Tensor, "batch frames 2"]:
    """Unit direction (x, z) that the root faces; of a lying body, of its feet (face down: its head)."""
    R = matrices(raw[..., ROOT_ROTATION])
    facing, upward, rise = R[..., [0, 2], 2], R[..., [0, 2], 1], R[..., 1, 2, None]
    lying = (1 - facing.norm(dim=-1, keepdim=True) / LYING).clamp(min=0)
    return functional.normalize(facing - lying * rise.sign() * upward, dim=-1, eps=1e-6)


def to_heading(values: Float[Tensor, "batch frames 201"], heading: Float[Tensor, "batch frames 2"]) -> Tensor:
    """Differences of features with their directions turned so that the heading is +z. `values` may be normalized: the
    statistics of x and z are alike."""
    hx, hz = heading[..., :1], heading[..., 1:]
    level, side = _LEVEL_COLUMNS.to(values), _SIDE.to(values)
    return values * (1 + level * (hz - 1)) + values[..., _PARTNER] * (side * hx)


def from_heading(values: Float[Tensor, "batch frames 201"], heading: Float[Tensor, "batch frames 2"]) -> Tensor:
    """Inverse of `to_heading`."""
    return to_heading(values, heading * torch.tensor([-1.0, 1.0], device=heading.device))


def view(raw: Float[Tensor, "batch frames 201"], heading: Float[Tensor, "batch frames 2"]) -> Tensor:
    """What the network reads of a motion (B, N, 274): pose relative to the root's place and heading, speeds in m/s in
    that heading, how it turns, and the place and heading in the window's frame."""
    place = raw[..., [0, 2]]
    about = to_heading(raw - place[..., :1] * _JOINT_X.to(raw) - place[..., 1:] * _JOINT_Z.to(raw), heading)
    step = functional.pad(raw[:, 1:] - raw[:, :-1], (0, 0, 1, 0))
    speed = FPS * to_heading(step, heading)
    before = torch.cat([heading[:, :1], heading[:, :-1]], 1)
    cosine = (heading * before).sum(-1, keepdim=True)
    sine = heading[..., :1] * before[..., 1:] - heading[..., 1:] * before[..., :1]
    return torch.cat(
        [
            about[..., 1:2], about[..., ROOT_ROTATION], about[..., BODY_ROTATIONS], about[..., JOINTS],
            speed[..., TRANSLATION], speed[..., JOINTS], cosine, FPS * sine, place, heading,
        ],
        -1,
    )  # fmt: skip
