"""People in the picture: boxes, BlazePose landmarks and masks over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, UInt8
from pydantic import NonNegativeInt

from video2anim.errors import ArtifactError
from video2anim.types.checks import Checked
from video2anim.types.storage import Holds, IdsOf, OnePer, Storage, stored


@dataclass(frozen=True, slots=True, eq=False)
class PersonTrack(Checked):
    """One tracked person; rows are frames from `first_frame` on. Rows with `valid` False are NaN (masks 0)."""

    person_id: NonNegativeInt
    valid: Bool[np.ndarray, "rows"]
    score: Annotated[Float[np.ndarray, "rows"], Holds.GAPS]
    """Presence score of the landmark model, 0 to 1."""
    box_px: Annotated[Float[np.ndarray, "rows 4"], Holds.GAPS]
    """x0, y0, x1, y1 around the landmarks in the clip's pixels."""
    landmarks_px: Annotated[Float[np.ndarray, "rows 33 2"], Holds.GAPS]
    """BlazePose landmarks, in the clip's pixels."""
    landmarks_m: Annotated[Float[np.ndarray, "rows 33 3"], Holds.GAPS]
    """BlazePose world landmarks in meters, origin between the hips, OpenCV axes (x right, y down, z away)."""
    visibility: Annotated[Float[np.ndarray, "rows 33"], Holds.GAPS]
    """Probability that the landmark is in the picture and not occluded, less where the model contradicts itself."""
    mask_crop: UInt8[np.ndarray, "rows 64 64"]
    """Person probability x 255 in the square crop."""
    T_image_crop: Annotated[Float[np.ndarray, "rows 2 3"], Holds.GAPS]
    """Affine map from crop coordinates in [0, 1] x [0, 1] to pixels."""
    first_frame: NonNegativeInt = 0
    """Frame of the clip of the first row."""

    def row(self, frame: int) -> int | None:
        """The row of a frame of the clip; None if the track has no row for it."""
        row = frame - self.first_frame
        return row if 0 <= row < len(self.valid) and self.valid[row] else None

    def frames_in(self, frame_count: int) -> slice:
        """The frames of its rows in a clip of `frame_count` frames.

        Raises:
            ArtifactError: it has rows beyond the clip, as files edited by hand may.
        """
        rows = slice(self.first_frame, self.first_frame + len(self.valid))
        if rows.stop > frame_count:
            raise ArtifactError(
                f"stage track, person {self.person_id}: want rows for frames 0 to {frame_count - 1} of the clip, got "
                f"{rows.start} to {rows.stop - 1}; correct first_frame, or run with --from track"
            )
        return rows

    def whole(self, frame_count: int) -> PersonTrack:
        """The track with a row for every frame of the clip. Masks and crops, which are large, are dropped (0, NaN).

        Args:
            frame_count: Number of frames of the clip.

        Raises:
            ArtifactError: as `frames_in`.
        """
        rows = self.frames_in(frame_count)

        def filled(values: np.ndarray) -> np.ndarray:
            whole = np.full((frame_count, *values.shape[1:]), np.nan if values.dtype.kind == "f" else 0, values.dtype)
            whole[rows] = values
            return whole

        return PersonTrack(
            self.person_id, filled(self.valid), filled(self.score), filled(self.box_px), filled(self.landmarks_px),
            filled(self.landmarks_m), filled(self.visibility),
            np.broadcast_to(np.uint8(0), (frame_count, *self.mask_crop.shape[1:])),
            np.broadcast_to(np.nan, (frame_count, 2, 3)),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Thumbnail(Checked):
    """Picture of a person from the frame in which most of the body is visible."""

    person_id: NonNegativeInt
    frame: NonNegativeInt
    rgb: UInt8[np.ndarray, "side side 3"] = stored(Storage.IMAGE)


@dataclass(frozen=True, slots=True, eq=False)
class PersonTracks(Checked):
    """All people, largest mean box area first."""

    people: tuple[PersonTrack, ...]
    selected_ids: Annotated[tuple[int, ...], IdsOf("people")]
    """Persons that later stages process (`--person`)."""
    thumbnails: Annotated[tuple[Thumbnail, ...], OnePer("people")] = ()
    """One for each person, in the order of `people`."""

    def selected(self) -> tuple[PersonTrack, ...]:
        """Tracks of the selected persons, main person first, each over its own frames."""
        by_id = {track.person_id: track for track in self.people}
        return tuple(by_id[i] for i in self.selected_ids)
