"""Stage ingest: any video file becomes one shot at 30 fps, upright, with square pixels.

Two streaming passes: the first notes time stamps and cuts, the second writes the chosen shot. Memory does not grow
with the length of the source.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from jaxtyping import Float

from video2anim.errors import InputError, StageError, UsageError
from video2anim.pipeline.options import limits
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import PayloadFile, SourceInfo, SourceVideo, VideoClip

if TYPE_CHECKING:
    from video2anim.video.decode import SourceHeader, Stamps
    from video2anim.video.source_scan import SourceScan

FPS = 30
"""Frame rate of every clip; all later stages count on it."""
_LOW_FPS = 20.0
_SMALL_SIDE_PX = 240
_LONG_HOLE_S = 0.25
_CUT_OFF_S = 0.5
"""Seconds by which the header may be wrong about the end."""
_MAX_FRAMES_PER_PICTURE = 15
"""Fewer than 2 pictures a second, on average, are no film: nearly every frame would repeat the one before."""
_MOTION_SAMPLES = 20
_MOTION_STEP = 8
"""The static-camera test looks at every such frame, but at most at `_MOTION_SAMPLES` spread over the clip."""


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
    from video2anim.camera.background_registration import STATIC_DRIFT_RATIO
    from video2anim.video.cfr import constant_rate_index
    from video2anim.video.decode import probe
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
    if len(source_scan.time_s) == 0:
        raise InputError(
            f"{source.path}: no picture between start_s={config.start_s} and stop_s={config.stop_s}; "
            f"{source_scan.report.frames} pictures decode in all"
        )
    shot = _choose_shot(source.path, source_scan, config)
    shot_time_s = source_scan.shot_time_s(shot)
    source_time_s = shot_time_s[constant_rate_index(shot_time_s, FPS)]
    if len(source_time_s) < config.min_frames:
        raise InputError(
            f"{source.path}: want at least {config.min_frames} frames at {FPS} fps "
            f"({config.min_frames / FPS:.2f} s), got {len(source_time_s)} from {len(shot_time_s)} decoded pictures"
        )
    if len(source_time_s) > _MAX_FRAMES_PER_PICTURE * len(shot_time_s):
        raise InputError(
            f"{source.path}: want a film of at least {FPS / _MAX_FRAMES_PER_PICTURE:.0f} pictures a second, got "
            f"{len(shot_time_s)} pictures in {len(source_time_s) / FPS:.0f} s; choose a denser part with "
            "--set ingest.start_s=S --set ingest.stop_s=S, or another shot with --set ingest.shot=N "
            f"(of {len(source_scan.shot_start)})"
        )
    size_px = header.upright_size_px(config.max_long_side_px)
    path = ctx.work_dir / "video.mp4"
    written = _write_clip(source.path, header, source_scan.stamps, source_time_s, size_px, path, ctx)
    drift = written.drift_ratio
    warnings = _warnings(header, source_scan, shot, shot_time_s, size_px)
    if written.missing_frames:
        warnings.append(f"{written.missing_frames} pictures did not decode a second time; the ones before are held")
    if math.isnan(drift):
        warnings.append("cannot tell whether the camera moves: too little background texture; taken as static")
    elif drift > STATIC_DRIFT_RATIO:
        warnings.append(
            f"the camera moves: the background drifts by {100 * drift:.1f} % of the picture's width "
            f"(static means below {100 * STATIC_DRIFT_RATIO:.1f} %); scene and motion will be less accurate"
        )
    for text in warnings:
        ctx.warn(text)
    _record_quality(source_scan, source_time_s, drift, ctx)
    return VideoClip(
        video=PayloadFile(path),
        width_px=size_px[0],
        height_px=size_px[1],
        fps=float(FPS),
        frame_time_s=np.arange(len(source_time_s)) / FPS,
        source_time_s=source_time_s,
        source=_source_info(header, source_scan),
        shots_s=source_scan.shots_s(),
        shot_index=shot,
        camera_is_static=not drift > STATIC_DRIFT_RATIO,
        camera_drift_ratio=drift,
        warnings=tuple(warnings),
    )


@dataclass(frozen=True, slots=True)
class _Written:
    drift_ratio: float
    missing_frames: int


def _choose_shot(path: Path, source_scan: SourceScan, config: IngestConfig) -> int:
    spans_s = source_scan.shots_s()
    if config.shot == "longest":
        return int(np.argmax([end_s - start_s for start_s, end_s in spans_s]))
    if int(config.shot) >= len(spans_s):
        raise InputError(f"{path}: no shot {config.shot}; {len(spans_s)} found, counted from 0")
    return int(config.shot)


def _frames(
    path: Path,
    header: SourceHeader,
    stamps: Stamps,
    wanted_s: Float[np.ndarray, "frames"],
    size_px: tuple[int, int],
) -> Iterator[tuple[np.ndarray, bool]]:
    """One RGB picture per wanted time stamp, and whether it is the right one.

    Where the decoder, on damaged input, does not return a picture that it returned before, the last one is held.
    """
    from video2anim.video.decode import DecodeReport, decode

    position = 0
    held: np.ndarray | None = None
    for picture in decode(path, header, DecodeReport(), stamps):
        if picture.time_s < wanted_s[position]:
            continue
        rgb: np.ndarray | None = None
        while position < len(wanted_s) and wanted_s[position] <= picture.time_s:
            found = wanted_s[position] == picture.time_s
            if rgb is None and (found or held is None):
                rgb = picture.rgb(*size_px)
            held = rgb if rgb is not None else held
            assert held is not None
            yield held, bool(found)
            position += 1
        if position == len(wanted_s):
            return
    if held is None:
        raise StageError(f"{path}: pictures decoded on the first pass but not on the second; is the file changing?")
    for _ in range(len(wanted_s) - position):
        yield held, False


def _write_clip(
    source: Path,
    header: SourceHeader,
    stamps: Stamps,
    source_time_s: Float[np.ndarray, "frames"],
    size_px: tuple[int, int],
    path: Path,
    ctx: StageContext,
) -> _Written:
    from video2anim.camera.background_registration import CameraMotion
    from video2anim.video.encode import FrameWriter

    count = len(source_time_s)
    samples = min(_MOTION_SAMPLES, max(1, count // _MOTION_STEP))
    sampled = set(np.linspace(0, count - 1, samples + 1).round().astype(int).tolist())
    motion = CameraMotion()
    missing = 0
    with FrameWriter(path, width_px=size_px[0], height_px=size_px[1], fps=FPS) as writer:
        for index, (rgb, found) in enumerate(_frames(source, header, stamps, source_time_s, size_px)):
            writer.write(rgb)
            missing += not found
            if index in sampled:
                motion.add(rgb)
            ctx.progress(count + index + 1, 2 * count)
    return _Written(motion.drift_ratio, missing)


def _warnings(
    header: SourceHeader,
    source_scan: SourceScan,
    shot: int,
    shot_time_s: Float[np.ndarray, "shot_pictures"],
    size_px: tuple[int, int],
) -> list[str]:
    from video2anim.video.cfr import max_gap_s

    texts = []
    shots_s, report = source_scan.shots_s(), source_scan.report
    if len(shots_s) > 1:
        start_s, end_s = shots_s[shot]
        texts.append(
            f"{len(shots_s)} shots found; shot {shot} ({start_s:.2f} to {end_s:.2f} s) is used, "
            f"--set ingest.shot=N (0 to {len(shots_s) - 1}) chooses another"
        )
    if header.video_streams > 1:
        texts.append(
            f"{header.video_streams} video streams found; stream {header.stream_index} is used, the one marked as "
            "default, else the first; for another, copy it to a file of its own"
        )
    if header.hdr:
        texts.append(
            f"high dynamic range ({header.hdr}), shown as it is: dark and pale to detectors and in textures; "
            "convert the video to standard range (BT.709) before for true colors"
        )
    if source_scan.stamps == "dts":
        texts.append("the file's presentation times go back and forth; decode order and decode times are used")
    if source_scan.reached_end and header.claimed_frames > report.frames:
        texts.append(
            f"the header claims {header.claimed_frames} frames, {report.frames} decode: the file is cut off or damaged"
        )
    end_s = source_scan.time_s[-1] + source_scan.period_s
    if source_scan.reached_end and header.claimed_s > end_s + _CUT_OFF_S:
        texts.append(
            f"the header claims {header.claimed_s:.2f} s, the pictures end at {end_s:.2f} s: the file is cut off or "
            "damaged"
        )
    if report.damaged_packets or report.damaged_frames or report.stopped_by:
        stopped = f"; decoding stopped early: {report.stopped_by}" if report.stopped_by else ""
        texts.append(
            f"damaged data: {report.damaged_packets} packets did not decode, "
            f"{report.damaged_frames} pictures are marked corrupt{stopped}"
        )
    if report.dropped_stamps:
        texts.append(f"{report.dropped_stamps} pictures left out: their time stamps do not advance")
    if len(shot_time_s) > 1:
        fps = 1.0 / float(np.median(np.diff(shot_time_s)))
        if fps < _LOW_FPS:
            texts.append(f"low frame rate: {fps:.1f} fps (want {_LOW_FPS:.0f} or more); fast motion will be lost")
        elif max_gap_s(shot_time_s) > _LONG_HOLE_S:
            texts.append(f"the source shows nothing new for {max_gap_s(shot_time_s):.2f} s; the picture is held")
    if min(size_px) < _SMALL_SIDE_PX:
        texts.append(
            f"small picture: {size_px[0]}x{size_px[1]} px (want a short side of {_SMALL_SIDE_PX} or more); "
            "people will be found less reliably"
        )
    return texts


def _source_info(header: SourceHeader, source_scan: SourceScan) -> SourceInfo:
    time_s = source_scan.time_s
    span_s = float(time_s[-1] - time_s[0])
    return SourceInfo(
        codec=header.codec,
        pixel_format=header.pixel_format,
        stored_width_px=header.stored_width_px,
        stored_height_px=header.stored_height_px,
        rotation_deg=header.rotation_deg,
        pixel_aspect=header.pixel_aspect,
        average_fps=(len(time_s) - 1) / span_s if span_s > 0 else header.nominal_fps,
        decoded_frames=source_scan.report.frames,
        claimed_frames=header.claimed_frames,
        duration_s=span_s + source_scan.period_s,
        focal_35mm=header.focal_35mm,
    )


def _record_quality(
    source_scan: SourceScan, source_time_s: Float[np.ndarray, "frames"], drift_ratio: float, ctx: StageContext
) -> None:
    report = source_scan.report
    ctx.quality("frames", len(source_time_s), "count")
    held_ratio = float(np.mean(np.diff(source_time_s, prepend=-np.inf) == 0))
    ctx.quality("held_frames", held_ratio, "ratio", "lower")
    ctx.quality("damaged_pictures", report.damaged_frames / max(report.frames, 1), "ratio", "lower")
    ctx.quality("camera_drift", drift_ratio, "ratio")


STAGE = StageSpec("ingest", ingest, version=3)
