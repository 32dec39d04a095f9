"""Views of preset `carried`: of several cameras, the one from which the moved object is most visible."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from video2anim.errors import InputError
from video2anim.lab.synth.cameras import NEVER_HIDES, CameraRequest, place_camera
from video2anim.lab.synth.hiding import in_picture
from video2anim.lab.synth.render.caster import RayCaster
from video2anim.lab.synth.render.surfaces import surfaces_of_objects
from video2anim.lab.synth.world import ProceduralMotion, Room
from video2anim.types import Intrinsics

_CAMERAS = 8
_FRAMES = 16
"""Number of views compared, and of frames checked in each."""
MIN_VISIBLE = 0.5
"""Minimum mean share of the object's points that are in the picture and unoccluded, in each third of the clip (before,
while and after it is carried)."""
_INSET_M = 0.003


def box_points(procedural: ProceduralMotion, spacing_m: float) -> Float[np.ndarray, "points 3"]:
    """Points on the box around the moved object, in its frame, slightly inside because it may rest on other objects."""
    if procedural.item is None:
        return np.zeros((0, 3))
    corners = np.concatenate([part.vertices_m for part in procedural.item.parts])
    low, high = corners.min(0) + _INSET_M, corners.max(0) - _INSET_M
    axes = [np.linspace(a, b, max(2, int((b - a) / spacing_m) + 1)) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return grid[((grid == low) | (grid == high)).any(1)]


def swept_points(procedural: ProceduralMotion, spacing_m: float) -> Float[np.ndarray, "points 3"]:
    """The points of `box_points` in the world in every second frame, which furniture must stay clear of."""
    if procedural.item_pose is None:
        return np.zeros((0, 3))
    T = procedural.item_pose[::2]
    return (box_points(procedural, spacing_m) @ np.swapaxes(T[:, :3, :3], -1, -2) + T[:, None, :3, 3]).reshape(-1, 3)


def moved_object_view(
    rng: np.random.Generator,
    room: Room,
    procedural: ProceduralMotion,
    joints_m: Float[np.ndarray, "frames 22 3"],
    skin_m: Float[np.ndarray, "frames vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    request: CameraRequest,
) -> tuple[Intrinsics, Float[np.ndarray, "frames 4 4"]]:
    """Of several cameras, the one from which the moved object is most visible: intrinsics and T_world_camera per frame.

    Raises:
        InputError: no camera sees the motion, or the object is occluded too much in each.
    """
    assert procedural.item_pose is not None
    frames = np.linspace(0, len(joints_m) - 1, _FRAMES).round().astype(int)
    points = box_points(procedural, 0.15)
    room_caster = surfaces_of_objects(obj for obj in room.objects if obj.label not in NEVER_HIDES).caster()
    bodies = [RayCaster(skin_m[frame], faces) for frame in frames]
    best, most = None, -1.0
    for _ in range(_CAMERAS):
        lens, T_world_camera = place_camera(rng, room, joints_m[None], request)
        eye = T_world_camera[0, :3, 3]
        seen = []
        for body, T in zip(bodies, procedural.item_pose[frames], strict=True):
            world_m = points @ T[:3, :3].T + T[:3, 3]
            ray = world_m - eye
            start = np.broadcast_to(eye, ray.shape)
            hidden = body.blocked(start, ray, 1.0) | room_caster.blocked(start, ray, 0.98)
            seen.append((in_picture(lens, T_world_camera[0], world_m)[1] & ~hidden).mean())
        worst = min(float(third.mean()) for third in np.array_split(np.array(seen), 3))
        if worst > most:
            best, most = (lens, T_world_camera), worst
    if best is None or most < MIN_VISIBLE:
        raise InputError("the moved object is occluded too much in every view")
    return best
