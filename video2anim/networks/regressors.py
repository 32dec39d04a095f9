"""Body regressors over the tracks of a clip."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Float, UInt8

from video2anim.networks.body_estimate import BodyEstimate, square_of_box
from video2anim.networks.gem_x import GemSmpl, coco_keypoints, track_squares
from video2anim.networks.hmr2 import Hmr2
from video2anim.types.camera import Intrinsics
from video2anim.types.people import PersonTrack

_LANDMARK_MARGIN = 1.1
"""Enlargement of a box around landmarks to the box that a detector would give."""
Pictures = Iterable[UInt8[np.ndarray, "height width 3"]]


def regress(
    network: Hmr2 | GemSmpl,
    tracks: Sequence[PersonTrack],
    pictures: Callable[[], Pictures],
    intrinsics: Intrinsics,
    R_first_camera: Float[np.ndarray, "frames 3 3"],
) -> list[BodyEstimate]:
    """SMPL parameters of each person in every frame; not valid where the person is not tracked.

    Args:
        network: the adapter.
        tracks: people, with a row for every frame of the clip (`PersonTrack.whole`).
        pictures: opens the clip's RGB frames; called only for networks that look at them.
        intrinsics: of the pictures.
        R_first_camera: orientation of each frame's camera against the first.

    Raises:
        ModelMissingError: the network's outputs are not those of its contract.
    """
    if isinstance(network, GemSmpl):
        return [
            network.infer(coco_keypoints(track), track_squares(track), intrinsics, R_first_camera=R_first_camera)
            for track in tracks
        ]
    frames = len(R_first_camera)
    found = [_nothing(frames) for _ in tracks]
    for frame, image in enumerate(pictures()):
        for track, body in zip(tracks, found, strict=True):
            if track.valid[frame]:
                square = square_of_box(track.box_px[frame].astype(np.float64), _LANDMARK_MARGIN)
                one = network.infer(image, square, intrinsics)
                body.valid[frame], body.R_parent_joint[frame] = one.valid, one.R_parent_joint
                body.translation_camera_m[frame], body.betas[frame] = one.translation_camera_m, one.betas
    return found


def _nothing(frames: int) -> BodyEstimate:
    identity = np.tile(np.eye(3), (frames, 22, 1, 1))
    return BodyEstimate("smpl", np.zeros(frames, bool), identity, np.full((frames, 3), np.nan), np.zeros((frames, 10)))
