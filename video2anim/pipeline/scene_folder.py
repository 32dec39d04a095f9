"""The scene folder as the runner sees it: run record, lock, stage states."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
import tempfile
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, field
from pathlib import Path
from typing import Annotated, Any

import pydantic
from pydantic.dataclasses import dataclass

from video2anim.artifacts.stage_files import read_json
from video2anim.errors import ArtifactError, InputError, UsageError
from video2anim.types.contact import Contact

STAGES = "stages"
RECORD = "run.json"
RESULTS = (
    r"(motion|scene)\w*\.\w+|preview\.mp4|report\.html|objects/\d+\.glb|"
    r"fbx_ready/(person_\d+\.glb|blender_to_fbx\.py)"
)
"""What a run may write at the top of the folder."""
ResultName = Annotated[str, pydantic.Field(pattern=f"^({RESULTS})$")]
RECORD_ASIDE, RESULT_ASIDE = ".run-", ".new-"
"""How the names of files begin that are written aside, to be renamed when whole."""


_STRICT = pydantic.ConfigDict(extra="forbid", strict=True)


@dataclass(frozen=True, slots=True, config=_STRICT)
class StageRow:
    """A stage as it was when it last ran or was found up to date."""

    stage: str
    state: str
    key: str
    wall_time_s: float


@dataclass(frozen=True, slots=True, config=_STRICT)
class RunRecord:
    """`run.json`: what the folder holds and what was asked for. Written after each stage that ran, so a command that
    fails leaves the record of what is there."""

    input_path: str
    input_digest: str
    preset: str
    seed: int
    config: dict[str, Any]
    """Every option of every stage."""
    versions: dict[str, str]
    settings: dict[str, Any] = field(default_factory=dict[str, Any])
    """Options that differ from the preset because the user said so; later runs keep them."""
    stages: list[StageRow] = field(default_factory=list[StageRow])
    results: dict[ResultName, str] = field(default_factory=dict[ResultName, str])
    """Files outside of `stages/` that the run wrote: path relative to the folder, and sha256."""
    contacts: list[Contact] = field(default_factory=list[Contact])
    """Which part of whose body touches which surface of which object, and when, in the results."""

    def with_rows(self, rows: Mapping[str, StageRow]) -> list[StageRow]:
        """Rows of all stages: these, and the others as they were."""
        kept = {row.stage: row for row in self.stages}
        return list((kept | dict(rows)).values())


def stage_folder(scene_dir: Path, name: str) -> Path:
    """Folder of a stage by its name, whatever its number: the numbers shift when a stage is added before it.

    Where there is none, a path that does not exist.
    """
    found = sorted((scene_dir / STAGES).glob(f"[0-9][0-9]_{name}"))
    return found[0] if found else scene_dir / STAGES / name


def is_result_name(name: str) -> bool:
    """Whether a run may write a file of this name, relative to the folder."""
    return re.fullmatch(RESULTS, name) is not None


def has_record(scene_dir: Path) -> bool:
    """Whether the folder was made by a run."""
    return os.path.isfile(scene_dir / RECORD)  # Path.is_file raises where a name is too long


def read_record(scene_dir: Path) -> RunRecord:
    """Read `run.json`.

    Raises:
        InputError: not a scene folder.
        ArtifactError: damaged.
    """
    if not has_record(scene_dir):
        raise InputError(f"{scene_dir}: want a scene folder made by `video2anim run`, found no run.json")
    try:
        return read_json(scene_dir / RECORD, RunRecord)
    except ArtifactError as error:
        raise ArtifactError(
            f"{error}; delete it and run `video2anim run VIDEO --out {scene_dir}`, finished stages are kept"
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
        os.replace(name, scene_dir / RECORD)
    except OSError as error:
        if name:
            Path(name).unlink(missing_ok=True)
        raise InputError(
            f"--out: could not write run.json ({(error.strerror or str(error)).lower()}) in {scene_dir}; "
            "free space or choose another folder, finished stages are kept"
        ) from error


def prepare(scene_dir: Path) -> None:
    """Make the folder and see that it can be written, and that nothing in it leads out of it.

    Raises:
        InputError: it is a file, writing is not allowed, or a part of it is a link.
    """
    for part in (STAGES, "objects", "fbx_ready", ".lock", RECORD):
        expect_no_link(scene_dir / part)
    try:
        (scene_dir / STAGES).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=scene_dir / STAGES):
            pass
    except OSError as error:
        raise InputError(f"--out: want a folder that can be written, got {error.strerror} at {scene_dir}") from error
    for path in (scene_dir / STAGES).iterdir():
        expect_no_link(path)


def expect_no_link(path: Path) -> None:
    """A link in a folder that came from elsewhere would have a run write, or delete, where it points.

    Raises:
        InputError: it is one.
    """
    if path.is_symlink():
        raise InputError(f"--out: want plain files and folders, got a link at {path}; remove it")


@contextmanager
def locked(scene_dir: Path) -> Generator[None]:
    """Hold the folder for one process; released by the system even after SIGKILL.

    Raises:
        UsageError: another run holds it.
        InputError: the folder cannot be written.
    """
    expect_no_link(scene_dir / ".lock")
    try:
        held = os.fdopen(os.open(scene_dir / ".lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644), "r+")
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
    """Delete what a killed run or export was writing aside."""
    for folder in (scene_dir, scene_dir / "objects"):
        for prefix in (RECORD_ASIDE, RESULT_ASIDE):
            for path in folder.glob(f"{prefix}*"):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
