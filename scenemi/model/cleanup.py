"""After sampling: the body is moved out of solids, then standing feet are held by the legs alone.

The same costs can steer the sampling (`scenemi.model.guidance`), at the price of a descent at every step, and then the
next estimate undoes part of it. Moving only the legs leaves the rest of the body where the model saw it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from scenemi.features import FEATURE_COUNT, ROTATIONS, Statistics
from scenemi.model.guidance import ContactCost, Guidance, PenetrationCost
from scenemi.model.kinematics import Pose
from scenemi.scene.body_balls import fit_balls
from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.grid import canonical_grid
from video2anim.body.anny_body import ShapedBody
from video2anim.body.skeleton import JOINT_INDEX
from video2anim.geometry.sdf import SdfGrid

LEGS = tuple(JOINT_INDEX[f"{side}_{part}"] for side in ("left", "right") for part in ("hip", "knee", "ankle", "foot"))
_ITERATIONS = 10
_SLACK_M = 0.001
"""Depths that are not worth a step."""
_STAY = 1.0
"""Against depth (cm^2, summed over balls): moving every joint by a centimetre costs as much as one ball that deep.
Without it, what leaves a solid goes on after it has left."""

Scene = SdfGrid | SceneGeometry


def leg_features() -> Float[Tensor, "201"]:
    """1 at the rotations of hips, knees, ankles and toes."""
    moved = torch.zeros(FEATURE_COUNT)
    for joint in LEGS:
        start = ROTATIONS.start + 6 * joint
        moved[start : start + 6] = 1.0
    return moved


class Cleanup:
    """Both repairs, for a batch of windows."""

    def __init__(
        self,
        statistics: Statistics,
        rest_joints_m: Float[Tensor, "batch 22 3"],
        fps: float,
        *,
        foot_rounds: int,
        clear_rounds: int,
        clearing: PenetrationCost | None,
    ) -> None:
        self.foot_rounds, self.clear_rounds = foot_rounds, clear_rounds if clearing else 0
        self._hold = Guidance(
            statistics, rest_joints_m, [ContactCost(fps)], iterations=_ITERATIONS, moved=leg_features()
        )
        self._clear = Guidance(
            statistics, rest_joints_m, [clearing] if clearing else [], iterations=_ITERATIONS,
            stay=_STAY,
        )  # fmt: skip

    def __call__(self, x0: Float[Tensor, "batch frames 201"]) -> Float[Tensor, "batch frames 201"]:
        """The windows (normalized features) after the repairs."""
        for _ in range(self.clear_rounds):
            x0 = self._clear(x0)
        for _ in range(self.foot_rounds):
            x0 = self._hold(x0)
        return x0


def penetration_cost(
    scenes: Sequence[Scene | None],
    bodies: Sequence[ShapedBody],
    T_world_canonical: Float[Tensor, "batch 4 4"],
    base: Pose,
    mask: Float[Tensor, "batch frames"],
) -> PenetrationCost | None:
    """Cost of a body in solids; None where no window has a scene.

    A part of the body may be as deep in a solid as a keyframe has it: who sits sinks into the seat.

    Args:
        scenes: of each window, in the world.
        bodies: of each window.
        T_world_canonical: of each window.
        base: the joined keyframes in the canonical frame; signed distances are looked up around them.
        mask: 1 at keyframes.
    """
    if all(scene is None for scene in scenes):
        return None
    frames = T_world_canonical.cpu().numpy().astype(np.float64)
    fields: list[Callable[[Tensor], Tensor] | None] = []
    balls, allowed_m = [_balls(body) for body in bodies], []
    for i, (scene, frame) in enumerate(zip(scenes, frames, strict=True)):
        around_m = base.joints_m[i].flatten(0, 1).cpu().numpy().astype(np.float64)
        fields.append(None if scene is None else canonical_grid(scene, around_m, frame).sample)
        allowed_m.append(torch.zeros(len(balls[i].joint)))
    plain = PenetrationCost(fields, balls, tuple(allowed_m))
    for i, field in enumerate(fields):
        keys = torch.nonzero(mask[i] > 0)[:, 0].cpu()
        if field is not None and len(keys):
            allowed_m[i] = functional.relu(-plain.clearance_m(base, i)[keys]).amax(0).cpu() + _SLACK_M
    return PenetrationCost(fields, balls, tuple(allowed_m))


_balls = functools.lru_cache(maxsize=64)(fit_balls)
