"""Background of a clip as planar pieces: walls, ceiling, cards (upright planes facing the camera), one backdrop."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from video2anim.geometry.heading import EdgeHeadings
from video2anim.scene.extent import BODY_M, GRAVITY_RAD, THROUGH, Part, before_walls, behind_people, parts_of, rectangle
from video2anim.scene.patches import SMOOTH_PX, clear, room_piece, smooth_field, squared, tidy
from video2anim.scene.planes import Plane, room_planes
from video2anim.scene.regions import FLOOR, HIDDEN, LOW, cards, labeled
from video2anim.scene.view import MAX_DOUBT, Look, look
from video2anim.types.metric import MetricDepth
from video2anim.types.motion import BodyMotion
from video2anim.types.scene import BackgroundImage, InstanceMasks, RoomPiece

_RASTER_M = 0.05
"""Grid size to which positions of joints are rounded."""
_MAX_CUT = 0.1
"""A plane is left out where people were behind a larger share of its pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class Backdrop:
    """Background behind people and objects."""

    pieces: tuple[RoomPiece, ...]
    parts: tuple[Part, ...]
    view: Look
    floor: Bool[np.ndarray, "height width"]
    """Pixels of the view that show the floor, also outside the floor's mask."""
    surface_m: Float[np.ndarray, "height width"]
    """Depth of each pixel by its plane; for floor pixels, that of the plane above them."""

    @property
    def counts(self) -> dict[str, int]:
        """Quality numbers: faces, walls, and openings in them."""
        return {
            "background_faces": sum(len(piece.mesh.faces) for piece in self.pieces),
            "walls": sum(piece.name.startswith("wall") for piece in self.pieces),
            "openings": sum(len(piece.openings) for piece in self.pieces),
        }


def backdrop(
    depth: MetricDepth,
    masks: InstanceMasks,
    background: BackgroundImage,
    far_m: float,
    relative_sigma: Float[np.ndarray, "small_height small_width"] | None = None,
) -> Backdrop:
    """Pieces for every pixel that is neither floor nor object.

    Args:
        far_m: farther depth goes onto the backdrop behind everything.
        relative_sigma: standard deviation of the background image's depth as a share of it; None where unknown.
    """
    sigma = np.zeros_like(depth.background_depth_m) if relative_sigma is None else relative_sigma
    view = look(depth, masks, background, sigma, far_m)
    heading = EdgeHeadings(background.background_rgb, depth.bodies.main_view).of_room()
    heading_rad = None if heading is None else heading.angle_rad
    paths_m = body_paths(depth.bodies.people)
    people_m = _people_depth(view, paths_m)
    planes, label = _explained(view, heading_rad, people_m, paths_m)
    parts = parts_of(view, planes, label, paths_m, heading_rad)
    parts += _far_part(view, parts, label, len(planes) - 1, paths_m)
    surface_m = _surface_depth(view, parts, label)
    pieces, numbers = [], Counter[str]()
    for part in parts:
        kind = part.plane.kind
        name = f"{kind} {numbers[kind] + 1}" if kind in ("wall", "card") else kind
        piece = _piece(name, part, parts, surface_m, label, view, background.background_rgb)
        if piece is not None:
            numbers[kind] += 1
            pieces.append(piece)
    return Backdrop(tuple(pieces), tuple(parts), view, label == FLOOR, surface_m)


def body_paths(people: Sequence[BodyMotion]) -> Float[np.ndarray, "points 3"]:
    """Joints of all people in all valid frames, rounded to a grid of 5 cm, without duplicates."""
    joints = [person.joints_world_m[person.valid].reshape(-1, 3) for person in people]
    points_m = np.concatenate([np.zeros((0, 3)), *joints])
    points_m = points_m[np.isfinite(points_m).all(1)]
    return np.unique(np.round(points_m / _RASTER_M), axis=0) * _RASTER_M


def _explained(
    view: Look,
    heading_rad: float | None,
    people_m: Float[np.ndarray, "height width"],
    paths_m: Float[np.ndarray, "points 3"],
) -> tuple[list[Plane], Int[np.ndarray, "height width"]]:
    """Planes, the backdrop last, and the number of the plane that each pixel shows.

    Low flat objects are labeled floor, higher ones hidden; all ceilings are merged into the first.
    """
    # What has no depth is behind all that has.
    open_to = ~view.floor & ~view.objects
    measured = open_to & view.known & ~view.unsure
    planes = room_planes(view, measured, heading_rad)
    planes += cards(view, measured, planes)
    planes.append(Plane("backdrop", view.T_world_camera[:3, 2], 1.0))
    label = labeled(view, open_to, planes)
    free = [plane for k, plane in enumerate(planes) if not _before_people(plane, label == k, view, people_m, paths_m)]
    if len(free) < len(planes):
        planes, label = free, labeled(view, open_to, free)
    ceilings = [index for index, plane in enumerate(planes) if plane.kind == "ceiling"]
    for index, plane in enumerate(planes):
        if plane.kind == "level":
            low = view.camera_m[1] - plane.distance_m < LOW * view.eye_m
            label[label == index] = FLOOR if low else HIDDEN
        elif plane.kind == "ceiling":
            label[label == index] = ceilings[0]
        elif plane.kind == "wall":
            height_m = view.camera_m[1] + plane.depth_m(view.direction) * view.direction[..., 1]
            if ceilings:
                roof_m = view.camera_m[1] + planes[ceilings[0]].distance_m
                label[(label == index) & (height_m > roof_m)] = ceilings[0]
            label[(label == index) & (height_m < -LOW * view.eye_m)] = FLOOR
    # Near the horizon the error of gravity leaves the distance of the floor unknown.
    level = np.linalg.norm(view.direction[..., [0, 2]], axis=-1)
    label[(label == FLOOR) & (-view.direction[..., 1] < GRAVITY_RAD / MAX_DOUBT * level)] = len(planes) - 1
    return planes, label


def _before_people(plane: Plane, own: np.ndarray, view: Look, people_m: np.ndarray, paths_m: np.ndarray) -> bool:
    """Whether people were behind the plane, farther than it may be pushed back."""
    if plane.kind in ("backdrop", "level") or not own.any():
        return False
    pushed = behind_people(plane, rectangle(plane, own, view), view, paths_m)
    return bool((people_m[own] > pushed.depth_m(view.direction[own])).mean() > _MAX_CUT)


def _people_depth(view: Look, paths_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "height width"]:
    """Maximum depth of people at each pixel, by disks around their joints; 0 where nobody was."""
    reached_m = np.zeros(view.shape, np.float32)
    pixel, depth_m, _ = view.pixels(paths_m)
    for index in np.argsort(depth_m):
        if depth_m[index] > BODY_M:
            center = np.clip(np.round(pixel[index]), -10_000, 10_000).astype(int)
            radius = max(1, round(BODY_M / float(depth_m[index]) * view.intrinsics.fx_px))
            cv2.circle(reached_m, center.tolist(), radius, float(depth_m[index] + 0.5 * BODY_M), -1)
    return reached_m


def _far_part(view: Look, parts: list[Part], label: np.ndarray, number: int, paths_m: np.ndarray) -> list[Part]:
    """The backdrop behind everything else, parallel to the image; none where no pixel has its label `number`."""
    own = label == number
    if not own.any():
        return []
    corners_m = [part.patch.grid(1e9).reshape(-1, 3) for part in parts]
    _, reached_m, _ = view.pixels(np.concatenate([paths_m, *corners_m]))
    seen_m, floor_m = view.depth_m[view.known & ~view.unsure], view.floor_depth_m()[label == FLOOR]
    distance_m = (1 + THROUGH) * max(1.0, *(float(some.max()) for some in (reached_m, seen_m, floor_m) if len(some)))
    plane = Plane("backdrop", view.T_world_camera[:3, 2], distance_m)
    return [Part(plane, rectangle(plane, _grown(own), view), own)]


def _grown(own: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """With the pixels around, by which smooth outlines can be off."""
    return cv2.dilate(own.astype(np.uint8), np.ones((2 * SMOOTH_PX + 1,) * 2)) > 0


def _surface_depth(
    view: Look, parts: Sequence[Part], label: Int[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width"]:
    """Depth of each pixel by its part; 0 at objects and where unknown. Floor pixels get the depth of the part above
    them in the image: the floor ends at its foot."""
    surface_m = np.zeros(view.shape)
    for part in parts:
        surface_m[part.own] = part.plane.depth_m(view.direction[part.own])
    rows = np.arange(view.shape[0])[:, None]
    above = np.maximum.accumulate(np.where(label == FLOOR, 0, rows), axis=0)
    return np.take_along_axis(surface_m, above, axis=0)


def _piece(
    name: str,
    part: Part,
    parts: Sequence[Part],
    surface_m: Float[np.ndarray, "height width"],
    label: Int[np.ndarray, "height width"],
    view: Look,
    background_rgb: UInt8[np.ndarray, "background_height background_width 3"],
) -> RoomPiece | None:
    """The mesh of a part, without the areas where the image shows something farther."""
    nodes_m = part.patch.grid(part.reach_m(view) / view.intrinsics.fx_px)
    solid = part.plane.kind in ("wall", "ceiling")
    own_m = part.plane.depth_m(view.direction)
    # Cards and the backdrop extend behind clearly nearer surfaces below their pixels, and behind the floor's end.
    hidden = np.maximum.accumulate(part.own, axis=0) & (surface_m < own_m * (1 - THROUGH))
    hidden |= _grown(part.own) & (label == FLOOR)
    covered = ~part.is_open(view, surface_m) if solid else hidden
    kept = view.sampled(part.own | covered, nodes_m, solid)
    whole = tidy(kept, SMOOTH_PX)
    field, openings = squared(whole, SMOOTH_PX) if solid else (smooth_field(whole, SMOOTH_PX), ())
    if part.plane.kind == "ceiling":
        field = np.minimum(field, before_walls(parts, nodes_m, view, surface_m))
    if not (field > 0).any():
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        near = np.abs(np.log(surface_m / own_m)) < THROUGH
    taken = np.logical_or.reduce([other.own for other in parts])
    # Pixels of no part are textured onto the piece, unless they are in front of it.
    loose = ~taken & view.known & (view.depth_m > own_m * (1 - THROUGH))
    shown = part.own | ((label >= 0) & (loose | near))
    nearer = ~shown & ((surface_m < own_m) | (label == FLOOR))
    shown &= clear(~nearer)
    return room_piece(name, part.patch, field, view, shown, background_rgb, openings)
