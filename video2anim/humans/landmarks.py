"""BlazePose landmarks in the order of the body's keypoints."""

from __future__ import annotations

import numpy as np

from video2anim.body.anny_body import KEYPOINT_NAMES
from video2anim.networks.landmarks import BLAZEPOSE_OF_KEYPOINT

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
