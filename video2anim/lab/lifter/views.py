"""Random cameras: phones and longer lenses, portrait and landscape, low and high, near and far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from video2anim.geometry.rotations import matrix_from_axis_angle

_PHONE_FOV_DEG, _LONG_FOV_DEG = (55.0, 80.0), (20.0, 55.0)
"""Field of view along the long side: main cameras of phones (60 to 75 degrees, cropped or wider), and telephoto."""
_PHONES = 0.7
"""Share of windows with a phone's field of view."""
_ASPECTS, _ASPECT_SHARES = (9 / 16, 3 / 4, 1.0), (0.6, 0.25, 0.15)
_LOW_M, _HIGH_M, _HIGHER_M = 0.3, 2.5, 4.0
_HIGHER = 0.12
"""Share of cameras above `_HIGH_M`, up to `_HIGHER_M`."""
_SMALL, _LARGE = 0.2, 1.0
"""Range of a standing person's height as a share of the picture's height, log-uniform; large persons are cropped."""
_STANDING_M = 1.7
_NEAREST_M, _FARTHEST_M = 1.0, 14.0
_BEFORE_LENS_M = 0.6
"""Minimum distance of any joint to the lens."""
_STEEPEST_RAD = 0.9
_OFF_CENTER = 0.25
"""Standard deviation of the person's offset from the picture's center, relative to its half width and height."""
_ROLL_RAD = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Static cameras, one per window: X_camera = R X_world + t."""

    R_camera_world: Float[Tensor, "batch 3 3"]
    t_camera_m: Float[Tensor, "batch 3"]
    half: Float[Tensor, "batch 2"]
    """Half width and height of the picture at depth 1."""


def draw_views(rng: np.random.Generator, joints_world_m: Float[Tensor, "batch frames 22 3"]) -> Views:
    """A random camera in front of the body of each window; world with the floor at y = 0."""
    batch = len(joints_world_m)
    half = _pictures(rng, batch)
    center = joints_world_m[:, :, 0].mean(1).numpy()
    from_middle = joints_world_m.numpy() - center[:, None, None]
    figure = np.exp(rng.uniform(np.log(_SMALL), np.log(_LARGE), batch))
    depth = np.clip(_STANDING_M / (2 * half[:, 1] * figure), _NEAREST_M, _FARTHEST_M)
    place = np.clip(rng.normal(0, _OFF_CENTER, (batch, 2)), -0.9, 0.9) * half
    height = np.where(
        rng.random(batch) < _HIGHER, rng.uniform(_HIGH_M, _HIGHER_M, batch), rng.uniform(_LOW_M, _HIGH_M, batch)
    )
    below = np.clip(np.arctan2(height - center[:, 1], depth), -_STEEPEST_RAD, _STEEPEST_RAD)
    pitch = below - np.arctan(place[:, 1])
    zero = np.zeros(batch)
    level = np.diag([1.0, -1.0, -1.0])
    R = matrix_from_axis_angle(np.stack([pitch, zero, zero], -1)) @ level
    # A person who walks towards the camera must not pass it.
    nearest = np.einsum("ba,btja->btj", R[:, 2], from_middle).min((1, 2))
    depth = np.maximum(depth, _BEFORE_LENS_M - nearest)
    roll = matrix_from_axis_angle(np.stack([zero, zero, rng.normal(0, _ROLL_RAD, batch)], -1))
    t = np.concatenate([place, np.ones((batch, 1))], 1) * depth[:, None] - np.einsum("bac,bc->ba", R, center)
    R, t = roll @ R, np.einsum("bac,bc->ba", roll, t)
    return Views(*(torch.from_numpy(part).float() for part in (R, t, half)))


def _pictures(rng: np.random.Generator, batch: int) -> Float[np.ndarray, "batch 2"]:
    """Half widths and heights of pictures at depth 1."""
    phone = rng.random(batch) < _PHONES
    fov = np.where(phone, rng.uniform(*_PHONE_FOV_DEG, batch), rng.uniform(*_LONG_FOV_DEG, batch))
    long = np.tan(0.5 * np.deg2rad(fov))
    short = long * rng.choice(_ASPECTS, batch, p=_ASPECT_SHARES)
    portrait = rng.random(batch) < 0.5
    return np.where(portrait[:, None], np.stack([short, long], -1), np.stack([long, short], -1))
