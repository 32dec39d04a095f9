"""Writing of H.264 files of constant frame rate."""

from __future__ import annotations

import errno
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import ColorRange, Colorspace
from jaxtyping import UInt8

from video2anim.errors import InputError, StageError, is_memory_shortage

_BT709 = 1
"""Number of BT.709 in ITU-T H.273 tables 2 to 4 (primaries, transfer and matrix alike)."""


class FrameWriter:
    """Writes RGB frames to an H.264 file of constant rate; a context manager.

    Even sizes are stored as yuv420p, odd ones as yuv444p, which needs no padding. No frame is reordered, so the
    frame number is the time stamp times the rate. Colors are BT.709, limited range, and tagged so.

    >>> with FrameWriter(path, width_px=640, height_px=360) as writer:  # doctest: +SKIP
    ...     writer.write(frame)
    """

    def __init__(
        self,
        path: Path,
        *,
        width_px: int,
        height_px: int,
        fps: int = 30,
        crf: int = 14,
        preset: str = "veryfast",
        threads: int = 1,
    ) -> None:
        """Prepare to write `path`; its folder must exist. The file is made with the first frame.

        Args:
            path: File to make, `.mp4`.
            width_px: Width of every frame.
            height_px: Height of every frame.
            fps: Frames per second.
            crf: x264 quality, lower is better: 14 is visually lossless, 23 suits previews.
            preset: x264 speed preset.
            threads: Encoder threads, 0 = as many as there are cores. With several, x264 may give different bytes for
                the same frames, which would look like an edit of a cached stage.
        """
        self.path = path
        self.frame_count = 0
        self._shape = (height_px, width_px, 3)
        self._pixel_format = "yuv420p" if width_px % 2 == 0 and height_px % 2 == 0 else "yuv444p"
        self._time_base = Fraction(1, fps)
        self._container = av.open(str(path), "w", format="mp4")
        stream = self._container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = width_px, height_px, self._pixel_format
        stream.time_base = self._time_base
        context = stream.codec_context
        # A key frame a second bounds the cost of a seek.
        context.gop_size, context.max_b_frames = fps, 0
        context.thread_count = threads
        context.color_primaries = context.color_trc = context.colorspace = _BT709
        context.color_range = int(ColorRange.MPEG)
        # With the macroblock tree, x264 reads uninitialized memory: the same frames may give different bytes.
        context.options = {"crf": str(crf), "preset": preset, "sc_threshold": "0", "x264-params": "mbtree=0"}
        self._stream = stream

    def write(self, rgb: UInt8[np.ndarray, "height width 3"]) -> None:
        """Append one frame.

        Raises:
            ValueError: its shape or type is not that of the file.
            StageError: the file cannot be made or written.
            InputError: the disk is full.
        """
        if rgb.shape != self._shape or rgb.dtype != np.uint8:
            raise ValueError(f"{self.path}: want uint8 frames {self._shape}, got {rgb.dtype} {rgb.shape}")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        frame = frame.reformat(
            format=self._pixel_format, dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
        )
        frame.pts, frame.time_base = self.frame_count, self._time_base
        try:
            self._container.mux(self._stream.encode(frame))
        except (FFmpegError, OSError) as error:
            raise write_error(self.path, error) from error
        self.frame_count += 1

    def close(self) -> None:
        """Flush and finish the file.

        Raises:
            StageError: the file cannot be written.
            InputError: the disk is full.
        """
        try:
            if self.frame_count:
                self._container.mux(self._stream.encode(None))
            self._container.close()
        except (FFmpegError, OSError) as error:
            raise write_error(self.path, error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
            return
        # The first error is reported; the caller removes the unfinished file.
        try:
            self._container.close()
        except (FFmpegError, OSError) as second:
            assert error is not None
            error.add_note(f"closing {self.path} failed too: {second}")


def write_error(path: Path, error: Exception) -> InputError | StageError | MemoryError:
    """Error to raise where a video cannot be written."""
    if is_memory_shortage(error):
        return MemoryError(f"while writing {path}: {error}")
    if getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT):
        return InputError(f"no space left on device at {path.parent}; free some space or choose another --out")
    return StageError(f"cannot write video {path}: {error}")
