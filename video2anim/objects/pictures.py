"""Objects with the paths of those that somebody moves, found in small pictures of the clip."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from video2anim.objects.carried import LONG_SIDE_PX, MAX_SAMPLES, Pictures, with_moved_objects
from video2anim.types import BackgroundImage, BodyTracks, InstanceMasks, PlacedObject, VideoClip
from video2anim.video import read_frames


def with_paths(
    objects: Sequence[PlacedObject],
    clip: VideoClip,
    masks: InstanceMasks,
    background: BackgroundImage,
    bodies: BodyTracks,
) -> Sequence[PlacedObject]:
    """`with_moved_objects` of a clip whose camera is static."""
    pictures = pictures_of(clip, background)
    return objects if pictures is None else with_moved_objects(pictures, masks, bodies, objects)


def pictures_of(clip: VideoClip, background: BackgroundImage) -> Pictures | None:
    """Small pictures with where people are in them; None for a clip of one."""
    if len(background.frame_index) < 2:
        return None
    step = int(background.frame_index[1])
    regular = np.flatnonzero(background.frame_index % step == 0)
    every = -(-len(regular) // MAX_SAMPLES)
    rows = regular[::every]
    scale = min(1.0, LONG_SIDE_PX / max(clip.width_px, clip.height_px))
    size = (round(clip.width_px * scale), round(clip.height_px * scale))
    frames = read_frames(clip, 0, int(background.frame_index[rows[-1]]) + 1, step * every)
    rgb = np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])
    people = [
        cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        for mask in background.person_mask[rows]
    ]
    background_rgb = cv2.resize(background.background_rgb, size, interpolation=cv2.INTER_AREA)
    return Pictures(rgb, np.stack(people) > 0, background_rgb, step * every)
