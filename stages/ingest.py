"""Stage ingest: one shot of any video file, at 30 fps, upright, with square pixels, without bars around it.

Two streaming passes, whose memory does not grow with the source: time stamps and cuts, then the chosen shot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from jaxtyping import Float

from video2anim.errors import UsageError
from video2anim.pipeline.options import limits
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import PayloadFile, SourceVideo, VideoClip
from video2anim.types.clip import FPS

if TYPE_CHECKING:
    from video2anim.video.bars import Crop
    from video2anim.video.decode import SourceHeader, Stamps
    from video2anim.video.source_scan import SourceScan


@dataclass(frozen=True)
class IngestConfig:
    """What part of the source becomes the clip, and at what size."""

    max_long_side_px: Annotated[int, limits("px", ge=16, le=16_384)] = 1920
    """Larger pictures are shrunk so that their longer side has this many pixels."""
    shot: Literal["longest"] | Annotated[int, limits(ge=0, le=100_000)] = "longest"
    """`longest`, or the number of the shot to use, counted from 0."""
    start_s: Annotated[float, limits("s", ge=0, le=1_000_000)] = 0.0
    """Seconds after the first picture where to begin."""
    stop_s: Annotated[float, limits("s", gt=0, le=1_000_000)] | None = None
    """Seconds after the first picture where to stop; none for the end."""
    min_frames: Annotated[int, limits("frames", ge=1, le=1_000_000)] = 5
    """Fewest frames at 30 fps that make a clip."""

    def __post_init__(self) -> None:
        if not 0 <= self.start_s < (math.inf if self.stop_s is None else self.stop_s):
            raise UsageError(f"ingest: want 0 <= start_s < stop_s, got {self.start_s} and {self.stop_s}")


def ingest(source: SourceVideo, config: IngestConfig, ctx: StageContext) -> VideoClip:
    """Decode the source, choose a shot, and write it as constant 30 fps H.264 (`video.mp4`).

    Raises:
        InputError: the source is missing, no video, too short, or has no such shot; or the disk is full.
        StageError: the clip cannot be written.
    """
    from video2anim.video.bars import picture_area
    from video2anim.video.decode import probe
    from video2anim.video.shot_choice import chosen_times
    from video2anim.video.source_report import source_info, source_warnings
    from video2anim.video.source_scan import scan_source

    header = probe(source.path)
    total = 2 * header.claimed_frames
    source_scan = scan_source(
        source.path,
        header,
        start_s=config.start_s,
        stop_s=config.stop_s,
        on_picture=lambda done: ctx.progress(min(done, total // 2), total) if total else None,
    )
    shot, shot_time_s, source_time_s = chosen_times(source.path, source_scan, config.shot, min_frames=config.min_frames)
    size_px = header.upright_size_px(config.max_long_side_px)
    area = picture_area(source_scan.shot_margins(shot), size_px)
    path = ctx.work_dir / "video.mp4"
    missing = _write_clip(source.path, header, source_scan.stamps, source_time_s, size_px, area, path, ctx)
    warnings = source_warnings(header, source_scan, shot, shot_time_s, size_px, area)
    if missing:
        warnings.append(f"{missing} images did not decode on the second pass; the ones before are held")
    for text in warnings:
        ctx.warn(text)
    _record_quality(source_scan, source_time_s, ctx)
    return VideoClip(
        video=PayloadFile(path),
        width_px=area.width_px,
        height_px=area.height_px,
        fps=FPS,
        frame_time_s=np.arange(len(source_time_s)) / FPS,
        source_time_s=source_time_s,
        source=source_info(header, source_scan),
        shots_s=source_scan.shots_s(),
        shot_index=shot,
        warnings=tuple(warnings),
    )


def _write_clip(
    source: Path,
    header: SourceHeader,
    stamps: Stamps,
    source_time_s: Float[np.ndarray, "frames"],
    size_px: tuple[int, int],
    area: Crop,
    path: Path,
    ctx: StageContext,
) -> int:
    """Write the clip; how many of its images did not decode again."""
    from video2anim.video.encode import FrameWriter
    from video2anim.video.source_report import frames_at

    count = len(source_time_s)
    missing = 0
    with FrameWriter(path, width_px=area.width_px, height_px=area.height_px, fps=round(FPS)) as writer:
        for index, (rgb, found) in enumerate(frames_at(source, header, stamps, source_time_s, size_px)):
            writer.write(area.of(rgb))
            missing += not found
            ctx.progress(count + index + 1, 2 * count)
    return missing


def _record_quality(source_scan: SourceScan, source_time_s: Float[np.ndarray, "frames"], ctx: StageContext) -> None:
    report = source_scan.report
    ctx.quality("frames", len(source_time_s), "count")
    held_ratio = float(np.mean(np.diff(source_time_s, prepend=-np.inf) == 0))
    ctx.quality("held_frames", held_ratio, "ratio", "lower")
    ctx.quality("damaged_pictures", report.damaged_frames / max(report.frames, 1), "ratio", "lower")


STAGE = StageSpec("ingest", ingest, version=8)
