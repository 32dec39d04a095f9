"""Keyframe optimization (paper 8.2): move the root of every fifth frame so that body and scene agree.

Five losses over the root displacements of the keyframes, all in square meters so that weights carry no unit:
regularization (small displacements), contact (touching parts meet the surface), penetration (other vertices stay out),
temporal smoothness, and the Chamfer distance between visible skin and metric depth. No weight moves a root away from
where the picture shows it. Poses are not touched, unless turns (`yaw`) or leg inverse kinematics (`leg_ik`) are asked
for; between keyframes the move, not the motion, is interpolated, so the raw motion keeps its detail and nothing pops.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.pipeline.options import limits, only_with
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BackgroundPlate,
    BodyMotion,
    BodyTracks,
    KeyframedMotion,
    MetricDepth,
    SceneModel,
)

if TYPE_CHECKING:
    from video2anim.fitting.keyframe_depth import DepthTarget
    from video2anim.fitting.keyframe_moves import RootMoves
    from video2anim.fitting.keyframe_points import SkinPoints
    from video2anim.fitting.keyframe_roots import ContactPart, RootProblem, RootWeights
    from video2anim.fitting.keyframe_sight import Sight
    from video2anim.geometry.sdf import SdfGrid

_LEFT_INSIDE_M = 0.01
"""Penetration that is told where the picture kept a body from leaving a solid."""


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
    weight_regularization: Annotated[float, limits(ge=0, le=1_000_000)] = 4.0
    """On the mean squared displacement along the line of sight (m^2). Depth is what one camera knows least, but that
    holds for the scene too."""
    weight_regularization_across: Annotated[float, limits(ge=0, le=1_000_000)] = 4.0
    """On the mean squared displacement across the line of sight (m^2), which would leave the picture."""
    picture_limit_ratio: Annotated[float, limits(ge=0, le=100)] = 0.05
    """No displacement across the line of sight is longer than this share of the body's height, plus the landmarks' 2D
    error at the root's depth; what a body penetrates then is left, and told."""
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
    yaw: bool = False
    """Also turn the body about the vertical through its root, per keyframe."""
    weight_yaw: Annotated[float, limits(ge=0, le=1_000_000), only_with("yaw", True)] = 4.0
    """On the mean squared way (m^2) of a point at `yaw_lever_m`, as across the line of sight; its change from keyframe
    to keyframe costs `weight_displacement_change`, and it is limited as a displacement across is."""
    yaw_lever_m: Annotated[float, limits("m", gt=0, le=100), only_with("yaw", True)] = 0.3
    """Distance from the vertical at which a turn counts as way: that of a hand at the side or a foot in mid-stride."""
    leg_ik: bool = False
    """Then bring touching feet that are still off the surface under them onto it, by leg inverse kinematics."""
    leg_ik_limit_m: Annotated[float, limits("m", gt=0, le=100), only_with("leg_ik", True)] = 0.1
    """Feet farther from an upward surface than this are left alone."""
    huber_m: Annotated[float, limits("m", gt=0, le=100)] = 0.05
    """Contact and depth distances above this count linearly."""
    iterations: Annotated[int, limits(ge=1, le=100_000)] = 200
    """Adam steps."""
    learning_rate_m: Annotated[float, limits("m", gt=0, le=10)] = 0.01
    """First step size; it falls to zero along a cosine."""


def optimize_keyframes(
    bodies: BodyTracks,
    scene: SceneModel,
    depth: MetricDepth,
    plate: BackgroundPlate,
    config: KeyframesConfig,
    ctx: StageContext,
) -> KeyframedMotion:
    """Optimize the keyframes' roots and carry the displacement over to all frames.

    Keyframes lie in valid frames only; invalid stretches are bridged. Depth is used for the main person, whose mask the
    plate holds, and only where the depth's scale is trusted.
    """
    from video2anim.geometry.sdf import SdfGrid

    grid = SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)
    masks_fit = plate.selected_mask.shape[1:] == depth.depth_m.shape[1:]
    usable = depth.trusted and masks_fit
    if not depth.trusted:
        ctx.warn(f"depth loss left out, the depth's scale is not trusted ({depth.reason})")
    elif not masks_fit:
        masks, maps = plate.selected_mask.shape[1:], depth.depth_m.shape[1:]
        ctx.warn(f"depth loss left out, masks {masks} do not fit depth {maps}")
    people, indices = [], []
    for number, motion in enumerate(bodies.people):
        keyframes = _choose_keyframes(motion.valid, config.keyframe_interval_frames)
        indices.append(keyframes)
        if len(keyframes) == 0:
            ctx.warn(f"person {motion.person_id} has no valid frame, motion left as it is")
            people.append(motion)
            continue
        seen = (depth, plate) if number == 0 and usable else None
        error_px = bodies.quality[number].reprojection_px if bodies.quality else 0.0
        name = "" if number == 0 else f" (person {motion.person_id})"
        people.append(_optimize_person(motion, keyframes, grid, seen, error_px, config, ctx, name))
        ctx.progress(number + 1, len(bodies.people))
    return KeyframedMotion(tuple(people), tuple(indices))


def _optimize_person(
    motion: BodyMotion,
    keyframes: Int[np.ndarray, "keyframes"],
    grid: SdfGrid,
    seen: tuple[MetricDepth, BackgroundPlate] | None,
    error_px: float,
    config: KeyframesConfig,
    ctx: StageContext,
    name: str,
) -> BodyMotion:
    """One person moved; `error_px` is the 2D error of its fit, `name` ends the names of its quality numbers."""
    from video2anim.body.anny_body import shaped_body
    from video2anim.fitting.keyframe_depth import depth_targets
    from video2anim.fitting.keyframe_legs import plant_feet
    from video2anim.fitting.keyframe_points import SkinSample
    from video2anim.fitting.keyframe_roots import solve_root_moves
    from video2anim.fitting.keyframe_sight import sight_of

    body = shaped_body(motion.shape)
    sample = SkinSample(body, spread=config.sampled_vertices, per_part=config.vertices_per_contact_part)
    before = sample.on(motion)
    sight = sight_of(
        motion,
        keyframes,
        stature_m=float(np.ptp(body.rest_vertices_m[:, 1])),
        limit_ratio=config.picture_limit_ratio,
        reprojection_px=error_px,
    )
    targets = (
        depth_targets(motion, body, *seen, points=config.depth_points, rng=ctx.rng("depth points")) if seen else ()
    )
    problem = _root_problem(motion, keyframes, before, sight, grid, targets, config)
    found = solve_root_moves(
        problem,
        _weights(config),
        iterations=config.iterations,
        learning_rate_m=config.learning_rate_m,
        yaw=config.yaw,
    )
    moves = found.at_all_frames(keyframes, motion.frame_count)
    moved = moves.apply(motion)
    after = sample.on(moved)
    if config.leg_ik:
        planted = plant_feet(
            moved,
            keyframes,
            after,
            grid,
            contact_threshold=config.contact_threshold,
            contact_points=config.contact_points,
            limit_m=config.leg_ik_limit_m,
        )
        ctx.quality(f"feet brought to their surface{name}", planted.moved, "count", "none")
        ctx.quality(f"feet left off their surface{name}", planted.left, "count", "lower")
        ctx.quality(f"foot correction max{name}", planted.largest_m, "m", "none")
        moved, after = planted.motion, sample.on(planted.motion)
    _report(ctx, name, before, after, motion.valid, grid)
    _report_moves(ctx, name, motion, moves)
    _report_keyframes(ctx, name, problem, moves, after, config)
    _report_held(ctx, name, problem, found, after)
    return moved


def _choose_keyframes(valid: Bool[np.ndarray, "frames"], interval: int) -> Int[np.ndarray, "keyframes"]:
    """Valid frames on the regular grid, and the edges of every valid stretch."""
    on_grid = np.zeros(len(valid), dtype=bool)
    on_grid[::interval] = True
    edge = np.diff(np.concatenate([[False], valid, [False]]).astype(np.int8))
    on_grid[np.flatnonzero(edge == 1)] = True
    on_grid[np.flatnonzero(edge == -1) - 1] = True
    return np.flatnonzero(on_grid & valid)


def _root_problem(
    motion: BodyMotion,
    keyframes: Int[np.ndarray, "keyframes"],
    points: SkinPoints,
    sight: Sight,
    grid: SdfGrid,
    targets: tuple[DepthTarget, ...],
    config: KeyframesConfig,
) -> RootProblem:
    """World-frame arrays at the keyframes; touches whose surface is out of reach are left out."""
    from video2anim.fitting.keyframe_points import TOUCHING
    from video2anim.fitting.keyframe_roots import ContactPart, RootProblem, contact_distance_m

    contacts: list[ContactPart] = []
    for joints in TOUCHING:
        part_m = points.touching_m(joints)
        probability = motion.contact[keyframes][:, joints].max(axis=1)
        rows = np.flatnonzero(probability >= config.contact_threshold)
        if len(rows) == 0 or part_m.shape[1] == 0:
            continue
        skin_m = part_m[keyframes[rows]]
        near = np.abs(contact_distance_m(skin_m, grid, config.contact_points)) <= config.contact_reach_m
        if near.any():
            contacts.append(ContactPart(joints, rows[near], skin_m[near], probability[rows][near]))
    valid = np.flatnonzero(motion.valid)
    skin_m = points.spread_m[valid]
    row, vertex = np.nonzero(grid.sample(skin_m) < config.penetration_reach_m)
    root_m = motion.T_world_root[:, :3, 3]
    return RootProblem(keyframes, root_m, sight, skin_m[row, vertex], valid[row], tuple(contacts), targets, grid)


def _report(
    ctx: StageContext,
    name: str,
    before: SkinPoints,
    after: SkinPoints,
    valid: Bool[np.ndarray, "frames"],
    grid: SdfGrid,
) -> None:
    """Penetration over all valid frames, keyframes and others."""
    for when, points in (("before", before), ("after", after)):
        deepest_m = _deepest_m(points.spread_m[valid], grid)
        ctx.quality(f"penetration max {when}{name}", float(deepest_m.max()), "m", "lower")
        ctx.quality(f"penetration mean {when}{name}", float(deepest_m.mean()), "m", "lower")


def _deepest_m(skin_m: Float[np.ndarray, "frames vertices 3"], grid: SdfGrid) -> Float[np.ndarray, "frames"]:
    return np.maximum(0.0, -grid.sample(skin_m).min(axis=1))


def _report_moves(ctx: StageContext, name: str, motion: BodyMotion, moves: RootMoves) -> None:
    """How far bodies went, over all valid frames."""
    shift_m = moves.displacement_m[motion.valid]
    ctx.quality(f"root displacement mean{name}", float(np.linalg.norm(shift_m, axis=1).mean()), "m", "none")
    if moves.yaw_rad.any():
        yaw_deg = float(np.rad2deg(np.abs(moves.yaw_rad[motion.valid])).mean())
        ctx.quality(f"turn mean{name}", yaw_deg, "deg", "none")


def _report_keyframes(
    ctx: StageContext, name: str, problem: RootProblem, moves: RootMoves, after: SkinPoints, config: KeyframesConfig
) -> None:
    """Contact distance and depth agreement before and after; corrections of legs do not count in the latter."""
    from video2anim.fitting.keyframe_moves import turned_about_y
    from video2anim.fitting.keyframe_roots import contact_distance_m
    from video2anim.geometry.chamfer import chamfer_m

    frames = problem.frame
    touching = {
        "before": [part.skin_m for part in problem.contacts],
        "after": [after.touching_m(part.joints)[frames[part.keyframe]] for part in problem.contacts],
    }
    visible: dict[str, list[np.ndarray]] = {"before": [], "after": []}
    for target in problem.depth:
        at = target.frame
        turned_m = turned_about_y(target.visible_m, problem.frame_root_m[at], moves.yaw_rad[at : at + 1])
        visible["before"].append(target.visible_m)
        visible["after"].append(turned_m + moves.displacement_m[at])
    for when, skins_m in touching.items():
        if skins_m:
            gaps_m = [contact_distance_m(skin_m, problem.scene, config.contact_points) for skin_m in skins_m]
            ctx.quality(f"contact distance {when}{name}", float(np.abs(np.concatenate(gaps_m)).mean()), "m", "lower")
        if visible[when]:
            pairs = zip(visible[when], problem.depth, strict=True)
            distances_m = [chamfer_m(skin_m, target.depth_m) for skin_m, target in pairs]
            ctx.quality(f"depth chamfer {when}{name}", float(np.mean(distances_m)), "m", "lower")


def _report_held(ctx: StageContext, name: str, problem: RootProblem, found: RootMoves, after: SkinPoints) -> None:
    """Keyframes that went as far across the sight as the picture lets them, and how deep they still are inside."""
    from video2anim.fitting.keyframe_sight import across_sight_m

    across_m = across_sight_m(found.displacement_m, problem.sight.direction)
    held = across_m >= 0.99 * problem.sight.limit_m
    left_m = np.where(held, _deepest_m(after.spread_m[problem.frame], problem.scene), 0.0)
    inside = left_m > _LEFT_INSIDE_M
    ctx.quality(f"root displacement across the sight max{name}", float(across_m.max()), "m", "none")
    ctx.quality(f"keyframes held in their picture{name}", float(held.mean()), "ratio", "lower")
    ctx.quality(f"penetration left for the picture{name}", float(left_m.max()), "m", "lower")
    if inside.any():
        ctx.warn(
            f"{inside.sum()} of {len(held)} keyframes stay up to {left_m.max():.2f} m inside solids, because moving on "
            f"would take the body from where the picture shows it; the scene may be wrong there{name}"
        )


def _weights(config: KeyframesConfig) -> RootWeights:
    from video2anim.fitting.keyframe_roots import RootWeights

    return RootWeights(
        regularization=config.weight_regularization,
        regularization_across=config.weight_regularization_across,
        contact=config.weight_contact,
        penetration=config.weight_penetration,
        displacement_change=config.weight_displacement_change,
        acceleration=config.weight_acceleration,
        depth=config.weight_depth,
        yaw=config.weight_yaw,
        huber_m=config.huber_m,
        contact_points=config.contact_points,
        yaw_lever_m=config.yaw_lever_m,
    )


STAGE = StageSpec("keyframes", optimize_keyframes, version=8)
