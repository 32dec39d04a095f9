"""Settle a motion's root: standing feet stand, and what is a little inside a solid comes out.

Centimetres of displacement per frame, smooth in time, found by least squares. The pose is not touched, so one frame's
skin moves as one piece.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import spsolve

from video2anim.body.skeleton import FEET
from video2anim.geometry.sdf import SdfGrid

_FRAMES_AT_ONCE = 256
"""Skin of so many frames is looked up at a time, bounding memory."""


@dataclass(frozen=True, slots=True)
class SettleConfig:
    """What counts how much: standard deviations of a least-squares problem."""

    sigma_m: float = 0.05
    """How far a frame's root may be off."""
    acceleration_m_s2: float = 2.0
    """How fast that may change."""
    foot_speed_m_s: float = 0.1
    """Speed of joints of standing feet."""
    odd_speed_m_s: float = 1.0
    """A foot as fast as this does not stand, whatever its contact says; a slower one counts the more, the slower."""
    contact_threshold: float = 0.5
    depth_sigma_m: float = 0.003
    """Depth of skin in solids beyond `free_depth_m`."""
    free_depth_m: float = 0.002
    odd_depth_m: float = 0.12
    """Skin as deep as this is not moved out: pose or solid are wrong there, not the root."""
    deepest_vertices: int = 12
    """Of each frame, so many of the deepest count."""
    iterations: int = 8


def settling_shift(
    joints_m: Float[np.ndarray, "frames 22 3"],
    contact: Float[np.ndarray, "frames 22"],
    fps: float,
    *,
    skin_m: Float[np.ndarray, "frames vertices 3"] | None = None,
    grid: SdfGrid | None = None,
    begun_m: Float[np.ndarray, "some_frames 3"] | None = None,
    config: SettleConfig | None = None,
) -> Float[np.ndarray, "frames 3"]:
    """Displacement of every frame's root, world frame, metres.

    Args:
        joints_m: world frame.
        contact: probabilities; feet only are looked at.
        fps: frames per second.
        skin_m: vertices in the world; with `grid`, solids count.
        grid: signed distance to the solids.
        begun_m: displacement that the first frames have already, and keep; what follows goes on from there.
        config: weights.
    """
    config = config or SettleConfig()
    frames = len(joints_m)
    shift_m = np.zeros((frames, 3))
    kept = 0 if begun_m is None else min(len(begun_m), frames)
    if begun_m is not None:
        shift_m[:kept] = begun_m[:kept]
    if frames < 3 or kept == frames:
        return shift_m
    free, fixed = np.arange(3 * kept, 3 * frames), np.arange(3 * kept)
    step = fps * (sparse.eye(frames - 1, frames, k=1) - sparse.eye(frames - 1, frames))
    bend = fps**2 * sum(share * sparse.eye(frames - 2, frames, k=k) for k, share in enumerate((1, -2, 1)))
    step, bend = (sparse.kron(matrix, sparse.identity(3), format="csr") for matrix in (step, bend))
    rest = sparse.identity(3 * frames) / config.sigma_m**2 + bend.T @ bend / config.acceleration_m_s2**2
    speed = np.diff(joints_m[:, FEET], axis=0) * fps
    both = np.minimum(contact[1:], contact[:-1])[:, FEET]
    standing = np.where(both > config.contact_threshold, both, 0.0)
    for _ in range(config.iterations):
        left = np.linalg.norm(speed + np.diff(shift_m, axis=0)[:, None] * fps, axis=-1)
        weight = standing * _believed(left / config.odd_speed_m_s) / config.foot_speed_m_s**2
        left_side = rest + step.T @ sparse.diags(np.repeat(weight.sum(1), 3)) @ step
        right_side = -step.T @ (weight[..., None] * speed).sum(1).reshape(-1)
        if skin_m is not None and grid is not None:
            blocks, pushes = _out_of_solids(skin_m, shift_m, grid, config)
            left_side, right_side = left_side + sparse.block_diag(list(blocks)), right_side + pushes.reshape(-1)
        rows = sparse.csr_matrix(left_side)[free]
        right_side = right_side[free] - rows[:, fixed] @ shift_m[:kept].reshape(-1)
        solved = np.asarray(spsolve(sparse.csc_matrix(rows[:, free]), right_side))
        shift_m[kept:] = solved.reshape(-1, 3)
    # To the micrometre: what is far from a change and the same but for rounding is the same to the bit.
    return np.round(shift_m, 6)


def _out_of_solids(
    skin_m: np.ndarray, shift_m: np.ndarray, grid: SdfGrid, config: SettleConfig
) -> tuple[Float[np.ndarray, "frames 3 3"], Float[np.ndarray, "frames 3"]]:
    """Normal equations of the deepest vertices' way out, linear in the shift."""
    moved_m = skin_m + shift_m[:, None]
    distance_m = np.concatenate([
        grid.sample(moved_m[start : start + _FRAMES_AT_ONCE]) for start in range(0, len(moved_m), _FRAMES_AT_ONCE)
    ])  # fmt: skip
    deepest = np.argsort(distance_m, axis=1)[:, : config.deepest_vertices]
    at_m = np.take_along_axis(moved_m, deepest[..., None], axis=1)
    distance_m = np.take_along_axis(distance_m, deepest, axis=1)
    half_m = 0.5 * grid.spacing_m
    normal = np.stack(
        [grid.sample(at_m + half_m * axis) - grid.sample(at_m - half_m * axis) for axis in np.eye(3)], axis=-1
    )
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    missing_m = -config.free_depth_m - distance_m
    # A smooth hinge: what has just come out still counts a little, or it would go to and fro.
    inside = 1 / (1 + np.exp(-np.clip(missing_m / (0.5 * config.free_depth_m), -30, 30)))
    weight = inside * _believed(np.maximum(missing_m, 0) / config.odd_depth_m) / config.depth_sigma_m**2
    goal_m = (normal * shift_m[:, None]).sum(-1) + missing_m
    blocks = np.einsum("tk,tka,tkb->tab", weight, normal, normal)
    return blocks, np.einsum("tk,tka->ta", weight * goal_m, normal)


def _believed(off: np.ndarray) -> np.ndarray:
    """Tukey's biweight: 1 at 0, nothing from 1 on."""
    return np.clip(1 - off**2, 0, None) ** 2
