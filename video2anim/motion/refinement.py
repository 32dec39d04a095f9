"""Refined motion: an in-betweening prior fills sparse keyframes, then one solve fits all people and the scene.

With a prior, the solve is made a second time with plain interpolation of the observed motion, so that the share of
frames that the prior changed can be told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scenemi.longmotion import KeyframeMotion, inbetween
from scenemi.postprocess.motion_solve import SceneMotion, Solved, solve_motions
from scenemi.prior import InbetweeningPrior, InterpolationPrior
from scenemi.windows import select_keyframes
from video2anim.geometry.sdf import SdfGrid
from video2anim.motion.movable_scene import (
    PlaceUncertainty,
    movable_solids,
    moved_scene,
    moving_fields,
    scene_field,
    with_scene_contacts,
)
from video2anim.motion.observation import inlier_frames, observation
from video2anim.objects.path import follow_hand
from video2anim.types import BodyMotion, SceneModel
from video2anim.types.clip import FPS
from video2anim.types.motion import main_person


@dataclass(frozen=True, slots=True)
class PriorConfig:
    """What the prior is given."""

    keyframe_interval_frames: int
    noise: tuple[float, float]
    """Standard deviation of the keyframes: degrees, centimeters."""


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """The people with their scene."""

    people: list[BodyMotion]
    without_prior: list[BodyMotion]
    """The same solve from the interpolated observation."""
    scene: SceneModel
    gaps: dict[int, np.ndarray]
    """By number of the person: frames that were interpolated, since the gap is longer than a window of the prior."""
    moved_m: dict[int, float]
    """By object ID: how far the solve moved an object; those that did not move are left out."""


def refine_people(
    people: Sequence[BodyMotion],
    path_people: Sequence[BodyMotion],
    scene: SceneModel,
    prior: InbetweeningPrior | None,
    config: PriorConfig,
    uncertainty: PlaceUncertainty,
) -> Refinement:
    """Fill, solve, and find the contacts in the scene that the solve leaves.

    Args:
        people: after stage keyframes; those without a valid frame stay as they are.
        path_people: the same people as the paths of moved objects were found with.
        scene: whose objects may move.
        prior: None where there is none: the observation itself goes into the solve.
        config: of the prior.
        uncertainty: how far objects may move.
    """
    solids = movable_solids(scene, main_person(people).view().center_m, uncertainty)
    field = scene_field(scene)
    numbers = [number for number, motion in enumerate(people) if motion.valid.any()]
    observed = [(people[number], observation(people[number], scene.objects)) for number in numbers]
    interpolation = InterpolationPrior(monotone=True)
    every_frame = replace(config, keyframe_interval_frames=1)
    gaps: dict[int, np.ndarray] = {}
    filled = []
    for number, (motion, one) in zip(numbers, observed, strict=True):
        made, gaps[number] = fill_between(motion, one, prior or interpolation, field, config if prior else every_frame)
        filled.append(made)
    solved = solve_motions(filled, solids)
    plain = solved
    if prior is not None:
        plain = solve_motions([fill_between(*one, interpolation, field, every_frame)[0] for one in observed], solids)
    refined, without_prior = (_posed(people, numbers, one) for one in (solved, plain))
    moved = moved_scene(scene, solids, solved.moved_m)
    ways_m = {
        new.object_id: float(np.linalg.norm(new.T_world_object[:3, 3] - old.T_world_object[:3, 3]))
        for old, new in zip(scene.objects, moved.objects, strict=True)
    }
    moved = replace(moved, objects=tuple(follow_hand(item, path_people, refined) for item in moved.objects))
    after, moving = scene_field(moved), moving_fields(moved)
    for motions in (refined, without_prior):
        for number in numbers:
            motions[number] = with_scene_contacts(motions[number], after, moving, moved.objects)
    moved_m = {object_id: way_m for object_id, way_m in ways_m.items() if way_m > 0}
    return Refinement(refined, without_prior, moved, gaps if prior else {}, moved_m)


def fill_between(
    motion: BodyMotion, observed: SceneMotion, prior: InbetweeningPrior, field: SdfGrid, config: PriorConfig
) -> tuple[SceneMotion, np.ndarray]:
    """What the prior makes of keyframes of the observed motion, and the frames that it left to interpolation."""
    keys = np.zeros(motion.frame_count, bool)
    interval = config.keyframe_interval_frames
    keys[select_keyframes(motion.frame_count, interval, usable=inlier_frames(motion))] = True
    given = KeyframeMotion(
        observed.R_parent_joint, observed.translation_world_m, keys, motion.rest_joints_m, FPS, observed.body,
        noise=config.noise,
    )  # fmt: skip
    made = inbetween(given, prior, scene=field)
    filled = replace(observed, R_parent_joint=made.R_parent_joint, translation_world_m=made.translation_world_m)
    return filled, made.interpolated_index


def _posed(people: Sequence[BodyMotion], numbers: Sequence[int], solved: Solved) -> list[BodyMotion]:
    """The people, those of the numbers in their solved poses."""
    posed = list(people)
    for k, number in enumerate(numbers):
        posed[number] = people[number].with_pose(
            translation_world_m=solved.translation_world_m[k], R_parent_joint=solved.R_parent_joint[k]
        )
    return posed
