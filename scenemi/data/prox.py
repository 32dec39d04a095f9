"""PROX (Hassan et al. 2019): people in scanned rooms, fitted to RGB-D video; the fits with depth, PROXD.

Read as published: `PROXD/<scene>_<subject>_<take>/results/s001_frame_<number>__<time>/000.pkl` (pickled tables of numpy
arrays: SMPL-X `global_orient` (1, 3), `transl` (1, 3), `body_pose` (1, 63), in the frame of the camera, 30 fps; read by
`video2anim.body.array_pickle`, which runs nothing), `cam2world/<scene>.json` (4 x 4, camera to the scene's world),
`sdf/<scene>.json` (`min`, `max`, `dim`) and `sdf/<scene>_sdf.npy` (dim^3 signed distances in x, y, z of that world,
negative in solids, first and last node at `min` and `max`). The scans `scenes/<scene>.ply` are not read: the distances
are those of their closed form.

That world has +Z up and its floor at no particular height. It is turned by -90 degrees about x (x stays, its z is our
y, its y our -z), then lowered or raised so that the height at which most columns of the distance grid first leave a
solid, going up, is y = 0.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scenemi.data.plain_files import read_array, read_json_value
from scenemi.data.smpl_clip import R_Y_UP_Z_UP, smpl_clip
from scenemi.data.source_clip import SourceClip
from scenemi.scene.voxel_sdf import standing_sdf
from video2anim.body.array_pickle import read_pickled_arrays
from video2anim.errors import InputError
from video2anim.geometry.runs import runs
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.clip import FPS

_FRAME = re.compile(r"_frame_(\d+)__")
_PARTS = ("global_orient", "body_pose", "transl")
_FARTHEST_M = 20.0
"""Fits that went wrong lie far off."""
_BIN_M = 0.02
"""Of the histogram of floor heights: about the step of the distance grid."""


@dataclass(frozen=True, slots=True, eq=False)
class ProxPiece:
    """Consecutive frames of one recording."""

    clip: SourceClip
    scene_name: str


def read_prox(folder: str | Path, *, min_frames: int = 30) -> Iterator[ProxPiece]:
    """Recordings, cut where frames are missing or were not fitted.

    Args:
        folder: holds `PROXD`, `cam2world` and `sdf`.
        least_frames: shorter pieces are left out.

    Raises:
        InputError: files are missing or of another layout.
    """
    folder = Path(folder)
    recordings = sorted(path for path in (folder / "PROXD").glob("*") if (path / "results").is_dir())
    if not recordings:
        raise InputError(f"{folder}: want PROXD/<recording>/results; see the folder layout in scenemi/data/prox.py")
    for recording in recordings:
        scene = recording.name.split("_")[0]
        T_scene_camera = np.array(_json(folder / "cam2world" / f"{scene}.json"), np.float64)
        if T_scene_camera.shape != (4, 4):
            raise InputError(f"{folder}/cam2world/{scene}.json: want a 4 x 4 matrix, got {T_scene_camera.shape}")
        T_world_camera = _T_world_scene(_floor_height(folder, scene)) @ T_scene_camera
        number, values = _frames(recording / "results")
        good = np.isfinite(values).all(1) & (np.abs(values[:, -3:]).max(1) < _FARTHEST_M)
        every = np.zeros(number[-1] + 2, bool)
        every[number[good]] = True
        for first, stop in runs(every):
            if stop - first < min_frames:
                continue
            row = int(np.searchsorted(number, first))
            rows = slice(row, row + stop - first)
            clip = smpl_clip(
                values[rows, :66], values[rows, 66:], name=f"prox_{recording.name}_{first}", source="prox", fps=FPS,
                model="smplx", T_world_data=T_world_camera,
            )  # fmt: skip
            yield ProxPiece(clip, scene)


def read_prox_sdf(folder: str | Path, scene: str) -> SdfGrid:
    """Signed distances to what stands on the floor of a scene, in the world of the clips.

    Raises:
        InputError: files are missing or do not fit each other.
    """
    sdf_m, low_m, step_m = _published_sdf(Path(folder), scene)
    floor_m = _floor_height(Path(folder), scene)
    high_y_m = low_m[1] + step_m[1] * (sdf_m.shape[1] - 1)
    turned = sdf_m.transpose(0, 2, 1)[:, :, ::-1]
    return standing_sdf(turned, np.array([low_m[0], low_m[2] - floor_m, -high_y_m]), step_m[[0, 2, 1]])


@functools.lru_cache(maxsize=32)
def _floor_height(folder: Path, scene: str) -> float:
    """z of the floor in the scene's own world."""
    sdf_m, low_m, step_m = _published_sdf(folder, scene)
    solid = sdf_m < 0
    leaves = solid[:, :, :-1] & ~solid[:, :, 1:]
    x, y = np.nonzero(leaves.any(2))
    if not len(x):
        raise InputError(f"{folder}/sdf/{scene}_sdf.npy: no floor, nothing of it is negative below something positive")
    node = leaves[x, y].argmax(1)
    below, over = sdf_m[x, y, node], sdf_m[x, y, node + 1]
    height_m = low_m[2] + step_m[2] * (node + below / (below - over))
    count, edges = np.histogram(height_m, np.arange(height_m.min() - _BIN_M, height_m.max() + 2 * _BIN_M, _BIN_M))
    most = edges[int(count.argmax())]
    return float(np.median(height_m[np.abs(height_m - most - 0.5 * _BIN_M) < 1.5 * _BIN_M]))


@functools.lru_cache(maxsize=1)
def _published_sdf(
    folder: Path, scene: str
) -> tuple[Float[np.ndarray, "x y z"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Distances, place of the first node, steps of the nodes, in the scene's own world."""
    path = folder / "sdf" / f"{scene}_sdf.npy"
    table = _json(path.with_name(f"{scene}.json"))
    try:
        size = int(table["dim"])
        low_m, high_m = (np.array(table[name], np.float64).reshape(3) for name in ("min", "max"))
        sdf_m = read_array(path, "distance grid of PROX").astype(np.float32).reshape(size, size, size)
        if size < 2 or not (high_m > low_m).all() or not np.isfinite(sdf_m).all():
            raise ValueError("its box has no size, or distances are not finite")
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: want dim^3 distances with dim, min and max in {scene}.json: {error}") from error
    return sdf_m, low_m, (high_m - low_m) / (size - 1)


def _T_world_scene(floor_z_m: float) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, :3] = R_Y_UP_Z_UP
    T[1, 3] = -floor_z_m
    return T


def _frames(results: Path) -> tuple[np.ndarray, Float[np.ndarray, "frames 69"]]:
    """Numbers of the frames, rising; root orientation, pose and translation."""
    found = {int(match[1]): path for path in results.iterdir() if (match := _FRAME.search(path.name))}
    rows = []
    for number in sorted(found):
        arrays = read_pickled_arrays(found[number] / "000.pkl", _PARTS)
        row = np.concatenate([arrays[part].astype(np.float64).ravel() for part in _PARTS])
        if row.shape != (69,):
            raise InputError(f"{found[number]}: want {', '.join(_PARTS)} of 3, 63 and 3 numbers, got {row.size} in all")
        rows.append(row)
    if not rows:
        raise InputError(f"{results}: want folders s001_frame_<number>__<time> with 000.pkl, found none")
    return np.array(sorted(found)), np.stack(rows)


def _json(path: Path) -> Any:
    return read_json_value(path, "table of PROX (scenemi/data/prox.py)")
