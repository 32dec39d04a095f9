"""Rotations: conversions and interpolation, one implementation for numpy arrays and torch tensors.

Quaternions are w, x, y, z. `R_a_b` maps coordinates of b into a (column vectors). The 6D form holds the first two
columns of the matrix (Zhou et al. 2019). Every function takes any leading axes and returns what it was given.
"""

from __future__ import annotations

from typing import Any

import numpy as np

_TINY = 1e-12


def _module(array: Any) -> Any:
    if isinstance(array, np.ndarray | np.generic):
        return np
    import torch

    return torch


def _stack(parts: list[Any]) -> Any:
    module = _module(parts[0])
    return module.stack(parts, axis=-1) if module is np else module.stack(parts, dim=-1)


def _norm(vector: Any) -> Any:
    """Euclidean norm over the last axis, kept, with a finite gradient at zero."""
    total = (vector * vector).sum(-1)[..., None]
    return (total + _TINY**2) ** 0.5


def matrix_from_axis_angle(axis_angle_rad: Any) -> Any:
    """Rotation matrices (..., 3, 3) from rotation vectors (..., 3), Rodrigues' formula.

    Smooth at zero: sin(x)/x and (1 - cos(x))/x^2 are written by half-angle sinc.
    """
    module = _module(axis_angle_rad)
    angle = _norm(axis_angle_rad)
    sinc = module.sin(angle) / angle
    half = module.sin(0.5 * angle) / (0.5 * angle)
    versine = 0.5 * half * half
    x, y, z = axis_angle_rad[..., 0], axis_angle_rad[..., 1], axis_angle_rad[..., 2]
    s, c = sinc[..., 0], versine[..., 0]
    rows = [
        1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y,
        c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x,
        c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y),
    ]  # fmt: skip
    return _stack(rows).reshape(*axis_angle_rad.shape[:-1], 3, 3)


def matrix_from_quaternion(quaternion_wxyz: Any) -> Any:
    """Rotation matrices (..., 3, 3) from quaternions (..., 4) of any length but zero."""
    q = quaternion_wxyz / _norm(quaternion_wxyz)
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return _stack(rows).reshape(*quaternion_wxyz.shape[:-1], 3, 3)


def quaternion_from_matrix(R_a_b: Any) -> Any:
    """Unit quaternions (..., 4), w >= 0, from rotation matrices (..., 3, 3).

    Of the four ways to write a quaternion the one with the largest divisor is taken (Shepperd 1978).
    """
    module = _module(R_a_b)
    m = R_a_b
    d0, d1, d2 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = _stack([1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2])
    yz, zx, xy = m[..., 2, 1], m[..., 0, 2], m[..., 1, 0]
    zy, xz, yx = m[..., 1, 2], m[..., 2, 0], m[..., 0, 1]
    candidates = [
        _stack([squares[..., 0], yz - zy, zx - xz, xy - yx]),
        _stack([yz - zy, squares[..., 1], xy + yx, zx + xz]),
        _stack([zx - xz, xy + yx, squares[..., 2], yz + zy]),
        _stack([xy - yx, zx + xz, yz + zy, squares[..., 3]]),
    ]
    best = squares.argmax(-1)[..., None]
    q = candidates[0]
    for i in range(1, 4):
        q = module.where(best == i, candidates[i], q)
    q = q / _norm(q)
    return module.where(q[..., :1] < 0, -q, q)


def axis_angle_from_matrix(R_a_b: Any) -> Any:
    """Rotation vectors (..., 3) with angle in [0, pi] from rotation matrices (..., 3, 3)."""
    module = _module(R_a_b)
    q = quaternion_from_matrix(R_a_b)
    sine = _norm(q[..., 1:])
    arctan2 = module.arctan2 if module is np else module.atan2
    factor = 2 * arctan2(sine, q[..., :1]) / sine
    return q[..., 1:] * module.where(sine < 1e-9, 2 * module.ones_like(sine), factor)


def matrix_from_rot6d(rot6d: Any) -> Any:
    """Rotation matrices (..., 3, 3) from two column vectors (..., 6) by Gram-Schmidt."""
    module = _module(rot6d)
    first = rot6d[..., :3] / _norm(rot6d[..., :3])
    second = rot6d[..., 3:] - (first * rot6d[..., 3:]).sum(-1)[..., None] * first
    second = second / _norm(second)
    third = module.cross(first, second, axis=-1) if module is np else module.cross(first, second, dim=-1)
    return _stack([first, second, third])


def rot6d_from_matrix(R_a_b: Any) -> Any:
    """First two columns, concatenated (..., 6)."""
    module = _module(R_a_b)
    columns = [R_a_b[..., :, 0], R_a_b[..., :, 1]]
    return np.concatenate(columns, -1) if module is np else module.cat(columns, -1)


def slerp(quaternion_a: Any, quaternion_b: Any, weight: Any) -> Any:
    """Shortest-way spherical interpolation; `weight` (..., 1) is 0 at a and 1 at b."""
    module = _module(quaternion_a)
    cosine = (quaternion_a * quaternion_b).sum(-1)[..., None]
    quaternion_b = module.where(cosine < 0, -quaternion_b, quaternion_b)
    cosine = abs(cosine)
    limit = 1.0 - 1e-9
    clipped = module.where(cosine > limit, limit * module.ones_like(cosine), cosine)
    angle = module.arccos(clipped)
    sine = module.sin(angle)
    near = cosine > limit
    a = module.where(near, 1 - weight, module.sin((1 - weight) * angle) / sine)
    b = module.where(near, weight, module.sin(weight * angle) / sine)
    q = a * quaternion_a + b * quaternion_b
    return q / _norm(q)


def continuous_quaternions(quaternion_wxyz: np.ndarray) -> np.ndarray:
    """Quaternions (T, ..., 4) with signs flipped so that neighbors in time lie on the same half sphere."""
    flips = np.ones(quaternion_wxyz.shape[:-1])
    dots = (quaternion_wxyz[1:] * quaternion_wxyz[:-1]).sum(-1)
    flips[1:] = np.cumprod(np.where(dots < 0, -1.0, 1.0), axis=0)
    return quaternion_wxyz * flips[..., None]


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Closest proper rotations (..., 3, 3) in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    sign = np.linalg.det(u @ vt)
    u = u.copy()
    u[..., :, 2] *= sign[..., None]
    return u @ vt


def rotation_between(direction_from: np.ndarray, direction_to: np.ndarray) -> np.ndarray:
    """Smallest rotation (3, 3) that turns one direction (3,) into another, which is not its opposite."""
    a = direction_from / np.linalg.norm(direction_from)
    b = direction_to / np.linalg.norm(direction_to)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    if sine < _TINY:
        if a @ b > 0:
            return np.eye(3)
        raise ValueError("rotation_between: opposite directions have no single smallest rotation")
    return matrix_from_axis_angle(axis / sine * np.arctan2(sine, a @ b))


def rotations_between(vectors_from: np.ndarray, vectors_to: np.ndarray) -> np.ndarray:
    """Smallest rotations (N, 3, 3) that turn vectors (N, 3) of any length into the directions of others."""
    axis = np.cross(vectors_from, vectors_to)
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, np.einsum("td,td->t", vectors_from, vectors_to))
    return matrix_from_axis_angle(axis * (angle / np.maximum(sine, 1e-15))[:, None])
