"""The file formats by name, for `video2anim export` and the export stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from video2anim.errors import InputError, UsageError
from video2anim.types import BodyMotion, SceneModel


class MissingLibraryError(UsageError):
    """A format's optional library is not installed (exit code 2)."""


@dataclass(frozen=True, slots=True, eq=False)
class ExportScene:
    """What the writers write."""

    people: tuple[BodyMotion, ...]
    """Main person first."""
    scene: SceneModel | None


def write_format(name: str, content: ExportScene, out_dir: Path) -> tuple[Path, ...]:
    """Write one format into an existing folder.

    Args:
        name: `glb`, `usd`, `bvh`, `amass` or `fbx-ready`.
        content: People and scene.
        out_dir: Folder for the files; files of the same name are replaced.

    Returns:
        The files written, the main one first.

    Raises:
        UsageError: no such format, or nobody to export.
        MissingLibraryError: the format's library is missing; the message names the command that installs it.
        InputError: the folder cannot be written.
    """
    if name not in FORMATS:
        raise UsageError(f"export format: want one of {', '.join(FORMATS)}, got {name!r}")
    if not content.people:
        raise UsageError("export: the scene has no person to export")
    try:
        return FORMATS[name](content, out_dir)
    except OSError as error:
        raise InputError(f"cannot write {name} files to {out_dir}: {error}") from error


def person_file(stem: str, motion: BodyMotion, index: int, suffix: str) -> str:
    """`motion.bvh` for the main person, `motion_<id>.bvh` for others."""
    return f"{stem}{suffix}" if index == 0 else f"{stem}_{motion.person_id}{suffix}"


def _write_glb(content: ExportScene, out_dir: Path) -> tuple[Path, ...]:
    from video2anim.export.character import character_of
    from video2anim.export.glb import write_object_glb, write_scene_glb

    path = out_dir / "scene.glb"
    write_scene_glb(path, tuple(character_of(motion) for motion in content.people), content.scene)
    written = [path]
    if content.scene is not None and content.scene.objects:
        (out_dir / "objects").mkdir(exist_ok=True)
        for placed in content.scene.objects:
            if len(placed.mesh.faces):
                written.append(out_dir / "objects" / f"{placed.object_id}.glb")
                write_object_glb(written[-1], placed)
    return tuple(written)


def _write_usd(content: ExportScene, out_dir: Path) -> tuple[Path, ...]:
    from video2anim.export.character import character_of

    try:
        from video2anim.export.usd import write_usd
    except ImportError as error:
        raise MissingLibraryError(
            "USD files need usd-core, which is not installed; run `pip install usd-core`"
        ) from error
    path = out_dir / "scene.usdc"
    write_usd(path, tuple(character_of(motion) for motion in content.people), content.scene)
    return (path,)


def _write_bvh(content: ExportScene, out_dir: Path) -> tuple[Path, ...]:
    from video2anim.export.bvh import write_bvh
    from video2anim.export.character import character_of

    written = []
    for index, motion in enumerate(content.people):
        written.append(out_dir / person_file("motion", motion, index, ".bvh"))
        write_bvh(written[-1], character_of(motion))
    return tuple(written)


def _write_amass(content: ExportScene, out_dir: Path) -> tuple[Path, ...]:
    from video2anim.export.amass import write_amass

    written = []
    for index, motion in enumerate(content.people):
        written.append(out_dir / person_file("motion_amass", motion, index, ".npz"))
        write_amass(written[-1], motion)
    return tuple(written)


def _write_fbx_ready(content: ExportScene, out_dir: Path) -> tuple[Path, ...]:
    from video2anim.export.fbx_ready import write_fbx_ready

    return write_fbx_ready(content.people, out_dir)


FORMATS: dict[str, Callable[[ExportScene, Path], tuple[Path, ...]]] = {
    "glb": _write_glb,
    "usd": _write_usd,
    "bvh": _write_bvh,
    "amass": _write_amass,
    "fbx-ready": _write_fbx_ready,
}
"""Writers by the name the command line uses."""
