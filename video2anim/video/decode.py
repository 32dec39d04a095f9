"""Streaming decode of any source that FFmpeg reads: upright, square pixels, RGB8, with time stamps.

The header is not relied on: frames are counted as they decode, damage is counted in a `DecodeReport`, and memory does
not grow with the length of the source.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.reformatter import Colorspace, ColorTrc, Interpolation
from jaxtyping import UInt8

from video2anim.errors import InputError, is_memory_shortage
from video2anim.video.container import open_video
from video2anim.video.metadata import focal_35mm_of

_UNSPECIFIED_COLORSPACE = 2
_MAX_SD_HEIGHT_PX = 576
"""Untagged images with a larger short side than standard definition are BT.709, as in video players."""
HDR_TRANSFERS = {int(ColorTrc.SMPTE2084): "PQ", int(ColorTrc.ARIB_STD_B67): "HLG"}
"""Transfer functions of high dynamic range, by their number in ITU-T H.273 table 3."""
Stamps = Literal["pts", "dts"]
"""Which time stamps are used: those of presentation or, where those do not increase, of decoding."""


@dataclass(frozen=True, slots=True)
class SourceHeader:
    """Properties by the container and the first image, before the rest is decoded."""

    codec: str
    pixel_format: str
    stored_width_px: int
    stored_height_px: int
    rotation_deg: int
    """Clockwise quarter turns that make the picture upright: 0, 90, 180 or 270."""
    pixel_aspect: float
    """Width over height of a stored pixel."""
    nominal_fps: float
    """Rate by the container, 0 where it gives none."""
    claimed_frames: int
    """Frames by the container, 0 where it gives none. Frames that an edit list hides are not counted."""
    claimed_s: float
    """Time of the end by the container, 0 where it gives none or gives the number of frames."""
    focal_35mm: float
    """35 mm equivalent focal length from metadata, 0 where absent."""
    hdr: str = ""
    """`PQ` or `HLG` where the pictures are of high dynamic range, else empty."""
    stream_index: int = 0
    """Number of the stream that is read, among all of the container."""
    video_streams: int = 1
    """Video streams of the container, covers not counted."""

    def upright_size_px(self, max_long_side_px: int | None = None) -> tuple[int, int]:
        """Width and height of the upright picture with square pixels, shrunk to `max_long_side_px` where larger.

        Pixels that are not square are stretched along their shorter side. Sizes are as stored unless the image is
        resized; then they are even.
        """
        width, height = float(self.stored_width_px), float(self.stored_height_px)
        if self.pixel_aspect > 1:
            width *= self.pixel_aspect
        else:
            height /= self.pixel_aspect
        scale = 1.0 if max_long_side_px is None else min(1.0, max_long_side_px / max(width, height))
        if scale < 1.0 or self.pixel_aspect != 1.0:
            width, height = (max(2, 2 * round(0.5 * scale * side)) for side in (width, height))
        size = (int(width), int(height))
        return size if self.rotation_deg % 180 == 0 else (size[1], size[0])


@dataclass(slots=True)
class DecodeReport:
    """Counts of a decode; complete once the iterator is exhausted."""

    frames: int = 0
    damaged_packets: int = 0
    damaged_frames: int = 0
    """Pictures that the decoder returned but marked as corrupt."""
    dropped_stamps: int = 0
    """Pictures left out because their time stamp did not advance."""
    faulty_pts: int = 0
    """Presentation times that are not later than the one of the picture before."""
    faulty_dts: int = 0
    """Decode times that are not later than the one of the picture before."""
    stopped_by: str = ""
    """What stopped the decoder before the end of the stream; empty where nothing did."""


@dataclass(frozen=True, slots=True)
class SourcePicture:
    """One decoded picture with its time stamp, converted on demand."""

    time_s: float
    frame: av.VideoFrame
    rotation_deg: int

    def rgb(self, width_px: int, height_px: int) -> UInt8[np.ndarray, "height width 3"]:
        """The upright picture at the given size. High dynamic range is not tone mapped."""
        turned = self.rotation_deg % 180 != 0
        stored_width, stored_height = (height_px, width_px) if turned else (width_px, height_px)
        shrinks = stored_width < self.frame.width or stored_height < self.frame.height
        untagged_hd = (
            self.frame.colorspace == _UNSPECIFIED_COLORSPACE
            and min(self.frame.width, self.frame.height) > _MAX_SD_HEIGHT_PX
        )
        frame = self.frame.reformat(
            width=stored_width,
            height=stored_height,
            format="rgb24",
            src_colorspace=Colorspace.ITU709 if untagged_hd else None,
            interpolation=Interpolation.AREA if shrinks else Interpolation.BICUBIC,
        )
        return np.ascontiguousarray(self._upright(frame.to_ndarray()))

    def luminance(self) -> UInt8[np.ndarray, "height width"]:
        """The upright picture's luminance, in stored pixels."""
        return self._upright(self.frame.reformat(format="gray").to_ndarray())

    def _upright(self, stored: np.ndarray) -> np.ndarray:
        # np.rot90 turns counter-clockwise; rotation_deg is clockwise.
        return np.rot90(stored, k=-self.rotation_deg // 90)


def probe(path: Path) -> SourceHeader:
    """Open `path` and decode its first picture.

    Raises:
        InputError: no regular file, unreadable, not a video, a still image, a playlist, without a video stream, or
            without a single picture that decodes.
    """
    with open_video(path) as container:
        streams = _video_streams(container, path)
        stream = streams[0]
        metadata = {**container.metadata, **stream.metadata}
        try:
            first = next(_pictures(container, stream, DecodeReport()), None)
        except ValueError as error:
            raise InputError(f"{path}: cannot decode {stream.codec_context.name}: {error}") from error
        if first is None:
            raise InputError(f"{path}: want a video, but no picture of its video stream decodes")
        aspect = stream.sample_aspect_ratio
        rate = stream.guessed_rate or stream.average_rate
        return SourceHeader(
            codec=stream.codec_context.name,
            pixel_format=first.format.name,
            stored_width_px=first.width,
            stored_height_px=first.height,
            # FFmpeg's angle is counter-clockwise, -180 to 180.
            rotation_deg=round(-first.rotation / 90) % 4 * 90,
            pixel_aspect=float(aspect) if aspect else 1.0,
            nominal_fps=float(rate) if rate else 0.0,
            claimed_frames=_claimed_frames(container, stream),
            claimed_s=_claimed_s(container, stream),
            focal_35mm=focal_35mm_of(metadata),
            hdr=HDR_TRANSFERS.get(first.color_trc, ""),
            stream_index=stream.index,
            video_streams=len(streams),
        )


def decode(path: Path, header: SourceHeader, report: DecodeReport, stamps: Stamps = "pts") -> Iterator[SourcePicture]:
    """Yield the pictures of `path` in the order in which they are shown, one at a time.

    Damaged packets are skipped and counted. A picture without a time stamp follows its predecessor at the nominal
    rate; one whose stamp does not advance is left out.

    Raises:
        InputError: the file cannot be opened.
    """
    period_s = 1.0 / header.nominal_fps if header.nominal_fps > 0 else 1.0 / 30.0
    last_s = -np.inf
    last_pts = last_dts = None
    with open_video(path) as container:
        stream = _video_streams(container, path)[0]
        for frame in _pictures(container, stream, report):
            report.faulty_pts += _goes_back(last_pts, frame.pts)
            report.faulty_dts += _goes_back(last_dts, frame.dts)
            last_pts, last_dts = frame.pts, frame.dts
            time_s = frame.time if stamps == "pts" else _decode_time_s(frame)
            if time_s is None:
                time_s = last_s + period_s if np.isfinite(last_s) else 0.0
            if time_s <= last_s:
                report.dropped_stamps += 1
                continue
            last_s = time_s
            report.frames += 1
            report.damaged_frames += int(frame.is_corrupt)
            yield SourcePicture(time_s=time_s, frame=frame, rotation_deg=header.rotation_deg)


def _goes_back(before: int | None, stamp: int | None) -> bool:
    return before is not None and stamp is not None and stamp <= before


def _decode_time_s(frame: av.VideoFrame) -> float | None:
    if frame.dts is None or frame.time_base is None:
        return None
    return float(frame.dts * frame.time_base)


def _claimed_frames(container: InputContainer, stream: av.VideoStream) -> int:
    # Only this demuxer has the whole index at once; after it has applied the edit list, which may hide frames.
    if not stream.frames or not container.format.name.startswith("mov"):
        return stream.frames
    shown = sum(not entry.is_discard for entry in stream.index_entries)
    return min(stream.frames, shown)


def _claimed_s(container: InputContainer, stream: av.VideoStream) -> float:
    """Time of the end of the images. Sound may end later, so a file with sound needs a duration of its video stream."""
    if stream.frames:
        return 0.0
    hours, minutes, seconds = (["", "", "", *stream.metadata.get("DURATION", "").split(":")])[-3:]
    with contextlib.suppress(ValueError):  # Matroska's form
        return 3600 * int(hours) + 60 * int(minutes) + float(seconds)
    return (container.duration or 0) / av.time_base if len(container.streams) == 1 else 0.0


def _video_streams(container: InputContainer, path: Path) -> list[av.VideoStream]:
    """The video streams; first the one that the container marks as default, if any."""
    streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
    if not streams:
        kinds = sorted({s.type for s in container.streams} - {"video"})
        if container.streams.video:
            kinds.append("a cover picture")
        raise InputError(f"{path} has no video stream (it holds: {', '.join(kinds) or 'nothing'}); want a video file")
    streams.sort(key=lambda s: not s.disposition & Disposition.default)
    streams[0].thread_type = "AUTO"
    return streams


def _pictures(container: InputContainer, stream: av.VideoStream, report: DecodeReport) -> Iterator[av.VideoFrame]:
    """Decoded frames of the stream. Damage is counted, not raised; a lack of memory is raised."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
        except (FFmpegError, OSError) as error:
            if is_memory_shortage(error):
                raise
            report.stopped_by = getattr(error, "strerror", None) or str(error)
            return
        if packet is None:
            return
        try:
            yield from packet.decode()
        except FFmpegError as error:
            if is_memory_shortage(error):
                raise
            report.damaged_packets += 1
