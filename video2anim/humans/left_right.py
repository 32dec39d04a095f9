"""Frames in which a landmark model swaps left and right."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from video2anim.humans.landmarks import MIRROR_KEYPOINT

_SIDED = np.arange(len(MIRROR_KEYPOINT)) != MIRROR_KEYPOINT
_MIN_JUMP = 0.08
"""Mean jump of the keypoints from frame to frame, over the person's size, below which no flip is tested."""
_CLEARLY = 0.5
"""With sides exchanged the jump must fall below this share."""
_LONGEST_S = 1.0
"""Longer stretches stay: the person may have turned while unseen."""


def left_right_flips(
    keypoints_px: Float[np.ndarray, "frames keypoints 2"],
    keypoints_m: Float[np.ndarray, "frames keypoints 3"],
    weight: Float[np.ndarray, "frames keypoints"],
    valid: Bool[np.ndarray, "frames"],
    frame_time_s: Float[np.ndarray, "frames"],
) -> Bool[np.ndarray, "frames"]:
    """Frames whose left and right are exchanged against those before and after.

    A body cannot turn around within a frame. Where all keypoints jump, and hardly jump with sides exchanged, the
    landmark model flipped. Of the stretches between flips, the alternate ones with fewer frames in all are wrong.
    """
    rows = np.flatnonzero(valid)
    swapped = np.zeros(len(valid), bool)
    if len(rows) < 3:
        return swapped
    size = np.linalg.norm(np.ptp(keypoints_px[rows], axis=1), axis=-1)
    # In sizes of the person, and in meters, relative to the hips.
    seen = np.concatenate([keypoints_px[rows] / np.median(size), keypoints_m[rows]], -1)
    both = np.minimum(weight[rows[1:]], weight[rows[:-1]][:, MIRROR_KEYPOINT])[:, _SIDED] + 1e-3
    stay = np.linalg.norm(seen[1:] - seen[:-1], axis=-1)[:, _SIDED]
    cross = np.linalg.norm(seen[1:] - seen[:-1][:, MIRROR_KEYPOINT], axis=-1)[:, _SIDED]
    jump, jump_crossed = ((both * part).sum(1) / both.sum(1) for part in (stay, cross))
    changes = np.flatnonzero((jump > _MIN_JUMP) & (jump_crossed < _CLEARLY * jump)) + 1
    edges = np.concatenate([[0], changes, [len(rows)]])
    sides = np.arange(len(edges) - 1) % 2
    lengths = np.diff(edges)
    wrong = 1 if lengths[sides == 1].sum() <= lengths[sides == 0].sum() else 0
    for first, last, side in zip(edges[:-1], edges[1:], sides, strict=True):
        lasts_s = frame_time_s[rows[last - 1]] - frame_time_s[rows[first]]
        if side == wrong and len(changes) and lasts_s <= _LONGEST_S:
            swapped[rows[first:last]] = True
    return swapped
