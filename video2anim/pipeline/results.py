"""The files for the user at the top of a scene folder. They belong to the run: it writes them, and removes what it no
longer makes; what somebody else wrote or changed there it leaves alone and says so."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from video2anim.digest import file_digest
from video2anim.errors import InputError, UsageError
from video2anim.pipeline.runner import Edits
from video2anim.pipeline.scene_folder import RESULT_ASIDE, RunRecord, expect_no_link, is_result_name, stage_folder

REPORT = "report.html"


def edited_results(scene_dir: Path, record: RunRecord) -> list[str]:
    """Results that are there and no longer as the run wrote them."""
    found: list[str] = []
    for name, digest in record.results.items():
        path = scene_dir / name
        if path.is_file() and file_digest(path) != digest:
            found.append(name)
    return found


def expect_unedited(scene_dir: Path, record: RunRecord, edits: Edits) -> None:
    """See before a run that it will not write over what somebody changed.

    Raises:
        UsageError: it would.
    """
    names = edited_results(scene_dir, record) if edits == "refuse" else []
    if names:
        instead = stage_folder(scene_dir, "refine").relative_to(scene_dir) / "motion.npz"
        raise UsageError(
            f"{', '.join(names)} in {scene_dir} changed since the run; files there are written by runs. Edit "
            f"{instead} or another stage in place of them; --discard-edits writes them anew, "
            "--keep-edits leaves them"
        )


def publish_results(
    scene_dir: Path,
    exported: Mapping[str, Path],
    report: Callable[[], str],
    record: RunRecord,
    edits: Edits,
    *,
    new_report: bool,
) -> dict[str, str]:
    """Bring the results to the top of the folder, where they changed.

    Args:
        scene_dir: the scene folder.
        exported: files to copy, by their path relative to the folder.
        report: makes `report.html`.
        record: of the folder as it was.
        edits: `keep` leaves files that were changed by hand.
        new_report: whether the report has something new to say.

    Returns:
        sha256 of every result by its path relative to the folder.

    Raises:
        InputError: a file that no run made has the name of a result, the disk is full, or an exported file has a name
            that no result has.
    """
    changed = set(edited_results(scene_dir, record))
    kept = changed if edits == "keep" else set[str]()
    placed: dict[str, str] = {}
    for name, source in exported.items():
        digest, target = file_digest(source), scene_dir / name
        _expect_ours(scene_dir, name, digest, record)
        placed[name] = digest
        if name in kept:
            placed[name] = record.results[name]
        elif not target.is_file() or file_digest(target) != digest:
            target.parent.mkdir(parents=True, exist_ok=True)
            into_place(target, lambda path, source=source: shutil.copyfile(source, path))
    if REPORT not in kept and (new_report or REPORT in changed or not (scene_dir / REPORT).is_file()):
        into_place(scene_dir / REPORT, lambda path: Path(path).write_text(report()))
    placed[REPORT] = record.results[REPORT] if REPORT in kept else file_digest(scene_dir / REPORT)
    for name in record.results.keys() - placed.keys():
        if name not in kept:
            (scene_dir / name).unlink(missing_ok=True)
    return placed


def _expect_ours(scene_dir: Path, name: str, digest: str, record: RunRecord) -> None:
    path = scene_dir / name
    if not is_result_name(name):
        raise InputError(f"{scene_dir}: stage export names a file {name!r}, which is no result of a run; run it again")
    expect_no_link(path)
    # A run that was killed while it placed its files leaves new ones that the record does not name yet.
    if path.exists() and name not in record.results and (not path.is_file() or file_digest(path) != digest):
        raise InputError(
            f"{path}: a result of this name is to be written, but no run made the file there; move it away"
        )


def into_place(target: Path, write: Callable[[str], Any], option: str = "--out") -> None:
    """Write aside and rename, so that a result file is never half there.

    Raises:
        InputError: it cannot be written.
    """
    name = ""
    try:
        handle, name = tempfile.mkstemp(prefix=RESULT_ASIDE, dir=target.parent)
        os.close(handle)
        write(name)
        os.chmod(name, 0o644)
        os.replace(name, target)
    except OSError as error:
        raise InputError(
            f"{option}: could not write {target} ({error.strerror}); free space or choose another folder"
        ) from error
    finally:
        if name:
            Path(name).unlink(missing_ok=True)
