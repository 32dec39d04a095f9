"""The scene folder as the runner sees it: run record, lock, stage states."""

from __future__ import annotations

import fcntl
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from video2anim.errors import ArtifactError, InputError, UsageError

STAGES = "stages"
RECORD_ASIDE, RESULT_ASIDE = ".run-", ".new-"
"""How the names of files begin that are written aside, to be renamed when whole."""


@dataclass(frozen=True, slots=True)
class RunRecord:
    """`run.json`: what was asked for."""

    input_path: str
    input_digest: str
    preset: str
    seed: int
    config: dict[str, Any]
    versions: dict[str, str]
    stages: list[dict[str, Any]] = field(default_factory=list)
    """One row per stage: name, state, key, wall time."""


def read_record(scene_dir: Path) -> RunRecord:
    """Read `run.json`.

    Raises:
        InputError: not a scene folder.
        ArtifactError: damaged.
    """
    path = scene_dir / "run.json"
    if not path.is_file():
        raise InputError(f"{scene_dir}: want a scene folder made by `video2anim run`, found no run.json")
    try:
        return RunRecord(**json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise ArtifactError(
            f"run.json: damaged ({error}) at {path}; delete it and run `video2anim run VIDEO --out {scene_dir}`, "
            "finished stages are kept"
        ) from error


def write_record(scene_dir: Path, record: RunRecord) -> None:
    """Replace `run.json` in one rename.

    Raises:
        InputError: it cannot be written, for example because the disk is full.
    """
    name = ""
    try:
        handle, name = tempfile.mkstemp(prefix=RECORD_ASIDE, dir=scene_dir)
        with os.fdopen(handle, "w") as stream:
            stream.write(json.dumps(asdict(record), indent=1) + "\n")
        os.chmod(name, 0o644)
        os.replace(name, scene_dir / "run.json")
    except OSError as error:
        if name:
            Path(name).unlink(missing_ok=True)
        raise InputError(
            f"--out: could not write run.json ({(error.strerror or str(error)).lower()}) in {scene_dir}; "
            "free space or choose another folder, finished stages are kept"
        ) from error


def prepare(scene_dir: Path) -> None:
    """Make the folder and see that it can be written.

    Raises:
        InputError: it is a file, or writing is not allowed.
    """
    try:
        (scene_dir / STAGES).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=scene_dir / STAGES):
            pass
    except OSError as error:
        raise InputError(f"--out: want a folder that can be written, got {error.strerror} at {scene_dir}") from error


@contextmanager
def locked(scene_dir: Path) -> Iterator[None]:
    """Hold the folder for one process; released by the system even after SIGKILL.

    Raises:
        UsageError: another run holds it.
        InputError: the folder cannot be written.
    """
    try:
        held = (scene_dir / ".lock").open("w")
    except OSError as error:
        raise InputError(f"--out: want a folder that can be written, got {error.strerror} at {scene_dir}") from error
    with held as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UsageError(f"{scene_dir}: another video2anim run is at work here; wait for it to end") from error
        _remove_leftovers(scene_dir)
        yield


def _remove_leftovers(scene_dir: Path) -> None:
    """Delete the files that a killed run was writing aside."""
    for folder in (scene_dir, scene_dir / "objects"):
        for prefix in (RECORD_ASIDE, RESULT_ASIDE):
            for path in folder.glob(f"{prefix}*"):
                path.unlink(missing_ok=True)
