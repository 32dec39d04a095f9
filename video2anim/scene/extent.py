"""Extent of the planes of a room: down to the floor, behind the people, up to each other."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.scene.patches import Patch
from video2anim.scene.planes import Plane
from video2anim.scene.regions import FLOOR
from video2anim.scene.view import Look

BODY_M = 0.3
"""Minimum distance of background pieces from joints: skin, clothes and hands around them."""
MAX_PUSH = 0.3
"""Maximum relative increase of a plane's distance that puts it behind the people; beyond it the plane is in front."""
THROUGH = 0.15
"""Relative depth difference at which a pixel shows something behind a piece: the piece has an opening there."""
_SCALE_SIGMA = 0.15
"""Standard deviation of the logarithm of a wall's depth by networks: 0.06 to 0.17 on renders of furnished rooms."""
GRAVITY_RAD = np.deg2rad(1.0)
"""Error of gravity and of the line where floor and wall meet."""
_MIN_FOOT = 0.05
"""Minimum length of the line where floor and wall meet, over the image's width."""
_CORNER = 0.25
"""Pieces that end within this share of the distance from their intersection are extended to it."""
_ALONG, _ACROSS = np.cos(np.deg2rad(15.0)), np.sin(np.deg2rad(30.0))
"""Walls within 15 degrees are parallel; walls that meet at less than 30 degrees have no corner."""
_UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A plane with its extent and the pixels that show it."""

    plane: Plane
    patch: Patch
    own: Bool[np.ndarray, "height width"]

    def reach_m(self, view: Look) -> float:
        """Median distance of its pixels from the camera."""
        direction = view.direction[self.own]
        return float(np.median(np.linalg.norm(direction, axis=-1) * np.minimum(self.plane.depth_m(direction), 1e3)))

    def is_open(self, view: Look, surface_m: Float[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
        """Where pixels show something farther."""
        return surface_m > (1 + THROUGH) * self.plane.depth_m(view.direction)


def parts_of(
    view: Look,
    planes: Sequence[Plane],
    label: Int[np.ndarray, "height width"],
    paths_m: Float[np.ndarray, "points 3"],
    heading_rad: float | None,
) -> list[Part]:
    """Visible planes, moved to their foot line and behind the people, as bounding rectangles of connected pixels."""
    if heading_rad is None:
        wall = next((plane for plane in planes if plane.kind == "wall"), None)
        heading_rad = 0.0 if wall is None else float(np.arctan2(wall.normal[2], wall.normal[0]))
    parts = []
    for index, plane in enumerate(planes):
        own = label == index
        if plane.kind == "backdrop" or not own.any():
            continue
        if plane.kind == "wall":
            plane = _footed(plane, own, label == FLOOR, view)
        for piece in _connected(plane, own, label == FLOOR, view):
            behind = behind_people(plane, rectangle(plane, piece, view, heading_rad), view, paths_m)
            parts.append(Part(behind, rectangle(behind, piece, view, heading_rad), piece))
    return cornered(parts, view)


def _connected(plane: Plane, own: np.ndarray, floor: np.ndarray, view: Look) -> list[Bool[np.ndarray, "height width"]]:
    """Groups of a plane's pixels that are one surface: connected, also behind what hides it or has no depth.

    Pixels between two groups that show something farther (above the horizon also those without depth), or the floor,
    prove that the plane does not go on there.
    """
    farther = np.where(view.known, view.depth_m > plane.depth_m(view.direction), view.direction[..., 1] > 0)
    count, group = cv2.connectedComponents((own | ~(farther | floor)).astype(np.uint8), connectivity=4)
    pieces = (own & (group == number) for number in range(1, count))
    return [piece for piece in pieces if piece.any()]


def rectangle(plane: Plane, own: Bool[np.ndarray, "height width"], view: Look, heading_rad: float = 0.0) -> Patch:
    """Bounding rectangle of a plane's pixels; walls and cards extend down to the floor."""
    if plane.kind == "ceiling":
        across = np.array([np.cos(heading_rad), 0.0, np.sin(heading_rad)])
        upward = np.cross(-plane.normal, across)
    else:
        upward = _UP - plane.normal * plane.normal[1]
        upward /= np.linalg.norm(upward)
        across = np.cross(upward, -plane.normal)
    origin_m = view.camera_m + plane.normal * plane.distance_m
    solid = cv2.morphologyEx(own.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(bool)
    direction = view.direction[solid if solid.any() else own]
    depth_m = plane.depth_m(direction)
    met = np.isfinite(depth_m)
    if not met.any():
        return Patch(origin_m, across, upward, np.zeros(2), np.zeros(2))
    points_m = direction[met] * depth_m[met][:, None] - plane.normal * plane.distance_m
    on_plane = np.stack([points_m @ across, points_m @ upward], 1)
    low, high = on_plane.min(0), on_plane.max(0)
    if plane.kind in ("wall", "card"):
        low[1] = -origin_m[1]
        high[1] = max(high[1], low[1])
    return Patch(origin_m, across, upward, low, high)


def _footed(plane: Plane, own: np.ndarray, floor: np.ndarray, view: Look) -> Plane:
    """The wall moved toward its foot line, whose distance follows from gravity and the camera's height.

    Both distances are weighted by their variances; the error of the foot line grows with its distance.
    """
    foot = np.zeros_like(own)
    foot[1:] = own[:-1] & floor[1:]
    foot &= view.direction[..., 1] < -1e-3
    # The foot line is between two rows.
    direction = 0.5 * (view.direction + np.roll(view.direction, 1, axis=0))[foot]
    direction = direction[direction[:, 1] < -1e-3]
    on_floor_m = direction * (-view.camera_m[1] / direction[:, 1:2])
    along = on_floor_m @ plane.normal
    if (along > 0).sum() < _MIN_FOOT * view.shape[1]:
        return plane
    log_ratio = float(np.median(np.log(along[along > 0] / plane.distance_m)))
    distance_m = float(np.median(np.linalg.norm(on_floor_m[along > 0], axis=1)))
    foot_sigma = GRAVITY_RAD * distance_m / max(view.camera_m[1], 0.1)
    share = _SCALE_SIGMA**2 / (_SCALE_SIGMA**2 + foot_sigma**2)
    return plane.pushed(float(np.exp(share * np.clip(log_ratio, -MAX_PUSH, MAX_PUSH))))


def behind_people(plane: Plane, patch: Patch, view: Look, paths_m: Float[np.ndarray, "points 3"]) -> Plane:
    """The plane moved away from the camera until nobody is behind it."""
    from_camera_m = paths_m - view.camera_m
    along = from_camera_m @ plane.normal
    from_camera_m, along = from_camera_m[along > 0.1], along[along > 0.1]
    met_m = from_camera_m * (plane.distance_m / along)[:, None] - plane.normal * plane.distance_m
    on_plane = np.stack([met_m @ patch.across, met_m @ patch.upward], 1)
    within = ((on_plane > patch.low_m - BODY_M) & (on_plane < patch.high_m + BODY_M)).all(1)
    if not within.any():
        return plane
    need = float((along[within].max() + BODY_M) / plane.distance_m)
    return plane.pushed(need) if 1 < need <= 1 + MAX_PUSH else plane


def cornered(parts: list[Part], view: Look) -> list[Part]:
    """Parts extended or cut to their intersections where these are near: walls with walls, walls with the ceiling.

    Those that lose all of their pixels are left out.
    """
    ends_m = np.array([[part.patch.low_m, part.patch.high_m] for part in parts])

    def gaps_m(index: int, axis: int, value_m: float) -> Float[np.ndarray, "2"]:
        return np.abs(ends_m[index, :, axis] - value_m)

    walls = [index for index, part in enumerate(parts) if part.plane.kind == "wall"]
    for pair in itertools.combinations(walls, 2):
        normals = np.stack([parts[index].plane.normal[[0, 2]] for index in pair])
        if abs(np.linalg.det(normals)) < _ACROSS:
            continue
        x, z = np.linalg.solve(normals, [parts[index].plane.distance_m for index in pair])
        values_m = [float(np.array([x, 0.0, z]) @ parts[index].patch.across) for index in pair]
        gaps = [gaps_m(index, 0, value_m) for index, value_m in zip(pair, values_m, strict=True)]
        if all(gap.min() < _CORNER * np.hypot(x, z) for gap in gaps):
            for index, value_m, gap in zip(pair, values_m, gaps, strict=True):
                ends_m[index, gap.argmin(), 0] = value_m
            # The image border cuts near walls lower than far ones; the walls of a room have one height.
            ends_m[list(pair), 1, 1] = ends_m[list(pair), 1, 1].max()
    for number, roof in enumerate(parts):
        for index in walls if roof.plane.kind == "ceiling" else ():
            wall = parts[index]
            top_m = float(roof.patch.origin_m[1] - wall.patch.origin_m[1])
            if ends_m[index, 1, 1] > top_m - _CORNER * float(roof.patch.origin_m[1]):
                ends_m[index, 1, 1] = top_m
            for axis, along in enumerate((roof.patch.across, roof.patch.upward)):
                if abs(wall.plane.normal @ along) > _ALONG:
                    value_m = wall.plane.distance_m / float(wall.plane.normal @ along)
                    gap = gaps_m(number, axis, value_m)
                    if gap.min() < _CORNER * wall.plane.distance_m:
                        ends_m[number, gap.argmin(), axis] = value_m
    ended = []
    for part, (low_m, high_m) in zip(parts, ends_m, strict=True):
        patch = replace(part.patch, low_m=low_m, high_m=np.maximum(high_m, low_m))
        ended.append(replace(part, patch=patch, own=part.own & _holds(patch, part.plane, view)))
    return [part for part in ended if part.own.any()]


def _holds(patch: Patch, plane: Plane, view: Look) -> Bool[np.ndarray, "height width"]:
    """Pixels whose rays meet the rectangle."""
    depth_m = plane.depth_m(view.direction)
    met = np.isfinite(depth_m)
    points_m = view.camera_m + view.direction * np.where(met, depth_m, 0.0)[..., None] - patch.origin_m
    on_plane = np.stack([points_m @ patch.across, points_m @ patch.upward], -1)
    slack_m = 0.02 * plane.distance_m
    return met & ((on_plane > patch.low_m - slack_m) & (on_plane < patch.high_m + slack_m)).all(-1)


def before_walls(
    parts: Sequence[Part],
    points_m: Float[np.ndarray, "rows columns 3"],
    view: Look,
    surface_m: Float[np.ndarray, "height width"],
    *,
    endless: bool = False,
) -> Float[np.ndarray, "rows columns"]:
    """Distance of points in front of the walls between them and the camera, in meters; negative behind a wall.

    Args:
        surface_m: depth of each pixel by its part.
        endless: treat walls as endless to the sides.
    """
    room_m = np.full(points_m.shape[:-1], np.inf)
    from_camera_m = points_m - view.camera_m
    for part in parts:
        if part.plane.kind != "wall" or (endless and _has_wall_behind(part, parts)):
            continue
        along = from_camera_m @ part.plane.normal
        across = from_camera_m @ part.patch.across * (part.plane.distance_m / np.maximum(along, 1e-6))
        hidden = along > 0
        if not endless:
            hidden &= (across > part.patch.low_m[0]) & (across < part.patch.high_m[0])
            hidden &= ~view.sampled(part.is_open(view, surface_m), points_m, False)
        room_m = np.where(hidden, np.minimum(room_m, part.plane.distance_m - along), room_m)
    return np.minimum(room_m, 1.0)


def _has_wall_behind(part: Part, parts: Sequence[Part]) -> bool:
    return any(
        other.plane.kind == "wall"
        and other.plane.distance_m > part.plane.distance_m
        and other.plane.normal @ part.plane.normal > _ALONG
        for other in parts
    )
