"""Gaps of a map filled as smoothly as can be."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu


def harmonic_fill(
    value: Float[np.ndarray, "rows columns *channels"], told: Bool[np.ndarray, "rows columns"]
) -> Float[np.ndarray, "rows columns *channels"]:
    """Told cells as they are, the others each the mean of its neighbors; some cell must be told."""
    free = (~told).ravel()
    if not free.any():
        return value
    cell = np.arange(told.size).reshape(told.shape)
    a = np.concatenate([cell[:, :-1].ravel(), cell[:-1].ravel()])
    b = np.concatenate([cell[:, 1:].ravel(), cell[1:].ravel()])
    near = coo_matrix((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), shape=(told.size,) * 2).tocsr()
    laplacian = (diags(np.asarray(near.sum(1)).ravel()) - near).tocsr()
    filled = value.reshape(told.size, -1).astype(np.float64)
    filled[free] = splu(laplacian[free][:, free].tocsc()).solve(near[free][:, ~free] @ filled[~free])
    return filled.reshape(value.shape)
