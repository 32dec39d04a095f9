"""A synthetic walk past a box, with a moving camera: known truth for export and viewer tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types import (
    BodyMotion,
    BodyShape,
    Hold,
    Intrinsics,
    Mesh,
    ObjectPath,
    PlacedObject,
    RoomPiece,
    SceneModel,
    Texture,
)
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

FPS = 30.0


def rotation(axis: str, angle_rad: np.ndarray) -> np.ndarray:
    """Rotation matrices (T, 3, 3) about a coordinate axis."""
    vector = np.zeros((*np.shape(angle_rad), 3))
    vector[..., "xyz".index(axis)] = angle_rad
    return matrix_from_axis_angle(vector)


def walk(frames: int = 24, person_id: int = 1, *, camera_moves: bool = False, side_m: float = 0.0) -> BodyMotion:
    """A person walking along +X with swinging limbs, turning steadily by more than half a turn."""
    shape = BodyShape("anny", dict(ADULT))
    body = shaped_body(shape)
    time_s = np.arange(frames) / FPS
    swing = np.sin(2 * np.pi * 1.2 * time_s)
    R_parent_joint = np.tile(np.eye(3), (frames, 22, 1, 1))
    R_parent_joint[:, 0] = rotation("y", np.linspace(0.5, 0.5 + 1.2 * np.pi, frames)) @ rotation("x", 0.1 * swing)
    for name, axis, angle in (
        ("left_hip", "x", 0.6 * swing), ("right_hip", "x", -0.6 * swing),
        ("left_knee", "x", 0.4 + 0.4 * swing), ("right_knee", "x", 0.4 - 0.4 * swing),
        ("left_shoulder", "z", -1.2 + 0.2 * swing), ("right_shoulder", "z", 1.2 + 0.2 * swing),
        ("left_elbow", "y", -0.7 + 0.3 * swing), ("head", "y", 0.5 * swing), ("spine2", "z", 0.1 * swing),
    ):  # fmt: skip
        R_parent_joint[:, JOINT_INDEX[name]] = rotation(axis, angle)
    translation_m = np.stack([1.2 * time_s - 0.5, 0.88 + 0.03 * swing, np.full(frames, side_m)], -1)
    T_world_root = np.tile(np.eye(4), (frames, 1, 1))
    T_world_root[:, :3, :3], T_world_root[:, :3, 3] = R_parent_joint[:, 0], translation_m
    joints_world_m, _ = forward_kinematics(R_parent_joint, translation_m, body.rest_joints_m)
    valid = np.ones(frames, bool)
    valid[frames // 2] = False
    return BodyMotion(
        person_id=person_id,
        frame_time_s=time_s,
        valid=valid,
        T_world_root=T_world_root,
        R_parent_joint=R_parent_joint,
        T_world_camera=camera_path(frames, moves=camera_moves),
        intrinsics=Intrinsics.centered(500.0, 640, 360),
        contact=np.zeros((frames, 22)),
        shape=shape,
        rest_joints_m=body.rest_joints_m,
        joints_world_m=joints_world_m,
    )


def camera_path(frames: int, *, moves: bool) -> np.ndarray:
    """OpenCV camera 4 m in front of the origin, 1.4 m up, level, looking along -Z; optionally panning and sliding."""
    T_world_camera = np.tile(np.eye(4), (frames, 1, 1))
    T_world_camera[:, :3, :3] = np.diag([1.0, -1.0, -1.0])
    T_world_camera[:, :3, 3] = (0.0, 1.4, 4.0)
    if moves:
        T_world_camera[:, 0, 3] = np.linspace(0.0, 0.5, frames)
        T_world_camera[:, :3, :3] = T_world_camera[:, :3, :3] @ rotation("y", np.linspace(0.0, 0.2, frames))
    return T_world_camera


def box_mesh(size_m: tuple[float, float, float], rgb: tuple[int, int, int]) -> Mesh:
    """A closed box resting on y = 0, centered in x and z, faces counter-clockwise seen from outside."""
    x, y, z = size_m
    corners = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (0.0, 1.0) for k in (-0.5, 0.5)]) * [x, y, z]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])
    return Mesh(corners, faces, np.tile(np.array(rgb, np.uint8), (8, 1)))


def patch(corners_m: np.ndarray, rgb: tuple[int, int, int]) -> Mesh:
    """One quadrilateral."""
    return Mesh(
        np.asarray(corners_m, float), np.array([[0, 1, 2], [0, 2, 3]]), np.tile(np.array(rgb, np.uint8), (4, 1))
    )


def room() -> SceneModel:
    """Floor, back wall, and a box of half size in its own frame that stands at (1.2, 0, 0.2), scaled by 2."""
    T_world_object = np.eye(4)
    T_world_object[:3, :3] = rotation("y", np.array([0.4]))[0]
    T_world_object[:3, 3] = (1.2, 0.0, 0.2)
    box = PlacedObject(
        object_id=3, label="storage box", mesh=box_mesh((0.25, 0.3, 0.2), (40, 110, 200)), scale=2.0,
        T_world_object=T_world_object, chamfer_before_m=0.1, chamfer_after_m=0.02, trusted=True, reason="",
    )  # fmt: skip
    floor = patch(np.array([[-3, 0, 3], [3, 0, 3], [3, 0, -3], [-3, 0, -3]]), (150, 140, 120))
    wall = patch(np.array([[-3, 0, -3], [3, 0, -3], [3, 2.5, -3], [-3, 2.5, -3]]), (200, 195, 180))
    rows, columns = np.mgrid[:10, :24]
    picture = np.stack([200 - 4 * columns, 100 + 8 * rows, np.full(rows.shape, 60)], -1).astype(np.uint8)
    corner_uv = (wall.vertices_m[wall.faces][..., :2] * [1 / 6, -1 / 2.5] + [0.5, 1.0]).astype(np.float32)
    window_m = np.array([[-1.0, 1.0, -3.0], [0.0, 1.0, -3.0], [0.0, 2.0, -3.0], [-1.0, 2.0, -3.0]])
    far = patch(np.array([[-9, 0, -8], [9, 0, -8], [9, 4, -8], [-9, 4, -8]]), (120, 140, 180))
    height_m = np.broadcast_to(0.2 * np.arange(-3, 10)[None, :, None], (31, 13, 31))
    return SceneModel(
        objects=(box,), floor=RoomPiece("floor", floor),
        background=(RoomPiece("wall 1", wall, (Texture(picture, corner_uv),), (window_m,)), RoomPiece("backdrop", far)),
        sdf_m=height_m.copy(),
        sdf_origin_m=np.array([-3.0, -0.6, -3.0]), sdf_spacing_m=0.2,
    )  # fmt: skip


def room_with_carried_box(frames: int = 24, person_id: int = 1) -> SceneModel:
    """The room; its box rests, is carried in an arc 1.5 m along -X while it turns, and rests again."""
    scene = room()
    (box,) = scene.objects
    first, last = frames // 4, 3 * frames // 4
    share = np.clip((np.arange(frames) - first + 1) / (last - first + 2), 0.0, 1.0)
    T_world_object = np.tile(box.T_world_object, (frames, 1, 1))
    T_world_object[:, 0, 3] -= 1.5 * share
    T_world_object[:, 1, 3] += 0.6 * np.sin(np.pi * share) * (share < 1)
    T_world_object[:, :3, :3] = rotation("y", 1.4 * share) @ T_world_object[:, :3, :3]
    path = ObjectPath(T_world_object, (Hold(person_id, "right hand", first, last),))
    return replace(scene, objects=(replace(box, path=(path,)),))
