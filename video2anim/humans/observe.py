"""Observations of a fit from a tracked person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from video2anim.humans.landmarks import LANDMARK_ORDER
from video2anim.humans.problem import Observations
from video2anim.types.camera import Intrinsics
from video2anim.types.clip import VideoClip
from video2anim.types.people import PersonTrack


def at_frame_times(track: PersonTrack, clip: VideoClip) -> PersonTrack:
    """Landmarks at the times of the frames instead of those of the pictures they show, linear between pictures.

    The times differ where the source has another frame rate than the clip.

    Raises:
        ArtifactError: the track has rows beyond the clip.
    """
    rows = track.frames_in(clip.frame_count)
    frame_time_s, picture_time_s = clip.frame_time_s[rows], clip.picture_time_s[rows]
    pictures = np.flatnonzero((np.diff(picture_time_s, prepend=-np.inf) != 0) & track.valid)
    if len(pictures) == 0:
        return track
    taken_s = picture_time_s[pictures]
    after = np.searchsorted(taken_s, frame_time_s).clip(max=len(pictures) - 1)
    before = np.maximum(after - 1, 0)
    lasted_s = np.maximum(taken_s[after] - taken_s[before], 1e-9)
    between = np.clip((frame_time_s - taken_s[before]) / lasted_s, 0.0, 1.0)

    def moved(values: np.ndarray) -> np.ndarray:
        share = between.reshape(-1, *[1] * (values.ndim - 1))
        whole = (1 - share) * values[pictures[before]] + share * values[pictures[after]]
        whole[~track.valid] = np.nan
        return whole

    return replace(
        track, landmarks_px=moved(track.landmarks_px), landmarks_m=moved(track.landmarks_m),
        visibility=moved(track.visibility),
    )  # fmt: skip


def observations(
    track: PersonTrack,
    frame_time_s: Float[np.ndarray, "frames"],
    intrinsics: Intrinsics,
    up_camera: Float[np.ndarray, "frames 3"],
) -> Observations:
    """Landmarks of a track in the order of the body's keypoints.

    Args:
        track: One person, with a row for every time.
        frame_time_s: Seconds.
        intrinsics: Lens.
        up_camera: Unit vector against gravity in the axes of each row's camera.
    """
    pixels, points = track.landmarks_px[:, LANDMARK_ORDER], track.landmarks_m[:, LANDMARK_ORDER]
    weight = np.nan_to_num(np.where(track.valid[:, None], track.visibility[:, LANDMARK_ORDER], 0.0))
    return Observations(frame_time_s, track.valid, pixels, points, weight, intrinsics, up_camera)
