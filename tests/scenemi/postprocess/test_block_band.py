"""The banded solver against dense algebra."""

from __future__ import annotations

import numpy as np

from scenemi.postprocess.block_band import BlockBand, solve_together

COUNT = 5


def random_band(frames: int, shared: int, seed: int) -> tuple[BlockBand, np.ndarray]:
    """Normal equations of random residuals of one and two neighboring frames, and their dense matrix."""
    rng = np.random.default_rng(seed)
    band = BlockBand(frames, COUNT, shared)
    total = frames * COUNT
    dense = np.zeros((total + shared, total + shared))
    for t in range(frames):
        J, S = rng.normal(size=(7, COUNT)), rng.normal(size=(7, shared))
        band.same[t] += J.T @ J
        band.cross[t] += J.T @ S
        band.shared += S.T @ S
        full = np.zeros((7, total + shared))
        full[:, t * COUNT : (t + 1) * COUNT], full[:, total:] = J, S
        dense += full.T @ full
    for t in range(frames - 1):
        J, K = rng.normal(size=(3, COUNT)), rng.normal(size=(3, COUNT))
        band.same[t] += J.T @ J
        band.same[t + 1] += K.T @ K
        band.next[t] += J.T @ K
        full = np.zeros((3, total + shared))
        full[:, t * COUNT : (t + 1) * COUNT], full[:, (t + 1) * COUNT : (t + 2) * COUNT] = J, K
        dense += full.T @ full
    band.right[:] = rng.normal(size=band.right.shape)
    band.shared_right[:] = rng.normal(size=shared)
    return band, dense


def test_motions_with_shared_unknowns_are_solved_as_one_system() -> None:
    shared = 3
    bands, dense = zip(*(random_band(frames, shared, frames) for frames in (6, 1, 2)), strict=True)
    known, known_right = np.diag([2.0, 3.0, 4.0]), np.array([1.0, -2.0, 0.5])
    sizes = [band.right.size for band in bands]
    start = np.cumsum([0, *sizes])
    whole = np.zeros((start[-1] + shared, start[-1] + shared))
    for begin, size, one in zip(start, sizes, dense, strict=False):
        rows = [*range(begin, begin + size), *range(start[-1], start[-1] + shared)]
        whole[np.ix_(rows, rows)] += one
    whole[start[-1] :, start[-1] :] += known
    right = np.concatenate([band.right.reshape(-1) for band in bands])
    both_right = known_right + sum(band.shared_right for band in bands)
    expected = np.linalg.solve(whole, np.concatenate([right, both_right]))
    found, both = solve_together(bands, known, known_right)
    np.testing.assert_allclose(np.concatenate([x.reshape(-1) for x in found]), expected[: start[-1]], atol=1e-9)
    np.testing.assert_allclose(both, expected[start[-1] :], atol=1e-9)


def test_second_differences_are_those_of_numpy() -> None:
    rng = np.random.default_rng(1)
    values, weight = rng.normal(size=(6, COUNT)), rng.uniform(1, 2, COUNT)
    band = BlockBand(6, COUNT)
    band.same += np.eye(COUNT)
    band.add_second_difference(values, weight)
    D = np.diff(np.eye(6), n=2, axis=0)
    (found,), _ = solve_together([band], np.zeros((0, 0)), np.zeros(0))
    for k in range(COUNT):
        H = np.eye(6) + weight[k] * D.T @ D
        np.testing.assert_allclose(found[:, k], np.linalg.solve(H, -weight[k] * D.T @ D @ values[:, k]), atol=1e-10)
