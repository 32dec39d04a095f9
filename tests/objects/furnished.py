"""Rooms of boxes with exact depth and masks, and furniture made of boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from seen_boxes import FLOOR, LENS, SKY, Block, Piece, Shot, about_y, drawn, looking, shoot
from synthetic import planted_walk

from video2anim.objects.evidence import ObjectViews, PeopleEvidence, SeenObject
from video2anim.objects.observed import DepthErrors
from video2anim.types import BodyTracks, CompletedObject, InstanceMasks, MetricDepth, ObjectInstance
from video2anim.types.contact import RestedSkin

NOBODY = np.zeros((0, 3))
EYE_M = (0.0, 1.6, 0.0)
WALL = Block((0.0, 1.5, -6.0), (16.0, 3.0, 0.1))


def moved(parts: Sequence[Block], at_m: tuple[float, float], yaw_rad: float) -> list[Block]:
    """Parts around the origin, turned about it, then brought to x and z."""
    made = []
    for part in parts:
        x, y, z = about_y(yaw_rad) @ part.center_m
        made.append(Block((x + at_m[0], y, z + at_m[1]), part.size_m, part.yaw_rad + yaw_rad))
    return made


def legs(width_m: float, depth_m: float, top_m: float, thick_m: float = 0.045) -> list[Block]:
    x, z = 0.5 * (width_m - thick_m), 0.5 * (depth_m - thick_m)
    size = (thick_m, top_m, thick_m)
    return [Block((sx * x, 0.5 * top_m, sz * z), size) for sx in (-1, 1) for sz in (-1, 1)]


def chair(width_m: float = 0.44, depth_m: float = 0.44, seat_m: float = 0.46, back_m: float = 0.44) -> list[Block]:
    """Its front towards +z; the back of a chair in reality leans, this one does not."""
    seat = Block((0, seat_m - 0.02, 0), (width_m, 0.04, depth_m))
    back = Block((0, seat_m + 0.5 * back_m, -0.5 * depth_m), (width_m, back_m, 0.03))
    return [seat, back, *legs(width_m, depth_m, seat_m - 0.04)]


def bed(width_m: float = 1.4, length_m: float = 2.0, height_m: float = 0.5, head_m: float = 0.45) -> list[Block]:
    """Its foot towards +z."""
    head = Block((0, 0.5 * (height_m + head_m), -0.5 * length_m - 0.03), (width_m, height_m + head_m, 0.06))
    return [Block((0, 0.5 * height_m, 0), (width_m, height_m, length_m)), head]


def shelf(width_m: float = 0.9, depth_m: float = 0.3, height_m: float = 1.8) -> list[Block]:
    """Open, with books behind the front edges of its boards."""
    sides = [Block((side * 0.5 * width_m, 0.5 * height_m, 0), (0.025, height_m, depth_m)) for side in (-1, 1)]
    tops = np.linspace(0.08, height_m, 6)
    boards = [Block((0, top - 0.0125, 0), (width_m, 0.025, depth_m)) for top in tops]
    books = Block((0, 0.5 * height_m, -0.06), (width_m - 0.06, height_m - 0.1, depth_m - 0.12))
    return [*sides, *boards, books]


@dataclass(frozen=True, eq=False)
class Furnished:
    """One object in a room, as `ObjectViews` shows it."""

    shot: Shot
    seen: SeenObject
    views: ObjectViews


def furnished(
    obj: Sequence[Block | Piece],
    others: Sequence[Block] = (),
    *,
    eye_m: tuple[float, float, float] = EYE_M,
    target_m: tuple[float, float, float] | None = None,
    rested_m: np.ndarray = NOBODY,
    places: Sequence[int] = (),
    ahead: Sequence[float] = (0.0, 0.0, 0.0),
    body_m: np.ndarray = NOBODY,
    depth_factor: np.ndarray | float = 1.0,
    depth_sigma: float = 0.04,
    distance_sigma: float = 0.01,
    unseen: np.ndarray | None = None,
    known: np.ndarray | None = None,
    own: np.ndarray | None = None,
    floor: np.ndarray | None = None,
    edges_m: Sequence[np.ndarray] = (),
    errors: DepthErrors | None = None,
    seed: int = 0,
) -> Furnished:
    """What is known of the object; the others have masks too, walls have none.

    Args:
        places: Where each of `rested_m` rested; by default all at one place.
        ahead: Where people looked who sat there.
        unseen: Pixels that people always hid.
        known: Pixels with depth, instead of all.
        own: The object's mask, instead of its visible pixels.
        floor: That of the floor, likewise.
        edges_m: Lines of the world that the picture shows.
        errors: Instead of those of true depth.
    """
    blocks = [*obj, *others, WALL]
    center = np.mean([block.center_m for block in obj], axis=0)
    shot = shoot(blocks, looking(eye_m, target_m or tuple(center)))
    own = shot.mask(*range(len(obj))) if own is None else own
    masks = [own, *(shot.mask(len(obj) + number) for number in range(len(others)))]
    instances = tuple(ObjectInstance(n, "object", 1.0, np.zeros(4), mask) for n, mask in enumerate(masks, 1))
    depth_m = np.where(own, depth_factor, 1.0) * shot.depth_m
    floor = shot.mask(FLOOR) if floor is None else floor
    views = ObjectViews(
        InstanceMasks("truth", instances, floor), metric(shot, depth_m, distance_sigma, known),
        np.zeros_like(own) if unseen is None else unseen,
        PeopleEvidence(
            RestedSkin(
                rested_m, np.array(places or [0] * len(rested_m), int), np.ones(len(rested_m), bool),
                np.tile(np.asarray(ahead, float), (len(rested_m), 1)),
            ), body_m,
        ),
        errors or DepthErrors(depth_sigma, 1.0, 2 * distance_sigma), drawn(edges_m, shot.T_world_camera),
    )  # fmt: skip
    seen = views.object(CompletedObject(1, "object", own, np.zeros((1, 1, 3), np.uint8)), np.random.default_rng(seed))
    assert seen is not None
    return Furnished(shot, seen, views)


def metric(shot: Shot, depth_m: np.ndarray, distance_sigma: float, known: np.ndarray | None = None) -> MetricDepth:
    """Metric depth of the picture, known wherever there is something."""
    shown = shot.shown != SKY
    walk = planted_walk(2)
    body = replace(walk, T_world_camera=np.tile(shot.T_world_camera, (2, 1, 1)), intrinsics=LENS)
    none = np.zeros((0, *depth_m.shape))
    return MetricDepth(
        1.0, 0.0, 0.0, 0.0, None, None, True, "truth", np.zeros(0, np.int64), none, none.astype(bool),
        depth_m, shown if known is None else shown & known, {"1": distance_sigma}, BodyTracks((body,)),
    )  # fmt: skip


def convex(mask: np.ndarray) -> np.ndarray:
    """The mask as networks draw it: without gaps."""
    filled = np.zeros(mask.shape, np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32)), 1)
    return filled.astype(bool)


def yaw_of(T_world_object: np.ndarray) -> float:
    return float(np.arctan2(T_world_object[0, 2], T_world_object[2, 2]))


def turned_by(one_rad: float, other_rad: float, period_rad: float = 2 * np.pi) -> float:
    """Difference of two angles, at most half the period."""
    return abs((one_rad - other_rad + 0.5 * period_rad) % period_rad - 0.5 * period_rad)
