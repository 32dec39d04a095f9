"""The global view of a scene: which voxels around the first frame's root are occupied (paper 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scenemi.scene.geometry import SceneGeometry

GRID_SHAPE = (48, 24, 48)
"""Voxels along x, y, z of the canonical frame."""
VOXEL_M = 0.1
"""Edge (paper 3.1)."""
EDGE_TOLERANCE_M = 1e-4
"""So that a floor at y = 0, exactly this far below the lowest centers, fills the lowest layer."""


@dataclass(frozen=True, slots=True)
class GridSpec:
    """Voxels over x, z in [-w/2, w/2) and y in [0, h) of the canonical frame."""

    shape: tuple[int, int, int] = GRID_SHAPE
    voxel_m: float = VOXEL_M

    @property
    def reach_m(self) -> float:
        """From the center to the nearest side."""
        return self.voxel_m * self.shape[0] / 2

    @property
    def within_m(self) -> float:
        """Distance from the center at which a solid point still fills the voxel: half a voxel."""
        return 0.5 * self.voxel_m + EDGE_TOLERANCE_M

    def axes_m(self) -> tuple[Float[np.ndarray, "x"], Float[np.ndarray, "y"], Float[np.ndarray, "z"]]:
        """Coordinates of the voxel centers along each axis."""
        x, y, z = (self.voxel_m * (np.arange(count) + 0.5) for count in self.shape)
        return x - 0.5 * self.voxel_m * self.shape[0], y, z - 0.5 * self.voxel_m * self.shape[2]

    def centers_m(self) -> Float[np.ndarray, "x y z 3"]:
        """Voxel centers in the canonical frame."""
        return np.stack(np.meshgrid(*self.axes_m(), indexing="ij"), -1)


DEFAULT_GRID = GridSpec()


def occupancy(
    scene: SceneGeometry, T_world_canonical: Float[np.ndarray, "4 4"], grid: GridSpec = DEFAULT_GRID
) -> Bool[np.ndarray, "x y z"]:
    """Voxels whose center has a solid point within half a voxel (5 cm), in the frame of the window's first root."""
    centers_m = grid.centers_m().reshape(-1, 3)
    world_m = centers_m @ T_world_canonical[:3, :3].T + T_world_canonical[:3, 3]
    return scene.touches(world_m, grid.within_m).reshape(grid.shape)
