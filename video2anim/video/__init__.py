"""Pictures in time: decoding any source, our own constant-rate clips, shots, and camera motion."""

from video2anim.video.encode import FrameWriter
from video2anim.video.read import read_frame, read_frames

__all__ = ["FrameWriter", "read_frame", "read_frames"]
