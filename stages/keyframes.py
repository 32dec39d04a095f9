"""Keyframe optimization (paper 8.2): move the root of every fifth frame so that body and scene agree.

Five losses over the displacements of the keyframes, all in square meters so that weights carry no unit: regularization
(small displacements), contact (touching parts meet the surface), penetration (other vertices stay out), temporal
smoothness, and the Chamfer distance between visible skin and metric depth. A root goes along its line of sight only,
which one camera knows least: so the body stays where the picture shows it. Poses are not touched; between keyframes the
displacement, not the motion, is interpolated, so the raw motion keeps its detail and nothing pops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.pipeline.options import limits
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BackgroundImage,
    BodyMotion,
    KeyframedMotion,
    MetricDepth,
    PlacedObject,
    SceneModel,
)

if TYPE_CHECKING:
    from video2anim.geometry.sdf import SdfGrid
    from video2anim.motion.keyframe_points import SkinPoints
    from video2anim.motion.keyframe_roots import RootProblem, RootWeights


@dataclass(frozen=True)
class KeyframesConfig:
    """Which frames are optimized, and by what."""

    keyframe_interval_frames: Annotated[int, limits("frames", ge=1, le=100_000)] = 5
    """Every such frame is a keyframe, besides the first and the last valid one (paper: 5)."""
    sampled_vertices: Annotated[int, limits(ge=1, le=100_000)] = 500
    """Skin vertices tested for penetration, spread by farthest-point sampling."""
    vertices_per_contact_part: Annotated[int, limits(ge=1, le=100_000)] = 100
    """Skin vertices of each part that may touch."""
    contact_threshold: Annotated[float, limits(ge=0, le=1)] = 0.5
    """Contact probability from which a part is pulled to the surface, weighed by the probability."""
    contact_reach_m: Annotated[float, limits("m", ge=0, le=100)] = 0.25
    """A touching part farther than this from every surface is left alone: what it touches is not in the scene."""
    contact_points: Annotated[int, limits(ge=1, le=100_000)] = 5
    """Nearest vertices of a part whose mean distance is brought to zero."""
    weight_regularization: Annotated[float, limits(ge=0, le=1_000_000)] = 40.0
    """On the mean squared displacement (m^2). A tenth lets roots follow errors of the scene: on clips with motion
    capture the root's path was then up to 12 mm worse than before the stage, with this it is within 3 mm of it."""
    weight_contact: Annotated[float, limits(ge=0, le=1_000_000)] = 17.0
    """On the mean Huber cost of the contact distance (m^2)."""
    penetration_reach_m: Annotated[float, limits("m", ge=0, le=100)] = 0.2
    """Vertices that start farther from every surface are not tested for penetration."""
    weight_penetration: Annotated[float, limits(ge=0, le=1_000_000)] = 100.0
    """On the mean squared depth of penetrating vertices (m^2), over all frames: between keyframes too."""
    weight_displacement_change: Annotated[float, limits(ge=0, le=1_000_000)] = 2.0
    """On the squared difference of consecutive displacements (m^2); the paper's smoothness, taken on the displacement
    so that walking is not slowed."""
    weight_acceleration: Annotated[float, limits(ge=0, le=1_000_000)] = 0.1
    """On the squared second difference of consecutive roots (m^2), at the keyframe interval."""
    weight_depth: Annotated[float, limits(ge=0, le=1_000_000)] = 15.0
    """On the robust Chamfer cost (m^2)."""
    depth_points: Annotated[int, limits(ge=1, le=100_000)] = 800
    """Depth points, and as many visible vertices, per sampled frame."""
    huber_m: Annotated[float, limits("m", gt=0, le=100)] = 0.05
    """Contact and depth distances above this count linearly."""
    iterations: Annotated[int, limits(ge=1, le=100_000)] = 200
    """Adam steps."""
    learning_rate_m: Annotated[float, limits("m", gt=0, le=10)] = 0.01
    """First step size; it falls to zero along a cosine."""


def optimize_keyframes(
    scene: SceneModel,
    depth: MetricDepth,
    background: BackgroundImage,
    config: KeyframesConfig,
    ctx: StageContext,
) -> KeyframedMotion:
    """Optimize the keyframes' roots and carry the displacement over to all frames.

    Keyframes lie in valid frames only; invalid stretches are bridged. Depth is used for the main person, whose mask the
    background image holds, and only where the depth's scale is trusted.
    """
    from video2anim.geometry.sdf import SdfGrid
    from video2anim.motion.keyframe_problem import choose_keyframes

    grid = SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)
    masks_fit = background.selected_mask.shape[1:] == depth.depth_m.shape[1:]
    usable = depth.trusted and masks_fit
    if not depth.trusted:
        ctx.warn(f"depth loss left out, the depth's scale is not trusted ({depth.reason})")
    elif not masks_fit:
        masks, maps = background.selected_mask.shape[1:], depth.depth_m.shape[1:]
        ctx.warn(f"depth loss left out, masks {masks} do not fit depth {maps}")
    people, indices = [], []
    for number, motion in enumerate(depth.bodies.people):
        keyframes = choose_keyframes(motion.valid, config.keyframe_interval_frames)
        indices.append(keyframes)
        if len(keyframes) == 0:
            ctx.warn(f"person {motion.person_id} has no valid frame, motion left as it is")
            people.append(motion)
            continue
        seen = (depth, background) if number == 0 and usable else None
        person_id = None if number == 0 else motion.person_id
        people.append(_optimize_person(motion, scene.objects, keyframes, grid, seen, config, ctx, person_id))
        ctx.progress(number + 1, len(depth.bodies.people))
    return KeyframedMotion(tuple(people), tuple(indices))


def _optimize_person(
    motion: BodyMotion,
    objects: Sequence[PlacedObject],
    keyframes: Int[np.ndarray, "keyframes"],
    grid: SdfGrid,
    seen: tuple[MetricDepth, BackgroundImage] | None,
    config: KeyframesConfig,
    ctx: StageContext,
    person_id: int | None,
) -> BodyMotion:
    """One person moved; `person_id` marks its quality numbers. Hands that hold one of the objects touch no
    solid."""
    from video2anim.body.anny_body import shaped_body
    from video2anim.motion.keyframe_depth import depth_targets
    from video2anim.motion.keyframe_points import SkinSample
    from video2anim.motion.keyframe_problem import KeyframeReach, between_keyframes, root_problem
    from video2anim.motion.keyframe_roots import solve_along
    from video2anim.objects.path import holding

    body = shaped_body(motion.shape)
    sample = SkinSample(body, spread=config.sampled_vertices, per_part=config.vertices_per_contact_part)
    before = sample.on(motion)
    targets = (
        depth_targets(motion, body, *seen, points=config.depth_points, rng=ctx.rng("depth points")) if seen else ()
    )
    free = replace(motion, contact=np.where(holding(objects, motion), 0.0, motion.contact))
    reach = KeyframeReach(
        config.contact_threshold, config.contact_reach_m, config.contact_points, config.penetration_reach_m
    )
    problem = root_problem(free, keyframes, before, grid, targets, reach)
    along_m = solve_along(
        problem, _weights(config), iterations=config.iterations, learning_rate_m=config.learning_rate_m
    )
    displacement_m = between_keyframes(keyframes, along_m[:, None] * problem.direction, motion.frame_count)
    moved = motion.with_pose(
        translation_world_m=motion.T_world_root[:, :3, 3] + displacement_m, R_parent_joint=motion.R_parent_joint
    )
    after = sample.on(moved)
    _report(ctx, person_id, before, after, motion.valid, grid)
    mean_m = float(np.linalg.norm(displacement_m[motion.valid], axis=1).mean())
    ctx.quality("root_displacement_mean", mean_m, "m", person_id=person_id)
    _report_keyframes(ctx, person_id, problem, displacement_m, after, config)
    return moved


def _report(
    ctx: StageContext,
    person_id: int | None,
    before: SkinPoints,
    after: SkinPoints,
    valid: Bool[np.ndarray, "frames"],
    grid: SdfGrid,
) -> None:
    """Penetration over all valid frames, keyframes and others."""
    for when, points in (("before", before), ("after", after)):
        deepest_m = _deepest_m(points.spread_m[valid], grid)
        ctx.quality(f"penetration_max_{when}", float(deepest_m.max()), "m", "lower", person_id=person_id)
        ctx.quality(f"penetration_mean_{when}", float(deepest_m.mean()), "m", "lower", person_id=person_id)


def _deepest_m(skin_m: Float[np.ndarray, "frames vertices 3"], grid: SdfGrid) -> Float[np.ndarray, "frames"]:
    return np.maximum(0.0, -grid.sample(skin_m).min(axis=1))


def _report_keyframes(
    ctx: StageContext,
    person_id: int | None,
    problem: RootProblem,
    displacement_m: np.ndarray,
    after: SkinPoints,
    config: KeyframesConfig,
) -> None:
    """Contact distance and depth agreement before and after."""
    from video2anim.geometry.chamfer import chamfer_m
    from video2anim.motion.keyframe_roots import contact_distance_m

    frames = problem.frame
    touching = {
        "before": [part.skin_m for part in problem.contacts],
        "after": [after.touching_m(part.joints)[frames[part.keyframe]] for part in problem.contacts],
    }
    visible: dict[str, list[np.ndarray]] = {"before": [], "after": []}
    for target in problem.depth:
        visible["before"].append(target.visible_m)
        visible["after"].append(target.visible_m + displacement_m[target.frame])
    for when, skins_m in touching.items():
        if skins_m:
            gaps_m = [contact_distance_m(skin_m, problem.scene, config.contact_points) for skin_m in skins_m]
            mean_m = float(np.abs(np.concatenate(gaps_m)).mean())
            ctx.quality(f"contact_distance_{when}", mean_m, "m", "lower", person_id=person_id)
        if visible[when]:
            pairs = zip(visible[when], problem.depth, strict=True)
            distances_m = [chamfer_m(skin_m, target.depth_m) for skin_m, target in pairs]
            ctx.quality(f"depth_chamfer_{when}", float(np.mean(distances_m)), "m", "lower", person_id=person_id)


def _weights(config: KeyframesConfig) -> RootWeights:
    from video2anim.motion.keyframe_roots import RootWeights

    return RootWeights(
        regularization=config.weight_regularization,
        contact=config.weight_contact,
        penetration=config.weight_penetration,
        displacement_change=config.weight_displacement_change,
        acceleration=config.weight_acceleration,
        depth=config.weight_depth,
        huber_m=config.huber_m,
        contact_points=config.contact_points,
    )


STAGE = StageSpec("keyframes", optimize_keyframes, version=12)
