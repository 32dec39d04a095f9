"""Video files: decoding of any source, reading and writing of constant-rate clips, detection of shots."""

from video2anim.video.encode import FrameWriter
from video2anim.video.read import read_frame, read_frames

__all__ = ["FrameWriter", "read_frame", "read_frames"]
