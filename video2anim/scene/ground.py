"""The floor as one patch around the motion and as far as it was seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from video2anim.scene.backdrop import Backdrop
from video2anim.scene.extent import before_walls
from video2anim.scene.patches import SMOOTH_PX, Patch, clear, room_piece, smooth_field, tidy
from video2anim.types.scene import BackgroundImage, Mesh, RoomPiece


def ground(
    found: Backdrop,
    background: BackgroundImage,
    around_m: Float[np.ndarray, "2 2"],
    objects: Sequence[Mesh] = (),
) -> RoomPiece:
    """Floor at y = 0, facing up: around the motion, as far as it was seen, below and behind objects, but not behind
    walls.

    Args:
        around_m: minimum and maximum x and z that the floor holds in any case.
        objects: in the world.
    """
    view, seen = found.view, found.floor
    seen_m = (view.camera_m + view.direction[seen] * view.floor_depth_m()[seen][:, None])[:, [0, 2]]
    walls_m = [part.patch.grid().reshape(-1, 3)[:, [0, 2]] for part in found.parts if part.plane.kind == "wall"]
    held_m = np.concatenate([around_m, seen_m, *walls_m, *(one.vertices_m[:, [0, 2]] for one in objects)])
    low, high = held_m.min(0), held_m.max(0)
    # With z across and x upward the patch faces up.
    patch = Patch(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), low[::-1], high[::-1])
    nodes_m = patch.grid(0.0)
    known = tidy(view.sampled(seen | view.objects, nodes_m, False), SMOOTH_PX)
    known |= ((nodes_m[..., [0, 2]] > around_m[0]) & (nodes_m[..., [0, 2]] < around_m[1])).all(-1)
    walls = (found.parts, nodes_m, view, found.surface_m)
    beside = np.maximum(smooth_field(known, SMOOTH_PX), before_walls(*walls, endless=True))
    field = np.minimum(before_walls(*walls), beside)
    return room_piece("floor", patch, field, view, clear(seen), background.background_rgb)
