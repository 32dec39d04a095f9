"""Space that fitted objects fill, so that the next ones are fitted beside them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.geometry.sdf import sample_sdf
from video2anim.objects.form_fit import FormFit

_SPACING_M = 0.05
"""Minimum between the nodes of the field; what is thinner than twice that, legs and boards, fills little or nothing."""
_MAX_NODES = 4_000_000
"""32 MB: a room of 8 x 8 x 4 m at the minimum spacing has 2 million; in halls and gardens the spacing is wider."""
_AROUND_M = 0.3
"""The field is right so near to an object; farther away only that nothing is there counts."""
_FAR_M = 10.0


class Occupied:
    """Signed distance to all fitted objects, on a grid over the room."""

    def __init__(self, bounds_m: Float[np.ndarray, "2 3"]) -> None:
        """`bounds_m`: lowest and highest corner of what objects may fill."""
        self._low_m = bounds_m[0] - _AROUND_M
        size_m = bounds_m[1] + _AROUND_M - self._low_m
        self._spacing_m = max(_SPACING_M, float(np.cbrt(np.prod(size_m) / _MAX_NODES)))
        count = np.ceil(size_m / self._spacing_m).astype(int) + 1
        self._sdf_m = np.full(tuple(count), _FAR_M)

    def add(self, fit: FormFit) -> None:
        """Fill the object's solids."""
        _, solids = fit.solids()
        T_world_object = fit.T_world_object
        surface_m = solids.surface_points_m(3)[0] @ T_world_object[:3, :3].T + T_world_object[:3, 3]
        shape = np.array(self._sdf_m.shape)
        first = np.clip(((surface_m.min(0) - _AROUND_M - self._low_m) / self._spacing_m).astype(int), 0, shape)
        last = np.clip(((surface_m.max(0) + _AROUND_M - self._low_m) / self._spacing_m).astype(int) + 1, 0, shape)
        nodes = np.stack(np.meshgrid(*map(np.arange, first, last), indexing="ij"), -1)
        own_m = (self._low_m + self._spacing_m * nodes - T_world_object[:3, 3]) @ T_world_object[:3, :3]
        distance_m = solids.distance_m(own_m.reshape(1, -1, 3)).min(1).reshape(nodes.shape[:3])
        part = self._sdf_m[tuple(map(slice, first, last))]
        np.minimum(part, distance_m, out=part)

    def distance_m(self, points_m: Float[np.ndarray, "*batch points 3"]) -> Float[np.ndarray, "*batch points"]:
        """Of points of the world from the nearest object, negative inside; large where none is near."""
        return sample_sdf(self._sdf_m, self._low_m, self._spacing_m, points_m)
