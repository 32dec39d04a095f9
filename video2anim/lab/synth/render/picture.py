"""The result of rendering one frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8, UInt16


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A rendered image with its labels. Labels are sampled at pixel centers and are not anti-aliased."""

    rgb: UInt8[np.ndarray, "height width 3"]
    """sRGB after exposure and tone curve, before the sensor."""
    depth_m: Float[np.ndarray, "height width"]
    """z-depth, float32; 0 = no surface."""
    normal_camera: Float[np.ndarray, "height width 3"]
    """Unit normals in camera axes, facing the camera, float32; 0 = no surface."""
    instance: UInt16[np.ndarray, "height width"]
    """`object_id`; `PERSON_ID` + person_id for people; 0 = no surface."""
