"""Refinement (paper 8.2): an in-betweening prior makes the motion from sparse keyframes of the observed one, and one
least-squares solve puts it into the picture and the scene (`scenemi.postprocess.motion_solve`).

The prior is `scenemi`; where its weights are absent the observed motion itself goes into the solve, and that is said.
The same solve without the prior is made too: the share of frames in which the two differ says how much the prior did.
What body and scene disagree in is given to the scene where its distance from the camera is uncertain: the stage returns
the scene with objects moved along their lines of sight. What somebody moves follows the hand that has
it; it is a solid only where it stays for more than half of the clip.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from video2anim.errors import UsageError
from video2anim.pipeline.options import limits
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BodyMotion,
    BodyTracks,
    KeyframedMotion,
    MetricDepth,
    RefinedMotion,
    SceneModel,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from scenemi.postprocess.motion_solve import SceneMotion, Solved
    from scenemi.prior import InbetweeningPrior
    from video2anim.geometry.sdf import SdfGrid


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
    from scenemi.model.load import load_prior
    from scenemi.postprocess.motion_solve import solve_motions
    from scenemi.prior import InterpolationPrior
    from video2anim.motion.assessment import shaped_by_prior
    from video2anim.motion.movable_scene import (
        PlaceUncertainty,
        movable_solids,
        moved_scene,
        moving_fields,
        scene_field,
        with_scene_contacts,
    )
    from video2anim.motion.observation import observation
    from video2anim.objects.path import follow_hand

    prior = load_prior(config.prior, device=ctx.device, seed=ctx.seed)
    if config.prior == "auto" and prior.name != "scenemi":
        ctx.warn("no scenemi weights present: the observed motion is not repaired, only fitted to picture and scene")
    bridging = InterpolationPrior(monotone=True)
    prior = prior if prior.name == "scenemi" else bridging
    uncertainty = PlaceUncertainty(
        config.objects_move, config.object_across_ratio, config.object_top_m, config.support_m
    )
    solids = movable_solids(scene, keyframed.people[0].T_world_camera[0, :3, 3], uncertainty)
    field = scene_field(scene)
    seen = [number for number, motion in enumerate(keyframed.people) if motion.valid.any()]
    for motion in keyframed.people:
        if not motion.valid.any():
            ctx.warn(f"person {motion.person_id} has no valid frame, motion left as it is")
    observed = [(keyframed.people[number], observation(keyframed.people[number], scene.objects)) for number in seen]
    solved, plain = (
        solve_motions([_filled(motion, one, by, field, config, ctx) for motion, one in observed], solids)
        for by in (prior, bridging)
    )
    people, alike = (_posed(keyframed.people, seen, one) for one in (solved, plain))
    moved = moved_scene(scene, solids, solved.moved_m)
    _report_places(ctx, scene, moved)
    # The paths were found with the bodies of stage metric.
    moved = replace(moved, objects=tuple(follow_hand(item, depth.bodies.people, people) for item in moved.objects))
    after, moving = scene_field(moved), moving_fields(moved)
    names, shares = ["none"] * len(people), [0.0] * len(people)
    for done, number in enumerate(seen, start=1):
        motion = keyframed.people[number]
        person_id = None if number == 0 else motion.person_id
        people[number], alike[number] = (
            with_scene_contacts(one, after, moving, moved.objects) for one in (people[number], alike[number])
        )
        if prior.name == "scenemi":
            names[number], shares[number] = prior.name, shaped_by_prior(people[number], alike[number])
        ctx.quality("frames_shaped_by_prior", shares[number], "ratio", "higher", person_id=person_id)
        raw = bodies.people[number].in_world(motion.T_world_camera)
        stages = (("raw", raw, field), ("without_prior", alike[number], after), ("refined", people[number], after))
        _report(ctx, stages, person_id)
        ctx.progress(done, len(seen))
    return RefinedMotion(tuple(people), tuple(names), tuple(shares), tuple(alike), moved)


def _posed(people: Sequence[BodyMotion], numbers: Sequence[int], solved: Solved) -> list[BodyMotion]:
    """The people, those of the numbers in their solved poses."""
    posed = list(people)
    for k, number in enumerate(numbers):
        posed[number] = people[number].with_pose(
            translation_world_m=solved.translation_world_m[k], R_parent_joint=solved.R_parent_joint[k]
        )
    return posed


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
    from video2anim.motion.observation import inlier_frames
    from video2anim.types.clip import FPS

    interval = config.keyframe_interval_frames if prior.name == "scenemi" else 1
    keys = np.zeros(motion.frame_count, bool)
    keys[select_keyframes(motion.frame_count, interval, usable=inlier_frames(motion))] = True
    given = KeyframeMotion(
        observed.R_parent_joint, observed.translation_world_m, keys, motion.rest_joints_m, FPS, observed.body,
        noise=(config.keyframe_noise_deg, config.keyframe_noise_cm),
    )  # fmt: skip
    made = inbetween(given, prior, scene=field, window=config.window_frames, overlap=config.overlap_frames)
    if len(made.interpolated_index) and prior.name == "scenemi":
        frames = ", ".join(str(i) for i in made.interpolated_index)
        ctx.warn(f"person {motion.person_id}: gaps longer than a window were bridged by interpolation at {frames}")
    return replace(observed, R_parent_joint=made.R_parent_joint, translation_world_m=made.translation_world_m)


def _report(ctx: StageContext, stages: Sequence[tuple[str, BodyMotion, SdfGrid]], person_id: int | None) -> None:
    """Quality of a motion by stage; the first of them is what the image shows."""
    from video2anim.motion.assessment import assess

    for when, motion, field in stages:
        for key, value, unit in assess(motion, stages[0][1], field):
            ctx.quality(f"{key}_{when}", value, unit, "lower", person_id=person_id)


def _report_places(ctx: StageContext, before: SceneModel, after: SceneModel) -> None:
    for old, new in zip(before.objects, after.objects, strict=True):
        way_m = new.T_world_object[:3, 3] - old.T_world_object[:3, 3]
        if way_m.any():
            ctx.quality("moved", float(np.linalg.norm(way_m)), "m", object_id=new.object_id)


STAGE = StageSpec("refine", refine_motion, version=12, models=("prior",))
