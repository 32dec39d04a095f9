"""What the body can touch: signed distances to solids, some of which may give way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from video2anim.geometry.sdf import SdfGrid

_STEP_M = 0.03
"""Half the way over which a surface's normal is taken: half the spacing of the scene's field."""


@dataclass(frozen=True, slots=True, eq=False)
class MovableSolid:
    """A solid whose place is uncertain."""

    field: SdfGrid
    covariance_m2: Float[np.ndarray, "3 3"]
    """Of its displacement."""


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """What the body can touch."""

    still: SdfGrid | None = None
    """Does not give way."""
    movable: tuple[MovableSolid, ...] = ()
    floor: bool = True
    """Whether the half space below y = 0 is solid."""
    reach_m: float = np.inf
    """Movable solids farther from a point than this need not be found."""

    @property
    def known(self) -> bool:
        """Whether there is any."""
        return self.floor or self.still is not None or bool(self.movable)

    def distance_m(
        self, points_m: Float[np.ndarray, "*points 3"], moved_m: Float[np.ndarray, "solids 3"]
    ) -> tuple[Float[np.ndarray, "*points"], Int[np.ndarray, "*points"]]:
        """Signed distance to the nearest solid, and its number among the movable ones; -1 for the others."""
        flat_m = points_m.reshape(-1, 3)
        nearest_m = flat_m[:, 1].copy() if self.floor else np.full(len(flat_m), self.reach_m)
        owner = np.full(len(flat_m), -1)
        if self.still is not None:
            nearest_m = np.minimum(nearest_m, self.still.sample(flat_m))
        for number, (solid, way_m) in enumerate(zip(self.movable, moved_m, strict=True)):
            field = replace(solid.field, origin_m=solid.field.origin_m + way_m)
            near = field.within(flat_m, self.reach_m)
            distance_m = field.sample(flat_m[near])
            closer = distance_m < nearest_m[near]
            nearest_m[near[closer]], owner[near[closer]] = distance_m[closer], number
        return nearest_m.reshape(points_m.shape[:-1]), owner.reshape(points_m.shape[:-1])

    def normals(
        self, points_m: Float[np.ndarray, "*points 3"], moved_m: Float[np.ndarray, "solids 3"]
    ) -> Float[np.ndarray, "*points 3"]:
        """Unit vectors away from the nearest solid."""
        ends_m = points_m[..., None, :] + _STEP_M * np.concatenate([np.eye(3), -np.eye(3)])
        ends, _ = self.distance_m(ends_m, moved_m)
        normal = ends[..., :3] - ends[..., 3:]
        return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
