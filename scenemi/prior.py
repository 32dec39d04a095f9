"""What an in-betweening prior is, and the interpolation baseline."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline, PchipInterpolator

from video2anim.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.skeleton import PARENTS

if TYPE_CHECKING:
    from scenemi.scene.geometry import SceneGeometry
    from video2anim.body.shaped_body import ShapedBody

WEIGHTS_FOLDER = Path(__file__).parent / "weights"
DEFAULT_STOP_STEP = 20
"""T*: noisy keyframes steer the sampling only above this diffusion step (paper 3.2.1, Table 3)."""
SAMPLE_STEPS = 20
"""Of motions that differ by their seeds; the expected motion takes one step."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeWindow:
    """One window to fill: poses at keyframes, in the world frame (+Y up, floor at y = 0, meters)."""

    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    """Local rotations, joint 0 the root in the world. Rows that are no keyframes carry no information."""
    translation_world_m: Float[np.ndarray, "frames 3"]
    is_keyframe: Bool[np.ndarray, "frames"]
    """First and last frame included."""
    rest_joints_m: Float[np.ndarray, "22 3"]
    fps: float
    scene: SdfGrid | SceneGeometry | None = None
    """Solids around the body; None = no scene known."""
    seed_frames: int = 0
    """How many leading frames come from the window before; they are keyframes without noise."""
    body: ShapedBody | None = None
    """Whose skin meets the scene; None = an adult of about the body height of `rest_joints_m`."""
    noise_level: float = 0.0
    """Paper's l: the keyframes (but the seed) are about l degrees and l centimeters off; 0 = exact."""
    noise: Float[np.ndarray, "frames 2"] | None = None
    """How far each keyframe is off, degrees and centimeters, where that is known better than by one l for all."""

    def __post_init__(self) -> None:
        frames = len(self.is_keyframe)
        shapes = (self.R_parent_joint.shape, self.translation_world_m.shape)
        if shapes != ((frames, len(PARENTS), 3, 3), (frames, 3)):
            raise ValueError(f"KeyframeWindow: {frames} frames want rotations (T, 22, 3, 3) and (T, 3), got {shapes}")
        if frames == 0 or not (self.is_keyframe[0] and self.is_keyframe[-1]):
            raise ValueError("KeyframeWindow: the first and the last frame must be keyframes")
        given = np.isfinite(self.R_parent_joint[self.is_keyframe]).all()
        if not given or not np.isfinite(self.translation_world_m[self.is_keyframe]).all():
            raise ValueError("KeyframeWindow: keyframes hold NaN or infinity; leave such frames out")
        if self.noise is not None and (self.noise.shape != (frames, 2) or not (self.noise >= 0).all()):
            raise ValueError(f"KeyframeWindow: want noise ({frames}, 2), none below 0, got {self.noise.shape}")
        if not 0 <= self.noise_level < np.inf or not 0 <= self.seed_frames <= frames:
            raise ValueError(
                f"KeyframeWindow: want a noise level >= 0 and up to {frames} seed frames, "
                f"got {self.noise_level} and {self.seed_frames}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class WindowMotion:
    """A filled window, same frames and frame of reference as its `KeyframeWindow`."""

    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    translation_world_m: Float[np.ndarray, "frames 3"]


def padded(window: KeyframeWindow, frame_count: int) -> KeyframeWindow:
    """The window made `frame_count` frames long by holding its last pose, for priors of fixed length.

    The added frames are keyframes; the caller cuts them off again.

    Raises:
        ValueError: the window is longer than that.
    """
    missing = frame_count - len(window.is_keyframe)
    if missing < 0:
        raise ValueError(f"padded: the window has {len(window.is_keyframe)} frames, more than {frame_count}")
    return replace(
        window,
        R_parent_joint=np.concatenate([window.R_parent_joint, np.repeat(window.R_parent_joint[-1:], missing, 0)]),
        translation_world_m=np.concatenate(
            [window.translation_world_m, np.repeat(window.translation_world_m[-1:], missing, 0)]
        ),
        is_keyframe=np.concatenate([window.is_keyframe, np.ones(missing, dtype=bool)]),
        noise=None
        if window.noise is None
        else np.concatenate([window.noise, np.repeat(window.noise[-1:], missing, 0)]),
    )


def is_exact(window: KeyframeWindow) -> bool:
    """Whether its keyframes carry no noise."""
    return window.noise_level == 0 and (window.noise is None or not window.noise.any())


@runtime_checkable
class InbetweeningPrior(Protocol):
    """Fills the frames between keyframes."""

    name: str

    def fill(self, window: KeyframeWindow) -> WindowMotion:
        """Motion of every frame of the window; keyframes may be moved by a prior that treats them as noisy."""
        ...


class InterpolationPrior:
    """The baseline: slerp of every joint's local rotation, cubic spline of the root translation.

    Exact at keyframes. It knows nothing of scenes or of how people move.
    """

    name = "interpolation"

    def __init__(self, *, monotone: bool = False) -> None:
        """With `monotone`, the root's spline does not overshoot: a natural one leaves a gap between dense and noisy
        keyframes at whatever speed their noise has."""
        self._spline = PchipInterpolator if monotone else CubicSpline

    def fill(self, window: KeyframeWindow) -> WindowMotion:
        keys = np.flatnonzero(window.is_keyframe)
        frames = np.arange(len(window.is_keyframe))
        if len(keys) == 1:
            return WindowMotion(window.R_parent_joint.copy(), window.translation_world_m.copy())
        quaternions = quaternion_from_matrix(window.R_parent_joint[keys])
        left = np.clip(np.searchsorted(keys, frames, side="right") - 1, 0, len(keys) - 2)
        weight = (frames - keys[left]) / (keys[left + 1] - keys[left])
        between = slerp(quaternions[left], quaternions[left + 1], weight[:, None, None])
        R_parent_joint = matrix_from_quaternion(between)
        R_parent_joint[keys] = window.R_parent_joint[keys]
        translation_m = self._spline(keys, window.translation_world_m[keys])(frames)
        translation_m[keys] = window.translation_world_m[keys]
        return WindowMotion(R_parent_joint, translation_m)
