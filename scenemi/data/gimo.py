"""GIMO (Zheng et al. 2022): people in scanned rooms.

Read as published: `dataset.csv` (columns sequence_path, start_frame, end_frame, scene, transformation, training),
`<scene>/<sequence>/transform_info.json` (`scale`, `transformation` 4 x 4: body to scan), `<scene>/scene_obj/`
(`textured_output.obj`, `transform_norm.txt` 4 x 4: scan to a frame with +Y up and the floor at 0).

To be converted once, with the data set's own tools: `<scene>/<sequence>/smplx_local/<frame>.pkl` are pickles of torch
tensors (`orient`, `trans`, `latent`), the latent being a VPoser code. Decode it with VPoser to 21 axis-angle rotations
and write one `<scene>/<sequence>/smplx_local.npz` with `frame` (T,) int, `orient` (T, 3), `trans` (T, 3),
`pose_body` (T, 63). Neither pickles nor VPoser are opened here.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scenemi.data.plain_files import read_arrays, read_json, read_text
from scenemi.data.scene_file import read_meshes
from scenemi.data.smpl_clip import smpl_clip
from scenemi.data.source_clip import SourceClip
from scenemi.scene.voxel_sdf import scan_sdf
from video2anim.errors import InputError
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.clip import FPS

_VOXEL_M, _DEPTH_M = 0.03, 0.1
"""Edge of a voxel, and depth that is solid behind a scan (not measured)."""
_ARRAYS = ("frame", "orient", "trans", "pose_body")


@dataclass(frozen=True, slots=True, eq=False)
class GimoSequence:
    """One annotated stretch of a sequence, with its room."""

    clip: SourceClip
    scene_mesh: Path
    T_world_mesh: Float[np.ndarray, "4 4"]
    """Takes the mesh, in its own unit, into the clip's world in meters (with a uniform scale)."""
    training: bool


def read_gimo_sdf(mesh: Path, T_world_mesh: Float[np.ndarray, "4 4"]) -> SdfGrid:
    """Signed distances to what stands on the floor of a room, in the clip's world: solid to 10 cm behind the scan.

    A scan shows the front of objects only. Penetration is measured up to that depth; what lies farther behind (under a
    table, say) was not seen and counts as free.

    Raises:
        InputError: the mesh is missing or broken.
    """
    corners = np.concatenate([part.vertices_m[part.faces] for part in read_meshes(mesh).parts])
    if not len(corners):
        raise InputError(f"{mesh}: want a scan with faces")
    return scan_sdf(corners @ T_world_mesh[:3, :3].T + T_world_mesh[:3, 3], _VOXEL_M, _DEPTH_M)


def read_gimo(folder: str | Path) -> Iterator[GimoSequence]:
    """Annotated sequences, in the order of `dataset.csv`.

    Raises:
        InputError: files are missing, not converted, or of another layout.
    """
    folder = Path(folder)
    table = folder / "dataset.csv"
    try:
        rows = list(csv.DictReader(read_text(table, "annotation table of GIMO").splitlines()))
        wanted = {"sequence_path", "start_frame", "end_frame", "scene", "transformation", "training"}
        if rows and not wanted <= set(rows[0]):
            raise ValueError(f"want the columns {', '.join(sorted(wanted))}")
        for row in rows:
            yield _sequence(folder, row)
    except (ValueError, csv.Error) as error:
        raise InputError(f"{table}: no annotations of GIMO: {error}") from error


def _sequence(folder: Path, row: dict[str, str]) -> GimoSequence:
    scene = folder / row["scene"]
    sequence = scene / row["sequence_path"]
    scale, T_scan_body = _transformation(sequence / row["transformation"])
    T_norm_scan = _matrix(scene / "scene_obj" / "transform_norm.txt")
    T_body = T_scan_body.copy()
    T_body[:3, 3] /= scale
    T_norm = T_norm_scan.copy()
    T_norm[:3, 3] /= scale
    path = sequence / "smplx_local.npz"
    if not path.is_file():
        raise InputError(f"{path}: missing; GIMO's pickles have to be converted, see scenemi/data/gimo.py")
    arrays = read_arrays(path, (), "converted sequence (see scenemi/data/gimo.py)", needed=_ARRAYS)
    start, stop = int(row["start_frame"]), int(row["end_frame"])
    chosen = (arrays["frame"] >= start) & (arrays["frame"] < stop)
    frame = arrays["frame"][chosen]
    steps = np.diff(frame)
    if len(frame) < 2 or (steps != steps[0]).any() or steps[0] < 1:
        raise InputError(f"{path}: frames {start} to {stop} are not evenly spaced; convert them again")
    clip = smpl_clip(
        np.concatenate([arrays["orient"][chosen], arrays["pose_body"][chosen]], axis=1),
        arrays["trans"][chosen],
        name=f"gimo_{row['scene']}_{row['sequence_path']}_{start}",
        source="gimo",
        fps=FPS / float(steps[0]),
        model="smplx",
        T_world_data=T_norm @ T_body,
    )
    T_world_mesh = T_norm_scan.copy()
    T_world_mesh[:3] /= scale
    mesh = scene / "scene_obj" / "textured_output.obj"
    return GimoSequence(clip, mesh, T_world_mesh, row["training"].strip() in ("1", "True", "true"))


def _transformation(path: Path) -> tuple[float, Float[np.ndarray, "4 4"]]:
    try:
        table = read_json(path, "transformation")
        scale, matrix = float(table["scale"]), np.array(table["transformation"], float)
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: want JSON with scale and transformation: {error}") from error
    if matrix.shape != (4, 4) or not scale > 0:
        raise InputError(f"{path}: want a 4 x 4 transformation and a scale above 0")
    return scale, matrix


def _matrix(path: Path) -> Float[np.ndarray, "4 4"]:
    try:
        return np.array(read_text(path, "matrix").split(), float).reshape(4, 4)
    except ValueError as error:
        raise InputError(f"{path}: want a 4 x 4 matrix: {error}") from error
