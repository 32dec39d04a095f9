"""Choice of keyframes, the arrays that their roots are optimized with, and interpolation between them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import PchipInterpolator

from video2anim.body.contact import LIKELY, REACH_M
from video2anim.geometry.runs import runs
from video2anim.geometry.sdf import SdfGrid
from video2anim.motion.keyframe_points import TOUCHING, SkinPoints
from video2anim.motion.keyframe_roots import ContactPart, RootProblem, contact_distance_m
from video2anim.types import BodyMotion


def choose_keyframes(valid: Bool[np.ndarray, "frames"], interval: int) -> Int[np.ndarray, "keyframes"]:
    """Valid frames on the regular grid, and the edges of every valid stretch."""
    on_grid = np.zeros(len(valid), dtype=bool)
    on_grid[::interval] = True
    for start, stop in runs(valid):
        on_grid[[start, stop - 1]] = True
    return np.flatnonzero(on_grid & valid)


def between_keyframes(
    keyframes: Int[np.ndarray, "keyframes"], moves_m: Float[np.ndarray, "keyframes 3"], frame_count: int
) -> Float[np.ndarray, "frames 3"]:
    """Displacement of every frame: monotone cubic between keyframes (no overshoot), constant beyond them."""
    if len(keyframes) == 1:
        return np.tile(moves_m, (frame_count, 1))
    frames = np.clip(np.arange(frame_count), keyframes[0], keyframes[-1])
    return PchipInterpolator(keyframes, moves_m)(frames)


def root_problem(
    motion: BodyMotion,
    keyframes: Int[np.ndarray, "keyframes"],
    points: SkinPoints,
    grid: SdfGrid,
) -> RootProblem:
    """World-frame arrays at the keyframes; contacts and skin without a surface within `REACH_M` are left out."""
    contacts: list[ContactPart] = []
    for joints in TOUCHING:
        part_m = points.touching_m(joints)
        probability = motion.contact[keyframes][:, joints].max(axis=1)
        rows = np.flatnonzero(probability >= LIKELY)
        if len(rows) == 0 or part_m.shape[1] == 0:
            continue
        skin_m = part_m[keyframes[rows]]
        near = np.abs(contact_distance_m(skin_m, grid)) <= REACH_M
        if near.any():
            contacts.append(ContactPart(joints, rows[near], skin_m[near], probability[rows][near]))
    valid = np.flatnonzero(motion.valid)
    skin_m = points.spread_m[valid]
    row, vertex = np.nonzero(grid.sample(skin_m) < REACH_M)
    root_m = motion.T_world_root[:, :3, 3]
    away_m = root_m[keyframes] - motion.T_world_camera[keyframes, :3, 3]
    direction = away_m / np.maximum(np.linalg.norm(away_m, axis=1, keepdims=True), 1e-6)
    return RootProblem(keyframes, direction, skin_m[row, vertex], valid[row], tuple(contacts), grid)
