"""BlazePose landmarks in the order of the body's keypoints, and where they are on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from video2anim.body.anny_body import KEYPOINT_NAMES, RestSkeleton
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

LANDMARK_OFFSETS = {
    "nose": (0.0, 0.003, -0.013), "eye": (-0.004, 0.0, -0.014), "ear": (-0.016, 0.003, 0.009),
    "shoulder": (-0.013, -0.005, 0.001), "elbow": (-0.001, -0.001, -0.001), "wrist": (0.004, 0.001, 0.001),
    "hip": (-0.004, 0.008, 0.007), "knee": (-0.005, 0.01, -0.003), "ankle": (0.001, 0.008, 0.005),
    "big_toe": (0.009, 0.004, -0.017), "heel": (-0.003, 0.005, 0.004), "index": (-0.013, -0.01, -0.007),
    "pinky": (-0.009, 0.008, 0.016),
}  # fmt: skip
"""From each left keypoint of the body to its landmark, over the body's height, along the axes of the T-pose (x to the
left, y up, z to the front): of 18 rendered people (`benchmarks/landmark_places.py`)."""


def _offset(keypoint: str) -> tuple[float, float, float]:
    side, _, part = keypoint.partition("_")
    x, y, z = LANDMARK_OFFSETS[part or side]
    return (-x if side == "right" else x, y, z)


_OFFSETS = torch.tensor([_offset(name) for name in KEYPOINT_NAMES])


def with_landmarks(rest: RestSkeleton) -> RestSkeleton:
    """The skeleton with its keypoints where BlazePose sees them."""
    moved_m = _OFFSETS[:, None] * rest.body_height_m
    return replace(rest, keypoint_offsets_m=rest.keypoint_offsets_m + moved_m)
