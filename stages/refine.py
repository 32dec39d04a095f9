"""Refinement (SceneMI, supplement section 8.2): an in-betweening prior makes the motion from sparse keyframes, and one
least-squares solve fits it to image and scene (`scenemi.postprocess.motion_solve`).

The prior is `scenemi`; without its weights the observed motion goes into the solve, and a warning says so. The same
solve without the prior gives the share of frames that the prior changed. Objects are moved too, mostly along their
lines of sight, since their distance from the camera is uncertain: the stage returns the scene with its objects moved.
Objects that somebody carries follow the hand; they are solid only while they rest, for more than half of the clip.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

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

    from video2anim.geometry.sdf import SdfGrid


@dataclass(frozen=True)
class RefineConfig:
    """Which prior, how sparse its keyframes, and how uncertain objects are."""

    prior: Literal["auto", "interpolation", "scenemi"] = "auto"
    """`auto` = `scenemi` where weights are present, else `interpolation`."""
    keyframe_interval_frames: Annotated[int, limits("frames", ge=1, le=100_000)] = 5
    """Frames between keyframes given to the prior (paper: 15, every third optimized keyframe)."""
    keyframe_noise_deg: Annotated[float, limits("degrees", ge=0, le=100)] = 6.0
    """Standard deviation of the keyframes' rotations (the paper's l)."""
    keyframe_noise_cm: Annotated[float, limits("cm", ge=0, le=100)] = 3.0
    """Standard deviation of the keyframes' translation."""
    objects_move: bool = True
    """Whether objects may move along their lines of sight, within the uncertainty of their distance."""
    object_across_ratio: Annotated[float, limits(gt=0, le=10)] = 0.01
    """Standard deviation of an object's position across the horizontal line of sight, over its distance."""


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
    from video2anim.motion.assessment import shaped_by_prior
    from video2anim.motion.movable_scene import PlaceUncertainty, scene_field
    from video2anim.motion.refinement import PriorConfig, refine_people

    prior = load_prior(config.prior, device=ctx.device, seed=ctx.seed)
    if config.prior == "auto" and prior.name != "scenemi":
        ctx.warn("no scenemi weights present: the observed motion is not repaired, only fitted to image and scene")
    people = keyframed.people
    for motion in people:
        if not motion.valid.any():
            ctx.warn(f"person {motion.person_id} has no valid frame, motion left as it is")
    found = refine_people(
        people,
        depth.bodies.people,
        scene,
        prior if prior.name == "scenemi" else None,
        PriorConfig(config.keyframe_interval_frames, (config.keyframe_noise_deg, config.keyframe_noise_cm)),
        PlaceUncertainty(config.objects_move, config.object_across_ratio),
    )
    for number, frames in found.gaps.items():
        if len(frames):
            listed = ", ".join(str(i) for i in frames)
            ctx.warn(f"person {people[number].person_id}: interpolated at {listed}, gaps longer than a window")
    for object_id, way_m in found.moved_m.items():
        ctx.quality("moved", way_m, "m", object_id=object_id)
    before, after = scene_field(scene), scene_field(found.scene)
    names, shares = ["none"] * len(people), [0.0] * len(people)
    for number, motion in enumerate(people):
        if not motion.valid.any():
            continue
        refined, plain = found.people[number], found.without_prior[number]
        if prior.name == "scenemi":
            names[number], shares[number] = prior.name, shaped_by_prior(refined, plain)
        person_id = None if number == 0 else motion.person_id
        ctx.quality("frames_shaped_by_prior", shares[number], "ratio", "higher", person_id=person_id)
        raw = bodies.people[number].in_world(motion.T_world_camera)
        _report(ctx, (("raw", raw, before), ("without_prior", plain, after), ("refined", refined, after)), person_id)
        ctx.progress(number + 1, len(people))
    return RefinedMotion(tuple(found.people), tuple(names), tuple(shares), tuple(found.without_prior), found.scene)


def _report(ctx: StageContext, stages: Sequence[tuple[str, BodyMotion, SdfGrid]], person_id: int | None) -> None:
    """Quality of a motion by stage; the first of them is what the image shows."""
    from video2anim.motion.assessment import assess

    for when, motion, field in stages:
        for key, value, unit in assess(motion, stages[0][1], field):
            ctx.quality(f"{key}_{when}", value, unit, "lower", person_id=person_id)


STAGE = StageSpec("refine", refine_motion, version=22, models=("prior",))
