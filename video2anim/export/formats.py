"""The file formats by name, for `video2anim export` and the export stage."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from video2anim.errors import InputError, UsageError
from video2anim.pipeline.scene_folder import RESULT_ASIDE
from video2anim.types import BodyMotion, Contact, SceneModel


class MissingLibraryError(UsageError):
    """A format's optional library or program is not installed (exit code 2)."""


@dataclass(frozen=True, slots=True, eq=False)
class ExportScene:
    """What the writers write."""

    people: tuple[BodyMotion, ...]
    """Main person first."""
    scene: SceneModel | None
    contacts: tuple[Contact, ...] = ()
    """Of these people; GLB carries them."""


@dataclass(frozen=True, slots=True)
class Format:
    """One format: how its files are named, and what writes them."""

    main: str
    """Name of the main file, where the user names only a folder."""
    suffixes: tuple[str, ...]
    """Endings of the main file that a user may ask for; none where the format is a folder."""
    write: Callable[[ExportScene, Path], tuple[Path, ...]]
    """Writes the main file at the path and those of further people beside it; returns all, the main one first."""
    write_more: Callable[[ExportScene, Path], tuple[Path, ...]] | None = None
    """Writes what goes into a folder beside the main file, but not along with a single file that the user named."""
    expect_library: Callable[[ExportScene, Path], None] | None = None
    """Raises MissingLibraryError where a library or program of the format is missing."""


def write_format(name: str, content: ExportScene, out: Path) -> tuple[Path, ...]:
    """Write one format, whole or not at all.

    All files are written aside and renamed once they are complete, so a failure leaves what was there before.

    Args:
        name: One of `FORMATS`.
        content: People and scene.
        out: Folder for the files, made where it is missing; or the main file, where it ends as the format's files do
            and is no folder. Files of the same name are replaced.

    Returns:
        The files written, the main one first.

    Raises:
        UsageError: no such format, nobody to export, or `out` is no name for files of this format.
        MissingLibraryError: the format's library or program is missing; the message names what installs it.
        InputError: the files cannot be written there.
    """
    if name not in FORMATS:
        raise UsageError(f"export format: want one of {', '.join(FORMATS)}, got {name!r}")
    if not content.people:
        raise UsageError("export: the scene has no person to export")
    chosen = FORMATS[name]
    folder, main, alone = _destination(name, chosen, out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if chosen.expect_library is not None:
            chosen.expect_library(content, folder / main)
        with tempfile.TemporaryDirectory(prefix=RESULT_ASIDE, dir=folder) as work:
            aside = Path(work)
            written = chosen.write(content, aside / main)
            if chosen.write_more is not None and not alone:
                written += chosen.write_more(content, aside)
            placed = tuple(folder / path.relative_to(aside) for path in written)
            for path, target in zip(written, placed, strict=True):
                target.parent.mkdir(exist_ok=True)
                os.replace(path, target)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(
            f"--out: cannot write {name} files to {folder} ({reason}); free space or choose another place"
        ) from error
    return placed


def _destination(name: str, chosen: Format, out: Path) -> tuple[Path, str, bool]:
    """Folder, name of the main file, and whether the user named that file."""
    if out.is_dir():
        return out, chosen.main, False
    if out.suffix.lower() in chosen.suffixes:
        return out.parent, out.name, True
    known = {suffix for other in FORMATS.values() for suffix in other.suffixes}
    if out.exists() or out.suffix.lower() in known:
        file = f" or a file that ends in {' or '.join(chosen.suffixes)}" if chosen.suffixes else ""
        raise UsageError(f"--out: for {name} want a folder{file}, got the file {out}; choose another name")
    return out, chosen.main, False


def person_file(stem: str, motion: BodyMotion, index: int, suffix: str) -> str:
    """`motion.bvh` for the main person, `motion_<id>.bvh` for others."""
    return f"{stem}{suffix}" if index == 0 else f"{stem}_{motion.person_id}{suffix}"


def _each_person(people: tuple[BodyMotion, ...], main: Path) -> list[tuple[BodyMotion, Path]]:
    """Every person with the file beside `main` that is theirs."""
    return [
        (motion, main.with_name(person_file(main.stem, motion, index, main.suffix)))
        for index, motion in enumerate(people)
    ]


def _write_glb(content: ExportScene, path: Path) -> tuple[Path, ...]:
    from video2anim.export.character import character_of
    from video2anim.export.glb import write_scene_glb

    characters = tuple(character_of(motion) for motion in content.people)
    write_scene_glb(path, characters, content.scene, contacts=content.contacts)
    return (path,)


def _write_objects(content: ExportScene, folder: Path) -> tuple[Path, ...]:
    from video2anim.export.glb import write_object_glb

    objects = () if content.scene is None else content.scene.objects
    written = []
    for placed in objects:
        if len(placed.mesh.faces):
            written.append(folder / "objects" / f"{placed.object_id}.glb")
            written[-1].parent.mkdir(exist_ok=True)
            write_object_glb(written[-1], placed)
    return tuple(written)


def _expect_usd(content: ExportScene, path: Path) -> None:
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise MissingLibraryError(
            "USD files need usd-core, which is not installed; run `pip install usd-core`"
        ) from error


def _write_usd(content: ExportScene, path: Path) -> tuple[Path, ...]:
    from video2anim.export.character import character_of
    from video2anim.export.usd import write_usd

    write_usd(path, tuple(character_of(motion) for motion in content.people), content.scene)
    return (path,)


def _write_bvh(content: ExportScene, path: Path) -> tuple[Path, ...]:
    from video2anim.export.bvh import write_bvh
    from video2anim.export.character import character_of

    files = _each_person(content.people, path)
    for motion, file in files:
        write_bvh(file, character_of(motion))
    return tuple(file for _, file in files)


def _write_amass(content: ExportScene, path: Path) -> tuple[Path, ...]:
    from video2anim.export.amass import write_amass

    smplh = _each_person(content.people, path)
    smplx = _each_person(content.people, path.with_stem(f"{path.stem}_smplx"))
    for motion, file in smplh:
        write_amass(file, motion, "smplh")
    for motion, file in smplx:
        write_amass(file, motion, "smplx")
    return tuple(file for _, file in (*smplh, *smplx))


def _expect_blender(content: ExportScene, path: Path) -> None:
    """Without Blender, make the files that it takes, and say what to type where it is."""
    from video2anim.export.fbx import BLENDER_VARIABLE, blender_command, command_line

    if blender_command() is not None:
        return
    *characters, script = write_format("fbx-ready", content, path.parent)
    files = [file for _, file in _each_person(content.people, path)]
    lines = [command_line(made, script, file) for made, file in zip(characters, files, strict=True)]
    raise MissingLibraryError(
        f"fbx: want Blender, found none; run `{' && '.join(lines)}` where it is, or name a Blender, or a Python that "
        f"has bpy, in {BLENDER_VARIABLE}"
    )


def _write_fbx(content: ExportScene, path: Path) -> tuple[Path, ...]:
    from video2anim.export.fbx import write_fbx

    files = _each_person(content.people, path)
    for motion, file in files:
        write_fbx(file, motion)
    return tuple(file for _, file in files)


def _write_fbx_ready(content: ExportScene, path: Path) -> tuple[Path, ...]:
    from video2anim.export.fbx import write_fbx_ready

    return write_fbx_ready(content.people, path)


FORMATS: dict[str, Format] = {
    "glb": Format("scene.glb", (".glb",), _write_glb, _write_objects),
    "usd": Format("scene.usdc", (".usdc", ".usda", ".usd"), _write_usd, expect_library=_expect_usd),
    "bvh": Format("motion.bvh", (".bvh",), _write_bvh),
    "amass": Format("motion_amass.npz", (".npz",), _write_amass),
    "fbx": Format("motion.fbx", (".fbx",), _write_fbx, expect_library=_expect_blender),
    "fbx-ready": Format("fbx_ready", (), _write_fbx_ready),
}
"""Formats by the name the command line uses."""
