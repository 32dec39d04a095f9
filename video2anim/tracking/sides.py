"""Front and back of people who are seen small or from behind: no body turns around within a frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from video2anim.networks.landmarks import BLAZEPOSE_OF_KEYPOINT, BODY_HALVES, MIRROR_LANDMARK
from video2anim.types import PersonTrack

_CLEAR = 0.1
"""Width of shoulders or hips over the torso's height from which a view is from the front or from behind, not from the
side."""
_SHORT_S = 0.2
"""Longest time for which a body is taken for one that faces the other way: nobody turns around and back in it."""
_LEFT, _RIGHT = (
    [BLAZEPOSE_OF_KEYPOINT[f"{side}_{part}"] for part in ("shoulder", "hip")] for side in ("left", "right")
)


def without_reversals(track: PersonTrack, fps: float) -> PersonTrack:
    """The track in which upper and lower bodies that turn around within a frame, and soon back, face the way that they
    did before.

    A body that faces the other way has the same outline if left and right, and near and far, are exchanged.
    """
    points_px = np.where(track.valid[:, None, None], track.landmarks_px, np.nan)
    turns = is_turned(points_px[1:], points_px[:-1])
    exchanged = np.zeros(track.visibility.shape, bool)
    for half, turned in zip(BODY_HALVES, turns.T, strict=True):
        last = None
        for frame in np.flatnonzero(turned) + 1:
            if last is not None and frame - last <= _SHORT_S * fps:
                exchanged[last:frame, half] = True
                last = None
            else:
                last = frame
    if not exchanged.any():
        return track
    source = np.where(exchanged, MIRROR_LANDMARK, np.arange(len(MIRROR_LANDMARK)))
    landmarks_px, landmarks_m = (
        np.take_along_axis(values, source[..., None], 1) for values in (track.landmarks_px, track.landmarks_m)
    )
    landmarks_m[exchanged, 2] *= -1
    visibility = np.take_along_axis(track.visibility, source, 1)
    return replace(track, landmarks_px=landmarks_px, landmarks_m=landmarks_m, visibility=visibility)


def is_turned(
    first_px: Float[np.ndarray, "*frames 33 2"], second_px: Float[np.ndarray, "*frames 33 2"]
) -> Bool[np.ndarray, "*frames halves"]:
    """Whether the shoulders, the hips of one of two bodies are clearly seen from the front and those of the other from
    behind; not where one is NaN."""
    first, second = _widths(first_px), _widths(second_px)
    return np.asarray((np.minimum(np.abs(first), np.abs(second)) > _CLEAR) & (first * second < 0))


def _widths(landmarks_px: Float[np.ndarray, "*frames 33 2"]) -> Float[np.ndarray, "*frames halves"]:
    """Widths of shoulders and hips over the height of the torso, positive if their left is to the right of the
    spine."""
    left, right = landmarks_px[..., _LEFT, :], landmarks_px[..., _RIGHT, :]
    across, spine = left - right, 0.5 * np.subtract(*np.moveaxis(left + right, -2, 0))[..., None, :]
    height_px2 = np.maximum((spine**2).sum(-1), 1e-9)
    return (spine[..., 0] * across[..., 1] - spine[..., 1] * across[..., 0]) / height_px2
