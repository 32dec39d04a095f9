"""Refinement (paper 8.2): an in-betweening prior makes the motion from sparse keyframes of the observed one, and one
least-squares solve puts it into the picture and the scene (`scenemi.postprocess.motion_solve`).

The prior is `scenemi`; where its weights are absent the observed motion itself goes into the solve, and that is said.
The same solve without the prior is made too: the share of frames in which the two differ says how much the prior did.
What body and scene disagree in is given to the scene where its distance from the camera is uncertain: the stage returns
the scene with objects moved along their lines of sight. What somebody moves follows the hand that has
it; it is a solid only where it stays for more than half of the clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float

from video2anim.errors import UsageError
from video2anim.pipeline.options import limits
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BodyMotion,
    BodyTracks,
    KeyframedMotion,
    MetricDepth,
    PlacedObject,
    RefinedMotion,
    SceneModel,
)

if TYPE_CHECKING:
    from scenemi.postprocess.motion_solve import SceneMotion
    from scenemi.postprocess.solids import Solids
    from scenemi.prior import InbetweeningPrior
    from video2anim.geometry.moving_field import MovingField
    from video2anim.geometry.sdf import SdfGrid
    from video2anim.types.quality import Unit

FPS = 30.0
"""Motion is at 30 fps after ingest."""
_JUMP = 6.0
"""Frames whose jerk exceeds the median by this factor are jumps of the observation."""
_DIFFERENT_RAD = np.deg2rad(3.0)
"""A joint's rotation differs when it does by more than this."""
_MOVED_M = 0.001
"""Objects that moved less stay."""
_FAR_M = 0.5
"""Distances beyond this are not measured: touch reaches 0.25 m, and normals are taken one spacing around."""
_SLAB_SPACING_M = 0.02
"""Of the field of an inferred support: slabs of 5 cm are lost between the nodes of the scene's."""
_VERTICES = 500
"""Skin vertices that penetration is measured with."""


@dataclass(frozen=True)
class RefineConfig:
    """Which prior, how sparse its keyframes, and how uncertain objects are."""

    prior: Literal["auto", "interpolation", "scenemi"] = "auto"
    """`auto` = `scenemi` where weights are present, else `interpolation`."""
    keyframe_interval_frames: Annotated[int, limits("frames", ge=1, le=100_000)] = 5
    """Frames between keyframes given to the prior (paper: 15, every third optimized keyframe)."""
    keyframe_noise_deg: Annotated[float, limits("degrees", ge=0, le=100)] = 6.0
    """How far the rotations of keyframes from video are off (paper's l)."""
    keyframe_noise_cm: Annotated[float, limits("cm", ge=0, le=100)] = 3.0
    """How far their translation is off."""
    window_frames: Annotated[int, limits("frames", ge=2, le=100_000)] = 121
    """Length of one synthesis (paper: N = 121)."""
    overlap_frames: Annotated[int, limits("frames", ge=0, le=100_000)] = 60
    """Frames of a window that seed the next (paper: v = 60)."""
    objects_move: bool = True
    """Whether objects give way along their lines of sight, as far as the calibration leaves their distance open."""
    object_across_ratio: Annotated[float, limits(gt=0, le=10)] = 0.01
    """Standard deviation of an object's place across the horizontal line of sight, over its distance."""
    object_top_m: Annotated[float, limits("m", gt=0, le=10)] = 0.05
    """Standard deviation of its height."""
    support_m: Annotated[float, limits("m", gt=0, le=10)] = 0.05
    """Standard deviation of an inferred support's place, each way: only the body that rested on it tells of it."""

    def __post_init__(self) -> None:
        if self.overlap_frames >= self.window_frames:
            raise UsageError(
                f"refine: want overlap_frames < window_frames, got {self.overlap_frames} and {self.window_frames}"
            )


def refine_motion(
    bodies: BodyTracks,
    depth: MetricDepth,
    keyframed: KeyframedMotion,
    scene: SceneModel,
    config: RefineConfig,
    ctx: StageContext,
) -> RefinedMotion:
    """Make the final motion of every person, and the scene that it fits.

    Raises:
        ModelMissingError: the prior is set to `scenemi` and its weights are absent.
    """
    from scenemi.postprocess.motion_solve import solve_motions
    from scenemi.prior import InterpolationPrior, load_prior
    from video2anim.objects.path import follow_hand

    prior = load_prior(config.prior, device=ctx.device, seed=ctx.seed)
    if config.prior == "auto" and prior.name != "scenemi":
        ctx.warn("no scenemi weights present: the observed motion is not repaired, only fitted to picture and scene")
    bridging = InterpolationPrior(monotone=True)
    prior = prior if prior.name == "scenemi" else bridging
    solids, field = _solids(scene, keyframed.people[0], config), _field(scene)
    seen = [number for number, motion in enumerate(keyframed.people) if motion.valid.any()]
    for motion in keyframed.people:
        if not motion.valid.any():
            ctx.warn(f"person {motion.person_id} has no valid frame, motion left as it is")
    observed = [_observation(keyframed.people[number], scene.objects) for number in seen]
    made, alone = (
        [
            _filled(keyframed.people[number], one, by, field, config, ctx)
            for number, one in zip(seen, observed, strict=True)
        ]
        for by in (prior, bridging)
    )
    solved, plain = solve_motions(made, solids), solve_motions(alone, solids)
    people, alike = list(keyframed.people), list(keyframed.people)
    for k, number in enumerate(seen):
        people[number], alike[number] = (
            keyframed.people[number].with_pose(
                translation_world_m=one.translation_world_m[k], R_parent_joint=one.R_parent_joint[k]
            )
            for one in (solved, plain)
        )
    moved = _moved(scene, solids, solved.moved_m, ctx)
    # The paths were found with the bodies of stage metric.
    moved = replace(moved, objects=tuple(follow_hand(item, depth.bodies.people, people) for item in moved.objects))
    after, moving = _field(moved), _moving(moved)
    names, shares = ["none"] * len(people), [0.0] * len(people)
    for done, number in enumerate(seen, start=1):
        motion = keyframed.people[number]
        person_id = None if number == 0 else motion.person_id
        people[number], alike[number] = (
            _touching(one, after, moving, moved.objects) for one in (people[number], alike[number])
        )
        without = alike[number]
        if prior.name == "scenemi":
            names[number], shares[number] = prior.name, _shaped(people[number], without)
        ctx.quality("frames_shaped_by_prior", shares[number], "ratio", "higher", person_id=person_id)
        raw = bodies.people[number].in_world(motion.T_world_camera)
        for when, one, where in (
            ("raw", raw, field),
            ("without_prior", without, after),
            ("refined", people[number], after),
        ):
            _report(ctx, when, one, raw, where, person_id)
        ctx.progress(done, len(seen))
    return RefinedMotion(tuple(people), tuple(names), tuple(shares), tuple(alike), moved)


def _filled(
    motion: BodyMotion,
    observed: SceneMotion,
    prior: InbetweeningPrior,
    field: SdfGrid,
    config: RefineConfig,
    ctx: StageContext,
) -> SceneMotion:
    """What a prior makes of keyframes of the observed motion: `scenemi` of sparse and noisy ones, interpolation of all
    that are calm, between which it only bridges gaps."""
    from scenemi.longmotion import KeyframeMotion, inbetween
    from scenemi.windows import select_keyframes

    interval = config.keyframe_interval_frames if prior.name == "scenemi" else 1
    keys = np.zeros(motion.frame_count, bool)
    keys[select_keyframes(motion.frame_count, interval, usable=inlier_frames(motion))] = True
    given = KeyframeMotion(
        observed.R_parent_joint, observed.translation_world_m, keys, motion.rest_joints_m, FPS, observed.body,
        noise=(config.keyframe_noise_deg, config.keyframe_noise_cm),
    )  # fmt: skip
    made = inbetween(given, prior, scene=field, window=config.window_frames, overlap=config.overlap_frames)
    if len(made.bridged_index) and prior.name == "scenemi":
        frames = ", ".join(str(i) for i in made.bridged_index)
        ctx.warn(f"person {motion.person_id}: gaps longer than a window were bridged by interpolation at {frames}")
    return replace(observed, R_parent_joint=made.R_parent_joint, translation_world_m=made.translation_world_m)


def _observation(motion: BodyMotion, objects: Sequence[PlacedObject]) -> SceneMotion:
    """The motion after keyframes, and where the picture shows it: keyframes go along their lines of sight. Hands that
    hold something touch no solid."""
    from scenemi.postprocess.motion_solve import PictureTarget, SceneMotion
    from video2anim.body.anny_body import shaped_body
    from video2anim.body.contact import believed
    from video2anim.geometry.projection import invert_rigid, project
    from video2anim.objects.path import holding

    shaped = shaped_body(motion.shape)
    camera_m = motion.joints_camera_m
    body_height_m = float(np.ptp(shaped.rest_vertices_m[:, 1]))
    picture = PictureTarget(
        project(camera_m, motion.intrinsics), inlier_frames(motion) & (camera_m[:, 0, 2] > 0.1),
        motion.intrinsics.fy_px * body_height_m / np.maximum(camera_m[:, 0, 2], 0.1),
        invert_rigid(motion.T_world_camera), motion.intrinsics.matrix(),
    )  # fmt: skip
    contact = np.where(holding(objects, motion), 0.0, believed(motion, shaped))
    fixed = np.zeros(motion.frame_count, bool)
    return SceneMotion(
        motion.R_parent_joint, motion.T_world_root[:, :3, 3], contact, motion.rest_joints_m, shaped, FPS, fixed, picture
    )


def inlier_frames(motion: BodyMotion) -> Bool[np.ndarray, "frames"]:
    """Valid frames in which the observed body does not jump: where the landmark model changes its mind about left and
    right, or front and back, the jerk is many times what it is elsewhere, and poses tell nothing."""
    calm = motion.valid.copy()
    jerk_m_s3 = np.linalg.norm(np.diff(motion.joints_world_m, n=3, axis=0), axis=-1).mean(1) * FPS**3
    if not len(jerk_m_s3):
        return calm
    for first in np.flatnonzero(jerk_m_s3 > _JUMP * np.median(jerk_m_s3)):
        calm[first : first + 4] = False
    # Somebody who jumps about all the time is taken as observed.
    return calm if calm.sum() > 0.5 * motion.valid.sum() else motion.valid


def _field(scene: SceneModel) -> SdfGrid:
    from video2anim.geometry.sdf import SdfGrid

    return SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)


def _solids(scene: SceneModel, main: BodyMotion, config: RefineConfig) -> Solids:
    """The objects, that give way mostly along their horizontal lines of sight; everything together where none does.
    What somebody moves is one if it stays where it is for more than half of the clip, as it is in the scene's field."""
    from scenemi.postprocess.solids import MovableSolid, Solids
    from video2anim.geometry.scene_mesh import world_mesh
    from video2anim.geometry.sdf import build_sdf_grid
    from video2anim.objects.path import settled
    from video2anim.scene.supports import SUPPORT

    standing = [item for item in map(settled, scene.objects) if item is not None]
    if not standing or not config.objects_move:
        return Solids(_field(scene), floor=False)
    camera_m = main.T_world_camera[0, :3, 3]
    movable = []
    for item in standing:
        solid = world_mesh(item.mesh, item.T_world_object, item.scale)
        bounds_m = np.stack([solid.vertices_m.min(0) - 0.3, solid.vertices_m.max(0) + 0.3])
        inferred = item.label == SUPPORT
        finest_m = min(_SLAB_SPACING_M, scene.sdf_spacing_m) if inferred else scene.sdf_spacing_m
        spacing_m = max(finest_m, float(np.ptp(bounds_m, axis=0).max()) / 60)
        away_m = 0.5 * bounds_m.sum(0) - camera_m
        away_m[1] = 0.0
        field = build_sdf_grid([solid], bounds_m, spacing_m, floor_y_m=None, reach_m=_FAR_M)
        along = item.distance_sigma**2 * np.outer(away_m, away_m)
        across = config.object_across_ratio**2 * (away_m @ away_m) * np.diag([1.0, 0.0, 1.0])
        covariance_m2 = along + across + np.diag([0.0, config.object_top_m**2, 0.0])
        movable.append(MovableSolid(field, config.support_m**2 * np.eye(3) if inferred else covariance_m2))
    return Solids(None, tuple(movable))


def _moved(scene: SceneModel, solids: Solids, moved_m: Float[np.ndarray, "solids 3"], ctx: StageContext) -> SceneModel:
    """The scene with its objects where the solve has them."""
    from video2anim.objects.path import settled

    if not (np.abs(moved_m) > _MOVED_M).any():
        return scene
    objects, ways_m = [], iter(moved_m)
    for item in scene.objects:
        if settled(item) is None:
            objects.append(item)
            continue
        way_m = next(ways_m)
        paths = tuple(replace(path, T_world_object=_shifted(path.T_world_object, way_m)) for path in item.path)
        objects.append(replace(item, T_world_object=_shifted(item.T_world_object, way_m), path=paths))
        ctx.quality("moved", float(np.linalg.norm(way_m)), "m", object_id=item.object_id)
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in scene.sdf_m.shape), indexing="ij"), -1)
    slabs = [solids.distance_m(scene.sdf_origin_m + scene.sdf_spacing_m * slab, moved_m)[0] for slab in nodes]
    return replace(scene, objects=tuple(objects), sdf_m=np.stack(slabs).astype(np.float32))


def _shifted(T: Float[np.ndarray, "*frames 4 4"], way_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "*frames 4 4"]:
    moved = T.copy()
    moved[..., :3, 3] += way_m
    return moved


def _moving(scene: SceneModel) -> tuple[MovingField, ...]:
    """Fields of the objects that somebody moves."""
    from video2anim.geometry.moving_field import MovingField
    from video2anim.geometry.scene_mesh import world_mesh
    from video2anim.geometry.sdf import build_sdf_grid

    fields = []
    for item in scene.objects:
        if item.path:
            solid = world_mesh(item.mesh, np.eye(4), item.scale)
            bounds_m = np.stack([solid.vertices_m.min(0) - 0.1, solid.vertices_m.max(0) + 0.1])
            spacing_m = max(_SLAB_SPACING_M, float(np.ptp(bounds_m, axis=0).max()) / 60)
            field = build_sdf_grid([solid], bounds_m, spacing_m, floor_y_m=None, reach_m=_FAR_M)
            fields.append(MovingField(field, np.asarray(item.path[0].T_world_object)))
    return tuple(fields)


def _touching(
    motion: BodyMotion, scene: SdfGrid, moving: Sequence[MovingField], objects: Sequence[PlacedObject]
) -> BodyMotion:
    """A solved motion, that has its observed contacts, with those that it has in the scene; a hand that holds something
    touches it."""
    from video2anim.body.anny_body import shaped_body
    from video2anim.body.contact import touches
    from video2anim.objects.path import holding

    contact = touches(motion, shaped_body(motion.shape), scene, motion.contact, moving)
    return replace(motion, contact=np.where(holding(objects, motion), 1.0, contact))


def _shaped(refined: BodyMotion, without: BodyMotion) -> float:
    """Share of the valid frames in which some joint's rotation is another without the prior."""
    from video2anim.geometry.rotations import axis_angle_from_matrix

    turn = axis_angle_from_matrix(without.R_parent_joint.swapaxes(-1, -2) @ refined.R_parent_joint)
    return float((np.linalg.norm(turn, axis=-1).max(1) > _DIFFERENT_RAD)[refined.valid].mean())


def _report(
    ctx: StageContext, when: str, motion: BodyMotion, seen: BodyMotion, field: SdfGrid, person_id: int | None
) -> None:
    """Quality from the first to the last valid frame."""
    from scenemi import metrics
    from video2anim.body.anny_body import shaped_body
    from video2anim.types.skeleton import forward_kinematics

    measured = np.flatnonzero(motion.valid)
    span = slice(int(measured[0]), int(measured[-1]) + 1)
    body = shaped_body(motion.shape)
    index = np.arange(0, len(body.rest_vertices_m), max(1, len(body.rest_vertices_m) // _VERTICES))
    joints_m, R_world_joint = forward_kinematics(
        motion.R_parent_joint[span], motion.T_world_root[span, :3, 3], motion.rest_joints_m
    )
    distance_m = field.sample(body.vertices(R_world_joint, joints_m, index).astype(np.float64))
    off = picture_distance_ratio(motion, seen)
    rows: tuple[tuple[str, float, Unit], ...] = (
        ("jerk", metrics.jerk_m_s3(joints_m, FPS), "m/s^3"),
        ("foot_skating_gmd", metrics.foot_skating_gmd(joints_m, FPS), "ratio"),
        ("penetration_max", metrics.penetration_max_m(distance_m), "m"),
        ("frames_in_collision_1cm", metrics.collision_frame_ratio(distance_m, metrics.COLLISION_TAUS_M[1]), "ratio"),
        ("image_distance_over_height", 100 * float(np.median(off)), "%"),
    )
    for key, value, unit in rows:
        ctx.quality(f"{key}_{when}", value, unit, "lower", person_id=person_id)


def picture_distance_ratio(motion: BodyMotion, seen: BodyMotion) -> Float[np.ndarray, "valid"]:
    """Mean distance in the picture of the joints of two motions of one person, over the standing body's height there,
    in every valid frame."""
    from video2anim.body.anny_body import shaped_body
    from video2anim.geometry.projection import project

    body_height_m = float(np.ptp(shaped_body(seen.shape).rest_vertices_m[:, 1]))
    valid = motion.valid & seen.valid
    here, there = (one.joints_camera_m[valid] for one in (motion, seen))
    apart_px = np.linalg.norm(project(here, motion.intrinsics) - project(there, seen.intrinsics), axis=-1).mean(1)
    return apart_px * np.maximum(there[:, 0, 2], 0.1) / (seen.intrinsics.fy_px * body_height_m)


STAGE = StageSpec("refine", refine_motion, version=12, models=("prior",))
