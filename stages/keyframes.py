"""Keyframe optimization (SceneMI, supplement section 8.2): moves roots so that body and scene agree.

Five losses over the displacements of the keyframes, all in square meters so that weights carry no unit: regularization
(small displacements), contact (touching parts meet the surface), penetration (skin stays outside of solids), temporal
smoothness, and the Chamfer distance between visible skin and metric depth. Roots move along their lines of sight only,
the direction in which one camera is least certain, so the body keeps its place in the image. Poses do not change.
Between keyframes the displacement is interpolated, not the motion, which keeps its detail.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from video2anim.pipeline.options import limits
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import BackgroundImage, KeyframedMotion, MetricDepth, SceneModel

if TYPE_CHECKING:
    from video2anim.motion.keyframe_fit import RootFitConfig


@dataclass(frozen=True)
class KeyframesConfig:
    """Keyframes, samples, weights and steps of the optimization."""

    keyframe_interval_frames: Annotated[int, limits("frames", ge=1, le=100_000)] = 5
    """Step between keyframes (paper: 5); the first and last frame of every valid run are keyframes too."""
    sampled_vertices: Annotated[int, limits(ge=1, le=100_000)] = 500
    """Skin vertices tested for penetration, spread by farthest-point sampling."""
    contact_points: Annotated[int, limits(ge=1, le=100_000)] = 5
    """Nearest vertices of a part whose mean distance is brought to zero."""
    weight_regularization: Annotated[float, limits(ge=0, le=1_000_000)] = 40.0
    """On the mean squared displacement (m^2). With a tenth of it roots follow errors of the scene: on clips with motion
    capture the root's path became up to 12 mm worse by this stage; with this value it changes by less than 3 mm."""
    weight_contact: Annotated[float, limits(ge=0, le=1_000_000)] = 17.0
    """On the mean Huber cost of the contact distance (m^2)."""
    weight_penetration: Annotated[float, limits(ge=0, le=1_000_000)] = 100.0
    """On the mean squared depth of penetrating vertices (m^2), over all frames: between keyframes too."""
    weight_displacement_change: Annotated[float, limits(ge=0, le=1_000_000)] = 2.0
    """On the squared difference of consecutive displacements (m^2); the paper's smoothness, taken on the displacement
    so that walking is not slowed."""
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
    from video2anim.motion.keyframe_fit import fit_roots, root_fit_quality
    from video2anim.motion.keyframe_problem import choose_keyframes

    grid = SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)
    usable = _depth_is_usable(depth, background, ctx)
    people, indices = [], []
    for number, motion in enumerate(depth.bodies.people):
        keyframes = choose_keyframes(motion.valid, config.keyframe_interval_frames)
        indices.append(keyframes)
        if len(keyframes) == 0:
            ctx.warn(f"person {motion.person_id} has no valid frame, motion left as it is")
            people.append(motion)
            continue
        seen = (depth, background) if number == 0 and usable else None
        fit = fit_roots(motion, scene.objects, keyframes, grid, seen, _fit_config(config), ctx.rng("depth points"))
        people.append(fit.motion)
        person_id = None if number == 0 else motion.person_id
        for key, value, unit in root_fit_quality(fit, config.contact_points):
            ctx.quality(key, value, unit, "lower", person_id=person_id)
        ctx.quality("root_displacement_mean", fit.mean_displacement_m, "m", person_id=person_id)
        ctx.progress(number + 1, len(depth.bodies.people))
    return KeyframedMotion(tuple(people), tuple(indices))


def _depth_is_usable(depth: MetricDepth, background: BackgroundImage, ctx: StageContext) -> bool:
    """Whether the depth loss can be used; a warning where it cannot."""
    masks, maps = background.selected_mask.shape[1:], depth.depth_m.shape[1:]
    if not depth.trusted:
        ctx.warn(f"depth loss left out, the depth's scale is not trusted ({depth.reason})")
    elif masks != maps:
        ctx.warn(f"depth loss left out, masks {masks} do not fit depth {maps}")
    return depth.trusted and masks == maps


def _fit_config(config: KeyframesConfig) -> RootFitConfig:
    from video2anim.motion.keyframe_fit import RootFitConfig
    from video2anim.motion.keyframe_roots import RootWeights

    weights = RootWeights(
        regularization=config.weight_regularization,
        contact=config.weight_contact,
        penetration=config.weight_penetration,
        displacement_change=config.weight_displacement_change,
        depth=config.weight_depth,
        huber_m=config.huber_m,
        contact_points=config.contact_points,
    )
    return RootFitConfig(
        config.sampled_vertices, config.depth_points, weights, config.iterations, config.learning_rate_m
    )


STAGE = StageSpec("keyframes", optimize_keyframes, version=13)
