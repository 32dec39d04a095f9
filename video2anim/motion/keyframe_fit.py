"""One person's keyframe roots, moved along their lines of sight, and the quality of the result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from video2anim.body.anny_body import shaped_body
from video2anim.geometry.sdf import SdfGrid
from video2anim.motion.keyframe_points import SkinPoints, SkinSample
from video2anim.motion.keyframe_problem import between_keyframes, root_problem
from video2anim.motion.keyframe_roots import RootProblem, contact_distance_m, solve_along
from video2anim.objects.path import holding
from video2anim.types import BodyMotion, PlacedObject
from video2anim.types.quality import Unit


@dataclass(frozen=True, slots=True, eq=False)
class RootFit:
    """The moved person, and what the move was computed from."""

    motion: BodyMotion
    displacement_m: Float[np.ndarray, "frames 3"]
    problem: RootProblem
    before: SkinPoints
    after: SkinPoints

    @property
    def mean_displacement_m(self) -> float:
        """Over the valid frames."""
        return float(np.linalg.norm(self.displacement_m[self.motion.valid], axis=1).mean())


def fit_roots(
    motion: BodyMotion,
    objects: Sequence[PlacedObject],
    keyframes: Int[np.ndarray, "keyframes"],
    grid: SdfGrid,
) -> RootFit:
    """Move the roots of a person's keyframes, and the frames between them.

    Args:
        motion: with at least one valid frame.
        objects: of the scene; a hand that holds one of them touches no solid.
        keyframes: valid frames.
        grid: distance field of the scene, meters, world frame.
    """
    body = shaped_body(motion.shape)
    sample = SkinSample(body)
    before = sample.on(motion)
    free = replace(motion, contact=np.where(holding(objects, motion), 0.0, motion.contact))
    problem = root_problem(free, keyframes, before, grid)
    along_m = solve_along(problem)
    displacement_m = between_keyframes(keyframes, along_m[:, None] * problem.direction, motion.frame_count)
    moved = motion.with_pose(
        translation_world_m=motion.T_world_root[:, :3, 3] + displacement_m, R_parent_joint=motion.R_parent_joint
    )
    return RootFit(moved, displacement_m, problem, before, sample.on(moved))


def root_fit_quality(fit: RootFit) -> Iterator[tuple[str, float, Unit]]:
    """Key, value and unit of the quality numbers, all the lower the better.

    Penetration is over all valid frames, contact distance over the keyframes of the problem.
    """
    valid, problem = fit.motion.valid, fit.problem
    for when, points in (("before", fit.before), ("after", fit.after)):
        deepest_m = np.maximum(0.0, -problem.scene.sample(points.spread_m[valid]).min(axis=1))
        yield f"penetration_max_{when}", float(deepest_m.max()), "m"
        yield f"penetration_mean_{when}", float(deepest_m.mean()), "m"
    touching = {
        "before": [part.skin_m for part in problem.contacts],
        "after": [fit.after.touching_m(part.joints)[problem.frame[part.keyframe]] for part in problem.contacts],
    }
    for when, skins_m in touching.items():
        if skins_m:
            gaps_m = [contact_distance_m(skin_m, problem.scene) for skin_m in skins_m]
            yield f"contact_distance_{when}", float(np.abs(np.concatenate(gaps_m)).mean()), "m"
