"""The line that makes relative depth metric: its use, and a first guess of it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.calibration.evidence import Evidence

NEAREST = 1e-3
"""Lines, and cosines of rays to the vertical, are not believed below this."""


def metric_depth(kind: str, value: np.ndarray, scale: float, offset: float) -> Float[np.ndarray, "..."]:
    """Meters of relative depth or disparity; what the model sends behind the camera or beyond 1 km is NaN."""
    line = scale * np.asarray(value, dtype=np.float64) + offset
    depth_m = line if kind == "depth" else 1.0 / np.where(line > NEAREST, line, np.nan)
    return np.where((depth_m > 0.02) & (depth_m < 1e3), depth_m, np.nan)


def first_line(evidence: Evidence, up: np.ndarray, height_m: float) -> tuple[float, float]:
    """Scale and offset by floor pixels and the person's medians, in the values' own domain, where they are linear:
    ridge regression towards the network's usual offset."""
    rays = np.concatenate([evidence.floor.pixel / evidence.focal_px, np.ones((len(evidence.floor.value), 1))], 1)
    x = np.concatenate([evidence.floor.value, [np.median(one.value) for one in evidence.skin]])
    z_m = np.concatenate([
        height_m / np.maximum(-rays @ up, NEAREST), [np.median(one.skin_m[:, 2]) for one in evidence.skin],
    ])  # fmt: skip
    if not len(x):
        # Neither floor nor reliable person: the main person's distance is that of the picture's middle.
        x, z_m = np.array([evidence.middle_value]), evidence.people[0].soles_root_m[:1, 2]
    y = z_m if evidence.kind == "depth" else 1 / z_m
    unit = evidence.middle_value
    x, usual = x / unit, evidence.usual_offset
    # Networks see people at distances of their own: skin does not outvote floor.
    floor, skin = len(evidence.floor.value), len(evidence.skin)
    trust = np.ones(len(x))
    trust[floor:] = min(1.0, floor / skin) if floor and skin else 1.0
    weight, scale, more = trust, 0.0, 0.0
    for _ in range(10):
        # y = scale (x + usual) + more; what is more than the usual offset is held near 0 by the spread of that.
        A = np.stack([x + usual, np.ones(len(x))], 1)
        ridge = np.diag([0.0, weight.sum() * 0.01 / evidence.usual_offset_sigma**2])
        scale, more = np.linalg.solve((A.T * weight) @ A + ridge + 1e-12 * np.eye(2), (A.T * weight) @ y)
        off = np.abs(A @ [scale, more] - y) / y
        weight = trust / (1 + (off / 0.1) ** 2) / y**2
        weight /= weight.max()
    if scale <= 0:
        # Values that fall where they should rise: through the medians, as flat as the usual offset says.
        scale = float(np.median(y)) / (1 + max(usual, 0.0))
        more = float(np.median(y - scale * (x + usual)))
    return float(scale / unit), float(scale * usual + more)
