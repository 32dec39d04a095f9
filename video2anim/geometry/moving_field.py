"""Signed distance to a solid that moves rigidly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.geometry.sdf import SdfGrid


@dataclass(frozen=True, slots=True, eq=False)
class MovingField:
    """A solid's distance field in its own frame, and its pose in every frame of the clip."""

    field: SdfGrid
    T_world_solid: Float[np.ndarray, "frames 4 4"]

    def sample(self, points_m: Float[np.ndarray, "frames points 3"]) -> Float[np.ndarray, "frames points"]:
        """Distance of points in the world, each at its frame."""
        return self.field.sample(transform_points(invert_rigid(self.T_world_solid), points_m))
