"""Evidence of the fit: points in the camera frame of stage humans (OpenCV axes, meters), viewing rays of pixels and
their relative depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, slots=True, eq=False)
class PersonEvidence:
    """One person."""

    person_id: int
    body_height_sigma: float
    """Prior standard deviation of the logarithm of the standing height."""
    support_m: Float[np.ndarray, "windows 3"]
    """Lowest point of the skin in each window of 0.6 s, in which people who stand or walk have a foot on the ground,
    and those on their hands a hand."""
    camera_m: Float[np.ndarray, "windows 3"]
    """Where the camera was then."""


@dataclass(frozen=True, slots=True, eq=False)
class SkinEvidence:
    """Skin of the main person and pixels that show it (supplement 8.1), or soles and the pixels of their support."""

    skin_m: Float[np.ndarray, "vertices 3"]
    ray: Float[np.ndarray, "pixels 3"]
    """Viewing rays of unit z-depth."""
    value: Float[np.ndarray, "pixels"]
    """Relative depth or disparity."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelEvidence:
    """Pixels of one surface and their relative depth."""

    ray: Float[np.ndarray, "pixels 3"]
    """Viewing rays of unit z-depth."""
    value: Float[np.ndarray, "pixels"]


@dataclass(frozen=True, slots=True, eq=False)
class PointEvidence:
    """Background points whose depth the motion of a traveling camera tells, where the first frame shows them."""

    seen: PixelEvidence
    depth_m: Float[np.ndarray, "pixels"]
    """With the length of the camera's path by stage humans."""
    log_sigma: Float[np.ndarray, "pixels"]
    """Standard deviation of the logarithm of the depth relative to the length of the path."""
    surface: Int[np.ndarray, "pixels"]
    """Index of the object that the pixel shows, or `FLOOR` or `ROOM`."""


FLOOR, ROOM = -1, -2
"""Surfaces that are no objects."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectEvidence:
    """One object of the image; evidence that is not visible is None."""

    object_id: int
    label: str
    foot: PixelEvidence | None
    """The pixel in which it meets the floor."""
    foot_is_cut: bool
    """Whether the image border cuts the object: it may be nearer than its lowest pixel on the floor."""
    top: PixelEvidence | None
    """Its highest pixel, if its foot is visible and its class has a usual height."""
    under_feet: SkinEvidence | None = None
    """Soles of the main person that stood on it, and the object's depth there, or its median depth for soles above the
    camera. Its foot is no evidence then, unless they are above the camera: what people stand on may be the floor."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """All evidence of the fit."""

    focal_px: float
    up: Float[np.ndarray, "3"]
    """Up direction in the camera frame."""
    people: tuple[PersonEvidence, ...]
    """The main person first."""
    kind: str
    """Of depth: `depth` or `disparity`."""
    skin: tuple[SkinEvidence, ...]
    floor: PixelEvidence
    objects: tuple[ObjectEvidence, ...]
    usual_offset: float
    """Offset over scale times `median_value`, mean of the network."""
    usual_offset_sigma: float
    """Its standard deviation."""
    median_value: float
    """Median absolute value of relative depth; absolute, because the zero of some networks is inside the range."""
    path_log_sigma: float = 0.0
    """Standard deviation of the logarithm of the length of the camera's path by stage humans; 0 if the camera does not
    travel."""
    points: PointEvidence | None = None
    """None if no depth is known by the camera's motion."""
