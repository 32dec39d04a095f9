"""Objects that somebody picks up, carries, pulls or puts down, from what changes in a fixed camera's picture for good.

What leaves or comes where a hand is at that moment was taken or put down by it. It lies at the hand's distance then, and
on what is under it; between the two it moves with the hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.spatial import KDTree

from video2anim.body.skeleton import forward_kinematics
from video2anim.geometry.projection import invert_rigid, pixel_rays, project, transform_points
from video2anim.geometry.scene_mesh import world_mesh
from video2anim.objects.changes import Change, lasting_changes
from video2anim.objects.meshing import ObjectPicture, box_object
from video2anim.types import BackgroundPlate, BodyMotion, Hold, InstanceMasks, ObjectPath, PlacedObject, VideoClip
from video2anim.types.camera import Intrinsics

HANDS = {"left hand": (20, 18), "right hand": (21, 19)}
"""Wrist and elbow, SMPL order."""
_HAND_M = 0.09
"""From the wrist to the middle of the hand."""
_NEAR_M = 0.2
"""A hand so near the outline of what leaves or comes, at the hand's distance, has to do with it: its length."""
_LONG_SIDE_PX = 480
_LEAST_PX = 30
"""Of that picture: a cup at 4 m."""
_MOST_SAMPLES = 400
_RESTS_M = 0.25
"""A surface so far below or above what a hand took was its support."""
_SLACK = 2
"""Samples by which the moment may be earlier or later than the pictures tell."""
_FADE_FRAMES = 10
"""In which the difference between its rest and the hand fades by two thirds: a third of a second."""
_LOOKS = 3
_DIFFERS_LAB = 8.0
_SEEN = 0.1
"""So much more of the object's colors must be seen at its place in the hand than at other times."""
_HAND_SIGMA_M = 0.15
"""Standard deviation of a hand's distance from the camera."""
_FLOOR_SIGMA_M, _TOP_SIGMA_M = 0.02, 0.06
"""Those of the heights of the floor and of objects' tops (`benchmarks/v2a_bench.py`)."""
_ALIKE = 0.7
"""Outlines of one object at two places: logarithm of the ratio of their sizes."""
_FURNITURE_M = 0.4
"""What is so high and wide, and stands on the floor, is not lifted but pulled."""
_SAME_OBJECT = 0.3
"""Share of the smaller outline in the other from which a change is an object that is known..."""
_LARGER = 3.0
"""...unless its outline is so much larger: things stand on tables."""


@dataclass(frozen=True, slots=True, eq=False)
class _Hand:
    person_id: int
    name: str
    T_world_hand: Float[np.ndarray, "frames 4 4"]
    """At the middle of the hand, with the wrist's axes."""
    pixels: Float[np.ndarray, "frames 2"]
    depth_m: Float[np.ndarray, "frames"]
    valid: Bool[np.ndarray, "frames"]


@dataclass(frozen=True, slots=True, eq=False)
class _Event:
    """Something is taken or put down by one of some hands."""

    change: Change
    hands: dict[str, tuple[_Hand, int]]
    """Those that are near, by name, and the frame for each; `both hands` where both are."""
    person_id: int

    @property
    def frame(self) -> int:
        return next(iter(self.hands.values()))[1]

    def frame_of(self, name: str) -> int:
        """When that hand does it; of one that is not near, when the nearest does."""
        return self.hands[name][1] if name in self.hands else self.frame


@dataclass(frozen=True, slots=True, eq=False)
class _Rest:
    """Where something rests."""

    T_world_object: Float[np.ndarray, "4 4"]
    size_m: tuple[float, float, float]

    @classmethod
    def of(cls, item: PlacedObject) -> _Rest:
        """Of an object of the scene."""
        extent_m = item.scale * np.ptp(item.mesh.vertices_m.astype(float), axis=0)
        return cls(item.T_world_object, tuple(extent_m.tolist()))

    def alike(self, other: _Rest) -> bool:
        """Both may be outlines of one object."""
        ratio = np.log(np.divide(self.size_m, other.size_m))
        return bool(np.abs(ratio).max() < _ALIKE)


def with_moved_objects(
    clip: VideoClip,
    plate: BackgroundPlate,
    masks: InstanceMasks,
    people: Sequence[BodyMotion],
    objects: Sequence[PlacedObject],
) -> list[PlacedObject]:
    """The objects, those that somebody moves with their paths, and boxes for moved things that were not among them.

    Nothing is found where the camera moves.
    """
    if not clip.camera_is_static or not len(plate.person_mask):
        return list(objects)
    pictures = _pictures(clip, plate)
    height, width = pictures.rgb.shape[1:3]
    lens = people[0].intrinsics.resized(width, height)
    hands = [hand for motion in people for hand in _hands(motion, lens)]
    changes = lasting_changes(pictures.rgb, pictures.hidden, _reach(hands, lens), _LEAST_PX)
    events = [event for change in changes if (event := _event(change, hands, pictures.step, lens)) is not None]
    scene = _Scene(objects, masks, pictures, lens, people[0].T_world_camera[0])
    ways = [way for pair in _stretches(events) for way in _ways(*pair, scene) if way.seen > _SEEN]
    kept = {item.object_id: item for item in objects}
    for way in _apart(ways):
        item = _placed(way, scene, max(kept, default=0) + 1)
        kept[item.object_id] = item
    return list(kept.values())


@dataclass(frozen=True, slots=True, eq=False)
class _Pictures:
    """Reduced pictures of a clip."""

    rgb: UInt8[np.ndarray, "samples height width 3"]
    hidden: Bool[np.ndarray, "samples height width"]
    """Where people are in them."""
    plate_rgb: UInt8[np.ndarray, "height width 3"]
    step: int
    """Frames from one to the next."""


def _pictures(clip: VideoClip, plate: BackgroundPlate) -> _Pictures:
    from video2anim.video import read_frames

    step = int(plate.frame_index[1]) if len(plate.frame_index) > 1 else 1
    regular = np.flatnonzero(plate.frame_index % step == 0)
    every = -(-len(regular) // _MOST_SAMPLES)
    rows = regular[::every]
    scale = min(1.0, _LONG_SIDE_PX / max(clip.width_px, clip.height_px))
    size = (round(clip.width_px * scale), round(clip.height_px * scale))
    frames = read_frames(clip, 0, int(plate.frame_index[rows[-1]]) + 1, step * every)
    rgb = np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])
    margin = np.ones((7, 7), np.uint8)
    hidden = [
        cv2.dilate(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST), margin) > 0
        for mask in plate.person_mask[rows]
    ]
    plate_rgb = cv2.resize(plate.plate_rgb, size, interpolation=cv2.INTER_AREA)
    return _Pictures(rgb, np.stack(hidden), plate_rgb, step * every)


def _hands(motion: BodyMotion, lens: Intrinsics) -> list[_Hand]:
    joints_m, R = forward_kinematics(motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.rest_joints_m)
    T_camera_world = invert_rigid(motion.T_world_camera)
    found = []
    for name, (wrist, elbow) in HANDS.items():
        along = joints_m[:, wrist] - joints_m[:, elbow]
        T = np.tile(np.eye(4), (len(joints_m), 1, 1))
        T[:, :3, :3] = R[:, wrist]
        T[:, :3, 3] = joints_m[:, wrist] + _HAND_M * along / np.linalg.norm(along, axis=-1, keepdims=True)
        camera_m = transform_points(T_camera_world, T[:, None, :3, 3])[:, 0]
        valid = motion.valid & (camera_m[:, 2] > 0.1)
        pixels = project(np.where(valid[:, None], camera_m, [0, 0, 1.0]), lens)
        found.append(_Hand(motion.person_id, name, T, pixels, camera_m[:, 2], valid))
    return found


def _reach(hands: Sequence[_Hand], lens: Intrinsics) -> Bool[np.ndarray, "height width"]:
    """Where a hand comes near."""
    near = np.zeros((lens.height_px, lens.width_px), np.uint8)
    for hand in hands:
        for (x, y), depth_m in zip(hand.pixels[hand.valid], hand.depth_m[hand.valid], strict=True):
            radius = round(3 * _NEAR_M * lens.fx_px / depth_m)
            if -radius < x < lens.width_px + radius and -radius < y < lens.height_px + radius:
                cv2.circle(near, (round(x), round(y)), radius, 1, -1)
    return near > 0


def _event(change: Change, hands: Sequence[_Hand], step: int, lens: Intrinsics) -> _Event | None:
    """The hands of the nearest person that are near while it happens, and when; None where none is."""
    away = cv2.distanceTransform((~change.mask).astype(np.uint8), cv2.DIST_L2, 5)
    near: list[tuple[float, int, _Hand]] = []
    for hand in hands:
        # What moves slowly at first still overlaps its old place.
        start, stop = (change.first - _SLACK) * step, (change.last + _SLACK) * step + 1
        frames = np.arange(max(start, 0), min(stop, len(hand.valid)))
        x, y = (hand.pixels[frames, k].round() for k in (0, 1))
        inside = hand.valid[frames] & (x >= 0) & (x < lens.width_px) & (y >= 0) & (y < lens.height_px)
        frames, x, y = frames[inside], x[inside].astype(int), y[inside].astype(int)
        gap_m = away[y, x] * hand.depth_m[frames] / lens.fx_px
        if len(gap_m) and gap_m.min() <= _NEAR_M:
            close = frames[gap_m <= gap_m.min() + 0.02]
            near.append((float(gap_m.min()), int(close[0] if change.came else close[-1]), hand))
    if not near:
        return None
    near.sort(key=lambda one: one[0])
    person = near[0][2].person_id
    own = {hand.name: (hand, frame) for _, frame, hand in near if hand.person_id == person}
    if len(own) == 2:
        own["both hands"] = (_both(*(hand for hand, _ in own.values())), next(iter(own.values()))[1])
    return _Event(change, own, person)


def _both(one: _Hand, other: _Hand) -> _Hand:
    """What two hands hold: between them, turned as the line from one to the other turns."""
    T = one.T_world_hand.copy()
    across = other.T_world_hand[:, :3, 3] - one.T_world_hand[:, :3, 3]
    yaw = np.arctan2(-across[:, 2], across[:, 0])
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
    T[:, :3, :3] = np.stack([np.stack([c, zero, s], -1), np.tile([0, 1.0, 0], (len(yaw), 1)),
                             np.stack([-s, zero, c], -1)], 1)  # fmt: skip
    T[:, :3, 3] += 0.5 * across
    pixels, depth_m = 0.5 * (one.pixels + other.pixels), 0.5 * (one.depth_m + other.depth_m)
    return _Hand(one.person_id, "both hands", T, pixels, depth_m, one.valid & other.valid)


def _stretches(events: Sequence[_Event]) -> list[tuple[_Event | None, _Event | None]]:
    """What a person takes may go with what it puts down next; what is not put down is kept to the end, and what was not
    taken was in hand from the start. All are tried; pictures decide."""
    found: list[tuple[_Event | None, _Event | None]] = []
    taken: list[_Event] = []
    for event in sorted(events, key=lambda one: (one.frame, one.change.came)):
        if not event.change.came:
            taken.append(event)
            continue
        own = [one for one in taken if one.person_id == event.person_id and one.frame < event.frame]
        found += [(one, event) for one in reversed(own)] or [(None, event)]
    return found + [(event, None) for event in taken]


def _lab_pixels(rgb: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width 3"]:
    return cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)


def _at_hand(hand: _Hand, frame: int, rest: _Rest, T_world_camera: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Pose of the middle of an object at rest, moved along the line of sight to the hand's distance."""
    T, origin_m = rest.T_world_object.copy(), T_world_camera[:3, 3]
    T[1, 3] += 0.5 * rest.size_m[1]
    sight = T[:3, 3] - origin_m
    T[:3, 3] = origin_m + sight * np.linalg.norm(hand.T_world_hand[frame, :3, 3] - origin_m) / np.linalg.norm(sight)
    return T


class _Scene:
    """What is known of the scene when something moves in it."""

    def __init__(
        self,
        objects: Sequence[PlacedObject],
        masks: InstanceMasks,
        pictures: _Pictures,
        lens: Intrinsics,
        T_world_camera: np.ndarray,
    ) -> None:
        self._pictures = pictures
        self.objects, self.lens, self.T_world_camera = {item.object_id: item for item in objects}, lens, T_world_camera
        size = (lens.width_px, lens.height_px)
        self._masks = {
            item.object_id: cv2.resize(item.mask.astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0
            for item in masks.instances
            if item.object_id in self.objects
        }
        self._solids = [world_mesh(item.mesh, item.T_world_object, item.scale) for item in objects]

    def known(self, change: Change) -> PlacedObject | None:
        """The object in the picture that the change shows, or a part of it."""
        best, found = _SAME_OBJECT, None
        for number, mask in self._masks.items():
            shared = (mask & change.mask).sum() / max(min(mask.sum(), change.mask.sum()), 1)
            if shared > best and mask.sum() < _LARGER * change.mask.sum():
                best, found = shared, self.objects[number]
        return found

    def rest(self, event: _Event, hand: _Hand, frame: int) -> _Rest | None:
        """A box around what the change shows, at the hand's distance, on what is under it; None where nothing is."""
        rows, columns = np.nonzero(event.change.mask)
        depth_m = float(hand.depth_m[frame])
        R, origin = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
        across_m = (np.ptp(columns) + 1) * depth_m / self.lens.fx_px
        down_m = (np.ptp(rows) + 1) * depth_m / self.lens.fy_px
        # A box as deep as wide, seen from above by the camera's pitch, shows its front and its top.
        sine = float(np.clip(-R[1, 2], 0, 0.95))
        height_m = max((down_m - across_m * sine) / np.sqrt(1 - sine**2), 0.25 * across_m)
        rays = pixel_rays(self.lens)
        low = R @ rays[rows.max(), round(columns.mean())]
        front_m = origin + depth_m * low
        support_m = self._support_m(front_m, front_m[1])
        if support_m is None:
            return None
        # Where the line of sight meets the support is the less certain the flatter it meets it.
        height_sigma_m = _FLOOR_SIGMA_M if support_m == 0 else _TOP_SIGMA_M
        weight = (low[1] * _HAND_SIGMA_M / height_sigma_m) ** 2 if low[1] < 0 else 0.0
        meets_m = (support_m - origin[1]) / low[1] if low[1] < 0 else depth_m
        front_m = origin + low * (depth_m + weight * meets_m) / (1 + weight)
        front_m[1] = support_m
        ahead = np.array([R[0, 2], 0, R[2, 2]]) / np.hypot(R[0, 2], R[2, 2])
        center_m = front_m + [0, 0.5 * height_m, 0] + 0.5 * across_m * ahead
        T = np.eye(4)
        toward = origin - center_m
        yaw = np.arctan2(toward[0], toward[2])
        T[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
        T[:3, 3] = center_m - [0, 0.5 * height_m, 0]
        return _Rest(T, (across_m, height_m, across_m))

    def looks_held(
        self, change: Change, rested: np.ndarray, hand: _Hand, rest: _Rest, at: int, hold: tuple[int, int]
    ) -> tuple[float, int]:
        """How much more of the object's colors the pictures have at its place in the hand while it is held than at other
        times, as a difference of shares of its size (NaN where the hand is seen too little), and in how many it is held.

        Args:
            rested: Pixels (height, width) where it rests before or after.
            at: Frame in which the hand is at the object where it rests.
            hold: First and last frame.
        """
        offset_m = (invert_rigid(hand.T_world_hand[at]) @ _at_hand(hand, at, rest, self.T_world_camera))[:3, 3]
        palette = KDTree(_lab_pixels(change.rgb)[ndimage.binary_erosion(change.mask)])
        middle_m = hand.T_world_hand[:, :3, 3] + np.einsum("fij,j->fi", hand.T_world_hand[:, :3, :3], offset_m)
        pixels = project(transform_points(invert_rigid(self.T_world_camera), middle_m), self.lens)
        plate, reach = _lab_pixels(self._pictures.plate_rgb), 0.5 * max(rest.size_m) * self.lens.fx_px
        inside, outside = [], []
        for k, rgb in enumerate(self._pictures.rgb):
            frame = k * self._pictures.step
            (x, y), near = pixels[frame], hand.depth_m[frame]
            if not hand.valid[frame] or not (0 <= x < self.lens.width_px and 0 <= y < self.lens.height_px):
                continue
            x0, y0 = (max(int(value - reach / near), 0) for value in (x, y))
            x1, y1 = (int(value + reach / near) + 1 for value in (x, y))
            away = max(hold[0] - frame, frame - hold[1])
            if away > 0 and rested[y0:y1, x0:x1].any():
                continue
            colors = _lab_pixels(rgb[y0:y1, x0:x1]).reshape(-1, 3)
            own = palette.query(colors, distance_upper_bound=_DIFFERS_LAB)[0]
            alike = (own < np.linalg.norm(colors - plate[y0:y1, x0:x1].reshape(-1, 3), axis=-1)).sum()
            share = min(1.0, float(alike / (change.mask.sum() * (hand.depth_m[at] / near) ** 2)))
            (inside if away <= 0 else outside).append(share)
        if len(inside) < _LOOKS:
            return float("nan"), 0
        return float(np.mean(inside) - (np.mean(outside) if outside else 0.0)), len(inside)

    def lowered(self, rest: _Rest) -> _Rest:
        """The same object upright on what is under it."""
        support_m = self._support_m(rest.T_world_object[:3, 3], float(rest.T_world_object[1, 3]))
        T = _on_floor(rest.T_world_object[None], rest.T_world_object)[0]
        T[1, 3] = rest.T_world_object[1, 3] if support_m is None else support_m
        return _Rest(T, rest.size_m)

    def _support_m(self, center_m: np.ndarray, bottom_m: float) -> float | None:
        """Height of the nearest level surface to the bottom of something."""
        heights = [0.0]
        for solid in self._solids:
            corners = solid.vertices_m[solid.faces]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            level = normal[:, 1] > 0.9 * np.maximum(np.linalg.norm(normal, axis=-1), 1e-12)
            low, high = corners[level].min(1), corners[level].max(1)
            over = ((low[:, [0, 2]] - 0.1 <= center_m[[0, 2]]) & (center_m[[0, 2]] <= high[:, [0, 2]] + 0.1)).all(1)
            heights += corners[level][over].mean(1)[:, 1].tolist()
        gap = np.abs(np.array(heights) - bottom_m)
        return float(heights[int(gap.argmin())]) if gap.min() < _RESTS_M else None


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """One way in which something may have been moved."""

    event: _Event
    """That shows most of the object."""
    hold: Hold
    T_world_object: Float[np.ndarray, "frames 4 4"]
    known: PlacedObject | None
    size_m: tuple[float, float, float]
    """Of the box that stands for what is not known."""
    seen: float
    """How much more of it is seen in the hand than at other times, as a share."""
    evidence: float
    """The same in pixels, summed over the pictures in which it is held."""


def _ways(taken: _Event | None, put: _Event | None, scene: _Scene) -> list[_Way]:
    """With each hand that was near at both ends."""
    events = [event for event in (taken, put) if event is not None]
    # Where a known object is in the picture, otherwise where most is seen.
    known = {one.change.came: scene.known(one.change) for one in events}
    event = max(events, key=lambda one: (known[one.change.came] is not None, one.change.mask.sum()))
    came, item = event.change.came, known[event.change.came]
    ways = []
    for name, (hand, _) in event.hands.items():
        first = taken.frame_of(name) if taken else 0
        last = put.frame_of(name) if put else len(hand.valid) - 1
        rests = {one.change.came: scene.rest(one, hand, one.frame_of(name)) for one in events}
        if item is not None:
            rests[came] = _Rest.of(item)
        shown, other = rests[came], rests.get(not came)
        if last <= first or shown is None or (len(events) == 2 and not _same_colors(*(one.change for one in events))):
            continue
        if other is not None and not shown.alike(other):
            # Most of it is hidden there: it lies where the hand leaves it.
            rests[not came] = None
            loose = _path(hand, first, last, [rests.get(end) for end in (False, True)], scene.T_world_camera)
            rests[not came] = scene.lowered(_Rest(loose[first if came else last], shown.size_m))
        T = _path(hand, first, last, [rests.get(end) for end in (False, True)], scene.T_world_camera)
        if min(shown.size_m[:2]) > _FURNITURE_M:
            T = _on_floor(T, shown.T_world_object)
        rested = np.logical_or.reduce([one.change.mask for one in events])
        seen, looks = scene.looks_held(event.change, rested, hand, shown, last if came else first, (first, last))
        ways.append(
            _Way(
                event,
                Hold(hand.person_id, name, first, last),
                T,
                item,
                shown.size_m,
                seen,
                seen * looks * event.change.mask.sum(),
            )
        )
    return ways


def _same_colors(a: Change, b: Change) -> bool:
    """Most of what the one shows has colors of the other."""
    palette = KDTree(_lab_pixels(a.rgb)[a.mask])
    gap = palette.query(_lab_pixels(b.rgb)[b.mask], distance_upper_bound=_DIFFERS_LAB)[0]
    return bool(np.isfinite(gap).mean() > 0.5)


def _apart(ways: Sequence[_Way]) -> list[_Way]:
    """The likeliest ways without those that move the object of another one: one person at one time, or a place where it
    rests."""
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
    gaps_m = np.linalg.norm((ends[0][:, None] - ends[1][None])[..., [0, 2]], axis=-1)
    return bool(gaps_m.min() < 0.5 * (part.size_m[0] + whole.size_m[0]) + _NEAR_M)


def _placed(way: _Way, scene: _Scene, number: int) -> PlacedObject:
    """The object with its path."""
    T, hold, item = way.T_world_object, way.hold, way.known
    if item is None:
        rest = T[hold.last_frame if way.event.change.came else hold.first_frame]
        picture = ObjectPicture(way.event.change.rgb, way.event.change.mask, scene.lens, scene.T_world_camera)
        mesh, parts, texture = box_object(way.size_m, rest, picture)
        item = PlacedObject(
            number, "object", mesh, 1.0, rest, None, None, True, f"moved by the {hold.hand}", parts=parts,
            textures=(texture,),
        )  # fmt: skip
    return replace(item, T_world_object=T[0], path=(ObjectPath(T, (hold,)),))


def _on_floor(T: Float[np.ndarray, "frames 4 4"], place: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "frames 4 4"]:
    """Furniture is pulled: it keeps its height and stays upright."""
    yaw = np.arctan2(T[:, 0, 2], T[:, 2, 2])
    c, s, zero, one = np.cos(yaw), np.sin(yaw), np.zeros(len(T)), np.ones(len(T))
    upright = T.copy()
    upright[:, :3, :3] = np.stack([np.stack([c, zero, s], -1), np.stack([zero, one, zero], -1),
                                   np.stack([-s, zero, c], -1)], 1)  # fmt: skip
    upright[:, 1, 3] = place[1, 3]
    return upright


def _path(
    hand: _Hand, first: int, last: int, ends: Sequence[_Rest | None], T_world_camera: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "frames 4 4"]:
    """At rest, with the hand, at rest.

    The hand's distance from the camera is known worse than where the object rests, so that the object seen in the hand
    is taken to be at the hand's distance, and the way from or to its rest is spread over a moment.
    """
    T_hand, held = hand.T_world_hand, np.arange(first, last + 1)
    ways, gaps = [], []
    for rest, frame in zip(ends, (first, last), strict=True):
        if rest is None:
            continue
        T_rest = rest.T_world_object.copy()
        T_rest[1, 3] += 0.5 * rest.size_m[1]
        near = _at_hand(hand, frame, rest, T_world_camera)
        way = T_hand[held] @ invert_rigid(T_hand[frame]) @ near
        fade = np.exp(-np.abs(held - frame) / _FADE_FRAMES)[:, None]
        way[:, :3, 3] += fade * (T_rest - near)[:3, 3] - 0.5 * rest.size_m[1] * way[:, :3, 1]
        ways.append(way)
        gaps.append(np.abs(held - frame))
    T = np.empty_like(T_hand)
    T[held] = ways[0]
    if len(ways) == 2:
        share = (gaps[0] / np.maximum(gaps[0] + gaps[1], 1))[:, None]
        T[held, :3, 3] = (1 - share) * ways[0][:, :3, 3] + share * ways[1][:, :3, 3]
    T[:first], T[last + 1 :] = T[first], T[last]
    return T
