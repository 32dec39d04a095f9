"""Motion blur of a moving camera: the image averaged along the optical flow while the shutter is open."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from video2anim.lab.synth.render.lens import project_distorted
from video2anim.lab.synth.render.view import Eye
from video2anim.lab.synth.world import NEAR_M

_STEPS = 5
_STILL_PX = 0.4


def shutter_shifts(shutter_frames: float, steps: int = _STEPS) -> list[float]:
    """Evenly spaced times within the shutter time, in frames from its center."""
    return [shutter_frames * ((step + 0.5) / steps - 0.5) for step in range(steps)]


def steps_for(path_px: float) -> int:
    """Number of samples in time for objects that move this far while the shutter is open; odd, 1 if not visible."""
    return 1 if path_px < _STILL_PX else int(min(3 + 2 * (path_px > 5), 5))


def camera_blur(
    radiance: Float[np.ndarray, "height width 3"],
    position_m: Float[np.ndarray, "height width 3"],
    before: Eye,
    after: Eye,
    frames_apart: float,
    shutter_frames: float,
) -> Float[np.ndarray, "height width 3"]:
    """Average the image along the optical flow caused by the camera's motion from one pose to another.

    Args:
        radiance: Linear radiance, before the tone curve.
        position_m: World points that the pixels show.
        before: Earlier camera.
        after: Later camera.
        frames_apart: Time between the two poses, in frames.
        shutter_frames: Time that the shutter is open, in frames.
    """
    flow = (_seen_at(position_m, after) - _seen_at(position_m, before)) / max(frames_apart, 1e-9)
    path = flow * shutter_frames
    if float(np.percentile(np.abs(path), 95)) < _STILL_PX:
        return radiance
    height, width = radiance.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    shifts: Sequence[float] = shutter_shifts(shutter_frames)
    total = np.zeros_like(radiance)
    for shift in shifts:
        at_x, at_y = x - shift * flow[..., 0], y - shift * flow[..., 1]
        total += cv2.remap(radiance, at_x, at_y, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    return total / len(shifts)


def _seen_at(position_m: np.ndarray, eye: Eye) -> Float[np.ndarray, "height width 2"]:
    camera = (position_m - eye.T_world_camera[:3, 3]) @ eye.T_world_camera[:3, :3]
    camera[..., 2] = np.maximum(camera[..., 2], NEAR_M)
    return project_distorted(camera, eye.intrinsics, eye.k1, eye.k2).astype(np.float32)
