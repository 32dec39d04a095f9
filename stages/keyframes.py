"""Keyframe optimization (SceneMI, supplement section 8.2): moves roots so that body and scene agree.

Four losses over the displacements of the keyframes, all in square meters so that weights carry no unit: regularization
(small displacements), contact (touching parts meet the surface), penetration (skin stays outside of solids) and
temporal smoothness. The paper's fifth, the Chamfer distance between visible skin and metric depth, is left out: stage
metric has fitted depth to the bodies (docs/refine.md). Roots move along their lines of sight only, the direction in
which one camera is least certain, so the body keeps its place in the image. Poses do not change. Between keyframes the
displacement is interpolated, not the motion, which keeps its detail.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from video2anim.pipeline.options import limits
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import KeyframedMotion, MetricDepth, SceneModel


@dataclass(frozen=True)
class KeyframesConfig:
    """Which frames are keyframes."""

    keyframe_interval_frames: Annotated[int, limits("frames", ge=1, le=100_000)] = 5
    """Step between keyframes (paper: 5); the first and last frame of every valid run are keyframes too."""


def optimize_keyframes(
    scene: SceneModel,
    depth: MetricDepth,
    config: KeyframesConfig,
    ctx: StageContext,
) -> KeyframedMotion:
    """Optimize the keyframes' roots and carry the displacement over to all frames.

    Keyframes lie in valid frames only; invalid stretches are bridged.
    """
    from video2anim.geometry.sdf import SdfGrid
    from video2anim.motion.keyframe_fit import fit_roots, root_fit_quality
    from video2anim.motion.keyframe_problem import choose_keyframes

    grid = SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)
    people, indices = [], []
    for number, motion in enumerate(depth.bodies.people):
        keyframes = choose_keyframes(motion.valid, config.keyframe_interval_frames)
        indices.append(keyframes)
        if len(keyframes) == 0:
            ctx.warn(f"person {motion.person_id} has no valid frame, motion left as it is")
            people.append(motion)
            continue
        fit = fit_roots(motion, scene.objects, keyframes, grid)
        people.append(fit.motion)
        person_id = None if number == 0 else motion.person_id
        for key, value, unit in root_fit_quality(fit):
            ctx.quality(key, value, unit, "lower", person_id=person_id)
        ctx.quality("root_displacement_mean", fit.mean_displacement_m, "m", person_id=person_id)
        ctx.progress(number + 1, len(depth.bodies.people))
    return KeyframedMotion(tuple(people), tuple(indices))


STAGE = StageSpec("keyframes", optimize_keyframes, version=15)
