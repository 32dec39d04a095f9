"""People in the picture: boxes, BlazePose landmarks and masks over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from video2anim.types.storage import Storage, stored


@dataclass(frozen=True, slots=True, eq=False)
class PersonTrack:
    """One person over all frames of the clip. Where `valid` is False the other rows are NaN (masks 0)."""

    person_id: int
    valid: Bool[np.ndarray, "frames"]
    score: Float[np.ndarray, "frames"]
    """Presence score of the landmark model, 0 to 1."""
    box_px: Float[np.ndarray, "frames 4"]
    """x0, y0, x1, y1 around the landmarks in the clip's pixels."""
    landmarks_px: Float[np.ndarray, "frames 33 2"]
    """BlazePose landmarks, in the clip's pixels."""
    landmarks_m: Float[np.ndarray, "frames 33 3"]
    """BlazePose world landmarks in metres, origin between the hips, OpenCV axes (x right, y down, z away)."""
    visibility: Float[np.ndarray, "frames 33"]
    """Probability that the landmark is in the picture and not hidden."""
    mask_crop: UInt8[np.ndarray, "frames 64 64"]
    """Person probability x 255 in the square crop."""
    T_image_crop: Float[np.ndarray, "frames 2 3"]
    """Affine map from crop coordinates in [0, 1] x [0, 1] to pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class Thumbnail:
    """A person as seen in the frame that shows most of them."""

    person_id: int
    frame: int
    rgb: UInt8[np.ndarray, "side side 3"] = stored(Storage.IMAGE)


@dataclass(frozen=True, slots=True, eq=False)
class PersonTracks:
    """All people, largest mean box area first."""

    people: tuple[PersonTrack, ...]
    selected_ids: tuple[int, ...]
    """Persons the later stages work on (`--person`)."""
    frame_stride: int
    """Landmarks were run on every such frame and interpolated between; 1 = every frame."""
    thumbnails: tuple[Thumbnail, ...] = ()
    """One of each person, in the order of `people`."""

    def selected(self) -> tuple[PersonTrack, ...]:
        """Tracks of the selected persons, main person first."""
        by_id = {track.person_id: track for track in self.people}
        return tuple(by_id[i] for i in self.selected_ids)
