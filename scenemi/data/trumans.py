"""TRUMANS (Jiang et al. 2024): motions of many takes in shared arrays, each in a scene given as a voxel grid.

Layout of the folder, all plain .npy files: `human_pose` (F, 63), `human_orient` (F, 3), `human_transl` (F, 3) SMPL-X
parameters at 30 fps with +Y up; `seg_name` (F,) the take of each frame; `scene_flag` (F,) row of `scene_list`;
optional `bad_frames` (frames to leave out); `Scene/<name>.npy` (300, 100, 400) occupancy in x, y, z over
x -3..3 m, y 0..2 m, z -4..4 m. Movable objects (`object_*`) are not read. `seg_name` or `scene_list` saved as Python
objects have to be saved again as text (`np.save(path, array.astype(str))`): pickles are not opened here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenemi.data.plain_files import read_array
from scenemi.data.smpl_clip import smpl_clip
from scenemi.data.source_clip import SourceClip
from scenemi.scene.voxel_sdf import voxel_sdf
from video2anim.errors import InputError
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.clip import FPS

_LOW_M = np.array([-3.0, 0.0, -4.0])
"""Lowest corner of the grids, which lie about x = z = 0."""
_GRID = (300, 100, 400)
"""Voxels along x, y, z."""
_VOXEL_M = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class TrumansTake:
    """One take and the scene it happens in."""

    clip: SourceClip
    scene_name: str


def read_trumans(folder: str | Path, *, min_frames: int = 30) -> Iterator[TrumansTake]:
    """Takes of the data set, cut at bad frames; the arrays are mapped, not read whole.

    Args:
        folder: see above.
        least_frames: shorter pieces are left out.

    Raises:
        InputError: files are missing, of other shapes, or hold Python objects.
    """
    folder = Path(folder)
    names = ("human_pose", "human_orient", "human_transl", "seg_name", "scene_flag")
    pose, orient, shift_m, take, scene = (_array(folder / f"{name}.npy") for name in names)
    frames = len(take)
    if pose.shape != (frames, 63) or orient.shape != (frames, 3) or shift_m.shape != (frames, 3):
        raise InputError(f"{folder}: human_pose, human_orient, human_transl want (F, 63), (F, 3), (F, 3) for {frames}")
    if scene.shape != (frames,):
        raise InputError(f"{folder}: scene_flag wants ({frames},), got {scene.shape}")
    scenes = [str(name) for name in _array(folder / "scene_list.npy")]
    bad = np.zeros(frames, bool)
    if (folder / "bad_frames.npy").is_file():
        bad[np.asarray(_array(folder / "bad_frames.npy"), np.int64)] = True
    changes = np.flatnonzero((take[1:] != take[:-1]) | (bad[1:] != bad[:-1]) | (scene[1:] != scene[:-1])) + 1
    for start, stop in zip([0, *changes.tolist()], [*changes.tolist(), frames], strict=True):
        if bad[start] or stop - start < min_frames:
            continue
        clip = smpl_clip(
            np.concatenate([orient[start:stop], pose[start:stop]], axis=1),
            shift_m[start:stop],
            name=f"trumans_{take[start]}_{start}",
            source="trumans",
            fps=FPS,
            model="smplx",
        )
        yield TrumansTake(clip, scenes[int(scene[start])])


def read_trumans_sdf(folder: str | Path, name: str) -> SdfGrid:
    """Signed distances to what stands on the floor of a scene, in the frame of the takes.

    Raises:
        InputError: no such scene, another grid, or an empty one.
    """
    return voxel_sdf(_voxels(folder, name) != 0, _LOW_M, _VOXEL_M)


def _voxels(folder: str | Path, name: str) -> np.ndarray:
    path = Path(folder) / "Scene" / f"{name.removesuffix('.npy')}.npy"
    grid = _array(path)
    if grid.shape != _GRID:
        raise InputError(f"{path}: scene grid wants {_GRID}, got {grid.shape}")
    return grid


def _array(path: Path) -> np.ndarray:
    if not path.is_file():
        raise InputError(f"{path}: missing; see the folder layout in scenemi/data/trumans.py")
    return read_array(path, "array of TRUMANS, text saved with astype(str),", mapped=True)
