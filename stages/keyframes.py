"""Keyframe optimization (paper 8.2): move the root of every fifth frame so that body and scene agree.

Five losses over the root displacements of the keyframes, all in square meters so that weights carry no unit:
regularization (small displacements), contact (touching parts meet the surface), penetration (other vertices stay out),
temporal smoothness, and the Chamfer distance between visible skin and metric depth. Poses are not touched; between
keyframes the displacement, not the motion, is interpolated, so the raw motion keeps its detail and nothing pops.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

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
    from video2anim.body.anny_body import ShapedBody
    from video2anim.fitting.keyframe_roots import ContactPart, DepthTarget, RootProblem, RootWeights
    from video2anim.geometry.sdf import SdfGrid

CONTACT_JOINTS = (
    "pelvis", "left_ankle", "right_ankle", "left_foot", "right_foot", "left_wrist", "right_wrist",
)  # fmt: skip
"""Parts that may be pulled to a surface."""


@dataclass(frozen=True)
class KeyframesConfig:
    """Which frames are optimized, and by what."""

    keyframe_interval_frames: int = 5
    """Every such frame is a keyframe, besides the first and the last valid one (paper: 5)."""
    sampled_vertices: int = 500
    """Skin vertices tested for penetration, spread by farthest-point sampling."""
    vertices_per_contact_part: int = 100
    """Skin vertices of each part that may touch."""
    contact_threshold: float = 0.5
    """Contact probability from which a part is pulled to the surface, weighed by the probability."""
    contact_reach_m: float = 0.25
    """A touching part farther than this from every surface is left alone: what it touches is not in the scene."""
    contact_points: int = 5
    """Nearest vertices of a part whose mean distance is brought to zero."""
    weight_regularization: float = 1.0
    """On the mean squared displacement along the line of sight (m^2): depth is what one camera knows least."""
    weight_regularization_across: float = 4.0
    """On the mean squared displacement across the line of sight (m^2), which would leave the picture."""
    weight_contact: float = 20.0
    """On the mean Huber cost of the contact distance (m^2)."""
    penetration_reach_m: float = 0.2
    """Vertices that start farther from every surface are not tested for penetration."""
    weight_penetration: float = 100.0
    """On the mean squared depth of penetrating vertices (m^2), over all frames: between keyframes too."""
    weight_displacement_change: float = 2.0
    """On the squared difference of consecutive displacements (m^2); the paper's smoothness, taken on the displacement
    so that walking is not slowed."""
    weight_acceleration: float = 0.1
    """On the squared second difference of consecutive roots (m^2), at the keyframe interval."""
    weight_depth: float = 5.0
    """On the robust Chamfer cost (m^2)."""
    depth_points: int = 800
    """Depth points, and as many visible vertices, per sampled frame."""
    huber_m: float = 0.05
    """Contact and depth distances above this count linearly."""
    iterations: int = 200
    """Adam steps."""
    learning_rate_m: float = 0.01
    """First step size; it falls to zero along a cosine."""


@dataclass(frozen=True, slots=True, eq=False)
class _BodyPoints:
    """Skin samples relative to the root, and which of them belong to parts that may touch."""

    spread_m: Float[np.ndarray, "frames spread 3"]
    parts_m: dict[int, Float[np.ndarray, "frames part 3"]]
    """By contact joint."""


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
    from video2anim.body.anny_body import shaped_body
    from video2anim.fitting.keyframe_roots import solve_root_displacements
    from video2anim.geometry.sdf import SdfGrid

    grid = SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)
    if not depth.trusted:
        ctx.warn(f"depth loss left out, the depth's scale is not trusted ({depth.reason})")
    people, indices = [], []
    for number, motion in enumerate(bodies.people):
        keyframes = _choose_keyframes(motion.valid, config.keyframe_interval_frames)
        indices.append(keyframes)
        if len(keyframes) == 0:
            ctx.warn(f"person {motion.person_id} has no valid frame, motion left as it is")
            people.append(motion)
            continue
        body = shaped_body(motion.shape)
        points = _body_points(motion, body, config)
        targets = _depth_targets(motion, body, depth, plate, config, ctx) if number == 0 and depth.trusted else []
        problem = _root_problem(motion, keyframes, points, grid, targets, config)
        found_m = solve_root_displacements(
            problem, _weights(config), iterations=config.iterations, learning_rate_m=config.learning_rate_m
        )
        shift_m = _between_keyframes(keyframes, found_m, motion.frame_count)
        moved = motion.with_pose(
            translation_world_m=motion.T_world_root[:, :3, 3] + shift_m, R_parent_joint=motion.R_parent_joint
        )
        skin_m = points.spread_m[motion.valid] + motion.T_world_root[motion.valid, None, :3, 3]
        name = "" if number == 0 else f" (person {motion.person_id})"
        _report(ctx, name, skin_m, shift_m[motion.valid], grid)
        _report_keyframes(ctx, name, problem, found_m, config)
        people.append(moved)
        ctx.progress(number + 1, len(bodies.people))
    return KeyframedMotion(tuple(people), tuple(indices))


def _choose_keyframes(valid: Bool[np.ndarray, "frames"], interval: int) -> Int[np.ndarray, "keyframes"]:
    """Valid frames on the regular grid, and the edges of every valid stretch."""
    on_grid = np.zeros(len(valid), dtype=bool)
    on_grid[::interval] = True
    edge = np.diff(np.concatenate([[False], valid, [False]]).astype(np.int8))
    on_grid[np.flatnonzero(edge == 1)] = True
    on_grid[np.flatnonzero(edge == -1) - 1] = True
    return np.flatnonzero(on_grid & valid)


def _body_points(motion: BodyMotion, body: ShapedBody, config: KeyframesConfig) -> _BodyPoints:
    from video2anim.body.skeleton import JOINT_INDEX, forward_kinematics

    spread = _farthest_points(body.rest_vertices_m, config.sampled_vertices)
    part_index = {}
    for name in CONTACT_JOINTS:
        members = np.flatnonzero(body.vertex_part == JOINT_INDEX[name])
        chosen = _farthest_points(body.rest_vertices_m[members], config.vertices_per_contact_part)
        part_index[JOINT_INDEX[name]] = members[chosen]
    index = np.concatenate([spread, *part_index.values()])
    root_m = motion.T_world_root[:, :3, 3]
    joints_m, R_world_joint = forward_kinematics(motion.R_parent_joint, np.zeros_like(root_m), motion.rest_joints_m)
    relative_m = body.vertices(R_world_joint, joints_m, index).astype(np.float64)
    parts, at = {}, len(spread)
    for joint, chosen in part_index.items():
        parts[joint] = relative_m[:, at : at + len(chosen)]
        at += len(chosen)
    return _BodyPoints(relative_m[:, : len(spread)], parts)


def _farthest_points(points_m: Float[np.ndarray, "points 3"], count: int) -> Int[np.ndarray, "chosen"]:
    """Farthest-point sampling from point 0; all points where there are no more than `count`."""
    if len(points_m) <= count:
        return np.arange(len(points_m))
    chosen = [0]
    nearest = np.linalg.norm(points_m - points_m[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(points_m - points_m[chosen[-1]], axis=1))
    return np.array(chosen)


def _depth_targets(
    motion: BodyMotion,
    body: ShapedBody,
    depth: MetricDepth,
    plate: BackgroundPlate,
    config: KeyframesConfig,
    ctx: StageContext,
) -> list[DepthTarget]:
    """Frames that have both depth and a mask of the person, with enough valid pixels in it."""
    from video2anim.body.skeleton import forward_kinematics
    from video2anim.fitting.keyframe_roots import DepthTarget
    from video2anim.geometry.projection import backproject, invert_rigid, transform_points
    from video2anim.geometry.visible import visible_vertices

    height, width = depth.depth_m.shape[1:]
    if plate.selected_mask.shape[1:] != (height, width):
        masks = plate.selected_mask.shape[1:]
        ctx.warn(f"depth loss left out, masks {masks} do not fit depth {(height, width)}")
        return []
    intrinsics = motion.intrinsics.resized(width, height)
    common, in_depth, in_plate = np.intersect1d(depth.frame_index, plate.frame_index, return_indices=True)
    rng = ctx.rng("depth points")
    targets: list[DepthTarget] = []
    for frame, d, p in zip(common, in_depth, in_plate, strict=True):
        seen = plate.selected_mask[p] & depth.valid[d] & (depth.depth_m[d] > 0)
        if not motion.valid[frame] or seen.sum() < 50:
            continue
        T_world_camera = depth.T_world_camera[frame]
        points_m = transform_points(T_world_camera, backproject(depth.depth_m[d], intrinsics)[seen])
        _, R_world_joint = forward_kinematics(
            motion.R_parent_joint[frame], motion.T_world_root[frame, :3, 3], motion.rest_joints_m
        )
        skin_m = body.vertices(R_world_joint[None], motion.joints_world_m[frame][None])[0].astype(np.float64)
        skin_camera_m = transform_points(invert_rigid(T_world_camera), skin_m)
        visible_m = skin_m[visible_vertices(skin_camera_m, body.faces, intrinsics)]
        if len(visible_m) < 50:
            continue
        chosen = [
            rng.choice(len(array), min(len(array), config.depth_points), replace=False)
            for array in (visible_m, points_m)
        ]
        targets.append(DepthTarget(int(frame), visible_m[chosen[0]], points_m[chosen[1]]))
    return targets


def _root_problem(
    motion: BodyMotion,
    keyframes: Int[np.ndarray, "keyframes"],
    points: _BodyPoints,
    grid: SdfGrid,
    targets: list[DepthTarget],
    config: KeyframesConfig,
) -> RootProblem:
    """World-frame arrays at the keyframes; touches whose surface is out of reach are left out."""
    from video2anim.fitting.keyframe_roots import ContactPart, RootProblem, contact_distance_m

    root_m = motion.T_world_root[keyframes, :3, 3]
    still = np.zeros_like(root_m)
    contacts: list[ContactPart] = []
    for joint, relative_m in points.parts_m.items():
        probability = motion.contact[keyframes, joint]
        rows = np.flatnonzero(probability >= config.contact_threshold)
        if len(rows) == 0 or relative_m.shape[1] == 0:
            continue
        part = ContactPart(rows, relative_m[keyframes[rows]] + root_m[rows, None], probability[rows])
        near = np.abs(contact_distance_m(part, still, grid, config.contact_points)) <= config.contact_reach_m
        if near.any():
            contacts.append(ContactPart(rows[near], part.skin_m[near], probability[rows][near]))
    valid = np.flatnonzero(motion.valid)
    skin_m = points.spread_m[valid] + motion.T_world_root[valid, None, :3, 3]
    row, vertex = np.nonzero(grid.sample(skin_m) < config.penetration_reach_m)
    sight = root_m - motion.T_world_camera[keyframes, :3, 3]
    sight /= np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-6)
    return RootProblem(keyframes, root_m, sight, skin_m[row, vertex], valid[row], tuple(contacts), tuple(targets), grid)


def _between_keyframes(
    keyframes: Int[np.ndarray, "keyframes"], displacement_m: Float[np.ndarray, "keyframes 3"], frame_count: int
) -> Float[np.ndarray, "frames 3"]:
    """Displacement of every frame: monotone cubic between keyframes (no overshoot), constant beyond them."""
    from scipy.interpolate import PchipInterpolator

    if len(keyframes) == 1:
        return np.tile(displacement_m, (frame_count, 1))
    frames = np.clip(np.arange(frame_count), keyframes[0], keyframes[-1])
    return PchipInterpolator(keyframes, displacement_m)(frames)


def _report(
    ctx: StageContext,
    name: str,
    skin_m: Float[np.ndarray, "frames vertices 3"],
    shift_m: Float[np.ndarray, "frames 3"],
    grid: SdfGrid,
) -> None:
    """Quality over all valid frames, keyframes and others."""
    for when, moved_m in (("before", skin_m), ("after", skin_m + shift_m[:, None])):
        deepest_m = np.maximum(0.0, -grid.sample(moved_m).min(axis=1))
        ctx.quality(f"penetration max {when}{name}", float(deepest_m.max()), "m", "lower")
        ctx.quality(f"penetration mean {when}{name}", float(deepest_m.mean()), "m", "lower")
    ctx.quality(f"root displacement mean{name}", float(np.linalg.norm(shift_m, axis=1).mean()), "m", "none")


def _report_keyframes(
    ctx: StageContext, name: str, problem: RootProblem, found_m: np.ndarray, config: KeyframesConfig
) -> None:
    """Contact distance and depth agreement before and after."""
    from video2anim.fitting.keyframe_roots import contact_distance_m
    from video2anim.geometry.chamfer import chamfer_m

    for when, shift_m in (("before", np.zeros_like(found_m)), ("after", found_m)):
        if problem.contacts:
            gaps_m = [contact_distance_m(c, shift_m, problem.scene, config.contact_points) for c in problem.contacts]
            ctx.quality(f"contact distance {when}{name}", float(np.abs(np.concatenate(gaps_m)).mean()), "m", "lower")
        if problem.depth:
            rows = [int(np.abs(problem.frame - target.frame).argmin()) for target in problem.depth]
            distances_m = [
                chamfer_m(target.visible_m + shift_m[row], target.depth_m)
                for row, target in zip(rows, problem.depth, strict=True)
            ]
            ctx.quality(f"depth chamfer {when}{name}", float(np.mean(distances_m)), "m", "lower")


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
        huber_m=config.huber_m,
        contact_points=config.contact_points,
    )


STAGE = StageSpec("keyframes", optimize_keyframes, version=3)
