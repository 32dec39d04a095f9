"""What a renderer hands over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8, UInt16


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A drawn picture with its truth. Labels hold at pixel centers and are not anti-aliased."""

    rgb: UInt8[np.ndarray, "height width 3"]
    """sRGB after exposure and tone curve, before the sensor."""
    depth_m: Float[np.ndarray, "height width"]
    """z-depth, float32; 0 where nothing is seen."""
    normal_camera: Float[np.ndarray, "height width 3"]
    """Unit normals in camera axes, turned to the camera, float32; 0 where nothing is seen."""
    instance: UInt16[np.ndarray, "height width"]
    """`object_id`; `PERSON_ID` + person_id for people; 0 where nothing is seen."""
