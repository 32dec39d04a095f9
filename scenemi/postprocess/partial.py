"""Partial keyframes: places of single joints, a path of the root, feet that do not move."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from scenemi.postprocess.motion_solve import JointTargets
from video2anim.body.legs import LEGS
from video2anim.types.skeleton import JOINT_INDEX

ROOT, LEVEL = JOINT_INDEX["pelvis"], [0, 2]
EXACT_M = 0.001
"""Standard deviation of what is to be met: against the other terms of the solve this is exact."""
PATH_M = 0.02
"""Standard deviation of the pelvis from its path: hips sway by this from step to step."""
MISS_M = {"joint": 0.02, "path": 0.05, "foot": 0.01}
"""What is reported or refused: a joint beside its place, hips that leave the path by more than their sway, a foot that
slides."""


@dataclass(frozen=True, slots=True)
class PinnedFoot:
    """A foot that stays where it is for a while."""

    side: int
    """0 left, 1 right."""
    first_frame: int
    last_frame: int
    """The last one pinned."""


@dataclass(frozen=True, slots=True, eq=False)
class PartialKeyframes:
    """What is asked of a motion beside whole poses; world +Y up, floor y = 0, meters."""

    position_m: Float[np.ndarray, "frames 22 3"]
    """Of joints that have a place; NaN for others."""
    path_m: Float[np.ndarray, "frames 2"]
    """x and z of the pelvis; NaN where it is free."""
    pinned: tuple[PinnedFoot, ...] = ()

    def over(self, frame_count: int) -> PartialKeyframes:
        """The same for a longer motion, of whose added frames nothing is asked."""
        added = ((0, frame_count - len(self.path_m)), (0, 0))
        position_m = np.pad(self.position_m, (*added, (0, 0)), constant_values=np.nan)
        return replace(self, position_m=position_m, path_m=np.pad(self.path_m, added, constant_values=np.nan))

    @property
    def contact(self) -> Float[np.ndarray, "frames 22"]:
        """1 for ankle and ball of a pinned foot, else 0."""
        contact = np.zeros(self.position_m.shape[:2])
        for pin in self.pinned:
            leg = LEGS[pin.side]
            contact[pin.first_frame : pin.last_frame + 1, [leg.ankle, leg.toe]] = 1.0
        return contact

    def targets(self, joints_m: Float[np.ndarray, "frames 22 3"], fixed: Bool[np.ndarray, "frames"]) -> JointTargets:
        """Places for all of it, given the present motion. A pinned foot stays over the ground where it is in a fixed
        frame of its stretch, else where it is slowest; its height is that of what it touches."""
        position_m, sigma_m = joints_m.copy(), np.full(joints_m.shape, np.inf)
        path = np.flatnonzero(np.isfinite(self.path_m).all(1))
        position_m[path[:, None], ROOT, LEVEL] = self.path_m[path]
        sigma_m[path[:, None], ROOT, LEVEL] = PATH_M
        step_m = np.linalg.norm(np.diff(joints_m, axis=0, prepend=joints_m[:1]), axis=-1)
        for pin in self.pinned:
            leg, frames = LEGS[pin.side], np.arange(pin.first_frame, pin.last_frame + 1)
            foot = [leg.ankle, leg.toe]
            at = frames[(step_m[frames][:, foot].sum(1) + np.where(fixed[frames], -np.inf, 0.0)).argmin()]
            for joint in foot:
                position_m[frames[:, None], joint, LEVEL] = joints_m[at, joint, LEVEL]
                sigma_m[frames[:, None], joint, LEVEL] = EXACT_M
        given = np.isfinite(self.position_m)
        position_m[given], sigma_m[given] = self.position_m[given], EXACT_M
        return JointTargets(position_m, sigma_m)
