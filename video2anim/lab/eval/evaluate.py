"""Evaluates one scene folder against the truth of its clip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from video2anim.geometry.sdf import SdfGrid
from video2anim.lab.eval.alignment import (
    FrameMatch,
    PersonMatch,
    expect_same_clip,
    match_frames,
    match_people,
    truth_from_estimate,
)
from video2anim.lab.eval.carried_rows import carried_group
from video2anim.lab.eval.clip_rows import camera_group, ingest_group, track_group
from video2anim.lab.eval.model import Evaluation, Group, PersonEvaluation, Row, make_group
from video2anim.lab.eval.motion_rows import MOTION, common_frames, motion_curves, motion_group
from video2anim.lab.eval.object_rows import complete_group, objects_group, segment_group
from video2anim.lab.eval.picture_rows import background_group, depth_group
from video2anim.lab.eval.plan import plan_of
from video2anim.lab.eval.results import MOTION_STAGES, SceneResult
from video2anim.lab.eval.scene_rows import BODY_GROUPS, BODY_IN_SCENE, BodyInScenes, space_group
from video2anim.lab.eval.true_scene import true_field
from video2anim.lab.eval.truth import Truth, read_truth
from video2anim.types import BodyMotion, BodyTracks, SceneModel


def evaluate(scene_dir: Path | str, truth_dir: Path | str) -> Evaluation:
    """Every number of docs/evaluation.md for one clip. Numbers of a missing stage are NaN with a reason.

    Raises:
        InputError: not a scene folder, not a truth folder, or the truth of another clip.
        ArtifactError: `run.json` is damaged.
    """
    result, truth = SceneResult(scene_dir), read_truth(truth_dir)
    expect_same_clip(result.clip, truth, str(scene_dir))
    frames = match_frames(result.clip, truth)
    people = _People(result, truth, frames)
    scene = result.scene or result.why(SceneModel)
    field = true_field(truth)
    evaluated = tuple(people.evaluate(match, field, scene) for match in people.matches)
    T_true_estimate = people.T_true_estimate()
    groups = (
        ingest_group(result, truth),
        track_group(result, truth, frames),
        camera_group(result, truth, frames),
        *people.mean_groups(evaluated),
        background_group(result, truth, frames),
        depth_group(result, truth, frames),
        segment_group(result, truth),
        complete_group(result, truth),
        objects_group(result, truth, T_true_estimate),
        carried_group(result, truth, frames, T_true_estimate),
        space_group(scene, truth, field, T_true_estimate),
    )
    return Evaluation(truth.name, _facts(result, truth), groups, evaluated, tuple(result.missing() + people.notes()))


class _People:
    """The persons of a clip at every stage."""

    def __init__(self, result: SceneResult, truth: Truth, frames: FrameMatch) -> None:
        self._result, self._truth, self._frames = result, truth, frames
        self._motions = result.motions()
        self._first = next(iter(self._motions.values()), ())
        """Persons of the earliest motion stage that has a value."""
        self.matches = match_people(self._first, truth, frames)

    def T_true_estimate(self) -> np.ndarray | str:
        """T_true_estimate (4, 4) from the main person's camera, or the reason why there is none."""
        if not self._first:
            return self._result.why(BodyTracks) or "nobody was fitted, so the camera has no place"
        return truth_from_estimate(self._first[0].T_world_camera, self._truth, self._frames)

    def evaluate(self, match: PersonMatch, field: SdfGrid, scene: SceneModel | str) -> PersonEvaluation:
        """Numbers, curves and floor plan of one person."""
        number = self._first[match.estimate].person_id
        true_person = self._truth.people[match.truth]
        stages = {name: self._of(number, name) for name in MOTION_STAGES}
        present = {name: motion for name, motion in stages.items() if not isinstance(motion, str)}
        common = common_frames(self._first[match.estimate], true_person, self._frames)
        T = truth_from_estimate(self._first[match.estimate].T_world_camera, self._truth, self._frames)
        fps = self._truth.fps
        bodies = BodyInScenes(stages, true_person, common, T, field, scene)
        return PersonEvaluation(
            person_id=number,
            true_person_id=true_person.person_id,
            distance_px=match.distance_px,
            groups=(motion_group(stages, true_person, common, T, fps, number), *bodies.groups(number)),
            curves=(*motion_curves(present, true_person, common, T, fps), *bodies.curves()),
            plan=plan_of(present, true_person, common, T, self._truth, scene),
        )

    def _of(self, person_id: int, stage: str) -> BodyMotion | str:
        people = self._motions.get(stage)
        if people is None:
            return self._result.why(MOTION_STAGES[stage])
        found = next((person for person in people if person.person_id == person_id), None)
        return found if found is not None else f"person {person_id} is not in stage {stage}"

    def mean_groups(self, evaluated: Sequence[PersonEvaluation]) -> tuple[Group, ...]:
        """The persons' groups, averaged over the persons."""
        if evaluated:
            return tuple(mean_group([p.groups[i] for p in evaluated]) for i in range(len(evaluated[0].groups)))
        why = self._result.why(BodyTracks) or "no estimated person was matched to a true one"
        kinds = [("motion", "Motion", MOTION), *((key, title, BODY_IN_SCENE) for key, title in BODY_GROUPS.items())]
        return tuple(make_group(key, title, rows, dict.fromkeys(MOTION_STAGES, why)) for key, title, rows in kinds)

    def notes(self) -> list[str]:
        """Notes on persons without a match."""
        estimated = {match.estimate for match in self.matches}
        true = {match.truth for match in self.matches}
        notes = [
            f"estimated person {person.person_id} was matched to nobody"
            for i, person in enumerate(self._first)
            if i not in estimated
        ]
        return notes + [
            f"true person {person.person_id} has no estimated motion"
            for i, person in enumerate(self._truth.people)
            if i not in true
        ]


def mean_group(groups: Sequence[Group]) -> Group:
    """Mean of every number over the persons that have it."""
    rows = []
    for same in zip(*(group.rows for group in groups), strict=True):
        qualities, reasons = [], []
        for column, quality in enumerate(same[0].qualities):
            present = [value for row in same if (value := row.values[column]) is not None]
            mean = float(np.mean(present)) if present else np.nan
            qualities.append(replace(quality, value=mean, person_id=None))
            reasons.append("" if present else same[0].reasons[column])
        true = [row.truth for row in same if row.truth is not None]
        rows.append(Row(tuple(qualities), float(np.mean(true)) if true else None, tuple(reasons)))
    note = "" if len(groups) == 1 else f"Mean of {len(groups)} persons."
    return Group(groups[0].key, groups[0].title, groups[0].columns, tuple(rows), note)


def _facts(result: SceneResult, truth: Truth) -> dict[str, str]:
    facts = {
        "clip": truth.name,
        "synth preset": truth.preset,
        "motion": ", ".join(sorted(set(truth.kinds))),
        "length": f"{truth.duration_s:.1f} s",
        "picture": f"{result.clip.width_px} x {result.clip.height_px} px",
        "camera": "fixed" if truth.is_static else "moving",
        "persons": str(len(truth.people)),
        "run preset": result.record.preset,
    }
    return {name: text for name, text in facts.items() if text}
