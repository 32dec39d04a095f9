"""The video: the input file, and the clip of the pipeline (30 fps, upright, square pixels)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import FiniteFloat, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from video2anim.types.checks import Checked
from video2anim.types.storage import Holds, PayloadFile

FPS = 30.0
"""Frame rate in Hz of every clip and motion after ingest; the networks are trained at it."""


@dataclass(frozen=True, slots=True)
class SourceVideo:
    """The input file."""

    path: Path
    digest: str
    """sha256 of the bytes, hexadecimal."""


@dataclass(frozen=True, slots=True)
class SourceInfo(Checked):
    """Properties of the input by its container and decoder."""

    codec: str
    pixel_format: str
    stored_width_px: PositiveInt
    stored_height_px: PositiveInt
    rotation_deg: int
    """Clockwise quarter turns that make the picture upright: 0, 90, 180 or 270."""
    pixel_aspect: PositiveFloat
    """Width over height of a stored pixel."""
    average_fps: NonNegativeFloat
    decoded_frames: NonNegativeInt
    claimed_frames: NonNegativeInt
    """Number of frames by the header; 0 if the header has none."""
    duration_s: NonNegativeFloat
    focal_35mm: NonNegativeFloat
    """35 mm equivalent focal length in mm from metadata; 0 if missing."""


@dataclass(frozen=True, slots=True, eq=False)
class VideoClip(Checked):
    """One shot at 30 fps. Read its pictures with `video2anim.video.read_frames`."""

    video: PayloadFile
    """H.264 at constant 30 fps, upright, square pixels."""
    width_px: PositiveInt
    height_px: PositiveInt
    fps: PositiveFloat
    frame_time_s: Annotated[Float[np.ndarray, "frames"], Holds.RISING]
    """Time in the clip, starting at 0."""
    source_time_s: Float[np.ndarray, "frames"]
    """Time stamp, in the source, of the picture in this frame."""
    source: SourceInfo
    shots_s: tuple[tuple[FiniteFloat, FiniteFloat], ...]
    """Start and end in source time of every shot found; the clip is one of them."""
    shot_index: NonNegativeInt
    warnings: tuple[str, ...]

    @property
    def frame_count(self) -> int:
        return len(self.frame_time_s)

    @property
    def picture_time_s(self) -> Float[np.ndarray, "frames"]:
        """Time in the clip at which the picture in each frame was taken; several frames may show one."""
        return self.source_time_s - self.source_time_s[0]
