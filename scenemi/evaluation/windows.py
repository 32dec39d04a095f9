"""Windows to evaluate on: clips cut up, put on one body, with keyframes taken from them, noisy or clean, and a scene.

Every window is moved so that its first root stands over the origin and faces +Z: distances do not change, and the scene
drawn for it lies around it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from scenemi.data.container import MotionArchive
from scenemi.data.retarget import RetargetedMotion, retarget
from scenemi.data.source_clip import SourceClip
from scenemi.features import to_canonical
from scenemi.prior import KeyframeWindow
from scenemi.scene.geometry import SceneGeometry
from scenemi.windows import KEYFRAME_INTERVALS, WINDOW_FRAMES, select_keyframes
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError, UsageError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.clip import FPS
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import forward_kinematics


class ObstacleField(Protocol):
    """Solids around a motion, without the floor."""

    def signed_distance(self, points_m: Float[np.ndarray, "frames skin 3"]) -> Float[np.ndarray, "frames skin"]:
        """Distance to the nearest solid, negative inside; meters, exact below `scenemi.metrics.CLOSE_PROXIMITY_M`."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class EvaluationWindow:
    """True motion of one window on the body of the evaluation."""

    name: str
    """Clip and first frame, `cmu_02_01@121`."""
    kind: str
    source: str
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    translation_m: Float[np.ndarray, "frames 3"]
    joints_m: Float[np.ndarray, "frames 22 3"]
    contact: Bool[np.ndarray, "frames 22"]
    body: ShapedBody
    obstacles: ObstacleField | None = None
    """Solids for the collision numbers, without the floor; None = no scene."""
    scene: SdfGrid | SceneGeometry | None = None
    """The same solids and the floor, as a prior is given them."""


@dataclass(frozen=True, slots=True)
class KeyframeProtocol:
    """Which frames of a window are given, and how exactly."""

    interval: int | None = KEYFRAME_INTERVALS[-1]
    """Every so many frames, and the last; None = by `probability`."""
    probability: float | None = None
    """Chance of each inner frame; first and last are always keyframes."""
    noise: float = 0.0
    """Paper's l: standard deviation in degrees for root orientation and joints (each component of the axis-angle
    vector) and in centimeters for the root translation (each axis). First and last frame stay clean, as in the
    paper."""
    seed: int = 0

    def __post_init__(self) -> None:
        if (self.interval is None) == (self.probability is None):
            raise UsageError("keyframes: want either an interval or a probability")
        if self.interval is not None and self.interval < 1:
            raise UsageError(f"keyframes: want an interval of at least 1 frame, got {self.interval}")
        if self.probability is not None and not 0 <= self.probability <= 1:
            raise UsageError(f"keyframes: want a probability from 0 to 1, got {self.probability}")
        if not 0 <= self.noise <= 100:
            raise UsageError(f"keyframes: want noise from 0 to 100 (degrees and cm), got {self.noise}")


@dataclass(frozen=True, slots=True, eq=False)
class GivenWindow:
    """A window as a prior sees it, and the whole noisy motion that its keyframes were taken from."""

    keyframes: KeyframeWindow
    noisy_R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    noisy_translation_m: Float[np.ndarray, "frames 3"]


def adult_body() -> ShapedBody:
    """The body all evaluations use: an average adult."""
    return shaped_body(BodyShape("anny", dict(ADULT)))


def cut_windows(
    archives: Sequence[MotionArchive],
    names: Sequence[str] | None = None,
    body: ShapedBody | None = None,
    *,
    stride: int = WINDOW_FRAMES,
) -> tuple[EvaluationWindow, ...]:
    """Every clip of at least 121 frames, retargeted, in windows of 121 frames that do not overlap.

    Args:
        archives: where clips are looked for.
        names: clips to use (a part of a split); None = all.
        body: None = the average adult.
        stride: frames from window to window; less than 121 makes more of them (for the FID).

    Raises:
        InputError: no clip is long enough.
    """
    body = body or adult_body()
    wanted = None if names is None else set(names)
    windows: list[EvaluationWindow] = []
    longest = 0
    for archive in archives:
        for name, frames in zip(archive.names, archive.frame_counts, strict=True):
            if wanted is not None and name not in wanted:
                continue
            longest = max(longest, frames)
            if frames >= WINDOW_FRAMES:
                windows += [window for _, window in windows_of(archive.clip(name), body, stride)[1]]
    if not windows:
        raise InputError(
            f"evaluation: want a clip of at least {WINDOW_FRAMES} frames at {FPS:.0f} fps, the longest has {longest}"
        )
    return tuple(windows)


def windows_of(
    clip: SourceClip, body: ShapedBody, stride: int = WINDOW_FRAMES
) -> tuple[RetargetedMotion, list[tuple[int, EvaluationWindow]]]:
    """A clip on a body, and its windows with their first frames.

    Raises:
        InputError: a clip of another frame rate, or of an unknown skeleton.
    """
    if abs(clip.fps - FPS) > 0.01:
        raise InputError(
            f"clip {clip.name!r}: want {FPS:.0f} fps, got {clip.fps:g}; resample it first (`scenemi data`)"
        )
    motion = retarget(clip, body)
    windows = []
    for start in range(0, len(motion.translation_m) - WINDOW_FRAMES + 1, stride):
        frames = slice(start, start + WINDOW_FRAMES)
        R_parent_joint, translation_m = to_canonical(motion.R_parent_joint[frames], motion.translation_m[frames])
        joints_m, _ = forward_kinematics(R_parent_joint, translation_m, body.rest_joints_m)
        one = EvaluationWindow(
            name=f"{clip.name}@{start}", kind=motion.kind, source=motion.source, R_parent_joint=R_parent_joint,
            translation_m=translation_m, joints_m=joints_m, contact=motion.contact[frames], body=body,
        )  # fmt: skip
        windows.append((start, one))
    return motion, windows


def window_seed(name: str, seed: int) -> int:
    """A number of 63 bits that depends on the window and the seed, alike on every machine."""
    return int.from_bytes(hashlib.sha256(f"{name}/{seed}".encode()).digest()[:8], "little") >> 1


def give_keyframes(window: EvaluationWindow, protocol: KeyframeProtocol) -> GivenWindow:
    """The keyframes of a window. Noise and random choice depend on the window's name and the protocol's seed only."""
    rng = np.random.default_rng(window_seed(window.name, protocol.seed))
    frames = len(window.translation_m)
    is_keyframe = np.zeros(frames, bool)
    is_keyframe[_chosen(frames, protocol, rng)] = True
    R_parent_joint, translation_m = window.R_parent_joint, window.translation_m
    if protocol.noise > 0:
        R_parent_joint, translation_m = with_noise(R_parent_joint, translation_m, protocol.noise, rng)
    given = KeyframeWindow(
        R_parent_joint, translation_m, is_keyframe, window.body.rest_joints_m, FPS, window.scene,
        body=window.body, noise_level=protocol.noise,
    )  # fmt: skip
    return GivenWindow(given, R_parent_joint, translation_m)


def _chosen(frames: int, protocol: KeyframeProtocol, rng: np.random.Generator) -> Int[np.ndarray, "keyframes"]:
    if protocol.interval is not None:
        return select_keyframes(frames, protocol.interval)
    assert protocol.probability is not None
    chosen = rng.random(frames) < protocol.probability
    chosen[[0, -1]] = True
    return np.flatnonzero(chosen)


def with_noise(
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"],
    translation_m: Float[np.ndarray, "frames 3"],
    level: float,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "frames 22 3 3"], Float[np.ndarray, "frames 3"]]:
    """Gaussian noise of `level` degrees and centimeters on all frames but the first and the last."""
    turn_rad = np.radians(level) * rng.standard_normal((*R_parent_joint.shape[:2], 3))
    shift_m = 0.01 * level * rng.standard_normal(translation_m.shape)
    turn_rad[[0, -1]] = 0.0
    shift_m[[0, -1]] = 0.0
    return R_parent_joint @ matrix_from_axis_angle(turn_rad), translation_m + shift_m
