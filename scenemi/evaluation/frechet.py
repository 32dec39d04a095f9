"""Frechet distance between two sets of features (the FID's formula)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def frechet_distance(a: Float[np.ndarray, "n features"], b: Float[np.ndarray, "m features"]) -> float:
    """|mean_a - mean_b|^2 + trace(C_a + C_b - 2 (C_a C_b)^(1/2)) of the Gaussians fitted to both sets; lower is better.

    Computed through the symmetric form (C_a^(1/2) C_b C_a^(1/2))^(1/2), which is real for any covariances, those of
    fewer samples than features too.

    Raises:
        ValueError: fewer than two samples, different widths, or numbers that are not finite.
    """
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1] or min(len(a), len(b)) < 2:
        raise ValueError(f"frechet_distance: want (n >= 2, d) twice with one d, got {a.shape} and {b.shape}")
    if not np.isfinite(a).all() or not np.isfinite(b).all():
        raise ValueError("frechet_distance: want finite features, got NaN or infinity")
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    return gaussian_distance(mean_a, _covariance(a - mean_a), mean_b, _covariance(b - mean_b))


def _covariance(centered: Float[np.ndarray, "n features"]) -> Float[np.ndarray, "features features"]:
    return centered.T @ centered / (len(centered) - 1)


def gaussian_distance(
    mean_a: Float[np.ndarray, "features"],
    covariance_a: Float[np.ndarray, "features features"],
    mean_b: Float[np.ndarray, "features"],
    covariance_b: Float[np.ndarray, "features features"],
) -> float:
    """The same between two Gaussians."""
    root_a = _root(covariance_a)
    cross = _root(root_a @ covariance_b @ root_a)
    shift = float(((mean_a - mean_b) ** 2).sum())
    return max(0.0, shift + float(np.trace(covariance_a) + np.trace(covariance_b) - 2 * np.trace(cross)))


def _root(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Symmetric square root of a positive semidefinite matrix; tiny negative eigenvalues are rounding."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
