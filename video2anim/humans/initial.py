"""Initial body from 3D landmarks: bone directions give rotations, the image gives the translation."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.geometry.rotations import matrix_from_axis_angle, nearest_rotation, rotations_between
from video2anim.humans.landmarks import KEYPOINT_INDEX
from video2anim.types.camera import Intrinsics
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES, PARENTS

_LIMBS = {
    "left_shoulder": ("left_shoulder", "left_elbow"), "right_shoulder": ("right_shoulder", "right_elbow"),
    "left_elbow": ("left_elbow", "left_wrist"), "right_elbow": ("right_elbow", "right_wrist"),
    "left_hip": ("left_hip", "left_knee"), "right_hip": ("right_hip", "right_knee"),
    "left_knee": ("left_knee", "left_ankle"), "right_knee": ("right_knee", "right_ankle"),
    "left_ankle": ("left_heel", "left_big_toe"), "right_ankle": ("right_heel", "right_big_toe"),
}  # fmt: skip
"""Joint -> the two keypoints whose direction its bone follows."""
_CHILD = {
    "left_shoulder": "left_elbow", "right_shoulder": "right_elbow", "left_elbow": "left_wrist",
    "right_elbow": "right_wrist", "left_hip": "left_knee", "right_hip": "right_knee",
    "left_knee": "left_ankle", "right_knee": "right_ankle", "left_ankle": "left_foot", "right_ankle": "right_foot",
}  # fmt: skip
_YAW_SHARE, _PITCH_SHARE = 0.75, 0.3
"""Parts of the viewing ray's angle by which BlazePose's landmarks are rotated against the camera
(`benchmarks/landmark_axes.py`)."""


def ray_rotation(points_px: Float[np.ndarray, "frames 2"], intrinsics: Intrinsics) -> Float[np.ndarray, "frames 3 3"]:
    """Rotation from the frame of a person's viewing ray into the camera frame, smallest about the optical axis.

    A crop-based landmark model sees every person as if the camera looked straight at them.
    """
    x = (points_px[:, 0] - intrinsics.cx_px) / intrinsics.fx_px
    y = (points_px[:, 1] - intrinsics.cy_px) / intrinsics.fy_px
    ray = np.stack([x, y, np.ones_like(x)], -1)
    return rotations_between(np.broadcast_to([0.0, 0.0, 1.0], ray.shape), ray)


def landmark_rotation(
    points_px: Float[np.ndarray, "frames 2"], intrinsics: Intrinsics
) -> Float[np.ndarray, "frames 3 3"]:
    """Rotation from the axes of a person's 3D landmarks into the camera frame.

    The landmark model sees a crop, whose place in the image it does not know, but assumes upright people and a level
    camera, and so corrects a part of the viewing ray's tilt. Measured on rendered people.
    """
    x = (points_px[:, 0] - intrinsics.cx_px) / intrinsics.fx_px
    y = (points_px[:, 1] - intrinsics.cy_px) / intrinsics.fy_px
    zero = np.zeros_like(x)
    angles = np.stack([-_PITCH_SHARE * np.arctan(y), _YAW_SHARE * np.arctan(x), zero], -1)
    return np.asarray(matrix_from_axis_angle(angles))


def rotations_from_keypoints(
    keypoints_m: Float[np.ndarray, "frames keypoints 3"], rest_joints_m: Float[np.ndarray, "22 3"]
) -> Float[np.ndarray, "frames 22 3 3"]:
    """Local rotations that point the bones along the keypoints; twists are left at rest. Axes as the keypoints'."""
    frames = len(keypoints_m)

    def at(name: str) -> np.ndarray:
        return keypoints_m[:, KEYPOINT_INDEX[name]]

    trunk = _frame_from(at("left_hip") - at("right_hip"), _mid(at, "shoulder") - _mid(at, "hip"))
    chest = _frame_from(at("left_shoulder") - at("right_shoulder"), _mid(at, "shoulder") - _mid(at, "hip"))
    world = np.tile(np.eye(3), (frames, 22, 1, 1))
    local = np.tile(np.eye(3), (frames, 22, 1, 1))
    world[:, 0] = local[:, 0] = trunk
    for joint in range(1, 22):
        parent = int(PARENTS[joint])
        name = JOINT_NAMES[joint]
        if name == "spine3":
            world[:, joint] = chest
        elif name in _LIMBS:
            start, end = _LIMBS[name]
            bone = rest_joints_m[JOINT_INDEX[_CHILD[name]]] - rest_joints_m[joint]
            if name.endswith("ankle"):
                bone = np.array([0.0, 0.0, 1.0])
            wanted = np.einsum("tji,tj->ti", world[:, parent], at(end) - at(start))
            world[:, joint] = world[:, parent] @ rotations_between(np.broadcast_to(bone, wanted.shape), wanted)
        else:
            world[:, joint] = world[:, parent]
        local[:, joint] = np.swapaxes(world[:, parent], -1, -2) @ world[:, joint]
    return local


def translation_from_projection(
    points_m: Float[np.ndarray, "frames points 3"],
    points_px: Float[np.ndarray, "frames points 2"],
    weight: Float[np.ndarray, "frames points"],
    intrinsics: Intrinsics,
) -> Float[np.ndarray, "frames 3"]:
    """Translation per frame that best projects root-relative points onto pixels (linear least squares).

    From fx (X + tx) = (u - cx) (Z + tz), and likewise for y.
    """
    u = points_px[..., 0] - intrinsics.cx_px
    v = points_px[..., 1] - intrinsics.cy_px
    root_weight = np.sqrt(weight)
    zero = np.zeros_like(u)
    row_x = np.stack([np.full_like(u, intrinsics.fx_px), zero, -u], -1) * root_weight[..., None]
    row_y = np.stack([zero, np.full_like(v, intrinsics.fy_px), -v], -1) * root_weight[..., None]
    goal_x = (u * points_m[..., 2] - intrinsics.fx_px * points_m[..., 0]) * root_weight
    goal_y = (v * points_m[..., 2] - intrinsics.fy_px * points_m[..., 1]) * root_weight
    matrix = np.concatenate([row_x, row_y], 1)
    goal = np.concatenate([goal_x, goal_y], 1)
    normal = np.einsum("tij,tik->tjk", matrix, matrix)
    return np.linalg.solve(normal, np.einsum("tij,ti->tj", matrix, goal)[..., None])[..., 0]


def _mid(at: object, part: str) -> np.ndarray:
    return 0.5 * (at(f"left_{part}") + at(f"right_{part}"))  # type: ignore[operator]


def _frame_from(left: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(T, 3, 3) frames with y along `up` and x as close to `left` as possible."""
    y = up / np.linalg.norm(up, axis=-1, keepdims=True)
    x = left - (left * y).sum(-1, keepdims=True) * y
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return nearest_rotation(np.stack([x, y, np.cross(x, y)], -1))
