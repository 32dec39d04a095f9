"""The solve for motions without a video: standing feet at rest, skin out of solids, exact keyframes kept."""

from __future__ import annotations

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

WITHOUT_PICTURE = SolveConfig(
    root_m=0.005, trunk_rad=0.01, limb_rad=0.5, acceleration_ratio=5.0, stance_m_s=0.05, odd_speed_m_s=2.0,
    contact_threshold=0.03, touch_m=0.015, touch_reach_m=0.25,
)  # fmt: skip
"""Nothing but the network says where the body is: legs give way, root and trunk only to solids. Feet that slide at up
to 0.94 m/s are held. Chosen on an eighth of the test windows of `benchmarks/scenemi/reach.py` (r = 30 and 60: skating
0.219 and 0.174 before, 0.138 and 0.092 with this, truth 0.081; error unchanged within 1 %). With the root as free as in
a video the error at 60 frames rises by a tenth; limbs at 0.3 rad leave skating at 0.189 and 0.123. On 23 validation
windows (`--part val --every 4 --choose-solve`, CMU and two more data sets, r = 30) skating is 0.164 before and 0.112
with this, the error 66.5 and 64.8 mm; a root held by 2 mm or by 2 cm changes neither by more than 0.001 and 0.1 mm."""
OBSERVED = replace(WITHOUT_PICTURE, root_m=0.05, trunk_rad=0.05, acceleration_ratio=1.0, iterations=16)
"""With partial keyframes, which say where root and trunk are, so that these give way too, smoothly. Pinned feet slide
by 5 mm with this and by 14 mm after 8 iterations; with 0.2 m for the root the solve may not converge
(`benchmarks/scenemi/partial.py`)."""
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
        )  # fmt: skip
        solved = solve_motions([start], Solids(field, floor=False), config)
        made = WindowMotion(solved.R_parent_joint[0], solved.translation_world_m[0])
    return made


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

    def __init__(self, prior: DiffusionPrior) -> None:
        self.name, self.model, self._prior = prior.name, prior.model, prior

    def fill(self, window: KeyframeWindow) -> WindowMotion:
        return put_in_scene(self._prior.fill(window), window)

    def fill_many(self, windows: Sequence[KeyframeWindow], seeds: Sequence[int]) -> list[WindowMotion]:
        made = self._prior.fill_many(windows, seeds)
        return [put_in_scene(motion, window) for motion, window in zip(made, windows, strict=True)]
