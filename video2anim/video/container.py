"""Opening of video files: regular files of a list of container formats, none of which opens other files."""

from __future__ import annotations

import re
import stat
from contextlib import suppress
from pathlib import Path

import av
import av.logging
from av.container import InputContainer
from av.error import ArgumentError, FFmpegError

from video2anim.errors import InputError, is_memory_shortage

CONTAINER_FORMATS = (
    "mov,matroska,avi,mpegts,mpeg,mpegvideo,asf,flv,live_flv,kux,ogg,rm,mxf,gxf,wtv,nut,nsv,nuv,dv,ivf,obu,"
    "h261,h263,h264,hevc,vvc,evc,av1,m4v,vc1,vc1test,cavsvideo,avs2,avs3,dirac,dnxhd,"
    "mjpeg,mjpeg_2000,mpjpeg,smjpeg,gif,apng,jpegxl_anim,yuv4mpegpipe,swf,flic,roq,r3d,cine,dhav,lmlm4"
)
"""FFmpeg's names of the formats that are read. Each reads the bytes of its own file only: playlists (hls, dash,
concat), numbered picture sequences (image2), session descriptions and capture devices are not here, because they
open files or addresses that no digest of the input covers."""
_WANTED = "want a video file such as MP4, MOV, MKV, WebM or AVI"
_ADDRESS = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+:/")
"""An address such as `https:/...` (a `Path` keeps one slash); drive letters are single."""


def expect_video_file(path: Path) -> None:
    """Check that `path` is a regular file that is not empty, without opening it.

    Opening a FIFO would block, and a device may never end.

    Raises:
        InputError: missing, an address, a folder, empty, or no regular file.
    """
    try:
        found = path.stat()
    except OSError as error:
        if _ADDRESS.match(str(path)):
            address = str(path).replace(":/", "://", 1)
            raise InputError(
                f"input: want a video file on this machine, got the address {address}; download it first"
            ) from error
        if isinstance(error, (FileNotFoundError, NotADirectoryError)):
            raise InputError(f"input: want a video file, found nothing at {path}") from error
        raise InputError(f"input: want a readable file, got {error.strerror} at {path}") from error
    if stat.S_ISDIR(found.st_mode):
        raise InputError(f"input: want a video file, got a folder at {path}")
    if not stat.S_ISREG(found.st_mode):
        kind = "a pipe" if stat.S_ISFIFO(found.st_mode) else "a device or socket"
        raise InputError(f"input: want a regular video file, got {kind} at {path}; save the video to a file first")
    if found.st_size == 0:
        raise InputError(f"input: want a video file, got an empty one (0 bytes) at {path}")


def open_video(path: Path) -> InputContainer:
    """Open a video file for reading; the caller closes it.

    Raises:
        InputError: no regular file, unreadable, damaged, or of a format that is not in `CONTAINER_FORMATS`.
    """
    expect_video_file(path)
    try:
        return _open(path)
    except PermissionError as error:
        raise InputError(f"{path} cannot be read: permission denied") from error
    except (FFmpegError, OSError, ValueError) as error:
        if is_memory_shortage(error):
            raise
        refused = _refused_format(path) if isinstance(error, ArgumentError) else ""
        if refused in {"image2", "ico"} or refused.endswith("_pipe"):
            raise InputError(f"{path} is a still image ({refused}); want a video file") from error
        if refused:
            raise InputError(
                f"{path} is of the format '{refused}'; {_WANTED} (a playlist or other file that names further files "
                "is not read: give the video itself)"
            ) from error
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path} is not a readable video, or it is cut off before its index ({reason})") from error


def _open(path: Path) -> InputContainer:
    # An absolute path is never taken for an address (`concat:a|b`).
    options = {"format_whitelist": CONTAINER_FORMATS, "protocol_whitelist": "file"}
    return av.open(str(path.absolute()), options=options)


def _refused_format(path: Path) -> str:
    """FFmpeg's name of the format of a file that `_open` refuses; empty if it is refused for another reason."""
    before = av.logging.get_level(), av.logging.get_skip_repeated()
    # FFmpeg names the format in its log only, which is off otherwise; repeated lines must not be suppressed.
    av.logging.set_level(av.logging.ERROR)
    av.logging.set_skip_repeated(False)
    try:
        with av.logging.Capture() as logs, suppress(FFmpegError):
            _open(path).close()
    finally:
        av.logging.set_level(before[0])
        av.logging.set_skip_repeated(before[1])
    return next((name for _, name, text in logs if "not on whitelist" in text), "")
