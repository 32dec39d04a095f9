"""Which BlazePose landmark is which point of the body."""

from __future__ import annotations

import numpy as np

from video2anim.body.anny_body import KEYPOINT_NAMES

BLAZEPOSE_OF_KEYPOINT: dict[str, int] = {
    "nose": 0, "left_eye": 2, "right_eye": 5, "left_ear": 7, "right_ear": 8,
    "left_shoulder": 11, "right_shoulder": 12, "left_elbow": 13, "right_elbow": 14,
    "left_wrist": 15, "right_wrist": 16, "left_pinky": 17, "right_pinky": 18,
    "left_index": 19, "right_index": 20, "left_hip": 23, "right_hip": 24,
    "left_knee": 25, "right_knee": 26, "left_ankle": 27, "right_ankle": 28,
    "left_heel": 29, "right_heel": 30, "left_big_toe": 31, "right_big_toe": 32,
}  # fmt: skip
"""BlazePose GHUM landmark numbers (model card of BlazePose GHUM 3D)."""

LANDMARK_ORDER: np.ndarray = np.array([BLAZEPOSE_OF_KEYPOINT[name] for name in KEYPOINT_NAMES])
"""Picks, from 33 landmarks, those of the body's keypoints in their order."""

KEYPOINT_INDEX: dict[str, int] = {name: i for i, name in enumerate(KEYPOINT_NAMES)}


def _other_side(name: str) -> str:
    return name.replace("left", "right") if name.startswith("left") else name.replace("right", "left")


MIRROR_KEYPOINT: np.ndarray = np.array([KEYPOINT_INDEX[_other_side(name)] for name in KEYPOINT_NAMES])
"""Each keypoint's partner on the other side; the nose is its own."""

_EXTREMITIES = ("index", "pinky", "heel", "toe", "eye", "ear", "nose")
KEYPOINT_TRUST: np.ndarray = np.array(
    [0.5 if any(part in name for part in _EXTREMITIES) else 1.0 for name in KEYPOINT_NAMES]
)
"""Weight of each keypoint: landmarks of hands, feet and face vary more than limb joints."""
