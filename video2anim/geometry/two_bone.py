"""Two-bone inverse kinematics: limbs of two bones of fixed length."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def flexion_rad(
    first_m: float | Float[np.ndarray, "frames"],
    second_m: float | Float[np.ndarray, "frames"],
    distance_m: Float[np.ndarray, "frames"],
) -> Float[np.ndarray, "frames"]:
    """Angle between the directions of two bones whose ends are so far apart, by the law of cosines; 0 is straight.

    Distances that the bones cannot reach give the nearest angle that they can.
    """
    cosine = (distance_m**2 - first_m**2 - second_m**2) / (2 * first_m * second_m)
    return np.arccos(np.clip(cosine, -1.0, 1.0))
