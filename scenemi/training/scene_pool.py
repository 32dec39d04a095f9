"""Captured clips with their scenes, made ready for training: converted once, then a volume of distances per window.

`prepare_scenes` reads a data set once and writes a folder in this package's formats: the clips as a motion archive and
each scene as distances in 8 bits. From these the motion set retargets, draws and augments, except by what would
separate a motion from its scene: no limbs of other clips, no bent paths. Mirroring reflects the volume too; reversed
time and other speeds do not change where the body is.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Int8

from scenemi.data.container import MotionArchive, write_archive
from scenemi.data.motion_store import MotionStore
from scenemi.data.plain_files import read_arrays, read_json
from scenemi.data.scene_clips import SceneClip, SceneFit, fit_scene, read_scene_clips
from scenemi.data.source_clip import SourceClip
from scenemi.data.split import Part, Split
from scenemi.data.windows import MotionSet, MotionSetConfig
from scenemi.scene.field import REACH_M, VOLUME_LEVELS, VOLUME_STEP_M
from scenemi.scene.grid import SPACING_M
from scenemi.scene.rows import VolumeRows
from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_quaternion
from video2anim.geometry.sdf import SdfGrid
from video2anim.types import BodyShape

VOLUME_NODES = (48, 32, 48)
"""Of a window's volume: 74 kB, half as much again as its features. Its box is that of the true and the blind path, so
nodes are 4 cm apart for who sits or reaches and some 10 cm for who crosses a room."""
_AROUND_M = REACH_M
"""How far the box reaches around the joints."""
_STEPS_M = (0.04, 0.12)
"""Least and largest step of the nodes."""
_KEPT_M = 0.8
"""How far distances of a scene are kept: beyond the reach of a field, because small bodies make a scene smaller."""
_SCENE_STEP_M = _KEPT_M / VOLUME_LEVELS
_FIT_EVERY = 10
"""Of the frames that tell how a scene follows a retargeted motion."""
_SCENE_ARRAYS = ("values", "origin_m", "spacing_m")
_CLIPS, _TABLE = "clips.npz", "scenes.json"
_VERSION = 1


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """Distances in steps of `_SCENE_STEP_M`."""

    values: Int8[np.ndarray, "x y z"]
    origin_m: Float[np.ndarray, "3"]
    spacing_m: float

    def grid(self) -> SdfGrid:
        return SdfGrid(np.float32(_SCENE_STEP_M) * self.values, self.origin_m, self.spacing_m)


def prepare_scenes(source: str, folder: Path, into: Path) -> Path:
    """The folder in `into` that holds a data set as training reads it; made if it is not there yet, whole or absent.

    Raises:
        InputError: no clips, or files of the data set are missing or broken.
    """
    digest = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:8]
    final = into / f"{source}-{digest}-{_VERSION}"
    if final.is_dir():
        return final
    aside = final.with_name(f".{final.name}.{os.getpid()}")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    try:
        clips: list[SourceClip] = []
        scenes: dict[str, int] = {}
        table: dict[str, Any] = {}
        for found in read_scene_clips(source, folder):
            number = scenes.setdefault(found.scene_name, len(scenes))
            if not (aside / _file(number)).is_file():
                _write_scene(aside / _file(number), found)
            clips.append(replace(found.clip, rotation_wxyz=found.clip.rotation_wxyz.astype(np.float32)))
            table[found.clip.name] = {"scene": number, "part": found.part}
        write_archive(aside / _CLIPS, clips)
        (aside / _TABLE).write_text(json.dumps({"scenes": list(scenes), "clips": table}, indent=1))
        os.replace(aside, final)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    return final


class SceneMotions(MotionSet):
    """Clips of one part on several bodies, as `MotionSet`, each in its scene."""

    def __init__(self, store: MotionStore, shapes: Sequence[BodyShape], config: MotionSetConfig) -> None:
        super().__init__(store, shapes, config)
        self._homes: list[tuple[MotionArchive, list[_Scene], dict[str, int]]] = []
        self._fits: dict[tuple[int, int], SceneFit] = {}

    @classmethod
    def read(
        cls,
        folders: Sequence[Path],
        split: Split | None,
        part: Part,
        bodies: int,
        config: MotionSetConfig,
        *,
        cache: Path | None = None,
    ) -> SceneMotions:
        """From prepared folders; clips that the split does not name are in the part that their data set says.

        Raises:
            InputError: no clip of this part, or of a source that `config` admits; broken folders.
        """
        tables = [_table(folder) for folder in folders]
        parts = {name: row["part"] for table in tables for name, row in table["clips"].items()}
        if len(parts) < sum(len(table["clips"]) for table in tables):
            raise InputError(f"{', '.join(map(str, folders))}: the same clips twice; give each data set once")
        whole = Split({**parts, **(split.named if split else {})})
        plain = replace(config, mirror=0.0, mix=0.0, store=replace(config.store, bends=0))
        motions = cls.build([folder / _CLIPS for folder in folders], whole, part, bodies, plain, cache=cache)
        assert isinstance(motions, SceneMotions)
        for folder, table in zip(folders, tables, strict=True):
            scenes = [_read_scene(folder / _file(i)) for i in range(len(table["scenes"]))]
            rows = {name: int(row["scene"]) for name, row in table["clips"].items()}
            motions._homes.append((MotionArchive.read(folder / _CLIPS), scenes, rows))
        return motions

    def volumes(
        self,
        T_world_canonical: Float[np.ndarray, "batch 4 4"],
        clip: Int[np.ndarray, "batch"],
        body: Int[np.ndarray, "batch"],
        around_m: Float[np.ndarray, "batch points 3"],
    ) -> VolumeRows:
        """The scenes of windows as volumes in their canonical frames.

        Args:
            T_world_canonical: of each window, not mirrored.
            clip: row of the store's tables of clips.
            body: row of `rest_joints_m`.
            around_m: canonical places where the body is, or might be taken to be.
        """
        low_m, step_m = _boxes(around_m)
        values = np.empty((len(clip), *VOLUME_NODES), np.int8)
        index = np.stack(np.meshgrid(*(np.arange(n) for n in VOLUME_NODES), indexing="ij"), -1)
        for i, T in enumerate(T_world_canonical):
            fit = self._fit(int(clip[i]), int(body[i]))
            world_m = (low_m[i] + step_m[i] * index) @ T[:3, :3].T + T[:3, 3]
            distance_m = fit.scale * self._scene(int(clip[i])).grid().sample(fit.scene_points(world_m))
            values[i] = np.rint(np.clip(distance_m, -REACH_M, REACH_M) / VOLUME_STEP_M)
        return VolumeRows(torch.from_numpy(values), torch.from_numpy(np.concatenate([low_m, step_m], 1)))

    def _scene(self, clip: int) -> _Scene:
        name = str(self.store.clip_name[clip])
        return next(scenes[rows[name]] for _, scenes, rows in self._homes if name in rows)

    def _fit(self, clip: int, body: int) -> SceneFit:
        """How the scene of a clip follows the clip on a body."""
        if (clip, body) not in self._fits:
            store, name = self.store, str(self.store.clip_name[clip])
            frames, rows = [], []
            for piece in np.flatnonzero((store.piece_clip == clip) & (store.piece_body == body)):
                steps = np.arange(0, store.piece_frames[piece], _FIT_EVERY)
                rows.append(store.piece_start[piece] + steps)
                frames.append(store.piece_first[piece] + steps)
            at = np.concatenate(rows)
            R_root = matrix_from_quaternion(np.asarray(store.quaternion_wxyz[at, 0], np.float64))
            source = next(archive for archive, _, known in self._homes if name in known).clip(name)
            self._fits[clip, body] = fit_scene(
                source, self.body(body), np.concatenate(frames), R_root, store.translation_m[at]
            )
        return self._fits[clip, body]


def _boxes(around_m: Float[np.ndarray, "batch points 3"]) -> tuple[np.ndarray, np.ndarray]:
    """First node and steps of each window's volume: around the points, centered on them where they go too far."""
    low_m, high_m = around_m.min(1) - _AROUND_M, around_m.max(1) + _AROUND_M
    low_m[:, 1] = np.maximum(low_m[:, 1], 0.0)
    last = np.array(VOLUME_NODES) - 1
    step_m = np.clip((high_m - low_m) / last, *_STEPS_M)
    low_m[:, [0, 2]] = (0.5 * (low_m + high_m - step_m * last))[:, [0, 2]]
    return low_m.astype(np.float32), step_m.astype(np.float32)


def _file(number: int) -> str:
    return f"scene_{number:04d}.npz"


def _write_scene(path: Path, found: SceneClip) -> None:
    solids = found.solids()
    shape = np.ceil((np.array(solids.sdf_m.shape) - 1) * solids.spacing_m / SPACING_M).astype(int) + 1
    shape += 2 * (margin := round(_KEPT_M / SPACING_M))
    origin_m = solids.origin_m - margin * SPACING_M
    axes = [origin_m[a] + SPACING_M * np.arange(shape[a]) for a in range(3)]
    values = np.empty(shape, np.int8)
    for i, x in enumerate(axes[0]):
        nodes_m = np.stack(np.broadcast_arrays(x, axes[1][:, None], axes[2]), -1)
        values[i] = np.rint(np.clip(solids.sample(nodes_m), -_KEPT_M, _KEPT_M) / _SCENE_STEP_M)
    np.savez_compressed(path, values=values, origin_m=origin_m, spacing_m=SPACING_M)


def _read_scene(path: Path) -> _Scene:
    file = read_arrays(path, (), "converted scene (delete its folder to convert it again)", needed=_SCENE_ARRAYS)
    return _Scene(file["values"], file["origin_m"], float(file["spacing_m"]))


def _table(folder: Path) -> dict[str, Any]:
    return read_json(folder / _TABLE, "table of converted scenes (delete the folder to convert them again)")
