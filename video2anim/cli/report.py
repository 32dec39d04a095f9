"""Builds the HTML report of a run from the values and manifests of its stages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from video2anim.pipeline.runner import Runner, StageStatus
from video2anim.pipeline.scene_folder import RunRecord
from video2anim.types import (
    BodyMotion,
    BodyTracks,
    CameraEstimate,
    ExportedFiles,
    KeyframedMotion,
    PersonTracks,
    RefinedMotion,
    VideoClip,
)

if TYPE_CHECKING:
    from video2anim.export.report import FoundPerson

MOTIONS = {"raw": BodyTracks, "keyframes": KeyframedMotion, "refined": RefinedMotion}
"""Motions of a run by the name used in options."""


def report_html(runner: Runner, record: RunRecord, rows: Sequence[StageStatus], exported: ExportedFiles) -> str:
    """`report.html` of a folder whose stages are all up to date."""
    from video2anim.export.report import ModelRow, Picture, ReportInput, StageRow, render_report
    from video2anim.networks import find_model
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
        used.update(m.licenses)
    devices = sorted({row.manifest.device for row in rows if row.manifest is not None})
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
            models=tuple(ModelRow(name, license_, find_model(name).source.text) for name, license_ in used.items()),
            camera=runner.value(CameraEstimate),
            motions=motions_of(runner),
            priors=tuple(
                f"{name}, {share:.0%} of the measured frames are others than without it" if name != "none" else "none"
                for name, share in zip(refined.prior, refined.prior_share, strict=True)
            ),
            scene=refined.scene,
            contacts=exported.contacts,
            made_with={"seed": str(record.seed), "device": ", ".join(devices)} | record.versions,
            pictures=tuple(pictures),
            moments=tuple(moments),
            found=found_people(
                runner.value(PersonTracks), runner.value(BodyTracks), runner.value(VideoClip).frame_count
            ),
        )
    )


def motions_of(runner: Runner) -> dict[str, tuple[BodyMotion, ...]]:
    """People of every motion stage, all in the world frame of the scene."""
    motions = {name: runner.value(kind).people for name, kind in MOTIONS.items()}
    T_world_camera = motions["refined"][0].T_world_camera
    return motions | {"raw": tuple(motion.in_world(T_world_camera) for motion in motions["raw"])}


def found_people(tracks: PersonTracks, bodies: BodyTracks, frame_count: int) -> tuple[FoundPerson, ...]:
    """All tracked people with a thumbnail, and for fitted ones whether they are trusted."""
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
