"""Stage 15: the files that other programs open, the preview, and who touches what."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from video2anim.pipeline.options import limits, only_with
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BodyTracks,
    ExportedFiles,
    PayloadFile,
    RefinedMotion,
    SourceVideo,
    VideoClip,
)

STAGE_FORMATS = ("glb", "usd", "bvh", "amass")
"""Formats that every run writes; the others are made on demand by `video2anim export`."""


def _known_formats(names: tuple[str, ...]) -> tuple[str, ...]:
    from video2anim.export.formats import FORMATS

    if set(names) - set(FORMATS):
        raise ValueError(f"a list of {', '.join(FORMATS)}")
    return names


@dataclass(frozen=True)
class ExportConfig:
    """Settings of the stage."""

    formats: Annotated[tuple[str, ...], AfterValidator(_known_formats)] = STAGE_FORMATS
    """Any of `glb`, `usd`, `bvh`, `amass`, `fbx`, `fbx-ready`."""
    preview: bool = True
    """Whether to make `preview.mp4`."""
    preview_height_px: Annotated[int, limits("px", ge=16, le=4320), only_with("preview", True)] = 360
    """Height of the preview's panels."""
    overlay_frames: Annotated[int, limits(ge=0, le=1000)] = 4
    """Still overlays made for the report."""
    worst_moments: bool = True
    """Whether to picture the worst moments of the main person for the report."""


def export_scene(
    source: SourceVideo,
    clip: VideoClip,
    bodies: BodyTracks,
    refined: RefinedMotion,
    config: ExportConfig,
    ctx: StageContext,
) -> ExportedFiles:
    """Write motion, scene, objects, preview and overlay pictures into the stage's folder.

    A format whose library is missing is left out with a warning that names the command to install it.

    Raises:
        InputError: the disk is full or the clip cannot be read.
    """
    from video2anim.artifacts.motion_io import write_motion
    from video2anim.export.formats import ExportScene, MissingLibraryError, person_file, write_format
    from video2anim.scene.contact_graph import scene_contacts

    written: list[Path] = []
    for index, motion in enumerate(refined.people):
        written.append(ctx.work_dir / person_file("motion", motion, index, ".npz"))
        write_motion(written[-1], motion)
    contacts = scene_contacts(refined.people, refined.scene)
    content = ExportScene(refined.people, refined.scene, contacts)
    for name in config.formats:
        try:
            written += write_format(name, content, ctx.work_dir)
        except MissingLibraryError as error:
            ctx.warn(f"{name}: {error}")
    written += _write_pictures(source, clip, refined, config, ctx)
    if config.worst_moments:
        written += _write_worst(clip, bodies, refined, ctx)
    ctx.quality("files", len(written), "count")
    ctx.quality("contacts", len(contacts), "count")
    ctx.quality("size", sum(path.stat().st_size for path in written) / 1e6, "MB")
    return ExportedFiles(tuple(PayloadFile(path) for path in written), contacts)


def _write_pictures(
    source: SourceVideo,
    clip: VideoClip,
    refined: RefinedMotion,
    config: ExportConfig,
    ctx: StageContext,
) -> list[Path]:
    from video2anim.artifacts.images import write_png
    from video2anim.export.preview import overlay_frame, write_preview

    written: list[Path] = []
    if config.preview:
        written.append(ctx.work_dir / "preview.mp4")
        sound_from = source.path if source.path.is_file() else None
        if sound_from is None:
            ctx.warn(f"the preview has no sound: the video is no longer at {source.path}")
        write_preview(
            written[-1], clip, refined.people, refined.scene, config.preview_height_px, ctx.progress,
            sound_from=sound_from,
        )  # fmt: skip
    for frame in _spread(refined.main.valid.nonzero()[0].tolist(), config.overlay_frames):
        written.append(ctx.work_dir / f"overlay_{frame:05d}.png")
        write_png(written[-1], overlay_frame(clip, refined.people, frame))
    return written


def _write_worst(clip: VideoClip, bodies: BodyTracks, refined: RefinedMotion, ctx: StageContext) -> list[Path]:
    from video2anim.artifacts.images import write_png
    from video2anim.export.preview import moment_picture
    from video2anim.export.quality import measured_span, motion_quality, worst_moments

    main = refined.main
    span = measured_span(main)
    if span is None:
        return []
    raw, written = bodies.main.in_world(main.T_world_camera), []
    for moment in worst_moments(motion_quality(main, refined.scene, span, clip.fps), span):
        name = moment.key.replace("_", "-")
        ctx.quality(moment.key, moment.value, moment.unit, "lower")
        written.append(ctx.work_dir / f"worst_{name}_{moment.frame:05d}.png")
        write_png(written[-1], moment_picture(clip, raw, main, refined.scene, moment.frame))
    return written


def _spread(frames: list[int], count: int) -> list[int]:
    """Up to `count` of the frames, evenly spread, ends left out."""
    if not frames or count < 1:
        return []
    steps = [(2 * i + 1) / (2 * count) for i in range(count)]
    return sorted({frames[int(share * len(frames))] for share in steps})


STAGE = StageSpec("export", export_scene, version=10)
