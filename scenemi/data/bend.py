"""Captured walking bent along smooth curves: the path turns more and more with the way gone, the body turns along.

Feet that stand slide a little by it (turning while one foot is down); retargeting plants them again.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from scenemi.data.source_clip import SourceClip
from video2anim.geometry.rotations import matrix_from_axis_angle, matrix_from_quaternion, quaternion_from_matrix

MIN_WAY_M = 2.0
"""Clips whose root goes less far are not bent: there is no path."""
_SHARPEST_PER_M = 0.7
"""Largest turn in a meter (rad): a radius of 1.4 m, as around a table."""
_WAVES_M = (1.5, 8.0)
"""Length of a bend to one side and back."""
_SMOOTHING_S = 0.4
"""Standard deviation over which the path is smoothed: sway from step to step is not part of it."""


def way_m(clip: SourceClip) -> float:
    """How far the root goes over the ground."""
    return float(_way(clip)[-1])


def bent(clip: SourceClip, rng: np.random.Generator) -> SourceClip:
    """The clip along a random smooth curve; feet have to be planted again."""
    way = _way(clip)
    waves, sharpness = rng.uniform(*_WAVES_M, 2), rng.uniform(0.2, 1.0) * _SHARPEST_PER_M
    phase, share = rng.uniform(0, 2 * np.pi, 2), rng.uniform(0.3, 0.7)
    slow, fast = (
        part * np.sin(2 * np.pi * way / wave + start)
        for part, wave, start in zip((share, 1 - share), waves, phase, strict=True)
    )
    turn_per_m = sharpness * (slow + fast)
    turn_rad = np.concatenate([[0.0], np.cumsum(turn_per_m[1:] * np.diff(way))])
    turn = matrix_from_axis_angle(turn_rad[:, None] * np.array([0.0, 1.0, 0.0]))
    step_m = np.diff(clip.root_position_m, axis=0)
    root_m = clip.root_position_m[0] + np.concatenate(
        [np.zeros((1, 3)), np.cumsum(np.einsum("tab,tb->ta", turn[:-1], step_m), axis=0)]
    )
    rotation = clip.rotation_wxyz.copy()
    rotation[:, 0] = quaternion_from_matrix(turn @ matrix_from_quaternion(clip.rotation_wxyz[:, 0]))
    return replace(clip, root_position_m=root_m, rotation_wxyz=rotation)


def _way(clip: SourceClip) -> np.ndarray:
    """Way gone until each frame, m."""
    level = gaussian_filter1d(clip.root_position_m[:, [0, 2]], _SMOOTHING_S * clip.fps, axis=0, mode="nearest")
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(level, axis=0), axis=1))])
