"""Normal equations whose unknowns are grouped by frame and coupled with those up to two frames away, and a few unknowns
that all frames share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import solveh_banded

REACH = 2
"""Frames apart that are coupled."""


class BlockBand:
    """H x = g, H symmetric positive definite.

    `same[t]` couples the unknowns of frame t, `next[t]` those of frame t (rows) with those of t + 1 (columns), and
    `after[t]` each unknown of frame t with the same one of t + 2. `cross` couples the unknowns of frames with the
    shared ones, `shared` those with each other.
    """

    def __init__(self, frames: int, unknowns: int, shared: int = 0) -> None:
        self.same = np.zeros((frames, unknowns, unknowns))
        self.next = np.zeros((max(frames - 1, 0), unknowns, unknowns))
        self.after = np.zeros((max(frames - 2, 0), unknowns))
        self.right = np.zeros((frames, unknowns))
        self.cross = np.zeros((frames, unknowns, shared))
        self.shared = np.zeros((shared, shared))
        self.shared_right = np.zeros(shared)

    def add_second_difference(
        self, values: Float[np.ndarray, "frames unknowns"], weight: Float[np.ndarray, "unknowns"]
    ) -> None:
        """The cost weight (x[t] - 2 x[t+1] + x[t+2])^2 / 2 of every unknown, at `values`."""
        share = np.array([1.0, -2.0, 1.0])
        frames, count = values.shape
        if frames < 3:
            return
        diagonal = np.arange(count)
        bend = values[:-2] - 2 * values[1:-1] + values[2:]
        for a in range(3):
            rows = slice(a, frames - 2 + a)
            self.right[rows] -= share[a] * weight * bend
            self.same[rows, diagonal, diagonal] += share[a] ** 2 * weight
        for a in range(2):
            self.next[a : frames - 2 + a, diagonal, diagonal] += share[a] * share[a + 1] * weight
        self.after += share[0] * share[2] * weight

    def fix(self, frames: Bool[np.ndarray, "frames"]) -> None:
        """Make x zero in some frames."""
        rows = np.flatnonzero(frames)
        self.same[rows], self.right[rows], self.cross[rows] = np.eye(self.right.shape[1]), 0.0, 0.0
        for apart, coupling in ((1, self.next), (2, self.after)):
            coupling[rows[rows < len(coupling)]] = 0.0
            coupling[rows[rows >= apart] - apart] = 0.0

    def eliminate(self) -> tuple[Float[np.ndarray, "frames unknowns"], Float[np.ndarray, "frames unknowns shared"]]:
        """H^-1 g and H^-1 times the coupling with the shared unknowns, by banded Cholesky factorization: frames x
        unknowns^3 operations."""
        frames, count, _ = self.same.shape
        # [t, k]: column of unknown k of frame t, from the diagonal down; LAPACK's storage, transposed.
        band = np.zeros((frames, count, REACH * count + 1))
        for k in range(count):
            band[:, k, : count - k] = self.same[:, k, k:]
            band[:-1, k, count - k : 2 * count - k] = self.next[:, k]
        band[:-2, :, REACH * count] = self.after
        used = self.cross.any((0, 1))
        sides = np.concatenate([self.right[None], np.moveaxis(self.cross[..., used], 2, 0)])
        solved = solveh_banded(
            band.reshape(frames * count, -1).T, sides.reshape(len(sides), -1).T, overwrite_ab=True, overwrite_b=True,
            lower=True, check_finite=False,
        ).T.reshape(sides.shape)  # fmt: skip
        of_shared = np.zeros_like(self.cross)
        of_shared[..., used] = np.moveaxis(solved[1:], 0, 2)
        return solved[0], of_shared


def solve_together(
    bands: Sequence[BlockBand], shared: Float[np.ndarray, "shared shared"], shared_right: Float[np.ndarray, "shared"]
) -> tuple[list[Float[np.ndarray, "frames unknowns"]], Float[np.ndarray, "shared"]]:
    """Unknowns of several motions that share some, by the Schur complement of those.

    `shared` and `shared_right` are what is known of the shared ones beside what the bands say of them.
    """
    eliminated = [band.eliminate() for band in bands]
    left, right = shared.copy(), shared_right.copy()
    for band, (alone, of_shared) in zip(bands, eliminated, strict=True):
        left += band.shared - np.einsum("tuk,tul->kl", band.cross, of_shared)
        right += band.shared_right - np.einsum("tuk,tu->k", band.cross, alone)
    both = np.linalg.solve(left, right) if len(right) else right
    return [alone - of_shared @ both for alone, of_shared in eliminated], both
