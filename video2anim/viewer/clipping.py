"""Cutting triangles and segments at the near plane of a camera."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.geometry.projection import NEAR_M


def clip_triangles_near(
    corners_m: Float[np.ndarray, "triangles 3 3"], values: Float[np.ndarray, "triangles 3 channels"]
) -> tuple[Float[np.ndarray, "clipped 3 3"], Float[np.ndarray, "clipped 3 channels"]]:
    """Parts of triangles with z >= NEAR_M, and the values at their corners.

    A triangle with one corner behind becomes two, one with two behind becomes a smaller one.
    """
    behind = corners_m[..., 2] < NEAR_M
    count = behind.sum(1)
    if not count.any():
        return corners_m, values
    channels = np.concatenate([corners_m, values], -1)
    parts = [channels[count == 0]]
    # Turn each triangle so that its odd corner (the one behind, or the one in front) comes first.
    one_behind = _turned(channels[count == 1], behind[count == 1].argmax(1))
    if len(one_behind):
        a, b, c = one_behind[:, 0], one_behind[:, 1], one_behind[:, 2]
        ab, ac = _cut(a, b), _cut(a, c)
        parts += [np.stack([ab, b, c], 1), np.stack([ab, c, ac], 1)]
    two_behind = _turned(channels[count == 2], (~behind[count == 2]).argmax(1))
    if len(two_behind):
        a, b, c = two_behind[:, 0], two_behind[:, 1], two_behind[:, 2]
        parts.append(np.stack([a, _cut(a, b), _cut(a, c)], 1))
    clipped = np.concatenate(parts)
    return clipped[..., :3], clipped[..., 3:]


def clip_segments_near(
    starts_m: Float[np.ndarray, "lines 3"], ends_m: Float[np.ndarray, "lines 3"]
) -> tuple[Float[np.ndarray, "clipped 3"], Float[np.ndarray, "clipped 3"]]:
    """Parts of segments with z >= NEAR_M."""
    seen = (starts_m[:, 2] >= NEAR_M) | (ends_m[:, 2] >= NEAR_M)
    starts, ends = starts_m[seen].copy(), ends_m[seen].copy()
    for first, second in ((starts, ends), (ends, starts)):
        cut = first[:, 2] < NEAR_M
        first[cut] = _cut(first[cut], second[cut])
    return starts, ends


def _turned(triangles: np.ndarray, first: np.ndarray) -> np.ndarray:
    order = (first[:, None] + np.arange(3)) % 3
    return np.take_along_axis(triangles, order[..., None], axis=1)


def _cut(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Point of the segment a-b on the near plane; the first three channels are x, y, z."""
    share = (NEAR_M - a[:, 2]) / (b[:, 2] - a[:, 2])
    point = a + share[:, None] * (b - a)
    point[:, 2] = NEAR_M
    return point
