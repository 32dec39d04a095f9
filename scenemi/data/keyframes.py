"""Keyframes as a user gives them: checked, at whole frames, on one body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from scenemi.data.plain_files import MAX_FRAMES
from scenemi.longmotion import KeyframeMotion
from scenemi.scene.scene_parts import MAX_SCENE_M
from scenemi.windows import select_keyframes
from video2anim.errors import InputError
from video2anim.geometry.rotations import nearest_rotation
from video2anim.types.clip import FPS
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import JOINT_NAMES

JOINTS = len(JOINT_NAMES)
_ROTATION_TOLERANCE = 0.02
"""Largest entry of R^T R - I that is taken for rounding and repaired; more is no rotation."""
_BODY_HEIGHT_M = (0.3, 3.0)
"""Extent of a T-pose from top to bottom joint that a person can have."""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframes:
    """Poses at some frames of a motion at 30 fps; world +Y up, floor y = 0, meters."""

    frame_index: Int[np.ndarray, "keyframes"]
    """Ascending, from 0."""
    R_parent_joint: Float[np.ndarray, "keyframes 22 3 3"]
    translation_m: Float[np.ndarray, "keyframes 3"]
    """Of the root transform; `rest_joints_m[0]` is the origin."""
    rest_joints_m: Float[np.ndarray, "22 3"]
    shape: BodyShape
    """Body whose skin is used; its joints are `rest_joints_m`."""

    @property
    def frame_count(self) -> int:
        """Up to and including the last keyframe."""
        return int(self.frame_index[-1]) + 1

    def to_motion(self, length: int | None = None) -> KeyframeMotion:
        """Rows for all frames; those without a keyframe hold identity and mean nothing.

        Raises:
            InputError: `length` frames leave keyframes out.
        """
        frames = self.frame_count if length is None else length
        if frames < self.frame_count:
            raise InputError(
                f"keyframes: the last one is at frame {self.frame_count - 1}, outside the {frames} frames asked for; "
                f"give a length of at least {self.frame_count}, or leave such keyframes out"
            )
        R_parent_joint = np.tile(np.eye(3), (frames, JOINTS, 1, 1))
        translation_m = np.zeros((frames, 3))
        is_keyframe = np.zeros(frames, bool)
        R_parent_joint[self.frame_index] = self.R_parent_joint
        translation_m[self.frame_index] = self.translation_m
        is_keyframe[self.frame_index] = True
        return KeyframeMotion(R_parent_joint, translation_m, is_keyframe, self.rest_joints_m, FPS)

    def every(self, interval: int, length: int | None = None) -> Keyframes:
        """Of poses at every frame, those at an interval (and the last); `length` cuts the motion first.

        Raises:
            InputError: fewer than `length` frames.
        """
        if length is not None and length > self.frame_count:
            raise InputError(f"motion: want {length} frames, it has {self.frame_count}; give a smaller length")
        kept = self.frame_index < (length or self.frame_count)
        frames = self.frame_index[kept]
        usable = np.zeros(int(frames[-1]) + 1, bool)
        usable[frames] = True
        return self.at(select_keyframes(len(usable), interval, usable=usable))

    def at(self, frames: Int[np.ndarray, "chosen"]) -> Keyframes:
        """Only those at some of its frames."""
        chosen = np.searchsorted(self.frame_index, frames)
        return Keyframes(
            frames, self.R_parent_joint[chosen], self.translation_m[chosen], self.rest_joints_m, self.shape
        )


def checked_keyframes(
    where: str,
    frame_index: np.ndarray,
    R_parent_joint: np.ndarray,
    translation_m: np.ndarray,
    rest_joints_m: np.ndarray,
    shape: BodyShape,
    *,
    valid: np.ndarray | None = None,
) -> Keyframes:
    """Keyframes in order, rotations made exact.

    A rest skeleton whose pelvis is not its origin is moved there, and the translation with it.

    Args:
        where: of what the errors speak.
        frame_index: (K,) frames of the keyframes.
        R_parent_joint: (K, 22, 3, 3) local rotations.
        translation_m: (K, 3) of the root.
        rest_joints_m: (22, 3) of the body.
        shape: of the body.
        valid: (K,) which rows are used; None = all.

    Raises:
        InputError: wrong joint count or shapes, NaN, matrices that are no rotations, frames that are negative, not
            whole, given twice or beyond an hour, fewer than two keyframes, or a body of impossible size (often other
            units).
    """
    frame_index, R_parent_joint = np.asarray(frame_index), np.asarray(R_parent_joint, np.float64)
    translation_m, rest_joints_m = np.asarray(translation_m, np.float64), np.asarray(rest_joints_m, np.float64)
    _expect_shapes(where, frame_index, R_parent_joint, translation_m, rest_joints_m)
    if valid is not None:
        if valid.shape != frame_index.shape:
            raise InputError(f"{where}: valid wants shape {frame_index.shape}, got {valid.shape}")
        used = valid.astype(bool)
        frame_index, R_parent_joint, translation_m = frame_index[used], R_parent_joint[used], translation_m[used]
    if len(R_parent_joint) < 2:
        raise InputError(
            f"{where}: want at least 2 keyframes, got {len(R_parent_joint)}; give the pose at another frame too"
        )
    frames = _whole_frames(where, frame_index)
    finite = np.isfinite(R_parent_joint).all((1, 2, 3)) & np.isfinite(translation_m).all(1)
    if not finite.all():
        raise InputError(f"{where}: keyframe {frames[~finite][0]} holds NaN or infinity; leave it out or repair it")
    _expect_meters(where, translation_m, rest_joints_m)
    order = np.argsort(frames)
    return Keyframes(
        frames[order],
        _exact_rotations(where, R_parent_joint, frames)[order],
        (translation_m + rest_joints_m[0])[order],
        rest_joints_m - rest_joints_m[0],
        shape,
    )


def _expect_shapes(
    where: str, frame_index: np.ndarray, R: np.ndarray, translation_m: np.ndarray, rest_joints_m: np.ndarray
) -> None:
    if R.ndim == 4 and R.shape[1] != JOINTS:
        raise InputError(f"{where}: want rotations of the {JOINTS} SMPL joints, got {R.shape[1]} joints")
    wanted = ((len(R), JOINTS, 3, 3), (len(R), 3), (len(R),), (JOINTS, 3))
    got = (R.shape, translation_m.shape, frame_index.shape, rest_joints_m.shape)
    names = ("R_parent_joint", "translation_m", "frame_index", "rest_joints_m")
    for name, want, have in zip(names, wanted, got, strict=True):
        if want != have:
            raise InputError(f"{where}: {name} wants shape {want}, got {have}")


def _expect_meters(where: str, translation_m: np.ndarray, rest_joints_m: np.ndarray) -> None:
    if not np.isfinite(rest_joints_m).all():
        raise InputError(f"{where}: rest_joints_m holds NaN or infinity")
    with np.errstate(over="ignore"):
        body_height_m = float(np.ptp(rest_joints_m[:, 1]))
    farthest_m = max(np.abs(a).max() for a in (translation_m, rest_joints_m))
    if not _BODY_HEIGHT_M[0] < body_height_m < _BODY_HEIGHT_M[1] or farthest_m > MAX_SCENE_M:
        raise InputError(
            f"{where}: want meters and +Y up, got a skeleton {body_height_m:.2f} high and roots up to "
            f"{np.abs(translation_m).max():.1f} from the origin"
        )


def _whole_frames(where: str, frame_index: np.ndarray) -> Int[np.ndarray, "keyframes"]:
    if frame_index.dtype.kind not in "iuf" or not np.isfinite(frame_index).all():
        raise InputError(f"{where}: frame_index wants whole numbers, got {frame_index.dtype} values")
    if frame_index.max() >= MAX_FRAMES:
        raise InputError(
            f"{where}: want frames below {MAX_FRAMES} (an hour at {FPS:.0f} fps), got {frame_index.max():g}"
        )
    if frame_index.min() < 0:
        raise InputError(f"{where}: frame_index wants whole numbers from 0, got {frame_index.min():g}")
    frames = np.rint(frame_index).astype(np.int64)
    if (frames != frame_index).any():
        raise InputError(f"{where}: frame_index wants whole numbers from 0 (at {FPS:.0f} fps), got {frame_index}")
    if len(np.unique(frames)) != len(frames):
        twice = next(int(f) for f in frames if (frames == f).sum() > 1)
        raise InputError(f"{where}: frame {twice} is given twice; keep one pose for each frame")
    return frames


def _exact_rotations(where: str, R: np.ndarray, frames: np.ndarray) -> Float[np.ndarray, "keyframes 22 3 3"]:
    with np.errstate(all="ignore"):  # numbers that overflow are no rotations either
        error = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max((-1, -2))
        determinant = np.linalg.det(R)
    wrong = ~(error <= _ROTATION_TOLERANCE) | ~(determinant > 0)
    if wrong.any():
        row, joint = (int(i) for i in np.argwhere(wrong)[0])
        raise InputError(
            f"{where}: keyframe {frames[row]}, joint {JOINT_NAMES[joint]}: no rotation matrix (R^T R differs from "
            f"identity by {error[row, joint]:.3g}, determinant {determinant[row, joint]:.3g})"
        )
    return R if error.max() < 1e-6 else nearest_rotation(R)
