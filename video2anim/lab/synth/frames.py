"""Single training images with labels, in shards of memory-mapped arrays."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from video2anim import __version__
from video2anim.artifacts.folder import atomic_directory
from video2anim.artifacts.stage_files import read_json
from video2anim.errors import ArtifactError
from video2anim.lab.synth.generate import (
    SynthConfig,
    checked_sources,
    clip_key,
    compose_options,
    expect_generated,
    in_processes,
    reported_write_errors,
)
from video2anim.lab.synth.presets import ClipSpec, clip_specs, expect_count_and_seed
from video2anim.lab.synth.world import LABELS

SHARD_SIZE = 64
"""Images per shard (a folder)."""
PER_ROOM = SHARD_SIZE // 2
"""Images per room, each from another camera and at another time."""
MAX_PICTURES = 1_000_000
"""Maximum number of images per call."""
ARRAYS = {
    "rgb": (np.uint8, (3,)),
    "depth_mm": (np.uint16, ()),
    "normal_camera": (np.int8, (3,)),
    "instance": (np.uint16, ()),
    "label": (np.uint8, ()),
}
"""Per-pixel arrays of a shard: type and channels; each file is (images, height, width, channels)."""


@dataclass(frozen=True, slots=True)
class ShardDone:
    """Result of making one shard."""

    name: str
    pictures: int
    cached: bool


def generate_frames(
    config: SynthConfig, out: Path, *, workers: int = 1, on_done: Callable[[ShardDone, int], None] = lambda d, n: None
) -> tuple[ShardDone, ...]:
    """Make `config.count` images (default 64) in `out/shard_<n>/<array>.npy`; a finished shard is kept.

    Besides `ARRAYS` a shard holds `intrinsics.npy` (n, 4) fx fy cx cy in pixels, `distortion.npy` (n, 2) k1 k2,
    `up_camera.npy` (n, 3) unit vectors in camera axes, `camera_height_m.npy` (n,), and `meta.json`.

    Raises:
        UsageError: count or seed is out of range.
        InputError: sources or output folder cannot be used; shards that are finished stay.
        StageError: a worker process was killed.
    """
    count = SHARD_SIZE if config.count is None else config.count
    expect_count_and_seed(count, config.seed, MAX_PICTURES)
    rooms = -(-count // PER_ROOM)
    specs = clip_specs("random", rooms, config.seed)
    sources = checked_sources(config)
    jobs = []
    for shard, first in enumerate(range(0, count, SHARD_SIZE)):
        size = min(SHARD_SIZE, count - first)
        start = first // PER_ROOM
        jobs.append((f"shard_{shard:05d}", specs[start : start + -(-size // PER_ROOM)], size))
    results = []
    with reported_write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        for result in in_processes(_shard, jobs, config, sources, out, workers):
            results.append(result)
            on_done(result, len(jobs))
    return tuple(sorted(results, key=lambda shard: shard.name))


def _shard(
    job: tuple[str, tuple[ClipSpec, ...], int], config: SynthConfig, sources: dict[str, str], out: Path
) -> ShardDone:
    from video2anim.lab.synth.pictures import room_pictures

    name, specs, size = job
    folder = out / name
    meta = {
        "format_version": 2, "preset": "random", "seed": config.seed, "first_room": specs[0].index, "pictures": size,
        "width_px": config.width_px, "height_px": config.height_px, "labels": list(LABELS),
        "generator": f"video2anim {__version__}", "key": clip_key(specs[0], config, sources),
    }  # fmt: skip
    with suppress(ArtifactError):
        whole = all((folder / f"{key}.npy").is_file() for key in ARRAYS)
        if whole and read_json(folder / "meta.json", dict[str, Any]) == meta:
            return ShardDone(name, size, True)
    expect_generated(folder)
    with atomic_directory(folder) as work, ExitStack() as files:
        shape = (size, config.height_px, config.width_px)
        # Written image by image: a memory map on a full disk would kill the process with a signal.
        maps = {
            key: files.enter_context(_begun(work / f"{key}.npy", np.dtype(kind), (*shape, *channels)))
            for key, (kind, channels) in ARRAYS.items()
        }
        facts: dict[str, list[np.ndarray]] = {
            k: [] for k in ("intrinsics", "distortion", "up_camera", "camera_height_m")
        }
        options, row = compose_options(config), 0
        for spec in specs:
            for values in room_pictures(spec, options, min(PER_ROOM, size - row)):
                for key, (kind, channels) in ARRAYS.items():
                    picture = np.broadcast_to(values[key], (*shape[1:], *channels))
                    maps[key].write(picture.astype(kind, copy=False).tobytes())
                for key, rows in facts.items():
                    rows.append(values[key])
                row += 1
        for key, rows in facts.items():
            np.save(work / f"{key}.npy", np.stack(rows).astype(np.float32), allow_pickle=False)
        (work / "meta.json").write_text(json.dumps(meta, indent=1) + "\n")
    return ShardDone(name, size, False)


def _begun(path: Path, dtype: np.dtype, shape: tuple[int, ...]) -> BinaryIO:
    """A new .npy file with its header, open for writing the values."""
    stream = path.open("wb")
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream
