"""Random access to the pictures of an ingested clip."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from av.error import FFmpegError
from jaxtyping import UInt8

from video2anim.errors import InputError, is_memory_shortage
from video2anim.types.clip import VideoClip
from video2anim.video.container import open_video


def read_frames(
    clip: VideoClip, start: int = 0, stop: int | None = None, step: int = 1
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield frames `start, start + step, ...` below `stop` of the clip as RGB, frame-exact.

    The video is our own (`FrameWriter`): constant rate, a key frame every second, no reordering. One frame is
    held at a time.

    Args:
        clip: The clip; frame numbers are those of `clip.frame_time_s`.
        start: First frame, 0 or more.
        stop: One past the last frame; None or anything beyond the end means the end.
        step: Distance between frames, 1 or more.

    Raises:
        ValueError: `start` or `step` is out of range.
        InputError: the video is missing, unreadable, or holds fewer frames than the clip says.
    """
    if start < 0 or step < 1:
        raise ValueError(f"read_frames: want start >= 0 and step >= 1, got start={start}, step={step}")
    end = clip.frame_count if stop is None else min(stop, clip.frame_count)
    return _read(clip, range(start, end, step))


def read_frame(clip: VideoClip, index: int) -> UInt8[np.ndarray, "height width 3"]:
    """One frame of the clip as RGB.

    Raises:
        IndexError: there is no such frame.
        InputError: the video is missing or damaged.
    """
    if not 0 <= index < clip.frame_count:
        raise IndexError(f"frame {index} of a clip with {clip.frame_count} frames")
    return next(read_frames(clip, index, index + 1))


def _read(clip: VideoClip, wanted: range) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    if not wanted:
        return
    position = 0
    try:
        with open_video(clip.video.path) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            assert stream.time_base is not None
            if wanted[0]:
                # The key frame at or before the middle of the picture before, so that rounding never lands after it.
                target = int(wanted[0] / clip.fps / stream.time_base)
                container.seek(target, stream=stream, backward=True)
            for frame in container.decode(stream):
                index = round(frame.time * clip.fps)
                if index < wanted[position]:
                    continue
                if index > wanted[position]:
                    break
                yield frame.to_ndarray(format="rgb24")
                position += 1
                if position == len(wanted):
                    return
    except (FFmpegError, IndexError, InputError) as error:
        if is_memory_shortage(error):
            raise
        raise InputError(f"cannot read the clip's video {clip.video.path}: {error}; run ingest again") from error
    raise InputError(
        f"want frame {wanted[position]} of {clip.video.path}, but it is not there "
        f"(the clip has {clip.frame_count} frames); run ingest again"
    )
