"""Focal length and up direction from images alone: perspective fields (supplement 8.1), corrected by line segments."""

from __future__ import annotations

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

    frame: int
    """The first of them."""
    camera: FieldCamera
    """The estimate."""
    of_fields: FieldCamera
    """What the perspective fields alone say, the focal length included."""
    segments: tuple[LineSegments, ...]
    """Line segments of each frame; none where they are not used."""

    def with_focal(self, focal_ratio: float) -> FieldCamera:
        """The estimate if the focal length, in image heights, is known from elsewhere."""
        return camera_with_edges(self.of_fields.with_focal(focal_ratio), self.segments, focal_known=True)


def image_cameras(
    clip: VideoClip, model: FieldModel, count: int, *, one_view: bool, line_segments: bool = True
) -> list[ImageCamera]:
    """Cameras that explain the perspective fields of some frames, spread over the clip.

    Args:
        clip: The clip.
        model: Network that gives the fields.
        count: How many frames.
        one_view: Whether all show the same view: then one camera explains them together, otherwise each has its own.
        line_segments: Whether line segments of the images correct the fit.

    Raises:
        InputError: the clip's video cannot be read.
    """
    frames = np.unique(np.linspace(0, clip.frame_count - 1, count).astype(int)).tolist()
    found = []
    for view in [frames] if one_view else [[frame] for frame in frames]:
        images = [read_frame(clip, frame) for frame in view]
        of_fields = fit_camera([model.field(image) for image in images], clip.width_px / clip.height_px)
        segments = tuple(detect_line_segments(image) for image in images) if line_segments else ()
        found.append(ImageCamera(view[0], camera_with_edges(of_fields, segments), of_fields, segments))
    return found
