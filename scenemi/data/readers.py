"""Any motion file or data set folder as clips: what `scenemi data` converts to the container format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from scenemi.data.amass import read_amass
from scenemi.data.asf_amc import read_asf_amc
from scenemi.data.bvh import read_bvh
from scenemi.data.container import MotionArchive
from scenemi.data.gimo import read_gimo
from scenemi.data.plain_files import read_arrays
from scenemi.data.prox import read_prox
from scenemi.data.source_clip import SourceClip
from scenemi.data.sources import UNKNOWN_LICENSE, checked_license
from scenemi.data.trumans import read_trumans
from video2anim.errors import InputError

SUFFIXES = (".npz", ".bvh", ".amc")


@dataclass(frozen=True, slots=True)
class ReadingOptions:
    """What a file may not say itself."""

    unit: str | None = None
    """Of BVH files, see `scenemi.data.bvh.read_bvh`."""
    mapping: Mapping[str, str] | None = None
    """Joints of BVH files."""
    kind: str | None = None
    """Kind of motion; None = unknown."""
    source: str | None = None
    """Of BVH and AMC files, with its license; None = the form of the file, whose license is unknown."""
    license: str | None = None

    def of_own(self, form: str) -> tuple[str, str]:
        """Source and license of clips of a form that says neither.

        Raises:
            UsageError: a source whose license is not known.
        """
        if self.source is None:
            return form, UNKNOWN_LICENSE
        return self.source, checked_license(self.source, self.license)


def read_clips(path: str | Path, options: ReadingOptions | None = None) -> list[SourceClip]:
    """Clips of a file or folder.

    A `.npz` is a motion archive or an AMASS file; an `.amc` needs its subject's `.asf` beside it (`02_01.amc`:
    `02.asf`, or the only one). A folder is TRUMANS (`seg_name.npy`), GIMO (`dataset.csv`), PROX (`PROXD`), or any with
    such files.

    Args:
        path: file or folder.
        options: what files do not say.

    Raises:
        InputError: nothing readable is there.
    """
    path, options = Path(path), options or ReadingOptions()
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
        return [clip for file in files for clip in read_clips(file, options)]
    suffix, kind = path.suffix.lower(), options.kind or "unknown"
    if suffix == ".bvh":
        source, license_name = options.of_own("bvh")
        clip = read_bvh(path, unit=options.unit, mapping=options.mapping, source=source, kind=kind)
        return [replace(clip, license=license_name)]
    if suffix == ".amc":
        source, license_name = options.of_own("amc")
        return [replace(read_asf_amc(_asf_of(path), path, source=source, kind=kind), license=license_name)]
    if suffix != ".npz":
        raise InputError(f"{path}: want a motion file ({', '.join(SUFFIXES)}) or a folder of TRUMANS, GIMO or PROX")
    if _is_archive(path):
        archive = MotionArchive.read(path)
        return [archive.clip(name) for name in archive.names]
    return [read_amass(path, kind=kind)]


def forms_of(paths: Sequence[Path]) -> set[str]:
    """What the files are, and those in folders: suffixes without a dot; a `.npz` is an `archive` or `amass`, a data set
    with scenes `scenes`."""
    found: set[str] = set()
    for path in paths:
        if path.is_dir():
            data_set = (path / "seg_name.npy").is_file() or (path / "dataset.csv").is_file()
            files = [file for file in path.rglob("*") if file.suffix.lower() in SUFFIXES]
            found |= {"scenes"} if data_set or (path / "PROXD").is_dir() else forms_of(files)
        elif path.suffix.lower() == ".npz":
            found.add("archive" if _is_archive(path) else "amass")
        else:
            found.add(path.suffix.lower().removeprefix("."))
    return found


def _is_archive(path: Path) -> bool:
    return "format_version" in read_arrays(path, ("format_version",), "motion file")


def _asf_of(amc: Path) -> Path:
    named = amc.with_name(f"{amc.stem.split('_')[0]}.asf")
    if named.is_file():
        return named
    found = sorted(amc.parent.glob("*.asf"))
    if len(found) == 1:
        return found[0]
    raise InputError(f"{amc}: want its subject's skeleton {named.name} beside it, found {len(found)} .asf files")
