"""From a tracked person to what the fit sees."""

from __future__ import annotations

import numpy as np

from video2anim.fitting.landmarks import LANDMARK_ORDER
from video2anim.fitting.problem import Observations
from video2anim.types.camera import Intrinsics
from video2anim.types.people import PersonTrack


def observations(
    track: PersonTrack, frame_time_s: np.ndarray, intrinsics: Intrinsics, frames: np.ndarray | None = None
) -> Observations:
    """Landmarks of a track (all frames, or the chosen ones) in the order of the body's keypoints."""
    chosen = np.arange(len(track.valid)) if frames is None else frames
    valid = track.valid[chosen]
    weight = np.where(valid[:, None], track.visibility[chosen][:, LANDMARK_ORDER], 0.0)
    return Observations(
        frame_time_s[chosen], valid, track.landmarks_px[chosen][:, LANDMARK_ORDER],
        track.landmarks_m[chosen][:, LANDMARK_ORDER], np.nan_to_num(weight), intrinsics,
    )  # fmt: skip
