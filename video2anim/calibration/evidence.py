"""What the fit rests on, in the camera frame (OpenCV axes, meters) as stage humans has it, or in pixels' own values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from video2anim.types.camera import UpEvidence


@dataclass(frozen=True, slots=True, eq=False)
class PersonEvidence:
    """One person. Roots are the pelvis in the same frames: the body turns about it when the lens changes."""

    person_id: int
    body_height_sigma: float
    """Standard deviation of the logarithm of the standing height before the clip is looked at."""
    soles_m: Float[np.ndarray, "windows 3"]
    """Lowest point of the skin in each stretch of 0.6 s: somebody who stands or walks has a foot down in it."""
    soles_root_m: Float[np.ndarray, "windows 3"]
    upright: Float[np.ndarray, "looks 3"]
    """Unit vectors from the feet to the center of mass, three a second: a body that stands or walks is in balance."""
    upright_root_m: Float[np.ndarray, "looks 3"]


@dataclass(frozen=True, slots=True, eq=False)
class SkinEvidence:
    """Skin of the main person and depth of pixels that show it (paper 8.1), or what it stands on."""

    root_m: Float[np.ndarray, "*vertices 3"]
    """One for all, of one frame; or of the frame of each vertex."""
    skin_m: Float[np.ndarray, "vertices 3"]
    pixel: Float[np.ndarray, "pixels 2"]
    """From the picture's middle, in pixels of the clip."""
    value: Float[np.ndarray, "pixels"]
    """Relative depth or disparity."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelEvidence:
    """Pixels of one surface with relative depth."""

    pixel: Float[np.ndarray, "pixels 2"]
    """From the picture's middle, in pixels of the clip."""
    value: Float[np.ndarray, "pixels"]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectEvidence:
    """One object of the picture; what is not seen of it is None."""

    object_id: int
    label: str
    foot: PixelEvidence | None
    """The pixel in which it meets the floor."""
    foot_is_cut: bool
    """Whether the picture ends there: the object is not farther than that, but may be nearer."""
    top: PixelEvidence | None
    """Its highest pixel, with a foot to measure from, where objects of its kind have a usual height."""
    behind: PixelEvidence | None
    """A pixel before which the main person was seen..."""
    behind_person_m: float
    """...at this depth: the object is not nearer."""
    under_feet: SkinEvidence | None = None
    """Soles of the main person that stood on it, each with its root, and the object's depth there. Where it meets the
    floor then tells nothing: the floor is what people stand on."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """All of it."""

    focal_px: float
    focal_log_sigma: float
    up: tuple[UpEvidence, ...]
    people: tuple[PersonEvidence, ...]
    """The main person first."""
    kind: str
    """Of depth: `depth` or `disparity`."""
    skin: tuple[SkinEvidence, ...]
    floor: PixelEvidence
    objects: tuple[ObjectEvidence, ...]
    usual_offset: float
    """Offset of depth over scale times the picture's middle value, as the network usually has it..."""
    usual_offset_sigma: float
    """...and its standard deviation."""
    middle_value: float
    """Of the sizes of the picture's values: some networks put their zero into the middle of the picture."""
