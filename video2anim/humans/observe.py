"""Observations of a fit from a tracked person."""

from __future__ import annotations

import numpy as np

from video2anim.humans.landmarks import LANDMARK_ORDER, MIRROR_KEYPOINT
from video2anim.humans.left_right import left_right_flips
from video2anim.humans.problem import Observations
from video2anim.types.camera import Intrinsics
from video2anim.types.people import PersonTrack


def observations(track: PersonTrack, frame_time_s: np.ndarray, intrinsics: Intrinsics) -> Observations:
    """Landmarks of a track in the order of the body's keypoints, without short left-right flips."""
    pixels, points = track.landmarks_px[:, LANDMARK_ORDER], track.landmarks_m[:, LANDMARK_ORDER]
    weight = np.nan_to_num(np.where(track.valid[:, None], track.visibility[:, LANDMARK_ORDER], 0.0))
    swapped = left_right_flips(pixels, points, weight, track.valid, frame_time_s)
    if swapped.any():
        for values in (pixels, points, weight):
            values[swapped] = values[swapped][:, MIRROR_KEYPOINT]
    return Observations(frame_time_s, track.valid, pixels, points, weight, intrinsics)
