"""Settle a motion's root: standing feet stand, and what is a little inside a solid comes out.

Centimetres of displacement per frame, smooth in time, found by least squares. The pose is not touched, so one frame's
skin moves as one piece.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import solveh_banded

from video2anim.body.skeleton import FEET
from video2anim.geometry.sdf import SdfGrid

_FRAMES_AT_ONCE = 256
"""Skin of so many frames is looked up at a time, bounding memory."""
_STEEPEST = 3**0.5
"""A field read by trilinear interpolation between true distances changes by no more than this per metre."""
_FARTHEST_HINGE = 30.0
"""Skin farther out of a solid than so many widths of the hinge counts nothing."""
_LIMIT_HINGE_M = 0.001
"""The limit across the line of sight sets in within about this."""
_BELOW = 6
"""Matrices are of frames times three coordinates, and couple frames up to two apart: so many diagonals below the main
one."""


@dataclass(frozen=True, slots=True)
class SettleConfig:
    """What counts how much: standard deviations of a least-squares problem."""

    sigma_m: float = 0.02
    """How far a frame's root may be off."""
    limit_sigma_m: float = 0.0003
    """How strictly the limit across the line of sight is kept."""
    speed_m_s: float = 0.05
    """How fast the shift may change: frames of a motion are known better beside each other than in the world."""
    acceleration_m_s2: float = 2.0
    """How fast that may change."""
    foot_speed_m_s: float = 0.04
    """Speed of joints of standing feet."""
    odd_speed_m_s: float = 1.0
    """A foot as fast as this does not stand, whatever its contact says; a slower one counts the more, the slower."""
    contact_threshold: float = 0.5
    depth_sigma_m: float = 0.0025
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
    skin: SkinNearSolids | None = None,
    sight: Sight | None = None,
    begun_m: Float[np.ndarray, "some_frames 3"] | None = None,
    config: SettleConfig | None = None,
) -> Float[np.ndarray, "frames 3"]:
    """Displacement of every frame's root, world frame, metres.

    Args:
        joints_m: world frame.
        contact: probabilities; feet only are looked at.
        fps: frames per second.
        skin: the body's skin among the solids it is to come out of; None for no solids.
        sight: from where the roots are seen; None where all directions are alike.
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
    rest = _rest(frames, fps, config)
    speed = np.diff(joints_m[:, FEET], axis=0) * fps
    both = np.minimum(contact[1:], contact[:-1])[:, FEET]
    standing = np.where(both > config.contact_threshold, both, 0.0)
    for _ in range(config.iterations):
        left = np.linalg.norm(speed + np.diff(shift_m, axis=0)[:, None] * fps, axis=-1)
        weight = standing * _believed(left / config.odd_speed_m_s) / config.foot_speed_m_s**2
        matrix = rest.copy()
        _add_steps(matrix, fps**2 * (weight.sum(1) + config.speed_m_s**-2))
        pulled = fps * (weight[..., None] * speed).sum(1)
        goal = np.concatenate([pulled, np.zeros((1, 3))]) - np.concatenate([np.zeros((1, 3)), pulled])
        if skin is not None:
            blocks, pushes = _out_of_solids(skin, shift_m, config)
            _add_blocks(matrix, blocks)
            goal += pushes
        if sight is not None:
            blocks, pushes = _within_limit(sight, shift_m, config)
            _add_blocks(matrix, blocks)
            goal += pushes
        # What is kept goes to the other side: it is coupled with the two frames that follow.
        for apart in (1, 2):
            for frame in range(max(kept - apart, 0), min(kept, frames - apart)):
                goal[frame + apart] -= matrix[3 * apart, 3 * frame : 3 * frame + 3] * shift_m[frame]
        solved = solveh_banded(matrix[:, 3 * kept :], goal[kept:].reshape(-1), lower=True, check_finite=False)
        shift_m[kept:] = solved.reshape(-1, 3)
    # To the micrometre: what is far from a change and the same but for rounding is the same to the bit.
    return np.round(shift_m, 6)


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """How roots are seen: the picture says little of where they are along the line of sight, but much across it."""

    direction: Float[np.ndarray, "frames 3"]
    """Unit vectors from the camera to the roots, world frame."""
    limit_m: Float[np.ndarray, "frames"]
    """A shift across it goes no farther."""


class SkinNearSolids:
    """Skin vertices of every frame that a shift of centimetres can bring into a solid.

    Their distance without a shift bounds what it can become, so the others are never looked up.
    """

    def __init__(self, skin_m: Float[np.ndarray, "frames vertices 3"], grid: SdfGrid) -> None:
        """`skin_m`: vertices in the world; `grid`: signed distance to the solids."""
        self._skin_m, self.grid = skin_m, grid
        self._distance_m = np.zeros(skin_m.shape[:2])
        for start in range(0, len(skin_m), _FRAMES_AT_ONCE):
            some = slice(start, start + _FRAMES_AT_ONCE)
            self._distance_m[some] = grid.sample(skin_m[some])

    def deepest(
        self, shift_m: Float[np.ndarray, "frames 3"], count: int, far_m: float
    ) -> tuple[Float[np.ndarray, "frames count 3"], Float[np.ndarray, "frames count"]]:
        """The deepest vertices of every frame, shifted, and their distance; `far_m` away or more is infinity."""
        reach_m = far_m + _STEEPEST * np.linalg.norm(shift_m, axis=1)
        near = self._distance_m < reach_m[:, None]
        frame, vertex = np.nonzero(near)
        moved_m = self._skin_m[frame, vertex] + shift_m[frame]
        distance_m = np.full_like(self._distance_m, np.inf)
        distance_m[frame, vertex] = self.grid.sample(moved_m)
        count = min(count, self._skin_m.shape[1])
        at = np.argpartition(distance_m, count - 1, axis=1)[:, :count]
        at_m = np.take_along_axis(self._skin_m, at[..., None], axis=1) + shift_m[:, None]
        return at_m, np.take_along_axis(distance_m, at, axis=1)


def _rest(frames: int, fps: float, config: SettleConfig) -> Float[np.ndarray, "diagonals unknowns"]:
    """Normal equations of a short and smooth shift: rows are diagonals, from the main one down."""
    matrix = np.zeros((_BELOW + 1, 3 * frames))
    matrix[0] = 1 / config.sigma_m**2
    bend = np.zeros((3, frames))
    for a, share in enumerate((1.0, -2.0, 1.0)):
        for b, other in enumerate((1.0, -2.0, 1.0)[: a + 1]):
            bend[a - b, b : b + frames - 2] += share * other
    matrix[::3] += np.repeat(bend, 3, axis=1) * (fps**2 / config.acceleration_m_s2) ** 2
    return matrix


def _add_steps(matrix: np.ndarray, weight: Float[np.ndarray, "steps"]) -> None:
    """Squared differences of neighboring frames."""
    each = np.repeat(weight, 3)
    matrix[0, :-3] += each
    matrix[0, 3:] += each
    matrix[3, :-3] -= each


def _add_blocks(matrix: np.ndarray, blocks: Float[np.ndarray, "frames 3 3"]) -> None:
    """Symmetric blocks within frames."""
    for below in range(3):
        for column in range(3 - below):
            matrix[below, column::3] += blocks[:, column + below, column]


def _out_of_solids(
    skin: SkinNearSolids, shift_m: np.ndarray, config: SettleConfig
) -> tuple[Float[np.ndarray, "frames 3 3"], Float[np.ndarray, "frames 3"]]:
    """Normal equations of the deepest vertices' way out, linear in the shift."""
    # A smooth hinge: what has just come out still counts a little, or it would go to and fro.
    hinge_m = 0.5 * config.free_depth_m
    at_m, distance_m = skin.deepest(shift_m, config.deepest_vertices, _FARTHEST_HINGE * hinge_m)
    frame, vertex = np.nonzero(np.isfinite(distance_m))
    at_m, distance_m = at_m[frame, vertex], distance_m[frame, vertex]
    half_m = 0.5 * skin.grid.spacing_m
    ends_m = at_m + half_m * np.concatenate([np.eye(3), -np.eye(3)])[:, None]
    after_m, before_m = skin.grid.sample(ends_m).reshape(2, 3, -1)
    normal = (after_m - before_m).T
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    missing_m = -config.free_depth_m - distance_m
    inside = 1 / (1 + np.exp(-np.clip(missing_m / hinge_m, -_FARTHEST_HINGE, _FARTHEST_HINGE)))
    weight = inside * _believed(np.maximum(missing_m, 0) / config.odd_depth_m) / config.depth_sigma_m**2
    goal_m = (normal * shift_m[frame]).sum(-1) + missing_m
    blocks, pushes = np.zeros((len(shift_m), 3, 3)), np.zeros((len(shift_m), 3))
    np.add.at(blocks, frame, (weight[:, None] * normal)[:, :, None] * normal[:, None])
    np.add.at(pushes, frame, (weight * goal_m)[:, None] * normal)
    return blocks, pushes


def _within_limit(
    sight: Sight, shift_m: np.ndarray, config: SettleConfig
) -> tuple[Float[np.ndarray, "frames 3 3"], Float[np.ndarray, "frames 3"]]:
    """Normal equations that hold shifts at the limit across the sight."""
    beside = np.eye(3) - sight.direction[:, :, None] * sight.direction[:, None]
    across_m = np.einsum("tab,tb->ta", beside, shift_m)
    length_m = np.linalg.norm(across_m, axis=1)
    beyond = np.clip((length_m - sight.limit_m) / _LIMIT_HINGE_M, -_FARTHEST_HINGE, _FARTHEST_HINGE)
    weight = 1 / (1 + np.exp(-beyond)) / config.limit_sigma_m**2
    goal_m = across_m * (sight.limit_m / np.maximum(length_m, 1e-9))[:, None]
    return weight[:, None, None] * beside, weight[:, None] * goal_m


def _believed(off: np.ndarray) -> np.ndarray:
    """Tukey's biweight: 1 at 0, nothing from 1 on."""
    return np.clip(1 - off**2, 0, None) ** 2
