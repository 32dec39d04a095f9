"""A room with known truth: floor, back wall, one box, a walking body, and a camera that may be tilted and rolled."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from video2anim.body.anny_body import shaped_body
from video2anim.geometry.projection import invert_rigid, pixel_rays, project, transform_points
from video2anim.types import (
    BackgroundImage,
    BodyMotion,
    BodyShape,
    BodyTracks,
    CameraEstimate,
    Intrinsics,
    MetricDepth,
    PayloadFile,
    PersonQuality,
    SourceInfo,
    VideoClip,
)
from video2anim.types.skeleton import FEET, forward_kinematics

WALL_Z_M = -6.5
BOX_CENTER_M = np.array([1.1, 0.45, -4.4])
BOX_SIZE_M = np.array([0.9, 0.9, 0.6])
BOX_YAW_RAD = 0.0
FLOOR, WALL, BOX = 1, 2, 3
SURE = PersonQuality(2.5, 0.01, 50.0, 0.1, 0.04, 1.0, 1.55, 0.0, body_height_sigma_m=0.01)
"""A person whose height is known."""


@dataclass(frozen=True, eq=False)
class Room:
    """Everything the stages take, and the truth they should find."""

    clip: VideoClip
    """There is no file behind it: no stage after depth reads pictures."""
    background: BackgroundImage
    bodies: BodyTracks
    camera: CameraEstimate
    depth_m: np.ndarray
    """True z-depth of the background image at the working resolution."""
    surface: np.ndarray
    """FLOOR, WALL or BOX at the working resolution."""
    surface_full: np.ndarray


def camera_pose(height_m: float = 1.6, pitch_deg: float = 14.0, roll_deg: float = 0.0) -> np.ndarray:
    """T_world_camera of a camera at x = z = 0 that looks along -z and down."""
    pitch, roll = np.deg2rad(pitch_deg), np.deg2rad(roll_deg)
    level = np.diag([1.0, -1.0, -1.0])
    down = np.array([[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]])
    turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = level @ down @ turn
    T_world_camera[1, 3] = height_m
    return T_world_camera


def render(T_world_camera: np.ndarray, intrinsics: Intrinsics, *, with_box: bool = True) -> tuple[np.ndarray, ...]:
    """Picture, z-depth and surface of the room without people, by intersecting rays with planes and a box."""
    ray = pixel_rays(intrinsics) @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(ray[..., 1] < 0, -origin[1] / ray[..., 1], np.inf)
        wall = np.where(ray[..., 2] < 0, (WALL_Z_M - origin[2]) / ray[..., 2], np.inf)
        box = _box_hit(origin, ray) if with_box else np.full(floor.shape, np.inf)
    stack = np.stack([floor, wall, box])
    surface = stack.argmin(0) + 1
    depth_m = stack.min(0)
    points = origin + ray * np.minimum(depth_m, 1e3)[..., None]
    return _paint(points, surface), depth_m, surface


def _box_hit(origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
    c, s = np.cos(BOX_YAW_RAD), np.sin(BOX_YAW_RAD)
    R_box_world = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    start, along = R_box_world @ (origin - BOX_CENTER_M), ray @ R_box_world.T
    near, far = (-BOX_SIZE_M / 2 - start) / along, (BOX_SIZE_M / 2 - start) / along
    enter, leave = np.minimum(near, far).max(-1), np.maximum(near, far).min(-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def _paint(points: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Colors with structure fixed to the surfaces."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    planks = 0.5 + 0.5 * np.sign(np.sin(x * 2 * np.pi / 0.35))
    grain = np.sin(37 * x + 3 * np.sin(9 * z)) * np.sin(11 * z + x)
    floor = np.stack([140 + 14 * planks + 10 * grain, 100 + 12 * planks + 8 * grain, 62 + 8 * planks + 5 * grain], -1)
    spots = np.sin(5 * x) * np.sin(6 * y + 1)
    wall = np.stack([182 + 6 * spots, 186 + 6 * spots, 190 + 8 * spots], -1)
    stripes = np.sign(np.sin(y * 2 * np.pi / 0.3))
    box = np.stack([50 + 10 * stripes, 72 + 12 * stripes, 128 + 14 * stripes], -1)
    color = np.select([(surface == FLOOR)[..., None], (surface == WALL)[..., None]], [floor, wall], box)
    noise = np.random.default_rng(7).normal(0, 3, color.shape)
    return np.clip(color + noise, 0, 255).astype(np.uint8)


@functools.cache
def walking_body(frames: int, height_m: float, pitch_deg: float, roll_deg: float, focal_px: float) -> BodyMotion:
    """A stiff body gliding diagonally through the room, feet on the floor."""
    shape = BodyShape("anny", {"height": 0.5})
    shaped = shaped_body(shape)
    R = np.tile(np.eye(3), (frames, 22, 1, 1))
    t = np.linspace(0, 1, frames)
    heading = 0.6
    R[:, 0] = [[np.cos(heading), 0, np.sin(heading)], [0, 1, 0], [-np.sin(heading), 0, np.cos(heading)]]
    for joint, sign in ((16, -1), (17, 1)):
        a = sign * 1.2
        R[:, joint] = [[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]
    rest = shaped.rest_joints_m
    sole = float(shaped.rest_vertices_m[:, 1].min())
    translation = np.stack([-1.2 + 1.0 * t, np.full(frames, -sole), -5.4 + 2.2 * t], -1)
    joints, _ = forward_kinematics(R, translation, rest)
    contact = np.zeros((frames, 22))
    contact[:, FEET] = 1.0
    T_world_root = np.tile(np.eye(4), (frames, 1, 1))
    T_world_root[:, :3, :3], T_world_root[:, :3, 3] = R[:, 0], translation
    return BodyMotion(
        person_id=1,
        frame_time_s=np.arange(frames) / 30,
        valid=np.ones(frames, dtype=bool),
        T_world_root=T_world_root,
        R_parent_joint=R,
        T_world_camera=np.tile(camera_pose(height_m, pitch_deg, roll_deg), (frames, 1, 1)),
        intrinsics=Intrinsics.centered(focal_px, 640, 360),
        contact=contact,
        shape=shape,
        rest_joints_m=rest,
        joints_world_m=joints,
    )


def body_mask(motion: BodyMotion, frame: int, intrinsics: Intrinsics) -> np.ndarray:
    """Silhouette of the body by filling its projected triangles."""
    shaped = shaped_body(motion.shape)
    _, R = forward_kinematics(
        motion.R_parent_joint[frame : frame + 1], motion.T_world_root[frame : frame + 1, :3, 3], motion.rest_joints_m
    )
    vertices = shaped.vertices(R, motion.joints_world_m[frame : frame + 1])[0].astype(float)
    pixels = project(transform_points(invert_rigid(motion.T_world_camera[frame]), vertices), intrinsics)
    mask = np.zeros((intrinsics.height_px, intrinsics.width_px), dtype=np.uint8)
    cv2.fillPoly(mask, list(np.round(pixels[shaped.faces] * 16).astype(np.int32)), 1, shift=4)
    for triangle in np.round(pixels[shaped.faces] * 16).astype(np.int32):
        cv2.fillConvexPoly(mask, triangle, 1, shift=4)
    return mask.astype(bool)


@functools.cache
def make_room(
    *,
    height_m: float = 1.6,
    pitch_deg: float = 14.0,
    roll_deg: float = 0.0,
    with_box: bool = True,
    frames: int = 40,
    step: int = 5,
    small: tuple[int, int] = (320, 180),
    focal_px: float = 520.0,
) -> Room:
    """The room as seen by one camera; arguments shape the camera and the contents."""
    motion = walking_body(frames, height_m, pitch_deg, roll_deg, focal_px)
    T_world_camera = motion.T_world_camera[0]
    background_rgb, _, surface_full = render(T_world_camera, motion.intrinsics, with_box=with_box)
    intrinsics = motion.intrinsics.resized(*small)
    _, depth_m, surface = render(T_world_camera, intrinsics, with_box=with_box)
    index = np.arange(0, frames, step)
    masks = np.stack([body_mask(motion, int(f), intrinsics) for f in index])
    background = BackgroundImage(background_rgb, 1 - masks.mean(0), index, masks, masks)
    up_camera = T_world_camera[1, :3].copy()
    camera = CameraEstimate(
        motion.intrinsics, "user", 0.01, up_camera, 0.01, True, np.tile(np.eye(4), (frames, 1, 1))
    )  # fmt: skip
    return Room(clip_of(motion), background, BodyTracks((motion,), (SURE,)), camera, depth_m, surface, surface_full)


def clip_of(motion: BodyMotion) -> VideoClip:
    """The clip of a motion at 30 fps."""
    k, time_s = motion.intrinsics, motion.frame_time_s
    source = SourceInfo("h264", "yuv420p", k.width_px, k.height_px, 0, 1.0, 30.0, *[len(time_s)] * 2, time_s[-1], 0.0)
    return VideoClip(
        PayloadFile(Path("none.mp4")), k.width_px, k.height_px, 30.0, time_s, time_s, source, ((0.0, 1.0),), 0, (),
    )  # fmt: skip


TRUE_RELIEF = {"depth_relief": 1.0, "depth_relief_sigma": 0.02, "open_bias": 0.0}
"""Options of stage reconstruct for depth without a network's errors."""


def true_depth(room: Room, depth_m: np.ndarray | None = None, bodies: BodyTracks | None = None) -> MetricDepth:
    """Depth without error of the background image alone, or another one; 0 and what is beyond 50 m is unknown."""
    depth_m = room.depth_m if depth_m is None else depth_m
    none = np.zeros((0, *depth_m.shape))
    return MetricDepth(
        1.0, 0.0, 0.0, 0.0, None, None, True, "truth", np.zeros(0, np.int64), none, none.astype(bool),
        depth_m, (depth_m > 0) & (depth_m < 50), {}, room.bodies if bodies is None else bodies,
    )  # fmt: skip
