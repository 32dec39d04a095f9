"""The floor plan of a room while it is furnished: placed objects, and tests where another one fits."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from video2anim.lab.synth.rooms.clearance import SweepIndex
from video2anim.lab.synth.rooms.making import pose, yaw_of
from video2anim.lab.synth.world import SceneObject

Bounds = tuple[float, float, float, float]
_TOUCH_M = 0.001
"""Objects may overlap by this much."""


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Axis-aligned boxes in one frame that is rotated about the vertical."""

    low_m: Float[np.ndarray, "boxes 3"]
    high_m: Float[np.ndarray, "boxes 3"]
    T_world_frame: Float[np.ndarray, "4 4"]

    @classmethod
    def of(cls, obj: SceneObject) -> Boxes:
        low = np.stack([part.vertices_m.min(0) for part in obj.parts])
        high = np.stack([part.vertices_m.max(0) for part in obj.parts])
        return cls(low, high, obj.T_world_object)

    def at(self, T_world_frame: np.ndarray) -> Boxes:
        return Boxes(self.low_m, self.high_m, T_world_frame)

    def whole(self) -> Boxes:
        """The one box around all boxes."""
        return Boxes(self.low_m.min(0)[None], self.high_m.max(0)[None], self.T_world_frame)

    def corners_xz(self) -> Float[np.ndarray, "4 2"]:
        """World x, z of the corners of the box around all boxes."""
        (x0, _, z0), (x1, _, z1) = self.low_m.min(0), self.high_m.max(0)
        local = np.array([[x0, 0, z0], [x1, 0, z0], [x1, 0, z1], [x0, 0, z1]])
        return (local @ self.T_world_frame[:3, :3].T + self.T_world_frame[:3, 3])[:, [0, 2]]


def overlap(a: Boxes, b: Boxes, margin_m: float = 0.0) -> bool:
    """Whether any box of `a` overlaps one of `b`, or is horizontally less than `margin_m` away from it."""
    yaw_a, yaw_b = yaw_of(a.T_world_frame), yaw_of(b.T_world_frame)
    level = [
        (boxes.low_m[:, 1] + boxes.T_world_frame[1, 3], boxes.high_m[:, 1] + boxes.T_world_frame[1, 3])
        for boxes in (a, b)
    ]
    meet = level[0][0][:, None] < level[1][1][None] - _TOUCH_M
    meet &= level[1][0][None] < level[0][1][:, None] - _TOUCH_M
    if not meet.any():
        return False
    center, half = [], []
    for boxes in (a, b):
        c = (boxes.low_m + boxes.high_m) / 2 * [1, 0, 1]
        center.append((c @ boxes.T_world_frame[:3, :3].T + boxes.T_world_frame[:3, 3])[:, [0, 2]])
        half.append((boxes.high_m - boxes.low_m)[:, [0, 2]] / 2)
    half[0] = half[0] + margin_m
    between = center[1][None] - center[0][:, None]
    for yaw in {yaw_a: 0, yaw_b: 0}:
        for axis in (np.array([np.cos(yaw), -np.sin(yaw)]), np.array([np.sin(yaw), np.cos(yaw)])):
            reach = []
            for own, size in ((yaw_a, half[0]), (yaw_b, half[1])):
                ex, ez = np.array([np.cos(own), -np.sin(own)]), np.array([np.sin(own), np.cos(own)])
                reach.append(size[:, 0] * abs(ex @ axis) + size[:, 1] * abs(ez @ axis))
            meet &= np.abs(between @ axis) < reach[0][:, None] + reach[1][None] - _TOUCH_M
    return bool(meet.any())


@dataclass(slots=True, eq=False)
class Plan:
    """Bounds of the room, body points of the people, and the objects placed so far."""

    bounds_m: Bounds
    height_m: float
    sweep: SweepIndex
    clear_m: float
    """Minimum distance of furniture from body points."""
    placed: list[SceneObject] = field(default_factory=list)
    boxes: list[Boxes] = field(default_factory=list)
    kept_free: list[Boxes] = field(default_factory=list)
    """Spaces in front of doors and windows, and for the camera."""

    def keep_free(
        self, low: tuple[float, float, float], high: tuple[float, float, float], T: np.ndarray | None = None
    ) -> None:
        self.kept_free.append(Boxes(np.array([low], float), np.array([high], float), np.eye(4) if T is None else T))

    def add(self, obj: SceneObject) -> SceneObject:
        self.placed.append(obj)
        self.boxes.append(Boxes.of(obj))
        return obj

    def fits(
        self,
        boxes: Boxes,
        *,
        apart_m: float = 0.02,
        clear_m: float | None = None,
        ignore_free: bool = False,
        whole: bool = False,
    ) -> bool:
        """Whether an object fits: inside the room, off kept-free spaces, other objects and people.

        Args:
            boxes: Bounding boxes of its parts.
            apart_m: Minimum distance from other objects.
            clear_m: Minimum distance from body points; `self.clear_m` if None.
            ignore_free: Allow it in kept-free spaces.
            whole: Compare its one bounding box with other objects, so that nothing is tucked under another.
        """
        corners = boxes.corners_xz()
        x0, x1, z0, z1 = self.bounds_m
        low, high = corners.min(0), corners.max(0)
        if low[0] < x0 or high[0] > x1 or low[1] < z0 or high[1] > z1:
            return False
        outline = boxes.whole()
        if not ignore_free and any(overlap(outline, free) for free in self.kept_free):
            return False
        for other in self.boxes:
            around = other.whole()
            if overlap(outline, around, apart_m) and (whole or overlap(boxes, other, apart_m)):
                return False
        return self.clear_of_people(boxes, self.clear_m if clear_m is None else clear_m)

    def clear_of_people(self, boxes: Boxes, clear_m: float) -> bool:
        """Whether no body point is within `clear_m` of any of the boxes."""
        corners = boxes.corners_xz()
        points = self.sweep.near(corners.min(0) - clear_m, corners.max(0) + clear_m)
        if len(points) == 0:
            return True
        local = (points - boxes.T_world_frame[:3, 3]) @ boxes.T_world_frame[:3, :3]
        low, high = boxes.low_m - clear_m, boxes.high_m + clear_m
        local = local[((local > low.min(0)) & (local < high.max(0))).all(1)]
        for start in range(0, len(local), 20_000):
            some = local[start : start + 20_000, None]
            if ((some > low[None]) & (some < high[None])).all(2).any():
                return False
        return True

    # --- ways to find a place -------------------------------------------------------------------------------------

    def try_at(self, obj: SceneObject, T: np.ndarray, **rules) -> SceneObject | None:
        """Place an object at a pose if it fits; None if not. `rules`: arguments of `fits`."""
        return self.add(obj.moved(T)) if self.fits(Boxes.of(obj).at(T), **rules) else None

    def wall_pose(self, side: int, along_m: float, off_m: float) -> np.ndarray:
        """Pose facing into the room, `along_m` from the center of wall `side` (0 = -Z, 1 = +X, 2 = +Z, 3 = -X)."""
        return wall_frame(self.bounds_m, side) @ pose(along_m, off_m, 0.0)

    def against_wall(
        self, obj: SceneObject, rng: np.random.Generator, *, tries: int = 16, turn: float = 0.0, **rules
    ) -> SceneObject | None:
        """Place an object at a random spot with its back to a wall (its side if `turn` is pi / 2), often in a
        corner."""
        boxes = Boxes.of(obj)
        extent = boxes.high_m.max(0) - boxes.low_m.min(0)
        if abs(np.sin(turn)) > 0.5:
            extent = extent[[2, 1, 0]]
        for _ in range(tries):
            side = int(rng.integers(4))
            room = wall_length(self.bounds_m, side) / 2 - extent[0] / 2 - 0.03
            if room < 0:
                continue
            along = float(rng.uniform(-room, room))
            if rng.random() < 0.35:
                along = float(np.sign(along) * (room - rng.uniform(0, 0.15) * (room > 0.2)))
            T = self.wall_pose(side, along, extent[2] / 2 + 0.02 + float(rng.uniform(0, 0.02)))
            T = T @ pose(0.0, 0.0, turn)
            if self.fits(boxes.at(T), **rules):
                return self.add(obj.moved(T))
        return None

    def near_people(
        self,
        obj: SceneObject,
        rng: np.random.Generator,
        clear_m: float,
        *,
        tries: int = 6,
        loose_rad: float = 0.1,
        **rules,
    ) -> SceneObject | None:
        """Place an object as near to the people as `clear_m` allows, moved towards them along a random line."""
        boxes = Boxes.of(obj)
        radius = float(np.linalg.norm((boxes.high_m.max(0) - boxes.low_m.min(0))[[0, 2]]) / 2)
        for _ in range(tries):
            goal = self.sweep.points[int(rng.integers(len(self.sweep.points)))]
            turn = float(rng.uniform(0, 2 * np.pi))
            yaw = float(rng.choice([0.0, np.pi / 2, np.pi, -np.pi / 2])) + float(rng.normal(0, loose_rad))
            away = np.array([np.sin(turn), np.cos(turn)])
            for distance in np.arange(0.04, 1.6 + radius, 0.04):
                x, z = goal[[0, 2]] + away * distance
                T = pose(float(x), float(z), yaw)
                if self.clear_of_people(boxes.at(T), clear_m):
                    if self.fits(boxes.at(T), clear_m=clear_m, **rules):
                        return self.add(obj.moved(T))
                    break
        return None

    def anywhere(
        self, obj: SceneObject, rng: np.random.Generator, *, tries: int = 16, yaw: float | None = None, **rules
    ) -> SceneObject | None:
        """Place an object at a random spot on the floor."""
        x0, x1, z0, z1 = self.bounds_m
        boxes = Boxes.of(obj)
        for _ in range(tries):
            turn = float(rng.uniform(0, 2 * np.pi)) if yaw is None else yaw
            T = pose(float(rng.uniform(x0, x1)), float(rng.uniform(z0, z1)), turn)
            if self.fits(boxes.at(T), **rules):
                return self.add(obj.moved(T))
        return None


def wall_frame(bounds_m: Bounds, side: int) -> Float[np.ndarray, "4 4"]:
    """T_world_wall: origin at the center of the inner face's lower edge, +X along the wall, +Z into the room."""
    x0, x1, z0, z1 = bounds_m
    cx, cz = (x0 + x1) / 2, (z0 + z1) / 2
    x, z, yaw = ((cx, z0, 0.0), (x1, cz, -np.pi / 2), (cx, z1, np.pi), (x0, cz, np.pi / 2))[side]
    return pose(x, z, yaw)


def wall_length(bounds_m: Bounds, side: int) -> float:
    """Length in meters of a wall (0 = -Z, 1 = +X, 2 = +Z, 3 = -X)."""
    x0, x1, z0, z1 = bounds_m
    return x1 - x0 if side % 2 == 0 else z1 - z0
