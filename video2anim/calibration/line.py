"""The line (scale and offset) that makes relative depth metric, and its initial estimate."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.calibration.evidence import Evidence

NEAREST = 1e-3
"""Least depth or disparity of a line, and least cosine of a ray to the vertical: no division by 0."""


def metric_depth(kind: str, value: np.ndarray, scale: float, offset: float) -> Float[np.ndarray, "..."]:
    """Depth in meters of relative depth or disparity; NaN where it is behind the camera or beyond 1 km."""
    line = scale * np.asarray(value, dtype=np.float64) + offset
    depth_m = line if kind == "depth" else 1.0 / np.where(line > NEAREST, line, np.nan)
    return np.where((depth_m > 0.02) & (depth_m < 1e3), depth_m, np.nan)


def first_line(evidence: Evidence, height_m: float) -> tuple[float, float]:
    """Scale and offset by the floor pixels and the median of each frame's skin: robust ridge regression of depth or
    disparity toward the network's usual offset."""
    x = np.concatenate([evidence.floor.value, [np.median(one.value) for one in evidence.skin]])
    floor_m = height_m / np.maximum(-evidence.floor.ray @ evidence.up, NEAREST)
    z_m = np.concatenate([floor_m, [np.median(one.skin_m[:, 2]) for one in evidence.skin]])
    if not len(x):
        # Neither floor nor skin: the main person is at the median depth.
        x, z_m = np.array([evidence.median_value]), evidence.people[0].support_m[:1, 2]
    y = z_m if evidence.kind == "depth" else 1 / z_m
    unit = evidence.median_value
    x, usual = x / unit, evidence.usual_offset
    # Networks see people nearer or farther than their floor, so skin weighs no more than floor in all.
    floor, skin = len(evidence.floor.value), len(evidence.skin)
    trust = np.ones(len(x))
    trust[floor:] = min(1.0, floor / skin) if floor and skin else 1.0
    weight, scale, more = trust, 0.0, 0.0
    for _ in range(10):
        # y = scale (x + usual) + more: the deviation from the usual offset has a Gaussian prior.
        A = np.stack([x + usual, np.ones(len(x))], 1)
        ridge = np.diag([0.0, weight.sum() * 0.01 / evidence.usual_offset_sigma**2])
        scale, more = np.linalg.solve((A.T * weight) @ A + ridge + 1e-12 * np.eye(2), (A.T * weight) @ y)
        off = np.abs(A @ [scale, more] - y) / y
        weight = trust / (1 + (off / 0.1) ** 2) / y**2
        weight /= weight.max()
    if scale <= 0:
        # No positive scale fits: the line with the usual offset through the medians.
        scale = float(np.median(y)) / (1 + max(usual, 0.0))
        more = float(np.median(y - scale * (x + usual)))
    return float(scale / unit), float(scale * usual + more)
