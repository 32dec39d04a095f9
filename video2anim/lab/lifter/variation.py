"""Augmentation with poses that no clip has, so that the network relies on the landmarks where priors fail."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.lab.lifter.contacts import PARTS
from video2anim.types.clip import FPS
from video2anim.types.skeleton import JOINT_INDEX


def _both(*parts: str) -> list[int]:
    return [JOINT_INDEX[f"{side}_{part}"] for side in ("left", "right") for part in parts]


_ARMS, _LEGS = _both("collar", "shoulder", "elbow", "wrist"), _both("hip", "knee", "ankle")
_TRUNK = [JOINT_INDEX[name] for name in ("spine1", "spine2", "spine3", "neck", "head")]
_WIDE = _both("shoulder", "hip")
_HANDS, _BACK = (torch.from_numpy(PARTS[name]) for name in ("hands", "back"))
_OTHER_ARMS, _OTHER_LEGS, _OTHER_TRUNK, _SWUNG, _LEANING, _TURNED = 0.25, 0.15, 0.1, 0.35, 0.15, 0.3
"""Share of the windows with arms, legs, trunk of another window, swinging limbs, leaning body, rotated joints."""
_FROM_OTHERS = ((_OTHER_ARMS, _ARMS, ~_HANDS), (_OTHER_LEGS, _LEGS, _HANDS), (_OTHER_TRUNK, _TRUNK, ~(_HANDS | _BACK)))
"""Share of windows, joints taken from another window, contacts that stay known."""
_SWING_RAD, _SWING_HZ, _LEAN_RAD = 0.5, (0.1, 1.2), 0.2
_TURN_SHARE = 0.35
"""Share of the joints that are rotated in a window with rotated joints."""
_TURN_RAD = np.full((22, 1), 0.2)
_TURN_RAD[_WIDE] = 0.45
_TURN_RAD[_both("elbow", "knee")] = 0.1
"""Elbows and knees are hinges: a large turn would bend them the wrong way."""
_TURN_RAD[0] = 0.0


def varied(
    rng: np.random.Generator, R: Float[Tensor, "batch frames 22 3 3"], known: Bool[Tensor, "batch frames 8"]
) -> tuple[Tensor, Tensor]:
    """Augmented rotations and known contacts: arms, legs or trunk of another window, swinging limbs, leaning bodies,
    joints with a constant offset. Contacts that may have become wrong are marked as unknown."""
    batch, frames = R.shape[:2]
    R, known = R.clone(), known.clone()
    original = R.clone()
    for number, (share, joints, kept) in enumerate(_FROM_OTHERS, 1):
        chosen = _some(rng, batch, share)
        donor = (chosen + number) % batch
        R[chosen[:, None], :, torch.tensor(joints)] = original[donor[:, None], :, torch.tensor(joints)]
        known[chosen] &= kept
    swung = _some(rng, batch, _SWUNG)
    R[swung[:, None], :, torch.tensor(_WIDE)] = R[swung[:, None], :, torch.tensor(_WIDE)] @ _swings(
        rng, len(swung), frames
    )
    leaning = _some(rng, batch, _LEANING)
    lean = rng.normal(0, _LEAN_RAD, (len(leaning), 1, 3)) * [1.0, 0.0, 1.0]
    R[leaning, :, 0] = _rotations(lean) @ R[leaning, :, 0]
    turned = _some(rng, batch, _TURNED)
    offset = rng.normal(0, 1, (len(turned), 1, 22, 3)) * _TURN_RAD * (rng.random((len(turned), 1, 22, 1)) < _TURN_SHARE)
    R[turned] = R[turned] @ _rotations(offset)
    for chosen in (swung, leaning, turned):
        known[chosen] = False
    return R, known


def _some(rng: np.random.Generator, batch: int, share: float) -> Tensor:
    return torch.from_numpy(np.flatnonzero(rng.random(batch) < share))


def _rotations(vectors_rad: np.ndarray) -> Tensor:
    return torch.from_numpy(matrix_from_axis_angle(vectors_rad)).float()


def _swings(rng: np.random.Generator, batch: int, frames: int) -> Float[Tensor, "batch 4 frames 3 3"]:
    """Rotations of hips and shoulders: a constant plus a sine over the window; the identity for half of them."""
    time_s = np.arange(frames)[:, None] / FPS
    shape = (batch, len(_WIDE), 1, 1)
    steady, swinging = rng.normal(0, _SWING_RAD, (2, batch, len(_WIDE), 1, 3)) * (rng.random(shape) < 0.5)
    rate = 2 * np.pi * rng.uniform(*_SWING_HZ, shape)
    return _rotations(steady + swinging * np.sin(rate * time_s + rng.uniform(0, 2 * np.pi, shape)))
