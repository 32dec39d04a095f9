"""Views of preset `hidden`: the person is out of sight for a while, behind an object or outside the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from video2anim.errors import InputError
from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.lab.synth.cameras import NEVER_HIDES, CameraRequest, place_camera
from video2anim.lab.synth.presets import Hiding
from video2anim.lab.synth.render.caster import RayCaster
from video2anim.lab.synth.render.surfaces import surfaces_of_objects
from video2anim.lab.synth.rooms import make_furniture
from video2anim.lab.synth.rooms.clearance import SweepIndex
from video2anim.lab.synth.rooms.making import pose
from video2anim.lab.synth.rooms.placing import Boxes, Plan
from video2anim.lab.synth.world import NEAR_M, Room, SceneObject
from video2anim.types import Intrinsics
from video2anim.types.clip import FPS

HIDDEN_RATIO = 0.2
"""Out of sight: the box around the visible part of the body has less than this share of the area of the body's box."""
_FULLY_RATIO = 0.02
"""Upper limit of that share in half of the hidden frames."""
_AROUND_S = 1.0
"""Minimum time in sight before and after."""
_AROUND_RATIO = 0.4
"""Minimum mean share of the box in sight during that time."""
_CAMERAS = 12
_PLACES = 60
"""Number of views tried, and of object positions tried in each."""
_CLEAR_M = 0.06
"""Minimum distance of the object from the bodies' path."""
_FROM_CAMERA_M = 0.7
_NEAREST_M = 1.0
"""Minimum distance to the lens of a person who leaves the picture."""


def hidden_view(
    rng: np.random.Generator,
    room: Room,
    swept_m: Float[np.ndarray, "points 3"],
    joints_m: Float[np.ndarray, "frames 22 3"],
    skin_m: Float[np.ndarray, "frames points 3"],
    request: CameraRequest,
    hiding: Hiding,
) -> tuple[Room, Intrinsics, Float[np.ndarray, "frames 4 4"]]:
    """A camera from which the person is out of sight once, and the room with the object that hides the person.

    Args:
        rng: Random numbers.
        room: The room without the object.
        swept_m: Skin points of the whole clip (world); the object stays clear of them.
        joints_m: Joints of the one person (world).
        skin_m: Some hundred skin points of the person (world).
        request: Ranges for the camera.
        hiding: How and for how long the person is to be hidden.

    Raises:
        InputError: no view and object position hides the person as wanted.
    """
    request = replace(request, height_m=hiding.camera_height_m)
    plan = Plan(room.bounds_m, room.height_m, SweepIndex(swept_m), _CLEAR_M)
    for obj in room.furniture:
        plan.add(obj)
    for _ in range(_CAMERAS):
        if hiding.behind is None:
            found = _leaving(rng, room, joints_m, skin_m, request, hiding)
        else:
            found = _behind(rng, room, plan, joints_m, skin_m, request, hiding)
        if found is not None:
            return found
    raise InputError(f"no view hides the person for {hiding.hidden_s[0]:g} to {hiding.hidden_s[1]:g} s")


def _behind(
    rng: np.random.Generator, room: Room, plan: Plan, joints_m: np.ndarray, skin_m: np.ndarray,
    request: CameraRequest, hiding: Hiding,
) -> tuple[Room, Intrinsics, np.ndarray] | None:  # fmt: skip
    """A view with the whole motion in the picture and an object in front of a part of it; None if none is found."""
    lens, T_world_camera = place_camera(rng, room, joints_m[None], request)
    camera_m = T_world_camera[0, :3, 3]
    pixel, seen = in_picture(lens, T_world_camera[0], skin_m)
    seen &= ~_blocked(_caster(room), camera_m, skin_m)
    for _ in range(_PLACES):
        obj = _object_before(rng, room, camera_m, joints_m, hiding)
        boxes = Boxes.of(obj)
        if np.linalg.norm(boxes.corners_xz() - camera_m[[0, 2]], axis=1).min() < _FROM_CAMERA_M:
            continue
        if not plan.fits(boxes):
            continue
        blocked = _blocked(surfaces_of_objects([obj]).caster(), camera_m, skin_m)
        if _is_hidden_once(pixel, seen & ~blocked, hiding):
            return replace(room, furniture=(*room.furniture, obj)), lens, T_world_camera
    return None


def _object_before(
    rng: np.random.Generator, room: Room, camera_m: np.ndarray, joints_m: np.ndarray, hiding: Hiding
) -> SceneObject:
    """An object, parallel to the walls, on the line of sight to the person at one frame."""
    height_m = float(rng.uniform(*hiding.height_m))
    depth_m = float(rng.uniform(0.3, 0.38) if hiding.behind == "shelf" else rng.uniform(0.42, 0.6))
    obj = make_furniture(
        hiding.behind or "", rng, size_m=(float(rng.uniform(*hiding.width_m)), depth_m), surface_height_m=height_m
    )
    frame = _moment(rng, camera_m, joints_m, hiding)
    person_m = joints_m[frame, 0]
    place = camera_m + rng.uniform(0.4, 0.95) * (person_m - camera_m) + rng.normal(0.0, 0.15, 3)
    away = camera_m - person_m
    quarter = np.round(np.arctan2(away[0], away[2]) / (np.pi / 2)) * (np.pi / 2)
    yaw = quarter + (np.pi if rng.random() < 0.3 else 0.0) + rng.normal(0.0, 0.03)
    number = max(item.object_id for item in room.objects) + 1
    return obj.moved(pose(float(place[0]), float(place[2]), float(yaw)), number)


def _moment(rng: np.random.Generator, camera_m: np.ndarray, joints_m: np.ndarray, hiding: Hiding) -> int:
    """Frame at which the object is in front of the person."""
    count = len(joints_m)
    if hiding.when == "low":
        return int(joints_m[:, :, 1].max(1).argmin())
    if hiding.when == "turning":
        gone_m = np.linalg.norm(joints_m[:, 0] - joints_m[0, 0], axis=-1)
        return int(np.clip(gone_m.argmax() + rng.integers(-10, 11), 0, count - 1))
    across_rad = np.unwrap(np.arctan2(*(joints_m[:, 0] - camera_m)[:, [0, 2]].T))
    speed = np.abs(np.gradient(across_rad))
    speed[: count // 5], speed[-(count // 5) :] = 0.0, 0.0
    return int(rng.choice(count, p=speed / speed.sum()))


def _leaving(
    rng: np.random.Generator, room: Room, joints_m: np.ndarray, skin_m: np.ndarray, request: CameraRequest,
    hiding: Hiding,
) -> tuple[Room, Intrinsics, np.ndarray] | None:  # fmt: skip
    """A view with only a part of the path in the picture; None if none is found."""
    gone_m = np.linalg.norm(joints_m[:, 0] - joints_m[0, 0], axis=-1)
    kept = gone_m < rng.uniform(0.25, 0.95) * gone_m.max()
    lens, T = place_camera(rng, room, joints_m[None, kept], request)
    camera_m = T[0, :3, 3]
    if np.linalg.norm(joints_m - camera_m, axis=-1).min() < _NEAREST_M:
        return None
    pixel, seen = in_picture(lens, T[0], skin_m)
    seen &= ~_blocked(_caster(room), camera_m, skin_m)
    return (room, lens, np.tile(T[0], (len(joints_m), 1, 1))) if _is_hidden_once(pixel, seen, hiding) else None


def _caster(room: Room) -> RayCaster:
    return surfaces_of_objects(obj for obj in room.objects if obj.label not in NEVER_HIDES).caster()


def in_picture(
    lens: Intrinsics, T_world_camera: np.ndarray, points_m: Float[np.ndarray, "*points 3"]
) -> tuple[Float[np.ndarray, "*points 2"], Bool[np.ndarray, "*points"]]:
    """Pixel coordinates of world points, and whether they are inside the picture."""
    camera_m = transform_points(invert_rigid(T_world_camera), points_m)
    ahead = camera_m[..., 2] > NEAR_M
    pixel = project(np.where(ahead[..., None], camera_m, [0.0, 0.0, 1.0]), lens)
    inside = (pixel > -0.5) & (pixel < np.array([lens.width_px, lens.height_px]) - 0.5)
    return pixel, ahead & inside.all(-1)


def _blocked(caster: RayCaster, camera_m: np.ndarray, skin_m: np.ndarray) -> Bool[np.ndarray, "frames points"]:
    ray = skin_m.reshape(-1, 3) - camera_m
    return caster.blocked(np.broadcast_to(camera_m, ray.shape), ray, 0.97).reshape(skin_m.shape[:2])


def _is_hidden_once(
    pixel: Float[np.ndarray, "frames points 2"], seen: Bool[np.ndarray, "frames points"], hiding: Hiding
) -> bool:
    """Whether there is exactly one hidden interval, of the wanted length, with the person in sight before and after."""
    ratio = _seen_ratio(pixel, seen)
    hidden = np.flatnonzero(ratio < HIDDEN_RATIO)
    if not len(hidden) or hidden[-1] - hidden[0] + 1 != len(hidden):
        return False
    around = round(_AROUND_S * FPS)
    before, after = ratio[: hidden[0]], ratio[hidden[-1] + 1 :]
    if min(len(before), len(after)) < around or min(before.mean(), after.mean()) < _AROUND_RATIO:
        return False
    long_enough = hiding.hidden_s[0] <= len(hidden) / FPS <= hiding.hidden_s[1]
    return long_enough and float(np.median(ratio[hidden])) <= _FULLY_RATIO


def _seen_ratio(pixel: np.ndarray, seen: np.ndarray) -> Float[np.ndarray, "frames"]:
    """Area of the box around the visible points over that of the box around all points, per frame."""
    low = np.where(seen[..., None], pixel, np.inf).min(1)
    high = np.where(seen[..., None], pixel, -np.inf).max(1)
    box_px = np.where(np.any(seen, axis=1)[:, None], high - low, 0.0)
    return box_px.prod(-1) / np.maximum(np.ptp(pixel, axis=1).prod(-1), 1.0)
