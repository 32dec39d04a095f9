"""Points that represent others, or a surface."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def farthest_points(points_m: Float[np.ndarray, "points 3"], count: int) -> Int[np.ndarray, "chosen"]:
    """Farthest-point sampling from point 0; all points where there are no more than `count`."""
    if len(points_m) <= count:
        return np.arange(len(points_m))
    chosen = [0]
    nearest = np.linalg.norm(points_m - points_m[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(points_m - points_m[chosen[-1]], axis=1))
    return np.array(chosen)


def surface_samples(
    triangles_m: np.ndarray, step_m: float
) -> tuple[Float[np.ndarray, "samples 3"], Int[np.ndarray, "samples"]]:
    """Centroids of pieces with edges up to `step_m`, and the triangle each belongs to.

    Triangles are bisected at their longest edge, so a long sliver gives few pieces. Centroids, not corners: a corner is
    shared, so its nearest samples could all belong to the wrong neighbors.
    """
    pieces, owners = triangles_m, np.arange(len(triangles_m))
    samples, sample_owners = [], []
    while len(pieces):
        edges_m = np.linalg.norm(np.roll(pieces, -1, axis=1) - pieces, axis=-1)
        done = edges_m.max(axis=1) <= step_m
        samples.append(pieces[done].mean(axis=1))
        sample_owners.append(owners[done])
        pieces, owners, edges_m = pieces[~done], owners[~done], edges_m[~done]
        longest = edges_m.argmax(axis=1)[:, None]
        rows = np.arange(len(pieces))[:, None]
        a, b, c = (pieces[rows, (longest + k) % 3][:, 0] for k in range(3))
        center = 0.5 * (a + b)
        pieces = np.concatenate([np.stack([a, center, c], 1), np.stack([center, b, c], 1)])
        owners = np.concatenate([owners, owners])
    return np.concatenate(samples), np.concatenate(sample_owners)
