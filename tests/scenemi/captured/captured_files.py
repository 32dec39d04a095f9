"""One walk in one room, in small files of the layouts of TRUMANS, GIMO and PROX.

The person walks along +Z beside a table towards a wall. Recordings of 150 frames in two rooms that are alike: the first
is for training, the second for tests, by each data set's own rule.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from synthetic import planted_walk

from scenemi.data.source_clip import SourceClip, SourceSkeleton
from video2anim.geometry.rotations import (
    axis_angle_from_matrix,
    matrix_from_axis_angle,
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from video2anim.types.skeleton import JOINT_NAMES, PARENTS

PELVIS_SMPLX_M = np.array([0.003, -0.351, 0.012])
"""Of the mean shape, in the model's own frame."""
R_Y_UP_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Z of the data is Y here."""

FRAMES = 150
START_Z_M = -1.6
WALL = np.array([[-1.5, 0.0, 3.0], [1.5, 2.0, 3.2]])
TABLE = np.array([[0.5, 0.0, -0.5], [1.0, 0.8, 0.5]])
"""Lowest and highest corner; +Y up, floor at y = 0, meters."""


def walk() -> SourceClip:
    """Along +Z, 4 m in 5 s."""
    motion = planted_walk(FRAMES)
    rest = motion.rest_joints_m
    offsets_m = rest - np.where(PARENTS[:, None] >= 0, rest[PARENTS], 0.0)
    same = np.arange(22)
    clip = SourceClip(
        name="walk", source="synthetic", kind="walk", description="", origin="", fps=30.0, uneven=False,
        skeleton=SourceSkeleton("smpl22", JOINT_NAMES, PARENTS.copy(), offsets_m, same, same),
        root_position_m=motion.T_world_root[:, :3, 3].copy(),
        rotation_wxyz=quaternion_from_matrix(motion.R_parent_joint),
    )  # fmt: skip
    return replace(clip, root_position_m=clip.root_position_m + np.array([0.0, 0.0, START_Z_M]))


def parameters(T_data_world: np.ndarray, clip: SourceClip) -> tuple[np.ndarray, np.ndarray]:
    """SMPL-X poses (T, 66) and translations (T, 3) of a clip in a data set's frame."""
    R = matrix_from_quaternion(clip.rotation_wxyz)
    R[:, 0] = T_data_world[:3, :3] @ R[:, 0]
    root_m = clip.root_position_m @ T_data_world[:3, :3].T + T_data_world[:3, 3]
    return axis_angle_from_matrix(R).reshape(-1, 66), root_m - PELVIS_SMPLX_M


def box_distance(points_m: np.ndarray, box_m: np.ndarray) -> np.ndarray:
    """Signed distance to an upright box."""
    over = np.maximum(box_m[0] - points_m, points_m - box_m[1])
    return np.linalg.norm(np.maximum(over, 0.0), axis=-1) + np.minimum(over.max(-1), 0.0)


def room_distance(points_m: np.ndarray) -> np.ndarray:
    """Signed distance to wall and table, which go on below the floor."""
    return np.minimum(*(box_distance(points_m, box - [[0, 3, 0], [0, 0, 0]]) for box in (WALL, TABLE)))


def write_trumans(folder: Path, voxel_m: float, grid: tuple[int, int, int]) -> None:
    poses, shift_m = parameters(np.eye(4), walk())
    np.save(folder / "human_pose.npy", np.tile(poses[:, 3:], (2, 1)))
    np.save(folder / "human_orient.npy", np.tile(poses[:, :3], (2, 1)))
    np.save(folder / "human_transl.npy", np.tile(shift_m, (2, 1)))
    np.save(folder / "seg_name.npy", np.repeat(["take_a", "take_b"], FRAMES))
    np.save(folder / "scene_flag.npy", np.repeat([0, 1], FRAMES))
    np.save(folder / "scene_list.npy", np.array(["kitchen", "study"]))
    centers_m = np.stack(np.meshgrid(*(voxel_m * (np.arange(n) + 0.5) for n in grid), indexing="ij"), -1)
    centers_m += [-3.0, 0.0, -4.0]
    solid = (room_distance(centers_m) < 0) | (centers_m[..., 1] < 0.04)
    (folder / "Scene").mkdir()
    for name in ("kitchen", "study"):
        np.save(folder / "Scene" / f"{name}.npy", solid)


def write_gimo(folder: Path) -> None:
    """The scan is of another size and turned against the body's frame; its back sides are not there."""
    scale = 1.25
    T_norm, T_scan_body = np.eye(4), np.eye(4)
    T_norm[:3, :3] = matrix_from_axis_angle(np.array([0.0, 0.4, 0.0]))
    T_norm[:3, 3] = [0.1, 1.5, 0.2]
    T_scan_body[:3, :3], T_scan_body[:3, 3] = matrix_from_axis_angle(np.array([0.0, 1.2, 0.0])), [0.5, -1.5, 2.0]
    rows = ["sequence_path,start_frame,end_frame,scene,transformation,training"]
    for name, training in (("bedroom", 1), ("office", 0)):
        rows.append(f"2022-01-23,0,{FRAMES},{name},transform_info.json,{training}")
        (folder / name / "scene_obj").mkdir(parents=True)
        sequence = folder / name / "2022-01-23"
        sequence.mkdir()
        table = {"scale": scale, "transformation": T_scan_body.tolist()}
        (sequence / "transform_info.json").write_text(json.dumps(table))
        np.savetxt(folder / name / "scene_obj" / "transform_norm.txt", T_norm)
        in_meters = [T.copy() for T in (T_norm, T_scan_body)]
        for T in in_meters:
            T[:3, 3] /= scale
        poses, shift_m = parameters(np.linalg.inv(in_meters[0] @ in_meters[1]), walk())
        np.savez(
            sequence / "smplx_local.npz", frame=np.arange(FRAMES), orient=poses[:, :3], trans=shift_m,
            pose_body=poses[:, 3:],
        )  # fmt: skip
        T_world_mesh = T_norm.copy()
        T_world_mesh[:3] /= scale
        mesh = scan()
        mesh.apply_transform(np.linalg.inv(T_world_mesh))
        mesh.export(folder / name / "scene_obj" / "textured_output.obj")
    (folder / "dataset.csv").write_text("\n".join(rows) + "\n")


def scan() -> trimesh.Trimesh:
    """What a scanner in the room sees: the floor from above, the wall's front, the table but for its bottom."""
    parts = []
    for box, seen in ((WALL, [(2, -1)]), (TABLE, [(0, -1), (0, 1), (1, 1), (2, -1), (2, 1)])):
        mesh = trimesh.creation.box(bounds=box)
        fronts = np.any([mesh.face_normals[:, axis] * sign > 0.5 for axis, sign in seen], axis=0)
        parts.append(mesh.submesh([np.flatnonzero(fronts)], append=True))
    corners = np.array([[-2.0, 0.0, -3.0], [2.0, 0.0, -3.0], [2.0, 0.0, 3.0], [-2.0, 0.0, 3.0]])
    parts.append(trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]], process=False))
    return trimesh.util.concatenate(parts)


def write_prox(folder: Path, *, floor_z_m: float = -0.7, dim: int = 96) -> None:
    T_scene_world = np.eye(4)
    T_scene_world[:3, :3], T_scene_world[2, 3] = R_Y_UP_Z_UP.T, floor_z_m
    cam2world = np.eye(4)
    cam2world[:3, :3], cam2world[:3, 3] = matrix_from_axis_angle(np.array([-1.9, 0.2, 0.1])), [0.3, 2.5, 0.9]
    poses, shift_m = parameters(np.linalg.inv(cam2world) @ T_scene_world, walk())
    low, high = np.array([-2.5, -3.5, -1.2]), np.array([2.5, 3.0, 1.6])
    nodes = np.stack(np.meshgrid(*np.linspace(low, high, dim).T, indexing="ij"), -1)
    world_m = (nodes - T_scene_world[:3, 3]) @ R_Y_UP_Z_UP.T
    sdf_m = np.minimum(room_distance(world_m), world_m[..., 1])
    for name in ("cam2world", "sdf"):
        (folder / name).mkdir()
    for scene in ("N3Office", "MPH16"):
        (folder / "cam2world" / f"{scene}.json").write_text(json.dumps(cam2world.tolist()))
        table = {"min": low.tolist(), "max": high.tolist(), "dim": dim}
        (folder / "sdf" / f"{scene}.json").write_text(json.dumps(table))
        np.save(folder / "sdf" / f"{scene}_sdf.npy", sdf_m.astype(np.float32).ravel())
        for frame in range(FRAMES):
            place = folder / "PROXD" / f"{scene}_00034_01" / "results" / f"s001_frame_{frame + 1:05d}__00.00.01.000"
            place.mkdir(parents=True)
            arrays = {
                "global_orient": poses[frame, None, :3], "body_pose": poses[frame, None, 3:],
                "transl": shift_m[frame, None], "betas": np.zeros((1, 10)),
            }  # fmt: skip
            content = {name: value.astype(np.float32) for name, value in arrays.items()}
            (place / "000.pkl").write_bytes(pickle.dumps(content, protocol=2))


VOXEL_M, GRID = 0.05, (120, 40, 160)
"""Of TRUMANS in these tests; published are 2 cm."""
WRITERS: dict[str, Callable[[Path], None]] = {
    "trumans": lambda folder: write_trumans(folder, VOXEL_M, GRID), "gimo": write_gimo, "prox": write_prox,
}  # fmt: skip
