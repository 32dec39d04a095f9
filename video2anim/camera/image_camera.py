"""Focal length and up direction from images alone: perspective fields (supplement 8.1), corrected by line segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from video2anim.geometry.line_segments import LineSegments, camera_with_edges, detect_line_segments
from video2anim.geometry.perspective_field import FieldCamera, PerspectiveField, fit_camera
from video2anim.types import VideoClip
from video2anim.video import read_frame


@runtime_checkable
class FieldModel(Protocol):
    """A network in slot `camera`."""

    def field(self, image_rgb: UInt8[np.ndarray, "height width 3"]) -> PerspectiveField:
        """Perspective field of one image."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ImageCamera:
    """What a few frames of one view say of the camera."""

    camera: FieldCamera
    """The estimate."""
    of_fields: FieldCamera
    """What the perspective fields alone say, the focal length included."""
    segments: tuple[LineSegments, ...]
    """Line segments of each frame; none where they are not used."""

    @classmethod
    def of(
        cls, of_fields: FieldCamera, segments: tuple[LineSegments, ...], focal_ratio: float | None = None
    ) -> ImageCamera:
        """The estimate from fields and segments; `focal_ratio` is the focal length in image heights if it is known."""
        known = focal_ratio is not None
        camera = of_fields.with_focal(focal_ratio) if known else of_fields
        return cls(camera_with_edges(camera, segments, focal_known=known), of_fields, segments)

    def with_focal(self, focal_ratio: float) -> ImageCamera:
        """The same evidence of gravity if the focal length, in image heights, is known from elsewhere."""
        return ImageCamera.of(self.of_fields, self.segments, focal_ratio)


def image_camera(
    clip: VideoClip,
    model: FieldModel,
    frames: Sequence[int],
    *,
    focal_px: float | None = None,
    line_segments: bool = True,
) -> ImageCamera:
    """Camera that explains the perspective fields of some frames.

    Args:
        clip: The clip.
        model: Network that gives the fields.
        frames: Frames of the same view.
        focal_px: Known focal length; only the up direction is estimated then.
        line_segments: Whether line segments of the images correct the fit.

    Raises:
        InputError: the clip's video cannot be read.
    """
    images = [read_frame(clip, frame) for frame in frames]
    fields = [model.field(image) for image in images]
    segments = tuple(detect_line_segments(image) for image in images) if line_segments else ()
    known = None if focal_px is None else focal_px / clip.height_px
    return ImageCamera.of(fit_camera(fields, clip.width_px / clip.height_px), segments, known)
