"""Variations of a motion: mirrored, restyled, faster and slower, at another frame rate, shorter. Pure functions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from scenemi.data.interpolate import blended, cubic_taps, nearest_rows, unit
from scenemi.data.retarget import RetargetedMotion
from video2anim.geometry.rotations import (
    axis_angle_from_matrix,
    continuous_quaternions,
    matrix_from_axis_angle,
    matrix_from_quaternion,
    nearest_rotation,
    quaternion_from_matrix,
)
from video2anim.types.clip import FPS
from video2anim.types.skeleton import JOINT_NAMES, MIRROR_JOINT

MIRROR_QUATERNION: np.ndarray = np.array([1.0, 1.0, -1.0, -1.0], np.float32)
"""Signs of w, x, y, z after reflection in the plane x = 0."""
_MIRROR_AXES = np.array([-1.0, 1.0, 1.0])
STYLE_PARTS: tuple[tuple[str, ...], ...] = (
    ("spine1", "spine2", "spine3"), ("neck", "head"),
    *(tuple(f"{side}_{name}" for name in ("collar", "shoulder", "elbow", "wrist")) for side in ("left", "right")),
)  # fmt: skip
"""Joints that are restyled alike."""
_WIDEST = 1.6
"""A swing grows to this many times its size, or shrinks as much (not measured)."""
_TURNS_BACK_RAD = 2.5
"""Swings that come near half a turn keep their size: beyond it the rotation vector jumps to the other side."""
_POSTURE_RAD = np.deg2rad(5.0)
"""Standard deviation about each axis by which a joint's mean changes: a guess at how much people's postures
differ."""


@dataclass(frozen=True, slots=True)
class WarpConfig:
    """A smooth random speed."""

    slowest: float = 0.8
    """Of the speed, and `fastest` the inverse: people walk at 0.8 to 1.25 times their usual speed (not measured)."""
    fastest: float = 1 / slowest
    longest_wave_frames: float = 600.0
    shortest_wave_frames: float = 120.0
    """Period of the change of speed."""


def mirrored(motion: RetargetedMotion) -> RetargetedMotion:
    """The motion reflected in the plane x = 0 with left and right exchanged."""
    R = motion.R_parent_joint[:, MIRROR_JOINT] * _MIRROR_AXES[:, None] * _MIRROR_AXES
    return replace(
        motion,
        translation_m=motion.translation_m * _MIRROR_AXES,
        R_parent_joint=R,
        contact=motion.contact[:, MIRROR_JOINT],
    )


def restyled(R_parent_joint: Float[np.ndarray, "batch frames 22 3 3"], rng: np.random.Generator) -> np.ndarray:
    """Windows in which trunk, head and arms swing more or less widely, each about another mean.

    Legs and root, which hold the feet in place, stay as they are. Joints have no limits: a few elbows bend backward by
    some degrees.
    """
    R = R_parent_joint.copy()
    for part in STYLE_PARTS:
        joints = [JOINT_NAMES.index(name) for name in part]
        mean = nearest_rotation(R[:, :, joints].mean(1))[:, None]
        swing = axis_angle_from_matrix(np.swapaxes(mean, -1, -2) @ R[:, :, joints])
        size = _WIDEST ** rng.uniform(-1, 1, (len(R), 1, 1, 1))
        widest = np.linalg.norm(swing, axis=-1).max((1, 2))[:, None, None, None]
        size = np.where(widest > _TURNS_BACK_RAD, 1.0, size)
        moved = matrix_from_axis_angle(_POSTURE_RAD * rng.standard_normal((len(R), 1, len(joints), 3)))
        R[:, :, joints] = mean @ moved @ matrix_from_axis_angle(size * swing)
    return R


def random_times(
    rng: np.random.Generator, count: int, frames: int, config: WarpConfig | None = None
) -> Float[np.ndarray, "count frames"]:
    """Source frame (from 0, rising) of each frame of a clip played at a smooth random speed.

    The speed is exp(a + b sin(...)), within [slowest, fastest] for `WarpConfig`.
    """
    config = config or WarpConfig()
    low, high = np.log(config.slowest), np.log(config.fastest)
    mean = rng.uniform(low, high, (count, 1))
    swing = rng.uniform(0.0, 1.0, (count, 1)) * np.minimum(mean - low, high - mean)
    waves = rng.uniform(1 / config.longest_wave_frames, 1 / config.shortest_wave_frames, (count, 1))
    phase = rng.uniform(0.0, 2 * np.pi, (count, 1))
    speed = np.exp(mean + swing * np.sin(2 * np.pi * waves * np.arange(frames - 1) + phase))
    return np.concatenate([np.zeros((count, 1)), np.cumsum(speed, axis=1)], axis=1)


def at_times(motion: RetargetedMotion, position: Float[np.ndarray, "new"]) -> RetargetedMotion:
    """The motion at these (fractional) frames; contacts are those of the nearest frame, ends are held."""
    count = np.full(position.shape, len(motion.translation_m))
    rows, weights = cubic_taps(position, count)
    quaternion = continuous_quaternions(quaternion_from_matrix(motion.R_parent_joint))
    return replace(
        motion,
        translation_m=blended(motion.translation_m, rows, weights),
        R_parent_joint=matrix_from_quaternion(unit(blended(quaternion, rows, weights))),
        contact=motion.contact[nearest_rows(position, count)],
    )


def resampled(motion: RetargetedMotion, fps: float, target_fps: float = FPS) -> RetargetedMotion:
    """The motion at another frame rate; frames are kept as they are where the rates divide.

    Raises:
        ValueError: a frame rate that is not above 0.
    """
    if not fps > 0 or not target_fps > 0:
        raise ValueError(f"resampled: want frame rates above 0, got {fps} and {target_fps}")
    step = fps / target_fps
    count = int(np.floor((len(motion.translation_m) - 1) / step + 1e-6)) + 1
    position = np.arange(count) * step
    if abs(step - round(step)) < 1e-6:
        rows = np.rint(position).astype(np.int64)
        return replace(
            motion,
            translation_m=motion.translation_m[rows],
            R_parent_joint=motion.R_parent_joint[rows],
            contact=motion.contact[rows],
        )
    return at_times(motion, position)


def cropped(motion: RetargetedMotion, start: int, stop: int) -> RetargetedMotion:
    """Frames [start, stop).

    Raises:
        ValueError: no frame is left, or the range is outside the clip.
    """
    if not 0 <= start < stop <= len(motion.translation_m):
        raise ValueError(f"cropped: want 0 <= start < stop <= {len(motion.translation_m)}, got {start}, {stop}")
    return replace(
        motion,
        translation_m=motion.translation_m[start:stop],
        R_parent_joint=motion.R_parent_joint[start:stop],
        contact=motion.contact[start:stop],
    )
