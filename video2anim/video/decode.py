"""Streaming decode of any source FFmpeg reads: upright, square pixels, RGB8, with time stamps.

Nothing here trusts the header: frames are counted as they decode, damage is tallied in a `DecodeReport`, and memory
does not grow with the length of the source.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.reformatter import Colorspace, Interpolation
from jaxtyping import UInt8

from video2anim.errors import InputError
from video2anim.video.metadata import focal_35mm_of

_UNSPECIFIED_COLORSPACE = 2
_LARGEST_SD_HEIGHT_PX = 576
"""Untagged pictures taller than standard definition are BT.709 by the usual convention of players."""


@dataclass(frozen=True, slots=True)
class SourceHeader:
    """What the container and the first picture say, before the rest is decoded."""

    codec: str
    pixel_format: str
    stored_width_px: int
    stored_height_px: int
    rotation_deg: int
    """Clockwise quarter turns that make the picture upright: 0, 90, 180 or 270."""
    pixel_aspect: float
    """Width over height of a stored pixel."""
    nominal_fps: float
    """Rate by the container's word, 0 where it is silent."""
    claimed_frames: int
    """Frames by the container's word, 0 where it is silent."""
    focal_35mm: float
    """35 mm equivalent focal length from metadata, 0 where absent."""

    def upright_size_px(self, max_long_side_px: int | None = None) -> tuple[int, int]:
        """Width and height of the upright picture with square pixels, shrunk to `max_long_side_px` where larger.

        The stored picture is only ever stretched along its squeezed side. Sizes are as stored unless the picture is
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
    """Tally of a decode as it goes; complete once the iterator is exhausted."""

    frames: int = 0
    damaged_packets: int = 0
    damaged_frames: int = 0
    """Pictures that the decoder returned but marked as corrupt."""
    dropped_stamps: int = 0
    """Pictures left out because their time stamp did not advance."""
    stopped_by: str = ""
    """What ended the stream before its end, empty where nothing did."""


@dataclass(frozen=True, slots=True)
class SourcePicture:
    """One decoded picture with its time stamp, converted on demand."""

    time_s: float
    frame: av.VideoFrame
    rotation_deg: int

    def rgb(self, width_px: int, height_px: int) -> UInt8[np.ndarray, "height width 3"]:
        """The upright picture at the given size."""
        turned = self.rotation_deg % 180 != 0
        stored_width, stored_height = (height_px, width_px) if turned else (width_px, height_px)
        shrinks = stored_width < self.frame.width or stored_height < self.frame.height
        untagged_hd = (
            self.frame.colorspace == _UNSPECIFIED_COLORSPACE
            and min(self.frame.width, self.frame.height) > _LARGEST_SD_HEIGHT_PX
        )
        frame = self.frame.reformat(
            width=stored_width,
            height=stored_height,
            format="rgb24",
            src_colorspace=Colorspace.ITU709 if untagged_hd else None,
            interpolation=Interpolation.AREA if shrinks else Interpolation.BICUBIC,
        )
        # np.rot90 turns counter-clockwise; rotation_deg is clockwise.
        return np.ascontiguousarray(np.rot90(frame.to_ndarray(), k=-self.rotation_deg // 90))


def probe(path: Path) -> SourceHeader:
    """Open `path` and decode its first picture.

    Raises:
        InputError: missing, a directory, unreadable, not a video, a still image, without a video stream, or without
            a single picture that decodes.
    """
    with _open(path) as container:
        stream = _video_stream(container, path)
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
            claimed_frames=stream.frames,
            focal_35mm=focal_35mm_of(metadata),
        )


def decode(path: Path, header: SourceHeader, report: DecodeReport) -> Iterator[SourcePicture]:
    """Yield the pictures of `path` in the order of their time stamps, one at a time.

    Damaged packets are skipped and counted. A picture without a time stamp follows its predecessor at the nominal
    rate; one whose stamp does not advance is left out.

    Raises:
        InputError: the file cannot be opened.
    """
    period_s = 1.0 / header.nominal_fps if header.nominal_fps > 0 else 1.0 / 30.0
    last_s = -np.inf
    with _open(path) as container:
        stream = _video_stream(container, path)
        for frame in _pictures(container, stream, report):
            time_s = frame.time
            if time_s is None:
                time_s = last_s + period_s if np.isfinite(last_s) else 0.0
            if time_s <= last_s:
                report.dropped_stamps += 1
                continue
            last_s = time_s
            report.frames += 1
            report.damaged_frames += int(frame.is_corrupt)
            yield SourcePicture(time_s=time_s, frame=frame, rotation_deg=header.rotation_deg)


def _open(path: Path) -> InputContainer:
    if path.is_dir():
        raise InputError(f"{path} is a directory; want a video file")
    if not path.exists():
        raise InputError(f"no such file: {path}")
    try:
        if path.stat().st_size == 0 and path.is_file():
            raise InputError(f"{path} is empty (0 bytes); want a video file")
        return av.open(str(path))
    except PermissionError as error:
        raise InputError(f"{path} cannot be read: permission denied") from error
    except (FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path} is not a readable video, or it is cut off before its index ({reason})") from error


def _video_stream(container: InputContainer, path: Path) -> av.VideoStream:
    streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
    if not streams:
        kinds = ", ".join(sorted({s.type for s in container.streams})) or "nothing"
        raise InputError(f"{path} has no video stream (it holds: {kinds}); want a video file")
    if container.format.name.endswith("_pipe") or container.format.name in {"image2", "ico"}:
        raise InputError(f"{path} is a still image ({container.format.name}); want a video file")
    streams[0].thread_type = "AUTO"
    return streams[0]


def _pictures(container: InputContainer, stream: av.VideoStream, report: DecodeReport) -> Iterator[av.VideoFrame]:
    """Decoded frames of the stream; damage is counted, never raised."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
        except (FFmpegError, OSError) as error:
            report.stopped_by = getattr(error, "strerror", None) or str(error)
            return
        if packet is None:
            return
        try:
            yield from packet.decode()
        except FFmpegError:
            report.damaged_packets += 1
