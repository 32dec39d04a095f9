"""Signed distance on a regular grid: build it from solid meshes and a floor, sample it with gradients.

Positive in free space, negative inside a solid. Node (i, j, k) lies at origin + spacing * (i, j, k).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from video2anim.geometry.mesh_query import MeshQuery
from video2anim.types.scene import Mesh


@dataclass(frozen=True, slots=True, eq=False)
class SdfGrid:
    """A signed-distance field."""

    sdf_m: Float[np.ndarray, "x y z"]
    origin_m: Float[np.ndarray, "3"]
    spacing_m: float

    def sample(self, points_m: Any) -> Any:
        """Distance at points (..., 3), numpy or torch; see `sample_sdf`."""
        return sample_sdf(self.sdf_m, self.origin_m, self.spacing_m, points_m)

    def within(self, points_m: Float[np.ndarray, "points 3"], reach_m: float) -> Int[np.ndarray, "found"]:
        """Numbers of the points in the box around all that is nearer than `reach_m`: others sample farther, unless a
        solid is cut off by the grid's edge."""
        near, found = self.sdf_m < reach_m, np.ones(len(points_m), bool)
        for axis in range(3):
            nodes = np.flatnonzero(near.any(tuple({0, 1, 2} - {axis})))
            if not len(nodes):
                return nodes
            low_m, high_m = self.origin_m[axis] + self.spacing_m * (nodes[[0, -1]] + [-1, 1])
            # Beyond the grid distances go on.
            low_m -= reach_m if nodes[0] == 0 else 0.0
            high_m += reach_m if nodes[-1] == near.shape[axis] - 1 else 0.0
            found &= (points_m[:, axis] >= low_m) & (points_m[:, axis] <= high_m)
        return np.flatnonzero(found)


def sample_sdf(sdf_m: Any, origin_m: Any, spacing_m: float, points_m: Any) -> Any:
    """Trilinear distance at world points (..., 3): numpy array or differentiable torch tensor, as the points are.

    A point outside the grid gets the value v at the nearest point of the grid's box and its distance d to that box:
    v + d where v is free (an upper bound of the true distance), v - d where v is solid (a point under the floor stays
    under it, and the gradient leads back up).
    """
    if isinstance(points_m, np.ndarray):
        return _sample(np, np.asarray(sdf_m), np.asarray(origin_m), spacing_m, points_m)
    import torch

    grid = torch.as_tensor(sdf_m, dtype=points_m.dtype, device=points_m.device)
    origin = torch.as_tensor(origin_m, dtype=points_m.dtype, device=points_m.device)
    return _sample(torch, grid, origin, spacing_m, points_m)


def _sample(module: Any, grid: Any, origin: Any, spacing_m: float, points_m: Any) -> Any:
    corner, outside, fractions, steps = 0, 0.0, [], []
    for axis, count in enumerate(grid.shape):
        node = (points_m[..., axis] - origin[axis]) / spacing_m
        inside = module.clip(node, 0.0, float(count - 1))
        outside = outside + (node - inside) ** 2
        # The cell's lower corner; the last node belongs to the last cell.
        low = module.clip(_floor_index(module, inside), 0, max(count - 2, 0))
        fractions.append(inside - low)
        corner = corner * count + low
        steps.append(math.prod(grid.shape[axis + 1 :]) if count > 1 else 0)
    values = grid.reshape(-1)

    def along(axis: int, start: int) -> Any:
        """Value at the fractions from an axis on, of the cell's corner that lies `start` values on."""
        if axis == 3:
            return values.take(corner + start)
        low = along(axis + 1, start)
        return low + fractions[axis] * (along(axis + 1, start + steps[axis]) - low)

    value = along(0, 0)
    outside_m = spacing_m * ((outside + 1e-24) ** 0.5 - 1e-12)
    return value + module.where(value < 0, -outside_m, outside_m)


def _floor_index(module: Any, position: Any) -> Any:
    return position.astype(np.int64) if module is np else position.detach().long()


def build_sdf_grid(
    solids: Sequence[Mesh],
    bounds_m: Float[np.ndarray, "2 3"],
    spacing_m: float,
    *,
    floor_y_m: float | None = 0.0,
    reach_m: float = np.inf,
) -> SdfGrid:
    """Signed distance to the union of solid meshes and the half space under the floor.

    Distances and sides are those of `MeshQuery`. Inside overlapping solids the union's value is a lower bound of the
    depth, as for any union by minimum.

    Args:
        solids: meshes in world coordinates, ideally watertight; one without faces is skipped.
        bounds_m: lowest and highest corner of the grid; the highest is rounded up to a whole spacing.
        floor_y_m: height of the floor plane, None for none.
        reach_m: solids farther from a node than this are not looked for, which is much faster: the node keeps the
            distance to the floor and nearer solids, or gets this where there are none, and so deep inside a solid.

    Raises:
        ValueError: bounds without extent, a spacing that is not positive, or neither a solid with faces nor a floor.
    """
    low_m, high_m = np.asarray(bounds_m, dtype=np.float64)
    if not spacing_m > 0 or not (high_m > low_m).all():
        raise ValueError(f"build_sdf_grid: want low < high and spacing > 0, got {low_m}, {high_m}, {spacing_m}")
    shape = tuple(int(n) for n in np.ceil((high_m - low_m) / spacing_m - 1e-9).astype(int) + 1)
    axes = [low_m[a] + spacing_m * np.arange(shape[a]) for a in range(3)]
    sdf_m = np.full(shape, np.inf)
    if floor_y_m is not None:
        sdf_m = np.minimum(sdf_m, (axes[1] - floor_y_m)[None, :, None])
    faced = [solid for solid in solids if len(solid.faces)]
    if floor_y_m is None and not faced:
        raise ValueError("build_sdf_grid: neither a solid with faces nor a floor was given")
    for solid in faced:
        _lower_by_solid(sdf_m, solid, axes, reach_m)
    sdf_m[np.isinf(sdf_m)] = reach_m
    return SdfGrid(sdf_m.astype(np.float32), low_m, spacing_m)


def _lower_by_solid(sdf_m: Float[np.ndarray, "x y z"], solid: Mesh, axes: list[np.ndarray], reach_m: float) -> None:
    """Take the minimum with one solid's signed distance, in place.

    Nodes around the solid's box whose value is below their distance to the box cannot change: they are left out.
    """
    corners_m = np.asarray(solid.vertices_m, np.float64)[np.unique(solid.faces)]
    box_m = np.stack([corners_m.min(0), corners_m.max(0)])
    gaps = [np.maximum(np.maximum(box_m[0, a] - axes[a], axes[a] - box_m[1, a]), 0.0) ** 2 for a in range(3)]
    box_distance_m = np.sqrt(gaps[0][:, None, None] + gaps[1][None, :, None] + gaps[2][None, None, :])
    near = np.nonzero((box_distance_m == 0) | (box_distance_m < np.minimum(sdf_m, reach_m)))
    nodes_m = np.stack([axes[a][near[a]] for a in range(3)], -1)
    distance_m = MeshQuery(solid.vertices_m, solid.faces).nearest(nodes_m).distance_m
    reached_m = np.where(distance_m > reach_m, np.inf, np.maximum(distance_m, -reach_m))
    sdf_m[near] = np.minimum(sdf_m[near], reached_m)
