"""Front and back of people who are seen small or from behind: no body turns around within a frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from video2anim.networks.landmarks import LEFT_TORSO, MIRROR_LANDMARK, RIGHT_TORSO
from video2anim.types import PersonTrack

_CLEAR = 0.1
"""Width of the torso over its height from which a view is from the front or from behind, not from the side."""
_SHORT_S = 0.2
"""Longest time for which a body is taken for one that faces the other way: nobody turns around and back in it."""
_SHOULDERS, _HIPS = map(list, zip(LEFT_TORSO, RIGHT_TORSO, strict=True))


def without_reversals(track: PersonTrack, fps: float) -> PersonTrack:
    """The track in which landmarks that turn around within a frame, and soon back, face the way that they did before.

    A body that faces the other way has the same outline if left and right, and near and far, are exchanged.
    """
    points_px = np.where(track.valid[:, None, None], track.landmarks_px, np.nan)
    reversed_frames, last = np.zeros(len(track.valid), bool), None
    for frame in np.flatnonzero(is_turned(points_px[1:], points_px[:-1])) + 1:
        if last is not None and frame - last <= _SHORT_S * fps:
            reversed_frames[last:frame] = True
            last = None
        else:
            last = frame
    if not reversed_frames.any():
        return track
    points_px, points_m, visibility = (
        np.where(reversed_frames.reshape(-1, *[1] * (values.ndim - 1)), values[:, MIRROR_LANDMARK] * sign, values)
        for values, sign in (
            (track.landmarks_px, 1.0), (track.landmarks_m, np.array([1.0, 1.0, -1.0])), (track.visibility, 1.0)
        )
    )  # fmt: skip
    return replace(track, landmarks_px=points_px, landmarks_m=points_m, visibility=visibility)


def is_turned(
    first_px: Float[np.ndarray, "*frames 33 2"], second_px: Float[np.ndarray, "*frames 33 2"]
) -> Bool[np.ndarray, "*frames"]:
    """Whether one of two bodies is clearly seen from the front and the other from behind; not where one is NaN."""
    first, second = _torso_width(first_px), _torso_width(second_px)
    return np.asarray((np.minimum(np.abs(first), np.abs(second)) > _CLEAR) & (first * second < 0))


def _torso_width(landmarks_px: Float[np.ndarray, "*frames 33 2"]) -> Float[np.ndarray, "*frames"]:
    """Width over height of the torso, positive if its left is to the right of its spine."""
    across = (landmarks_px[..., LEFT_TORSO, :] - landmarks_px[..., RIGHT_TORSO, :]).mean(-2)
    spine = landmarks_px[..., _SHOULDERS, :].mean(-2) - landmarks_px[..., _HIPS, :].mean(-2)
    height_px2 = np.maximum((spine**2).sum(-1), 1e-9)
    return (spine[..., 0] * across[..., 1] - spine[..., 1] * across[..., 0]) / height_px2
