"""The floor as one patch around the motion and as far as it was seen."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.scene.backdrop import Backdrop
from video2anim.scene.extent import before_walls
from video2anim.scene.patches import SMOOTH_PX, Patch, clear, room_piece, smooth_field, tidy
from video2anim.types.scene import BackgroundImage, RoomPiece

_STRAY = 0.5
"""Percentile of the floor's pixels that is left out as outliers on every side."""


def ground(found: Backdrop, background: BackgroundImage, around_m: Float[np.ndarray, "2 2"]) -> RoomPiece:
    """Floor at y = 0, facing up: around the motion and as far as it was seen, but not behind walls.

    Args:
        around_m: minimum and maximum x and z that the floor holds in any case.
    """
    view, points_m = found.view, [around_m]
    shown = clear(found.floor) & (view.direction[..., 1] < -1e-3)
    direction = view.direction[shown]
    depth_m = -view.camera_m[1] / direction[:, 1]
    seen_m = (view.camera_m + direction * depth_m[:, None])[depth_m < found.far_m][:, [0, 2]]
    if len(seen_m):
        points_m.append(np.percentile(seen_m, [_STRAY, 100 - _STRAY], axis=0))
    points_m += [one.patch.grid().reshape(-1, 3)[:, [0, 2]] for one in found.parts if one.plane.kind == "wall"]
    low, high = np.concatenate(points_m).min(0), np.concatenate(points_m).max(0)
    # With z across and x upward the patch faces up.
    patch = Patch(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), low[::-1], high[::-1])
    nodes_m = patch.grid(0.0)
    known = tidy(view.sampled(found.floor, nodes_m, False), SMOOTH_PX)
    known |= ((nodes_m[..., [0, 2]] > around_m[0]) & (nodes_m[..., [0, 2]] < around_m[1])).all(-1)
    walls = (found.parts, nodes_m, view, found.surface_m)
    beside = np.maximum(smooth_field(known, SMOOTH_PX), before_walls(*walls, endless=True))
    field = np.minimum(before_walls(*walls), beside)
    return room_piece("floor", patch, field, view, shown, background.background_rgb)
