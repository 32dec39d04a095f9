"""Runs the lifter on a clip of any frame rate."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from video2anim.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp
from video2anim.humans.lifter_input import LiftedBody, lifted_body, lifter_input
from video2anim.humans.problem import Observations
from video2anim.types.clip import FPS

Network = Callable[[Float[np.ndarray, "frames features"]], Float[np.ndarray, "frames outputs"]]
_NEAR_ENOUGH = 0.1
"""Frame rates within this share of `FPS` are not resampled."""
_LONGEST_GAP_S = 0.12
"""Measurements farther apart are not interpolated."""


def lift(observed: Observations, network: Network) -> LiftedBody:
    """Bodies of consecutive frames.

    Args:
        observed: all frames of a clip, in order of time.
        network: features -> outputs, at `FPS`.
    """
    times = observed.frame_time_s
    step_s = float(np.median(np.diff(times))) if len(times) > 1 else 1.0 / FPS
    even = len(times) < 2 or float(np.abs(np.diff(times) - step_s).max()) < 0.5 * step_s
    if even and abs(step_s * FPS - 1.0) <= _NEAR_ENOUGH:
        given = lifter_input(observed)
        return lifted_body(network(given.features), given)
    grid = np.arange(times[0], times[-1] + 0.5 / FPS, 1.0 / FPS)
    given = lifter_input(_at(observed, grid))
    return _back(lifted_body(network(given.features), given), grid, times)


def _at(observed: Observations, grid_s: Float[np.ndarray, "samples"]) -> Observations:
    """Measurements at other times, by linear interpolation between valid neighbors."""
    rows = np.flatnonzero(observed.valid)
    times = observed.frame_time_s[rows]
    if len(rows) == 0:
        return _taken(observed, np.zeros(len(grid_s), int), grid_s, np.zeros(len(grid_s), bool))
    right = np.clip(np.searchsorted(times, grid_s), 0, len(rows) - 1)
    left = np.maximum(right - (times[right] > grid_s), 0)
    gap = times[right] - times[left]
    weight = np.where(gap > 0, (grid_s - times[left]) / np.where(gap > 0, gap, 1.0), 0.0)
    slack = max(_LONGEST_GAP_S, 1.5 * float(np.median(np.diff(observed.frame_time_s))))
    near = np.minimum(np.abs(grid_s - times[left]), np.abs(grid_s - times[right]))
    valid = (gap <= slack) & (near <= slack)

    def between(values: np.ndarray) -> np.ndarray:
        w = np.clip(weight, 0, 1).reshape(-1, *[1] * (values.ndim - 1))
        return (1 - w) * values[rows[left]] + w * values[rows[right]]

    return Observations(
        grid_s, valid, between(observed.keypoints_px), between(observed.keypoints_m), between(observed.weight),
        observed.intrinsics,
    )  # fmt: skip


def _taken(observed: Observations, index: Int[np.ndarray, "n"], times: np.ndarray, valid: np.ndarray) -> Observations:
    return Observations(
        times, valid, observed.keypoints_px[index], observed.keypoints_m[index], observed.weight[index] * 0.0,
        observed.intrinsics,
    )  # fmt: skip


def _back(lifted: LiftedBody, grid_s: np.ndarray, times_s: np.ndarray) -> LiftedBody:
    """The output at the times of the clip's frames."""
    last = len(grid_s) - 1
    place = np.clip((times_s - grid_s[0]) * FPS, 0, last)
    left = np.floor(place).astype(int)
    right, weight = np.minimum(left + 1, last), place - left

    def between(values: np.ndarray) -> np.ndarray:
        return (1 - weight)[:, None] * values[left] + weight[:, None] * values[right]

    quaternion = quaternion_from_matrix(lifted.R_parent_joint)
    turned = slerp(quaternion[left], quaternion[right], np.broadcast_to(weight[:, None, None], (len(times_s), 22, 1)))
    up = between(lifted.up_camera)
    return LiftedBody(
        np.asarray(matrix_from_quaternion(turned)), between(lifted.translation_camera_m), between(lifted.contact),
        up / np.linalg.norm(up, axis=-1, keepdims=True), between(lifted.error_m), lifted.focal_px,
    )  # fmt: skip
