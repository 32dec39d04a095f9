"""The stage folders of a scene folder: written aside, renamed once, digested by content."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from video2anim.artifacts.manifest import MANIFEST_NAME
from video2anim.artifacts.stage_files import value_files
from video2anim.digest import file_digest

_TEMPORARY = ".unfinished-"


def folder_digest(folder: Path) -> str:
    """sha256 over names and bytes of all files in a folder but its manifest."""
    return _digest(folder, sorted(p for p in folder.rglob("*") if p.is_file() and p.name != MANIFEST_NAME))


def value_digest(folder: Path) -> str:
    """sha256 over names and bytes of the files that hold a stage folder's value; stray files are none of it."""
    return _digest(folder, [path for path in value_files(folder) if path.name != MANIFEST_NAME])


def _digest(folder: Path, files: list[Path]) -> str:
    total = hashlib.sha256()
    for path in files:
        total.update(f"{path.relative_to(folder).as_posix()}\0{file_digest(path)}\n".encode())
    return total.hexdigest()


@contextmanager
def atomic_directory(final: Path) -> Iterator[Path]:
    """A work folder that becomes `final` by one rename if the block succeeds, and vanishes if it fails.

    An older `final` stays in place until the new one is complete.
    """
    final.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f"{_TEMPORARY}{final.name}-", dir=final.parent))
    try:
        yield work
        work.chmod(0o755)
        if final.exists():
            retired = Path(tempfile.mkdtemp(prefix=f"{_TEMPORARY}{final.name}-", dir=final.parent))
            os.rename(final, retired / "old")
            os.rename(work, final)
            shutil.rmtree(retired, ignore_errors=True)
        else:
            os.rename(work, final)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise


def remove_unfinished(stages_dir: Path) -> None:
    """Delete what a killed run left behind. Only for the process that holds the folder's lock."""
    if stages_dir.is_dir():
        for path in stages_dir.iterdir():
            if path.name.startswith(_TEMPORARY):
                shutil.rmtree(path, ignore_errors=True)
