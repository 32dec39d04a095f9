"""Makes many clips: cached by specification, in parallel processes; each folder is complete or absent."""

from __future__ import annotations

import functools
import hashlib
import json
import multiprocessing
import multiprocessing.connection
import os
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from video2anim import __version__
from video2anim.artifacts.folder import remove_unfinished
from video2anim.artifacts.stage_files import read_json
from video2anim.digest import file_digest
from video2anim.errors import ArtifactError, InputError, StageError
from video2anim.lab.synth.presets import V2A_BENCH, ClipSpec, clip_specs
from video2anim.lab.synth.world import LABEL_STRIDE_FRAMES, PICTURE_SIZE_PX

if TYPE_CHECKING:
    from video2anim.lab.synth.compose import ComposeOptions

Job = TypeVar("Job")
Made = TypeVar("Made")
SET_NAME = "set.json"
_DIGESTED = ("truth.npz", "video.mp4")
_GENERATED_NAMES = re.compile(r"meta\.json|truth(_\d+)?\.npz|video\.mp4|plate\.png|scene\.glb|objects|\w+\.npy")
"""Names of the files and folders in clips and shards."""
GENERATOR_VERSION = 1
"""Increased when the same specification gives another clip."""


@dataclass(frozen=True, slots=True)
class SynthConfig:
    """Options of one call of `video2anim synth`."""

    preset: str = "bench"
    count: int | None = None
    seed: int = 0
    width_px: int = PICTURE_SIZE_PX[0]
    height_px: int = PICTURE_SIZE_PX[1]
    motion: tuple[Path, ...] = ()
    """Archives of captured motion, or folders of them. Without any, walking comes from the gait model."""
    noncommercial: bool = False
    meshes: Path | None = None
    """Folder of external meshes to add to rooms."""
    room_size_m: tuple[float, float] | None = None
    longest_s: float | None = None
    """Clips are cut to this length."""


@dataclass(frozen=True, slots=True)
class ClipDone:
    """Result of making one clip."""

    name: str
    cached: bool
    digests: dict[str, str]
    """sha256 of `truth.npz` and `video.mp4`."""


def generate(
    config: SynthConfig, out: Path, *, workers: int = 1, on_done: Callable[[ClipDone, int], None] = lambda d, n: None
) -> tuple[ClipDone, ...]:
    """Make the clips of a set in `out/<clip name>` and the table `out/set.json`.

    A clip that exists with the same specification, sources and generator version is kept. Leftovers of a killed run are
    removed, so only one process may work on a folder.

    Args:
        config: What to make.
        out: Folder of the set.
        workers: Processes.
        on_done: Called with each finished clip and the number of clips in all.

    Raises:
        UsageError: the preset or a count is wrong.
        InputError: motion archives or meshes cannot be used, the output folder cannot be written or holds other files,
            or a clip has no suitable scene; finished clips stay.
        StageError: a worker process was killed.
    """
    specs = clip_specs(config.preset, config.count, config.seed)
    sources = checked_sources(config)
    done: dict[str, ClipDone] = {}
    missing: list[ClipSpec] = []
    with reported_write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        remove_unfinished(out)
        for spec in specs:
            kept = finished_clip(out / spec.name, clip_key(spec, config, sources))
            if kept is None:
                expect_generated(out / spec.name)
                missing.append(spec)
            else:
                done[spec.name] = kept
                on_done(kept, len(specs))
        for result in in_processes(_make, missing, config, sources, out, workers):
            done[result.name] = result
            on_done(result, len(specs))
        results = tuple(done[spec.name] for spec in specs)
        _write_set(out, config, sources, results)
    return results


@contextmanager
def reported_write_errors(out: Path) -> Iterator[None]:
    """Context that turns errors of writing and of worker processes into one-line errors.

    Raises:
        InputError: `out` cannot be written.
        StageError: a worker process was killed.
    """
    try:
        yield
    except BrokenProcessPool as error:
        raise StageError(
            f"--workers: a process that wrote to {out} was killed, perhaps for lack of memory; "
            "use fewer; what is finished is kept"
        ) from error
    except OSError as error:
        raise InputError(
            f"--out: cannot write {out} ({(error.strerror or str(error)).lower()}); free space or choose another "
            "place, what is finished is kept"
        ) from error


def in_processes(
    make: Callable[[Job, SynthConfig, dict[str, str], Path], Made],
    jobs: Sequence[Job],
    config: SynthConfig,
    sources: dict[str, str],
    out: Path,
    workers: int,
) -> Iterator[Made]:
    """Yields the result of every job as it finishes; the first failure cancels jobs that have not begun."""
    if workers <= 1 or len(jobs) <= 1:
        for job in jobs:
            yield make(job, config, sources, out)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context, initializer=start_worker) as pool:
        waiting: set[Future[Made]] = {pool.submit(make, job, config, sources, out) for job in jobs}
        try:
            while waiting:
                finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield future.result()
        except BaseException:
            for future in waiting:
                future.cancel()
            raise


def start_worker() -> None:
    """Limit a worker to one thread (threads of several workers slow each other down) and end it with its parent."""
    import cv2
    import torch

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)


def _make(spec: ClipSpec, config: SynthConfig, sources: dict[str, str], out: Path) -> ClipDone:
    from video2anim.lab.synth.compose import compose
    from video2anim.lab.synth.store import write_clip

    shot = compose(spec, compose_options(config))
    facts = {
        "name": spec.name, "preset": spec.preset, "seed": spec.seed, "index": spec.index,
        "key": clip_key(spec, config, sources), "generator": f"video2anim {__version__}",
    }  # fmt: skip
    write_clip(shot, out / spec.name, facts, spec.rng("noise"))
    return ClipDone(spec.name, False, _digests(out / spec.name))


def checked_sources(config: SynthConfig) -> dict[str, str]:
    """sha256 of every file that clips are made from, by name. Fails before anything is made.

    Raises:
        InputError: an archive or mesh is missing or cannot be used.
    """
    files: list[Path] = []
    try:
        for path in config.motion:
            files += sorted(path.glob("*.npz")) if path.is_dir() else [path]
        if config.meshes is not None and config.meshes.is_dir():
            files += sorted(path for path in config.meshes.iterdir() if path.is_file())
        missing = [path for path in files if not path.is_file()]
        if missing:
            raise InputError(f"motion: want an archive (.npz) or a folder of them, found nothing at {missing[0]}")
        compose_options(config)
        return {path.name: file_digest(path) for path in files}
    except OSError as error:
        raise InputError(f"cannot read {error.filename} ({(error.strerror or str(error)).lower()})") from error


@functools.lru_cache(maxsize=1)
def compose_options(config: SynthConfig) -> ComposeOptions:
    """The options that hold for every clip; source files are read once per process."""
    from video2anim.lab.synth.compose import ComposeOptions
    from video2anim.lab.synth.library import MotionDatabase
    from video2anim.lab.synth.rooms import load_meshes

    library = MotionDatabase.read(config.motion, noncommercial=config.noncommercial) if config.motion else None
    meshes = load_meshes(config.meshes) if config.meshes is not None else ()
    return ComposeOptions(config.width_px, config.height_px, config.room_size_m, meshes, library, config.longest_s)


def clip_key(spec: ClipSpec, config: SynthConfig, sources: dict[str, str]) -> str:
    """Hash of everything that can change a clip."""
    facts: dict[str, Any] = {
        "version": GENERATOR_VERSION, "spec": asdict(spec), "size": (config.width_px, config.height_px),
        "room": config.room_size_m, "stride": LABEL_STRIDE_FRAMES, "sources": sources,
        "noncommercial": config.noncommercial, "longest_s": config.longest_s,
    }  # fmt: skip
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def finished_clip(folder: Path, key: str) -> ClipDone | None:
    """A finished clip with this key; None if there is none or it is damaged."""
    try:
        made = all((folder / name).is_file() for name in _DIGESTED)
        if made and read_json(folder / "meta.json", dict[str, Any])["key"] == key:
            return ClipDone(folder.name, True, _digests(folder))
    except (ArtifactError, OSError, KeyError):
        pass
    return None


def expect_generated(folder: Path) -> None:
    """Check that a folder holds only generated files, since the new clip or shard replaces all of it.

    Raises:
        InputError: it is a file or link, or holds other files.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise InputError(f"--out: want to make the folder {folder}, found a file or link there; move it away")
    if folder.is_dir():
        for path in folder.iterdir():
            if not _GENERATED_NAMES.fullmatch(path.name):
                raise InputError(f"--out: {folder} is to be replaced, but holds {path.name}; move that away")


def _digests(folder: Path) -> dict[str, str]:
    return {name: file_digest(folder / name) for name in _DIGESTED}


def _write_set(out: Path, config: SynthConfig, sources: dict[str, str], clips: Sequence[ClipDone]) -> None:
    table = {
        "format_version": 1,
        "benchmark": V2A_BENCH if config.preset == "bench" and config.seed == 0 else None,
        "preset": config.preset,
        "seed": config.seed,
        "generator": f"video2anim {__version__}",
        "generator_version": GENERATOR_VERSION,
        "motion_sources": sources,
        "clips": [{"name": clip.name, **clip.digests} for clip in clips],
    }
    aside = out / f".{SET_NAME}.tmp"
    aside.write_text(json.dumps(table, indent=1) + "\n")
    aside.replace(out / SET_NAME)
