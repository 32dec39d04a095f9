"""The floor as one clean patch, from under the motion to where it was seen."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.scene.backdrop import Backdrop
from video2anim.scene.extent import before_walls
from video2anim.scene.patches import Patch, clear, cut_mesh, painted, tidy
from video2anim.types.scene import BackgroundPlate, Mesh

_FINEST_M = 0.03
"""Cells are no smaller: the plate shows no more."""
_STRAY = 0.5
"""Percent of the floor's pixels that may be strays on every side."""
_TIDY_NODES = 3
"""Strips of floor narrower than twice this are left out."""
_CLEAR_PX = 1
"""Colors so near to things are mixed with theirs."""


def ground_mesh(
    found: Backdrop, plate: BackgroundPlate, around_m: Float[np.ndarray, "2 2"], *, most_faces: int = 24_000
) -> Mesh:
    """Floor at y = 0, facing up: around the motion and as far as it was seen, but not behind walls.

    Colored by the plate, and where that does not show it by a smooth blend of what is around.

    Args:
        around_m: least and largest x and z of floor that is there in any case.
    """
    view, points_m = found.view, [around_m]
    seen = clear(found.floor, _CLEAR_PX) & (view.direction[..., 1] < -1e-3)
    direction = view.direction[seen]
    depth_m = -view.camera_m[1] / direction[:, 1]
    seen_m = (view.camera_m + direction * depth_m[:, None])[depth_m < found.far_m][:, [0, 2]]
    if len(seen_m):
        points_m.append(np.percentile(seen_m, [_STRAY, 100 - _STRAY], axis=0))
    walls = [part.patch for part in found.parts if part.plane.kind == "wall"]
    points_m += [patch.grid(np.inf).reshape(-1, 3)[:, [0, 2]] for patch in walls]
    low, high = np.concatenate(points_m).min(0), np.concatenate(points_m).max(0)
    # z across and x upward: the patch faces up.
    patch = Patch(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), low[::-1], high[::-1])
    nodes_m = patch.grid(max(_FINEST_M, float(np.sqrt(2 * np.prod(high - low) / most_faces))))
    rgb = painted(nodes_m, view, clear(found.floor, _CLEAR_PX), plate.plate_rgb)
    field = np.minimum(before_walls(found.parts, nodes_m, view), _wanted(found, nodes_m, around_m))
    return cut_mesh(nodes_m, rgb, field)


def _wanted(
    found: Backdrop, nodes_m: Float[np.ndarray, "rows columns 3"], around_m: Float[np.ndarray, "2 2"]
) -> Float[np.ndarray, "rows columns"]:
    """Positive where floor was seen, around the motion, and where no wall is before it."""
    view, flat_m = found.view, nodes_m[..., [0, 2]]
    pixel, _, inside = view.pixels(nodes_m.reshape(-1, 3))
    column, row = (np.where(inside, np.round(pixel[:, k]), 0).astype(int) for k in (0, 1))
    known = (inside & found.floor[row, column]).reshape(flat_m.shape[:2])
    known = tidy(known, _TIDY_NODES) > 0
    known |= ((flat_m > around_m[0]) & (flat_m < around_m[1])).all(-1)
    # Only a room's walls go on where they are not seen.
    room_m = before_walls(found.parts, nodes_m, view, endless=True) if found.is_room else 1.0
    return np.maximum(tidy(known, _TIDY_NODES), room_m)
