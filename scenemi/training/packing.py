"""A training run in a folder that is small enough to carry to another machine and back: settings, state and motion, in
files of at most 16 MiB. Motion loses less than a tenth of a millimeter, weights a hundredth of their size; moments of
the optimizer are left behind and build up again within some hundred steps."""

from __future__ import annotations

import io
import json
import lzma
import tempfile
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Int16, UInt8
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from scenemi.data.container import ARRAYS, MotionArchive, write_archive
from scenemi.data.plain_files import read_arrays, read_json
from scenemi.data.split import PARTS, Split
from scenemi.data.windows import MotionSetConfig, archives_of, chosen_clips
from scenemi.features import Statistics
from scenemi.model.baselines.build import build_any
from scenemi.model.weights import save_weights
from scenemi.training.checkpoint import CHECKPOINT, Checkpoint, load_checkpoint
from scenemi.training.config import TrainConfig
from scenemi.training.pool import UNITS_PER_METER
from scenemi.training.runs import RunFiles
from video2anim.errors import MAX_BYTES, InputError, one_line

PIECE_BYTES = 16 * 2**20
"""Of a file of a pack: what can be sent as an attachment."""
_SETTINGS, _MOTION, _STATE = "run.json", "motion", "state"
_LEVELS = torch.iinfo(torch.int8).max


@dataclass(frozen=True, slots=True)
class Unpacked:
    """What a pack holds, as files."""

    files: RunFiles | None
    """Motion and settings; None = a pack of the state alone."""
    start: Path | None
    """Weights that the run goes on from."""


def pack_run(folder: Path, files: RunFiles, out: Path) -> int:
    """Write a run: its settings, its averaged weights, and those clips of its motion files that are for training and
    validation and that it may use.

    Args:
        folder: to write; must not exist or be empty.
        files: of the run; without motion, only the state is written.
        out: folder of the run.

    Returns:
        Bytes written.

    Raises:
        InputError: the folder has files, or nothing is to be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise InputError(f"{folder}: want an empty folder for the pack; name another one")
    state = load_checkpoint(out / CHECKPOINT) if (out / CHECKPOINT).is_file() else None
    if not files.motion and state is None:
        raise InputError(f"{folder}: neither motion nor a run that has begun to pack")
    config = files.config if state is None else state.config
    use, split = MotionSetConfig(files.noncommercial, config.sources), files.split or Split()
    parts: dict[str, list[str]] = {part: [] for part in PARTS}
    clips = []
    for archive in map(MotionArchive.read, archives_of(files.motion)):
        for part in ("train", "val"):
            names = chosen_clips(archive, split, part, use)
            parts[part] += names
            clips += [archive.clip(name) for name in names]
    settings: dict[str, Any] = {"config": config.to_json(), "split": parts, "noncommercial": files.noncommercial}
    if clips:
        with tempfile.TemporaryDirectory() as aside:
            archive = Path(aside) / "motion.npz"
            write_archive(archive, clips)
            with np.load(archive, allow_pickle=False) as tables:
                _write(folder, _MOTION, _compressed({name: tables[name] for name in tables.files}))
    if state is not None:
        settings["card"] = {"steps": state.step, "hours": round(state.seconds / 3600, 2)}
        _write(folder, _STATE, _state(state))
    (folder / _SETTINGS).write_text(json.dumps(settings))
    return sum(path.stat().st_size for path in folder.iterdir())


def unpack_run(folder: Path, into: Path) -> Unpacked:
    """Files of a pack, written to a folder.

    Raises:
        InputError: not a pack.
    """
    into.mkdir(parents=True, exist_ok=True)
    try:
        settings = read_json(folder / _SETTINGS, "pack")
        motion, state = _read(folder, _MOTION), _read(folder, _STATE)
        start = None if state is None else _weights(state, settings, into / "start.safetensors")
        (into / "split.json").write_text(json.dumps(settings["split"]))
        (into / "config.json").write_text(json.dumps(settings["config"]))
        files = None
        if motion is not None:
            with (into / "motion.npz").open("wb") as stream:
                np.savez_compressed(stream, allow_pickle=False, **cast("dict[str, Any]", _decompressed(motion)))
            MotionArchive.read(into / "motion.npz")
            files = RunFiles.of(
                into / "config.json", [into / "motion.npz"], into / "split.json", into / "cache",
                noncommercial=settings.get("noncommercial") is True,
            )  # fmt: skip
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        EOFError,
        RuntimeError,
        lzma.LZMAError,
        SafetensorError,
        InputError,
    ) as error:
        raise InputError(f"{folder}: want what `scenemi train --pack` wrote: {one_line(error)}") from error
    return Unpacked(files, start)


def _write(folder: Path, name: str, data: bytes) -> None:
    for number, first in enumerate(range(0, len(data), PIECE_BYTES)):
        (folder / f"{name}.{number:02d}").write_bytes(data[first : first + PIECE_BYTES])


def _read(folder: Path, name: str) -> bytes | None:
    pieces = sorted(folder.glob(f"{name}.??"))
    return b"".join(piece.read_bytes() for piece in pieces) if pieces else None


def _compressed(tables: dict[str, np.ndarray]) -> bytes:
    """Tables of a motion archive; of rotations and places the changes from frame to frame, a column after the other."""
    rotation, root_m = tables.pop("rot"), tables.pop("root_pos")
    turns, moves = [], []
    for rows, places in _by_clip(tables):
        frames = places.stop - places.start
        turns.append(np.diff(rotation[rows].reshape(frames, -1), axis=0, prepend=np.int16(0)).T.ravel())
        units = np.rint(root_m[places] * UNITS_PER_METER).astype(np.int32)
        moves.append(np.diff(units, axis=0, prepend=0).T.ravel())
    stream = io.BytesIO()
    arrays = {"turns": _planes(np.concatenate(turns)), "moves": np.concatenate(moves), **tables}
    np.savez(stream, allow_pickle=False, **cast("dict[str, Any]", arrays))
    return lzma.compress(stream.getvalue(), preset=6)


def _decompressed(data: bytes) -> dict[str, np.ndarray]:
    names = ("turns", "moves")
    stream = lzma.LZMADecompressor()
    whole = stream.decompress(data, MAX_BYTES)
    if not stream.eof:
        raise ValueError(f"motion that is cut off or unpacks to more than {MAX_BYTES / 2**30:g} GiB")
    tables = read_arrays(io.BytesIO(whole), ARRAYS, "pack", needed=names, where="motion of the pack")
    high, low = tables.pop("turns").astype(np.uint16)
    turns, moves = (high << 8 | low).view(np.int16), tables.pop("moves")
    rotation, root_m = np.zeros((len(turns) // 4, 4), np.int16), np.zeros((len(moves) // 3, 3), np.float32)
    for rows, places in _by_clip(tables):
        frames = places.stop - places.start
        columns = turns[4 * rows.start : 4 * rows.stop].reshape(-1, frames)
        rotation[rows] = np.cumsum(columns, axis=1, dtype=np.int16).T.reshape(-1, 4)
        way = np.cumsum(moves[3 * places.start : 3 * places.stop].reshape(3, frames), axis=1)
        root_m[places] = way.T / UNITS_PER_METER
    return {**tables, "rot": rotation, "root_pos": root_m}


def _by_clip(tables: dict[str, np.ndarray]) -> list[tuple[slice, slice]]:
    """Rows of rotations and of places of each clip."""
    rows, places = (pairwise(tables[name].tolist()) for name in ("clip_rot_start", "clip_start"))
    return [(slice(*row), slice(*place)) for row, place in zip(rows, places, strict=True)]


def _planes(values: Int16[np.ndarray, "many"]) -> UInt8[np.ndarray, "2 many"]:
    """High and low bytes apart: the high ones are nearly always the same."""
    unsigned = values.view(np.uint16)
    return np.stack([unsigned >> 8, unsigned & 255]).astype(np.uint8)


def _state(state: Checkpoint) -> bytes:
    """Averaged weights with a byte for each entry of a matrix."""
    tensors: dict[str, Tensor] = {}
    learned = {name for name, _ in build_any(state.config.model).named_parameters()}
    for name, value in state.ema.items():
        if name in learned and value.ndim > 1:
            step = value.flatten(1).abs().amax(1).clamp(min=1e-12) / _LEVELS
            tensors |= {f"bytes.{name}": torch.round(value / _column(step, value)).to(torch.int8), f"step.{name}": step}
        else:
            tensors[f"plain.{name}"] = value.contiguous()
    for item in fields(Statistics):
        tensors[f"statistics.{item.name}"] = torch.from_numpy(getattr(state.statistics, item.name).copy())
    return save_tensors(tensors)


def _weights(data: bytes, settings: dict[str, Any], path: Path) -> Path:
    """Inverse of `_state`: a file of weights."""
    tensors = load_tensors(data)
    denoiser = build_any(TrainConfig.from_json(settings["config"]).model)
    state = {name.removeprefix("plain."): value for name, value in tensors.items() if name.startswith("plain.")}
    for name, value in tensors.items():
        if name.startswith("bytes."):
            key = name.removeprefix("bytes.")
            state[key] = value.float() * _column(tensors[f"step.{key}"], value)
    denoiser.load_state_dict(state)
    statistics = Statistics(*(tensors[f"statistics.{item.name}"].numpy() for item in fields(Statistics)))
    save_weights(path, denoiser, statistics, settings["card"], half=False)
    return path


def _column(step: Tensor, like: Tensor) -> Tensor:
    return step.reshape(-1, *[1] * (like.ndim - 1))
