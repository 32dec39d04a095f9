"""One picture of a scene by the software renderer: the default of `--screenshot`."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.types import BodyMotion, Contact, SceneModel
from video2anim.types.motion import main_person
from video2anim.viewer.bodies import PosedBodies
from video2anim.viewer.contacts import contact_line, contacts_at, touched_rgb
from video2anim.viewer.drawing import draw_frustum, draw_static, world_vertices
from video2anim.viewer.raster import Canvas
from video2anim.viewer.viewpoint import Viewpoint, fit_viewpoint, looking

ELEVATION_RAD = 0.35
"""Of the usual view."""
TURN_RAD = 0.6
"""Of the usual view against the filming camera's."""
_SUPERSAMPLING = 2
ROOM_M = 0.25
"""Room left around bodies."""
_FRAMED_EVERY = 15
"""Frames: what moves is kept in the picture where it is in every such frame, twice a second, and in the last."""
_WHITE = (255, 255, 255)
_LINE_PX = 20
"""Height of a line of text."""


def render_software(
    people: tuple[BodyMotion, ...],
    scene: SceneModel | None,
    frame: int,
    width_px: int,
    height_px: int,
    contacts: Sequence[Contact] = (),
    turn_rad: float = TURN_RAD,
) -> UInt8[np.ndarray, "height width 3"]:
    """Bodies at one frame, objects, floor, room and filming camera, from behind and beside that camera; what touches
    what stands in the lower left corner."""
    size_px = _SUPERSAMPLING * width_px, _SUPERSAMPLING * height_px
    viewpoint = oblique_viewpoint(people, scene, *size_px, turn_rad)
    canvas = Canvas.blank(*size_px)
    bodies = PosedBodies(people, contacts)
    (meshes,) = bodies.frames(frame, frame + 1)
    if scene is not None:
        draw_static(canvas, viewpoint, scene, background=True, objects=True, frame=frame, bodies_m=meshes)
    bodies.draw(canvas, viewpoint, meshes, frame)
    draw_frustum(canvas, viewpoint, main_person(people).view(frame))
    picture = cv2.resize(canvas.rgb, (width_px, height_px), interpolation=cv2.INTER_AREA)
    now = [one for person in people for one in contacts_at(contacts, person.person_id, person.frame_time_s[frame])]
    for number, contact in enumerate(now):
        bottom_px = height_px - _LINE_PX * (len(now) - number) + _LINE_PX // 2
        _write(picture, contact_line(contact), (_LINE_PX // 2, bottom_px), touched_rgb(contact.object_id))
    return picture


def _write(
    picture: UInt8[np.ndarray, "height width 3"], text: str, at_px: tuple[int, int], rgb: tuple[int, int, int]
) -> None:
    """Text with a white rim, in place, readable on whatever is there."""
    rim = [((dx, dy), _WHITE) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
    for (dx, dy), color in (*rim, ((0, 0), rgb)):
        place = (at_px[0] + dx, at_px[1] + dy)
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, 1, cv2.LINE_AA)


def oblique_viewpoint(
    people: tuple[BodyMotion, ...],
    scene: SceneModel | None,
    width_px: int,
    height_px: int,
    turn_rad: float = TURN_RAD,
) -> Viewpoint:
    """A camera turned and raised from the filming one that sees the whole path and the objects near it."""
    points_m = framed_points(people, scene)
    forward = main_person(people).view().forward
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return fit_viewpoint(points_m, looking(turn @ forward, ELEVATION_RAD), width_px=width_px, height_px=height_px)


def framed_points(
    people: tuple[BodyMotion, ...], scene: SceneModel | None, object_reach_m: float = 4.0
) -> Float[np.ndarray, "points 3"]:
    """Points a picture of the scene must hold: bodies at all measured frames, the floor below, near objects."""
    measured = [motion.joints_world_m[motion.valid].reshape(-1, 3) for motion in people]
    paths_m = np.concatenate(measured)
    if len(paths_m) == 0:
        paths_m = np.concatenate([motion.joints_world_m.reshape(-1, 3) for motion in people])
    points = [paths_m + np.array([0.0, ROOM_M, 0.0]), paths_m * [1.0, 0.0, 1.0]]
    center_m = np.median(paths_m, axis=0)
    for placed in scene.objects if scene is not None else ():
        count = len(placed.path[0].T_world_object) if placed.path else 1
        frames = sorted({*range(0, count, _FRAMED_EVERY), count - 1})
        places = [world_vertices(placed, frame) for frame in frames]
        points += [
            vertices_m
            for vertices_m in places
            if len(vertices_m) and np.linalg.norm(vertices_m.mean(0) - center_m) < object_reach_m
        ]
    return np.concatenate(points)
