"""BlazePose landmarks in the order of the body's keypoints."""

from __future__ import annotations

import numpy as np

from video2anim.body.anny_body import KEYPOINT_NAMES
from video2anim.networks.landmarks import BLAZEPOSE_OF_KEYPOINT
from video2anim.types.skeleton import other_side

LANDMARK_ORDER: np.ndarray = np.array([BLAZEPOSE_OF_KEYPOINT[name] for name in KEYPOINT_NAMES])
"""Picks, from 33 landmarks, those of the body's keypoints in their order."""

KEYPOINT_INDEX: dict[str, int] = {name: i for i, name in enumerate(KEYPOINT_NAMES)}
MIRROR_KEYPOINT: np.ndarray = np.array([KEYPOINT_INDEX[other_side(name)] for name in KEYPOINT_NAMES])
"""Each keypoint's partner on the other side; the nose is its own."""

_EXTREMITIES = ("index", "pinky", "heel", "toe", "eye", "ear", "nose")
KEYPOINT_TRUST: np.ndarray = np.array(
    [0.5 if any(part in name for part in _EXTREMITIES) else 1.0 for name in KEYPOINT_NAMES]
)
"""Weight of each keypoint: landmarks of hands, feet and face vary more than limb joints."""
