"""Which BlazePose landmark is which point of the body."""

from __future__ import annotations

import numpy as np

BLAZEPOSE_OF_KEYPOINT: dict[str, int] = {
    "nose": 0, "left_eye": 2, "right_eye": 5, "left_ear": 7, "right_ear": 8,
    "left_shoulder": 11, "right_shoulder": 12, "left_elbow": 13, "right_elbow": 14,
    "left_wrist": 15, "right_wrist": 16, "left_pinky": 17, "right_pinky": 18,
    "left_index": 19, "right_index": 20, "left_hip": 23, "right_hip": 24,
    "left_knee": 25, "right_knee": 26, "left_ankle": 27, "right_ankle": 28,
    "left_heel": 29, "right_heel": 30, "left_big_toe": 31, "right_big_toe": 32,
}  # fmt: skip
"""BlazePose GHUM landmark numbers (model card of BlazePose GHUM 3D)."""
LANDMARKS = 1 + max(BLAZEPOSE_OF_KEYPOINT.values())
"""Landmarks of a person."""
_PAIRS = ((1, 4), (2, 5), (3, 6), (7, 8), (9, 10), *((left, left + 1) for left in range(11, LANDMARKS, 2)))
MIRROR_LANDMARK = np.arange(LANDMARKS)
"""Each landmark's partner on the other side; the nose is its own."""
for _left, _right in _PAIRS:
    MIRROR_LANDMARK[[_left, _right]] = _right, _left
BODY_HALVES = (np.arange(23), np.arange(23, LANDMARKS))
"""Face and arms; hips and legs. The network may take the front for the back in one of them alone."""
