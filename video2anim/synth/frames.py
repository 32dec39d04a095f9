"""Single training pictures with labels, in shards of memory-mapped arrays."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from video2anim import __version__
from video2anim.artifacts.folder import whole_or_absent
from video2anim.errors import InputError
from video2anim.synth.generate import SynthConfig, checked_sources, clip_key, compose_options, start_worker
from video2anim.synth.presets import ClipSpec, clip_specs
from video2anim.synth.world import LABELS

PER_ROOM = 32
"""Pictures made of one room, each from another camera and at another moment."""
SHARD_SIZE = 64
ARRAYS = {
    "rgb": (np.uint8, (3,)),
    "depth_mm": (np.uint16, ()),
    "normal_camera": (np.int8, (3,)),
    "instance": (np.uint16, ()),
    "label": (np.uint8, ()),
}
"""Per-pixel arrays of a shard: type and channels; each file is (pictures, height, width, channels)."""


@dataclass(frozen=True, slots=True)
class ShardDone:
    """What became of one shard."""

    name: str
    pictures: int
    cached: bool


def generate_frames(
    config: SynthConfig, out: Path, *, workers: int = 1, on_done: Callable[[ShardDone, int], None] = lambda d, n: None
) -> tuple[ShardDone, ...]:
    """Make `config.count` pictures (default 64) in `out/shard_<n>/<array>.npy`; a finished shard is kept.

    Besides `ARRAYS` a shard holds `intrinsics.npy` (n, 4) fx fy cx cy in pixels, `distortion.npy` (n, 2) k1 k2,
    `up_camera.npy` (n, 3), `camera_height_m.npy` (n,), and `meta.json`.

    Raises:
        UsageError: preset or count is wrong.
        InputError: sources or output folder cannot be used.
    """
    count = SHARD_SIZE if config.count is None else config.count
    rooms = -(-count // PER_ROOM)
    specs = clip_specs("random", rooms, config.seed)
    sources = checked_sources(config)
    jobs = []
    for shard, first in enumerate(range(0, count, SHARD_SIZE)):
        size = min(SHARD_SIZE, count - first)
        start = first // PER_ROOM
        jobs.append((f"shard_{shard:05d}", specs[start : start + -(-size // PER_ROOM)], size))
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out: cannot make folder {out}: {error.strerror}; choose another") from error
    results = []
    for result in _made(jobs, config, sources, out, workers):
        results.append(result)
        on_done(result, len(jobs))
    return tuple(sorted(results, key=lambda shard: shard.name))


def _made(
    jobs: list[tuple[str, tuple[ClipSpec, ...], int]],
    config: SynthConfig,
    sources: dict[str, str],
    out: Path,
    workers: int,
) -> Iterator[ShardDone]:
    if workers <= 1 or len(jobs) <= 1:
        for name, specs, size in jobs:
            yield _shard(name, specs, size, config, sources, out)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context, initializer=start_worker) as pool:
        for future in [pool.submit(_shard, name, specs, size, config, sources, out) for name, specs, size in jobs]:
            yield future.result()


def _shard(
    name: str, specs: tuple[ClipSpec, ...], size: int, config: SynthConfig, sources: dict[str, str], out: Path
) -> ShardDone:
    from video2anim.synth.pictures import room_pictures

    folder = out / name
    meta = {
        "format_version": 2, "preset": "random", "seed": config.seed, "first_room": specs[0].index, "pictures": size,
        "width_px": config.width_px, "height_px": config.height_px, "labels": list(LABELS),
        "generator": f"video2anim {__version__}", "key": clip_key(specs[0], config, sources),
    }  # fmt: skip
    try:
        if json.loads((folder / "meta.json").read_text()) == meta:
            return ShardDone(name, size, True)
    except (OSError, ValueError):
        pass
    with whole_or_absent(folder) as work:
        shape = (size, config.height_px, config.width_px)
        maps = {
            key: np.lib.format.open_memmap(work / f"{key}.npy", "w+", np.dtype(kind), (*shape, *channels))
            for key, (kind, channels) in ARRAYS.items()
        }
        facts: dict[str, list[np.ndarray]] = {
            k: [] for k in ("intrinsics", "distortion", "up_camera", "camera_height_m")
        }
        options, row = compose_options(config), 0
        for spec in specs:
            for values in room_pictures(spec, options, min(PER_ROOM, size - row)):
                for key in ARRAYS:
                    maps[key][row] = values[key]
                for key, rows in facts.items():
                    rows.append(values[key])
                row += 1
        for array in maps.values():
            array.flush()
        for key, rows in facts.items():
            np.save(work / f"{key}.npy", np.stack(rows).astype(np.float32), allow_pickle=False)
        (work / "meta.json").write_text(json.dumps(meta, indent=1) + "\n")
    return ShardDone(name, size, False)
