"""The solve for motions without a video: standing feet at rest, skin out of solids, exact keyframes kept."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from scenemi.metrics import ANKLES, GMD_SPEED_M_S, ROHM_ANKLE_HEIGHT_M, TOE_CONTACT_M, TOES
from scenemi.postprocess.motion_solve import SceneMotion, SolveConfig, solve_motions
from scenemi.postprocess.solids import Solids
from scenemi.prior import KeyframeWindow, WindowMotion, is_exact
from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.grid import AROUND_M, distance_grid
from video2anim.types.skeleton import forward_kinematics

if TYPE_CHECKING:
    from scenemi.model.prior import DiffusionPrior
    from scenemi.postprocess.partial import PartialKeyframes

PRIOR_ERROR = ((0.33, 57.0), (0.19, 11.0), (0.32, 5.7))
"""Error of the prior d frames from the nearest keyframe is a d / (d + b): a and b of root (m), trunk and limbs (rad),
as `benchmarks/scenemi/choices.py prior-error --every 2` measures it."""
WITHOUT_PICTURE = SolveConfig(
    acceleration_ratio=8.0, stance_m_s=0.12, odd_speed_m_s=math.inf, contact_threshold=0.0, touch_m=0.015
)
"""Nothing but the network says where the body is, so the standard deviations from it are its errors (`prior_error`).
Feet are held as much as they are slow (`slow_feet`), so none is too fast to stand. Chosen by `choices.py solve`;
docs/scenemi.md has the alternatives."""
OBSERVED = replace(
    WITHOUT_PICTURE, root_m=0.05, trunk_rad=0.05, limb_rad=0.5, acceleration_ratio=1.0, stance_m_s=0.05,
    contact_threshold=0.03, touch_reach_m=0.25, iterations=16,
)  # fmt: skip
"""With partial keyframes, which say where root and trunk are, so that these give way too, smoothly. Pinned feet slide
by 5 mm with this and by 14 mm after 8 iterations; with 0.2 m for the root the solve may not converge
(`benchmarks/scenemi/partial.py`)."""
_MIN_ERROR = 1e-3
"""Of exact keyframes, which stay where they are."""
_ROUNDS = 2
"""Solves: standing feet are found more reliably in a motion in which they have been held once."""


def put_in_scene(
    made: WindowMotion,
    given: KeyframeWindow,
    config: SolveConfig = WITHOUT_PICTURE,
    partial: PartialKeyframes | None = None,
) -> WindowMotion:
    """A filled motion of any length after the solve; its keyframes stay where they are exact, its seed in any case.
    Joints go where `partial` wants them."""
    from scenemi.model.scene_input import adult_like

    joints_m, _ = forward_kinematics(made.R_parent_joint, made.translation_world_m, given.rest_joints_m)
    field = given.scene
    if isinstance(field, SceneGeometry):
        around_m = joints_m.reshape(-1, 3)
        field = distance_grid(field, around_m.min(0) - AROUND_M, around_m.max(0) + AROUND_M)
    fixed = given.is_keyframe if is_exact(given) else np.arange(len(joints_m)) < given.seed_frames
    body = given.body or adult_like(given.rest_joints_m)
    for _ in range(_ROUNDS):
        joints_m, _ = forward_kinematics(made.R_parent_joint, made.translation_world_m, given.rest_joints_m)
        contact = slow_feet(joints_m, given.fps)
        start = SceneMotion(
            made.R_parent_joint, made.translation_world_m,
            contact if partial is None else np.maximum(contact, partial.contact), given.rest_joints_m, body,
            given.fps, fixed, targets=None if partial is None else partial.targets(joints_m, fixed),
            uncertainty=prior_error(given) if partial is None else None,
        )  # fmt: skip
        solved = solve_motions([start], Solids(field, floor=False), config)
        made = WindowMotion(solved.R_parent_joint[0], solved.translation_world_m[0])
    return made


def prior_error(given: KeyframeWindow) -> Float[np.ndarray, "frames 3"]:
    """Standard deviations of root (m), trunk and limbs (rad) in what the prior makes: the noise of the keyframes, and
    `PRIOR_ERROR` by the distance from them."""
    keyframes, frames = np.flatnonzero(given.is_keyframe), np.arange(len(given.is_keyframe))
    after = keyframes[np.searchsorted(keyframes, frames)]
    before = keyframes[np.searchsorted(keyframes, frames, side="right") - 1]
    nearest = np.where(after - frames < frames - before, after, before)
    distance = np.abs(frames - nearest)[:, None]
    noise = np.full((len(nearest), 2), given.noise_level) if given.noise is None else given.noise[nearest]
    limit, half = np.array(PRIOR_ERROR).T
    of_keyframes = np.stack([0.01 * noise[:, 1], *2 * [np.radians(noise[:, 0])]], 1)
    return np.maximum(np.hypot(of_keyframes, limit * distance / (distance + half)), _MIN_ERROR)


def slow_feet(joints_m: Float[np.ndarray, "frames 22 3"], fps: float) -> Float[np.ndarray, "frames 22"]:
    """How much each foot seems to stand: 1 where an ankle or a ball is low and does not move, less the faster it is;
    nothing for other joints. A motion that a network made slides where the truth stands."""
    contact = np.zeros(joints_m.shape[:2])
    if len(joints_m) < 2:
        return contact
    feet = [*ANKLES, *TOES]
    limit_m = np.array([ROHM_ANKLE_HEIGHT_M] * len(ANKLES) + [TOE_CONTACT_M] * len(TOES))
    speed_m_s = fps * np.linalg.norm(np.gradient(joints_m[:, feet], axis=0), axis=-1)
    low = joints_m[:, feet, 1] < limit_m
    contact[:, feet] = low * np.exp(-((speed_m_s / GMD_SPEED_M_S) ** 2))
    return contact


class SolvedPrior:
    """A diffusion prior whose windows go through the solve: what `scenemi sample` makes."""

    def __init__(self, prior: DiffusionPrior, config: SolveConfig = WITHOUT_PICTURE) -> None:
        self.name, self.model, self._prior, self._config = prior.name, prior.model, prior, config

    def fill(self, window: KeyframeWindow) -> WindowMotion:
        return put_in_scene(self._prior.fill(window), window, self._config)

    def fill_many(self, windows: Sequence[KeyframeWindow], seeds: Sequence[int]) -> list[WindowMotion]:
        made = self._prior.fill_many(windows, seeds)
        return [put_in_scene(motion, window, self._config) for motion, window in zip(made, windows, strict=True)]
