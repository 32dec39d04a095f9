"""Camera placement: a random pose from which the people are in the picture and mostly unoccluded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.lab.synth.render.caster import RayCaster
from video2anim.lab.synth.render.surfaces import surfaces_of_objects
from video2anim.lab.synth.world import PICTURE_SIZE_PX, Room
from video2anim.types import Intrinsics

NEVER_HIDES = ("ceiling", "floor", "rug", "picture", "skirting")
"""Labels of objects that cannot occlude people from a camera inside the room."""
_FRAME_STEP = 10
"""The view is checked in every 10th frame."""
_FROM_OBJECT_M = 0.3
_FROM_WALL_M = 0.2
_CHOICES = 12
"""The best of this many suitable poses is taken."""
_USUAL_FOV_RAD = float(np.deg2rad(55.0))
"""Vertical field of view of a phone or camcorder at its wide end, in landscape."""
_FOV_SPREAD = 0.3
"""Standard deviation of the logarithm of the preferred field of view over clips."""


CameraMotion = Literal["static", "handheld", "pan", "follow"]
"""`handheld` drifts; `pan` turns with the first person, `follow` moves beside them, both drifting too."""
_PAN_ZOOM = 1.3
"""Focal length of a camera that turns, over that of one that sees the whole motion at once."""
_FOLLOWED = (0.8, 0.6, 0.4, 0.2)
"""Shares of the person's path that a camera that follows moves itself; the largest that furniture and walls allow."""
_FOLLOW_LAG_FRAMES = 12
"""Standard deviation of the window over which the operator smooths the person's path."""


@dataclass(frozen=True, slots=True)
class CameraRequest:
    """Ranges from which a camera is drawn."""

    width_px: int = PICTURE_SIZE_PX[0]
    height_px: int = PICTURE_SIZE_PX[1]
    fov_y_rad: tuple[float, float] = (np.deg2rad(35.0), np.deg2rad(90.0))
    height_m: tuple[float, float] = (0.8, 2.6)
    pitch_rad: tuple[float, float] = (-0.6, 0.15)
    roll_sigma_rad: float = 0.02
    nearest_m: float = 1.6
    """Minimum distance of the lens from any joint."""
    figure_ratio: tuple[float, float] = (0.28, 0.85)
    """Median height of a person in the picture, as a share of the picture's height."""
    min_seen: float = 0.8
    """Minimum share of joints that no furniture occludes."""
    motion: CameraMotion = "static"


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    position_m: Float[np.ndarray, "3"]
    R_world_camera: Float[np.ndarray, "3 3"]
    fov_y_rad: float
    seen: float


def place_camera(
    rng: np.random.Generator,
    room: Room,
    joints_m: Float[np.ndarray, "people frames 22 3"],
    request: CameraRequest,
    tries: int = 1200,
) -> tuple[Intrinsics, Float[np.ndarray, "frames 4 4"]]:
    """Draw a camera that has all joints of all sampled frames in the picture and most of them unoccluded.

    Returns:
        Intrinsics and T_world_camera of each frame (OpenCV camera axes).

    Raises:
        InputError: no place in the room satisfies the request.
    """
    frames = joints_m.shape[1]
    points = joints_m[:, :: min(_FRAME_STEP, max(frames - 1, 1))].reshape(-1, 22, 3)
    boxes = _furniture_boxes(room)
    caster = surfaces_of_objects(obj for obj in room.objects if obj.label not in NEVER_HIDES).caster()
    wished = float(np.clip(_USUAL_FOV_RAD * np.exp(rng.normal(0.0, _FOV_SPREAD)), *request.fov_y_rad))
    found: list[_Candidate] = []
    for _ in range(tries):
        candidate = _draw(rng, room, points, boxes, request)
        if candidate is None:
            continue
        seen = _seen_share(caster, candidate.position_m, points)
        if seen >= request.min_seen:
            found.append(_Candidate(candidate.position_m, candidate.R_world_camera, candidate.fov_y_rad, seen))
        if len(found) >= _CHOICES:
            break
    if not found:
        x0, x1, z0, z1 = room.bounds_m
        raise InputError(
            f"camera: no place in the room of {x1 - x0:.1f} x {z1 - z0:.1f} m sees the whole motion; use a larger room"
        )
    best = max(found, key=lambda candidate: _score(candidate, wished))
    lens, T = _lens(best, request), _poses(rng, best, frames, request)
    if request.motion in ("pan", "follow"):
        lens, T = _operated(lens, T, joints_m[0, :, 0], room, boxes, request.motion)
    return lens, T


def _furniture_boxes(room: Room) -> Float[np.ndarray, "objects 2 3"]:
    boxes = [(vertices.min(0), vertices.max(0)) for vertices, _ in (obj.merged() for obj in room.furniture)]
    return np.array(boxes).reshape(-1, 2, 3)


def _score(candidate: _Candidate, wished_fov_rad: float) -> float:
    """Score of a pose, higher is better: joints visible, field of view near the preferred one."""
    other = abs(np.log(np.tan(0.5 * candidate.fov_y_rad) / np.tan(0.5 * wished_fov_rad)))
    return candidate.seen - 0.4 * other


def _draw(
    rng: np.random.Generator, room: Room, points: np.ndarray, boxes: np.ndarray, request: CameraRequest
) -> _Candidate | None:
    x0, x1, z0, z1 = room.bounds_m
    low, high = request.height_m
    high = min(high, room.height_m - 0.15)
    position = np.array(
        [rng.uniform(x0 + _FROM_WALL_M, x1 - _FROM_WALL_M), rng.uniform(low, high),
         rng.uniform(z0 + _FROM_WALL_M, z1 - _FROM_WALL_M)]
    )  # fmt: skip
    roll = float(np.clip(rng.normal(0, request.roll_sigma_rad), -0.07, 0.07))
    room_to_spare = rng.uniform(1.06, 1.35)
    near = (boxes[:, 0] - _FROM_OBJECT_M <= position) & (position <= boxes[:, 1] + _FROM_OBJECT_M)
    if near.all(1).any():
        return None
    ray = points.reshape(-1, 3) - position
    if np.linalg.norm(ray, axis=1).min() < request.nearest_m:
        return None
    center = ray.mean(0)
    yaw0 = np.arctan2(center[0], center[2])
    yaw = np.angle(np.exp(1j * (np.arctan2(ray[:, 0], ray[:, 2]) - yaw0)))
    pitch = np.arctan2(ray[:, 1], np.hypot(ray[:, 0], ray[:, 2]))
    if np.ptp(yaw) > 2.2:
        return None
    aim_pitch = float(np.clip(0.5 * (pitch.min() + pitch.max()), *request.pitch_rad))
    R = look_rotation(float(yaw0 + 0.5 * (yaw.min() + yaw.max())), aim_pitch, roll)
    camera = ray @ R
    if camera[:, 2].min() < 0.3:
        return None
    slope = np.abs(camera[:, :2] / camera[:, 2:])
    aspect = request.height_px / request.width_px
    needed = max(slope[:, 1].max() + 0.1 / np.median(camera[:, 2]), slope[:, 0].max() * aspect) * 1.04
    tangent = max(needed * room_to_spare, np.tan(0.5 * request.fov_y_rad[0]))
    tangent = min(tangent, np.tan(0.5 * request.fov_y_rad[1]))
    if tangent < needed:
        return None
    row = (camera[:, 1] / camera[:, 2]).reshape(len(points), 22)
    share = np.median(np.ptp(row, axis=1)) / (2 * tangent)
    if not request.figure_ratio[0] <= share <= request.figure_ratio[1]:
        return None
    return _Candidate(position, R, float(2 * np.arctan(tangent)), 0.0)


def look_rotation(yaw_rad: float, pitch_rad: float, roll_rad: float) -> Float[np.ndarray, "3 3"]:
    """R_world_camera (OpenCV axes) of a camera that looks along (sin yaw, tan pitch, cos yaw).

    Pitch > 0 looks up; roll > 0 turns the camera clockwise as seen from behind it.
    """
    forward = np.array([np.sin(yaw_rad) * np.cos(pitch_rad), np.sin(pitch_rad), np.cos(yaw_rad) * np.cos(pitch_rad)])
    right = np.cross(forward, (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(forward, right), forward], 1)
    return level @ matrix_from_axis_angle(np.array([0.0, 0.0, roll_rad]))


def _seen_share(caster: RayCaster, position_m: np.ndarray, points: np.ndarray) -> float:
    targets = points.reshape(-1, 3)
    ray = targets - position_m
    return float(1.0 - caster.blocked(np.broadcast_to(position_m, targets.shape), ray, 0.97).mean())


def _lens(candidate: _Candidate, request: CameraRequest) -> Intrinsics:
    focal_px = 0.5 * request.height_px / np.tan(0.5 * candidate.fov_y_rad)
    return Intrinsics.centered(float(focal_px), request.width_px, request.height_px)


def _poses(
    rng: np.random.Generator, candidate: _Candidate, frames: int, request: CameraRequest
) -> Float[np.ndarray, "frames 4 4"]:
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = candidate.R_world_camera, candidate.position_m
    if request.motion != "static":
        shift, turn = _drift(rng, frames, 0.025), _drift(rng, frames, 0.012)
        T[:, :3, :3] = candidate.R_world_camera @ matrix_from_axis_angle(turn)
        T[:, :3, 3] += shift
    return T


def _operated(
    lens: Intrinsics, T: np.ndarray, root_m: np.ndarray, room: Room, boxes: np.ndarray, motion: CameraMotion
) -> tuple[Intrinsics, Float[np.ndarray, "frames 4 4"]]:
    """The camera turned toward the person (`pan`) or moved along with them (`follow`)."""
    path_m = gaussian_filter1d(root_m, _FOLLOW_LAG_FRAMES, axis=0, mode="nearest") * [1.0, 0.0, 1.0]
    if motion == "follow":
        x0, x1, z0, z1 = room.bounds_m
        for share in _FOLLOWED:
            place = T[:, :3, 3] + share * (path_m - path_m.mean(0))
            inside = (place[:, [0, 2]] > [x0 + _FROM_WALL_M, z0 + _FROM_WALL_M]).all()
            inside &= (place[:, [0, 2]] < [x1 - _FROM_WALL_M, z1 - _FROM_WALL_M]).all()
            hit = (boxes[:, 0] - _FROM_OBJECT_M <= place[:, None]) & (place[:, None] <= boxes[:, 1] + _FROM_OBJECT_M)
            if inside and not hit.all(-1).any():
                T[:, :3, 3] = place
                return lens, T
        raise InputError("camera: no room to follow the person")
    sight = path_m - T[:, :3, 3] * [1.0, 0.0, 1.0]
    azimuth = np.unwrap(np.arctan2(sight[:, 0], sight[:, 2]))
    turn = (azimuth - azimuth.mean())[:, None] * [0.0, 1.0, 0.0]
    T[:, :3, :3] = matrix_from_axis_angle(turn) @ T[:, :3, :3]
    return Intrinsics.centered(_PAN_ZOOM * lens.fx_px, lens.width_px, lens.height_px), T


def _drift(rng: np.random.Generator, frames: int, amplitude: float) -> Float[np.ndarray, "frames 3"]:
    """Drift of a handheld camera: sum of slow sines with random phases and root mean square `amplitude`."""
    seconds = np.arange(frames)[:, None, None] / 30.0
    hertz = rng.uniform(0.15, 2.2, (1, 6, 3))
    weight = 1.0 / hertz
    wave = weight * np.sin(2 * np.pi * (hertz * seconds + rng.uniform(0, 1, (1, 6, 3))))
    return amplitude * wave.sum(1) / np.sqrt(0.5 * (weight**2).sum(1))
