"""Any motion file or data set folder as clips: what `scenemi data` converts to the container format."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from scenemi.data.amass import read_amass
from scenemi.data.asf_amc import read_asf_amc
from scenemi.data.bvh import read_bvh
from scenemi.data.container import MotionArchive
from scenemi.data.gimo import read_gimo
from scenemi.data.prox import read_prox
from scenemi.data.source_clip import SourceClip
from scenemi.data.trumans import read_trumans
from video2anim.errors import InputError

SUFFIXES = (".npz", ".bvh", ".amc")


def read_clips(
    path: str | Path, *, unit: str | None = None, mapping: Mapping[str, str] | None = None, kind: str = "unknown"
) -> list[SourceClip]:
    """Clips of a file or folder.

    A `.npz` is a motion archive or an AMASS file; an `.amc` needs its subject's `.asf` beside it (`02_01.amc`:
    `02.asf`, or the only one). A folder is TRUMANS (`seg_name.npy`), GIMO (`dataset.csv`), PROX (`PROXD`), or any with
    such files.

    Args:
        path: file or folder.
        unit: of BVH files, see `scenemi.data.bvh.read_bvh`.
        mapping: joints of BVH files.
        kind: kind of motion where the file does not say.

    Raises:
        InputError: nothing readable is there.
    """
    path = Path(path)
    if path.is_dir():
        if (path / "seg_name.npy").is_file():
            return [take.clip for take in read_trumans(path)]
        if (path / "dataset.csv").is_file():
            return [sequence.clip for sequence in read_gimo(path)]
        if (path / "PROXD").is_dir():
            return [piece.clip for piece in read_prox(path)]
        files = sorted(file for file in path.rglob("*") if file.suffix.lower() in SUFFIXES)
        if not files:
            raise InputError(f"{path}: want motion files ({', '.join(SUFFIXES)}), found none")
        return [clip for file in files for clip in read_clips(file, unit=unit, mapping=mapping, kind=kind)]
    suffix = path.suffix.lower()
    if suffix == ".bvh":
        return [read_bvh(path, unit=unit, mapping=mapping, kind=kind)]
    if suffix == ".amc":
        return [read_asf_amc(_asf_of(path), path, kind=kind)]
    if suffix != ".npz":
        raise InputError(f"{path}: want a motion file ({', '.join(SUFFIXES)}) or a folder of TRUMANS, GIMO or PROX")
    if _is_archive(path):
        archive = MotionArchive.read(path)
        return [archive.clip(name) for name in archive.names]
    return [read_amass(path, kind=kind)]


def _is_archive(path: Path) -> bool:
    try:
        with np.load(path, allow_pickle=False) as file:
            return "format_version" in getattr(file, "files", ())
    except (OSError, ValueError, EOFError):
        return True


def _asf_of(amc: Path) -> Path:
    named = amc.with_name(f"{amc.stem.split('_')[0]}.asf")
    if named.is_file():
        return named
    found = sorted(amc.parent.glob("*.asf"))
    if len(found) == 1:
        return found[0]
    raise InputError(f"{amc}: want its subject's skeleton {named.name} beside it, found {len(found)} .asf files")
