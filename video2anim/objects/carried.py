"""Objects that somebody picks up, carries, pulls or puts down, from lasting changes in the image of a fixed camera.

Where something disappears or appears beside a hand, the hand took it or put it down. It then rests at the hand's
distance on the surface below, and in between it moves with the hand, where the images must show its colors.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import KDTree

from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.objects.changes import Change, lasting_changes
from video2anim.objects.hands import NEAR_M, UP, Grip, HandPath, grip, hands_of, holders, reach
from video2anim.objects.meshing import ObjectPicture, box_object
from video2anim.objects.rest import Rest, SceneAtRest
from video2anim.types import BodyTracks, Hold, InstanceMasks, ObjectPath, PlacedObject

LONG_SIDE_PX = 480
"""Size of the images that are analyzed."""
_MIN_PX = 60
"""Minimum area of a change in those images: a cup at 3 m. Smaller changes are mostly borders of shadows and people."""
MAX_SAMPLES = 400
"""Maximum number of images (200 MB); longer clips are sampled less often."""
_MAX_GRIPS = 12
"""Maximum number of grips; all pairs are tested (2 s)."""
_LOOKS = 3
"""Minimum number of images of a hold."""
_ALIKE_LAB = 8.0
"""Maximum color difference (CIE Lab) within an object: noise, light and blur."""
_SEEN = 0.1
"""Minimum share of an object seen in the hand during the hold beyond that seen there at other times; half of it where
both its pick-up and its put-down were seen."""
_MARGIN = np.ones((7, 7), np.uint8)
"""Dilation of the masks of people, which are too small in places."""
_COLORS = 50
"""Colors of people that are sampled per image."""
_SHOWN = 0.3
"""Minimum share of an object's pixels that the background image shows: people hide some for long."""
_FURNITURE_M = 0.4
"""Objects this wide and high are pulled over the floor, not lifted."""
_FADE_FRAMES = 10
"""Time constant (0.33 s) of the transition between the pose at rest and the pose in the hand."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """Small images of a clip of a fixed camera, equally spaced in time."""

    rgb: UInt8[np.ndarray, "samples height width 3"]
    person_mask: Bool[np.ndarray, "samples height width"]
    """Where people are in them."""
    background_rgb: UInt8[np.ndarray, "height width 3"]
    step: int
    """Frames from one to the next."""

    @functools.cached_property
    def hidden(self) -> Bool[np.ndarray, "samples height width"]:
        """Where people are or may be."""
        return np.stack([cv2.dilate(mask.astype(np.uint8), _MARGIN) > 0 for mask in self.person_mask])

    @functools.cached_property
    def _people(self) -> list[Float[np.ndarray, "_ 3"]]:
        """Some colors of people in each picture."""
        found = []
        for rgb, mask in zip(self.rgb, self.person_mask, strict=True):
            colors = _lab(rgb)[mask]
            found.append(colors[:: max(1, len(colors) // _COLORS)])
        return found

    def colors_of_people(self, hold: tuple[int, int]) -> KDTree:
        """Colors where people are, while nothing is held."""
        outside = [colors for k, colors in enumerate(self._people) if not hold[0] <= k * self.step <= hold[1]]
        return KDTree(np.concatenate([np.full((1, 3), 1e3), *outside]))

    def background_shows(self, change: Change) -> bool:
        """Whether the background image, a median over time, shows the object of the change: most samples saw it."""
        looks = [
            (~hidden[:, change.mask]).sum(0) for hidden in (self.hidden[: change.first + 1], self.hidden[change.last :])
        ]
        with_it, without = reversed(looks) if change.came else looks
        return bool((with_it > without).mean() > _SHOWN)


def with_moved_objects(
    pictures: Pictures,
    masks: InstanceMasks,
    bodies: BodyTracks,
    objects: Sequence[PlacedObject],
) -> list[PlacedObject]:
    """The objects with the paths of those that somebody moves, and boxes for moved objects that were not among them.

    Objects that never rest for a second are not found.
    """
    height_px, width_px = pictures.rgb.shape[1:3]
    view = bodies.main_view.resized(width_px, height_px)
    lens = view.intrinsics
    hands = [hand for motion in bodies.people for hand in hands_of(motion, lens)]
    changes = lasting_changes(pictures.rgb, pictures.hidden, reach(hands, lens), _MIN_PX)
    largest = sorted(changes, key=lambda change: change.mask.sum(), reverse=True)
    found = [grip(change, hands, pictures.step, lens) for change in largest]
    grips = [one for one in found if one is not None][:_MAX_GRIPS]
    scene = SceneAtRest(objects, masks, view)
    ways = [way for pair in _pairs(grips) for way in _ways(*pair, scene, pictures)]
    kept = {item.object_id: item for item in objects}
    for way in _apart(ways):
        item = _placed(way, scene, max(kept, default=0) + 1)
        kept[item.object_id] = item
    return list(kept.values())


def _pairs(grips: Sequence[Grip]) -> list[tuple[Grip | None, Grip | None]]:
    """Candidate pairs of pick-up and put-down by one person; None for an end outside of the clip."""
    taken = [one for one in grips if not one.change.came]
    put = [one for one in grips if one.change.came]
    pairs: list[tuple[Grip | None, Grip | None]] = [
        (a, b)
        for a in taken
        for b in put
        if a.person_id == b.person_id and a.change.last <= b.change.last and _same_colors(a.change, b.change)
    ]
    paired = [b for _, b in pairs]
    return pairs + [(one, None) for one in taken] + [(None, one) for one in put if one not in paired]


def _same_colors(a: Change, b: Change) -> bool:
    """Whether most pixels of one have colors of the other."""
    palette = KDTree(_lab(a.rgb)[a.mask])
    gap = palette.query(_lab(b.rgb)[b.mask], distance_upper_bound=_ALIKE_LAB)[0]
    return bool(np.isfinite(gap).mean() > 0.5)


def _lab(rgb: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width 3"]:
    return cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """One hypothesis of how an object was moved."""

    change: Change
    """The change that shows most of the object."""
    hold: Hold
    T_world_object: Float[np.ndarray, "frames 4 4"]
    known: PlacedObject | None
    size_m: tuple[float, float, float]
    """Size of the box for an unknown object."""
    evidence: float
    """Pixels that show it in the hand, summed over the images; doubled where both ends were seen."""


def _ways(taken: Grip | None, put: Grip | None, scene: SceneAtRest, pictures: Pictures) -> list[_Way]:
    """One hypothesis per hand that may have moved it, if the images show it there."""
    grips = [one for one in (taken, put) if one is not None]
    # The end that shows a known object, otherwise the one that shows more.
    known = {
        one.change.came: scene.known(one.change.mask) if pictures.background_shows(one.change) else None
        for one in grips
    }
    shows = max(grips, key=lambda one: (known[one.change.came] is not None, one.change.mask.sum())).change
    item, rested = known[shows.came], np.logical_or.reduce([one.change.mask for one in grips])
    count = len(next(iter(grips[0].hands.values())).valid)
    ends = (taken.frame("") if taken else 0, put.frame("") if put else count - 1)
    ways = []
    for name, hand in holders(grips, *ends).items():
        first, last = taken.frame(name) if taken else 0, put.frame(name) if put else count - 1
        if last <= first:
            continue
        rests = {one.change.came: scene.rest(one.change.mask, hand, one.frame(name)) for one in grips}
        if item is not None:
            rests[shows.came] = Rest.of(item)
        best = rests[shows.came]
        if put and taken and not best.alike(rests[not shows.came]):
            # Mostly hidden at the other end: it rests where the hand leaves it.
            loose = _path(hand, first, last, {shows.came: best}, scene.view.T_world_camera)
            rests[not shows.came] = scene.lowered(Rest(loose[first if shows.came else last], best.size_m))
        looks = _looks(shows, rested, hand, best, (first, last), scene, pictures)
        pulled = min(best.size_m[:2]) > _FURNITURE_M
        if pulled and put is None:
            last = looks.let_go(first)
            loose = _path(hand, first, last, rests, scene.view.T_world_camera)
            rests[True] = scene.lowered(Rest(loose[last], best.size_m))
        T = _path(hand, first, last, rests, scene.view.T_world_camera)
        if pulled:
            T[:, :3, :3] = matrix_from_axis_angle(np.arctan2(T[:, 0, 2], T[:, 2, 2])[:, None] * UP)
            T[:, 1, 3] = best.T_world_object[1, 3]
        seen, held = looks.held(first, last)
        hold = Hold(hand.person_id, name, first, last)
        ends_seen = len(grips)
        if seen * ends_seen > _SEEN:
            evidence = ends_seen * seen * held * float(shows.mask.sum())
            ways.append(_Way(shows, hold, T, item, best.size_m, evidence))
    return ways


@dataclass(frozen=True, slots=True, eq=False)
class _Looks:
    """Share of an object that each image shows at its place in a hand, during the hold and outside of it."""

    frame: Int[np.ndarray, "looks"]
    share: Float[np.ndarray, "looks"]
    """Pixels of its colors over its area."""
    clear: Bool[np.ndarray, "looks"]
    """Whether its places of rest are elsewhere in the image."""

    def held(self, first: int, last: int) -> tuple[float, int]:
        """Mean share during the hold minus that at other times, and the number of images; zeros where too few."""
        inside = (self.frame >= first) & (self.frame <= last)
        if inside.sum() < _LOOKS:
            return 0.0, 0
        chance = self.share[~inside & self.clear]
        return float(self.share[inside].mean() - (chance.mean() if len(chance) else 0.0)), int(inside.sum())

    def let_go(self, first: int) -> int:
        """Last frame of the hold: before it the share is above half of that at the start, then below."""
        later = np.flatnonzero(self.frame >= first)
        if not len(later):
            return first
        level = 0.5 * np.median(self.share[later[: 2 * _LOOKS]])
        return int(self.frame[later[int(np.cumsum(self.share[later] - level).argmax())]])


def _looks(
    change: Change,
    rested: Bool[np.ndarray, "height width"],
    hand: HandPath,
    rest: Rest,
    hold: tuple[int, int],
    scene: SceneAtRest,
    pictures: Pictures,
) -> _Looks:
    """Shares of the object of a change in a hand that takes it from its rest or puts it there.

    Args:
        rested: Pixels where it rests before or after.
        hold: First and last frame in which the hand has it.
    """
    at = hold[1] if change.came else hold[0]
    offset_m = transform_points(
        invert_rigid(hand.T_world_hand[at]), _at_hand(hand, at, rest, scene.view.T_world_camera)[None]
    )[0]
    center_m = transform_points(hand.T_world_hand, offset_m[None])[:, 0]
    lens = scene.view.intrinsics
    pixels = project(transform_points(invert_rigid(scene.view.T_world_camera), center_m), lens)
    palette = KDTree(_lab(change.rgb)[cv2.erode(change.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0])
    others = pictures.colors_of_people(hold)
    background, half_px = _lab(pictures.background_rgb), (0.5 * max(rest.size_m) + 0.5 * NEAR_M) * lens.fx_px
    # A pixel nearer to the object's colors than to its background's is off that by more than half of the background's
    # own distance from them: most are not, and need no search.
    behind = palette.query(background.reshape(-1, 3), distance_upper_bound=2 * _ALIKE_LAB)[0]
    least = 0.5 * np.minimum(behind, 2 * _ALIKE_LAB).reshape(background.shape[:2])
    found = []
    for sample, rgb in enumerate(pictures.rgb):
        frame = sample * pictures.step
        (x, y), depth_m = pixels[frame], hand.depth_m[frame]
        if not hand.valid[frame] or not (0 <= x < lens.width_px and 0 <= y < lens.height_px):
            continue
        x0, y0 = (max(int(value - half_px / depth_m), 0) for value in (x, y))
        x1, y1 = (int(value + half_px / depth_m) + 1 for value in (x, y))
        colors = _lab(rgb[y0:y1, x0:x1])
        off = np.linalg.norm(colors - background[y0:y1, x0:x1], axis=-1)
        may = off > least[y0:y1, x0:x1]
        own = palette.query(colors[may], distance_upper_bound=_ALIKE_LAB)[0]
        alike = own < off[may]
        # Infinite where no person has such a color.
        other = others.query(colors[may][alike], distance_upper_bound=_ALIKE_LAB)[0]
        count = (own[alike] < other).sum()
        whole = change.mask.sum() * (hand.depth_m[at] / depth_m) ** 2
        found.append((frame, min(1.0, float(count / whole)), not rested[y0:y1, x0:x1].any()))
    frame, share, clear = np.array(found).reshape(-1, 3).T
    return _Looks(frame.astype(int), share, clear > 0)


def _apart(ways: Sequence[_Way]) -> list[_Way]:
    """The hypotheses with most evidence, without those in conflict with a better one: same person and time, same
    object, or same place of rest."""
    chosen: list[_Way] = []
    for way in sorted(ways, key=lambda one: (one.known is not None, one.evidence), reverse=True):
        if not any(_one_object(way, other) for other in chosen):
            chosen.append(way)
    return chosen


def _one_object(part: _Way, whole: _Way) -> bool:
    a, b = part.hold, whole.hold
    if a.person_id == b.person_id and a.first_frame < b.last_frame and b.first_frame < a.last_frame:
        return True
    if part.known is not None and part.known is whole.known:
        return True
    ends = [way.T_world_object[[0, -1], :3, 3] for way in (part, whole)]
    gap_m = np.linalg.norm((ends[0][:, None] - ends[1][None])[..., [0, 2]], axis=-1)
    return bool(gap_m.min() < 0.5 * (part.size_m[0] + whole.size_m[0]) + NEAR_M)


def _placed(way: _Way, scene: SceneAtRest, number: int) -> PlacedObject:
    """The object with its path."""
    T, hold, item = way.T_world_object, way.hold, way.known
    if item is None:
        rest = T[hold.last_frame if way.change.came else hold.first_frame]
        picture = ObjectPicture(way.change.rgb, way.change.mask, scene.view)
        mesh, parts, texture = box_object(way.size_m, rest, picture)
        reason = f"moved by the {hold.hand} of person {hold.person_id}"
        item = PlacedObject(
            number, "object", mesh, 1.0, rest, None, None, True, reason, parts=parts, textures=(texture,)
        )  # fmt: skip
    return replace(item, T_world_object=T[0], path=(ObjectPath(T, (hold,)),))


def _at_hand(
    hand: HandPath, frame: int, rest: Rest, T_world_camera: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "3"]:
    """Center of an object at rest, moved along the line of sight to the hand's distance."""
    origin_m = T_world_camera[:3, 3]
    sight = rest.center_m - origin_m
    return origin_m + sight * np.linalg.norm(hand.T_world_hand[frame, :3, 3] - origin_m) / np.linalg.norm(sight)


def _path(
    hand: HandPath, first: int, last: int, rests: dict[bool, Rest], T_world_camera: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "frames 4 4"]:
    """Pose of the object in every frame: at rest, with the hand, at rest.

    The hand's distance from the camera is less certain than that of the object at rest. In the hand the object is at
    the hand's distance, and the difference fades over a short time.

    Args:
        rests: Where it rests before (False) and after (True), or one of them.
    """
    T_hand, held = hand.T_world_hand, np.arange(first, last + 1)
    ways, gaps = [], []
    for came, rest in sorted(rests.items()):
        frame = last if came else first
        near = rest.T_world_object.copy()
        near[:3, 3] = _at_hand(hand, frame, rest, T_world_camera)
        way = T_hand[held] @ invert_rigid(T_hand[frame]) @ near
        fade = np.exp(-np.abs(held - frame) / _FADE_FRAMES)[:, None]
        way[:, :3, 3] += fade * (rest.center_m - near[:3, 3]) - 0.5 * rest.size_m[1] * way[:, :3, 1]
        ways.append(way)
        gaps.append(np.abs(held - frame))
    T = np.empty_like(T_hand)
    T[held] = ways[0]
    if len(ways) == 2:
        share = (gaps[0] / np.maximum(gaps[0] + gaps[1], 1))[:, None]
        T[held, :3, 3] = (1 - share) * ways[0][:, :3, 3] + share * ways[1][:, :3, 3]
        T[last] = rests[True].T_world_object
    T[:first], T[last + 1 :] = T[first], T[last]
    return T
