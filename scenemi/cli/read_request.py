"""What `scenemi sample` is asked for: whole poses and postures at objects, partial keyframes, a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scenemi.animation.named_objects import read_objects
from scenemi.animation.partial_file import PartialValues, expect_no_contradiction, partial_keyframes
from scenemi.animation.postures import Posture, place, settled, standing
from scenemi.cli.sample_motion import body_of
from scenemi.data.keyframe_file import read_keyframes, shape_in
from scenemi.data.keyframes import Keyframes, checked_keyframes
from scenemi.data.plain_files import checked, read_json
from scenemi.data.scene_file import SceneFile, mesh_path, read_scene
from scenemi.model.scene_input import adult_like
from scenemi.postprocess.partial import PartialKeyframes
from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.scene_parts import geometry_of, notes_on
from video2anim.body.anny_body import shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError

_Path = tuple[int, Float[np.ndarray, "way 2"]]


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """Everything that a motion has to meet."""

    keyframes: Keyframes
    partial: PartialKeyframes | None
    scene: SceneGeometry
    notes: tuple[str, ...]


def read_request(
    path: Path, scene: Path | None, *, interval: int = 15, length: int | None = None, exact: bool = True
) -> Request:
    """Read a keyframe file and a scene.

    Args:
        path: keyframes; a `.json` may hold partial keyframes (docs/scenemi.md).
        scene: mesh or scene folder; None = a bare floor.
        interval: frames between keyframes, where the file does not say it.
        length: how much of a whole motion is used.
        exact: whether whole poses are met.

    Raises:
        InputError: one line about what is wrong with a file, or what contradicts itself.
    """
    found = None if scene is None else read_scene(scene)
    values = read_json(path, "keyframe file") if path.suffix.lower() == ".json" else {}
    asked = checked(PartialValues, str(path), values)
    if not asked.asked():
        given = read_keyframes(path, interval=interval, length=length)
        return Request(given, None, *_solids(found, given.translation_m))
    whole = None
    if asked.poses_from is not None or {"R_parent_joint", "axis_angle"} & values.keys():
        own = path if asked.poses_from is None else path.parent / asked.poses_from
        whole = read_keyframes(own, interval=interval, length=length)
    body = shaped_body(shape_in(path)) if whole is None else body_of(whole) or adult_like(whole.rest_joints_m)
    way = _way(str(path), asked, whole)
    postures = _postures(str(path), asked, way, whole, scene, body)
    roots_m = [*(() if whole is None else whole.translation_m), *(one.translation_m for one in postures.values())]
    if not roots_m:
        raise InputError(f"{path}: want whole poses, postures or a root_path beside joint_targets and pinned feet")
    solids, notes = _solids(found, np.stack(roots_m))
    settle = {frame: settled(posture, body, solids, str(path)) for frame, posture in postures.items()}
    given = _together(str(path), whole, settle, body)
    partial = partial_keyframes(str(path), asked, way, given.frame_count)
    if partial is not None:
        expect_no_contradiction(str(path), partial, given.translation_m, given.frame_index, exact)
    return Request(given, partial, solids, notes)


def _solids(found: SceneFile | None, roots_m: Float[np.ndarray, "poses 3"]) -> tuple[SceneGeometry, tuple[str, ...]]:
    parts = () if found is None else found.parts
    notes = () if found is None else (*found.notes, *notes_on(parts, roots_m))
    return geometry_of(parts, roots_m), notes


def _way(where: str, asked: PartialValues, whole: Keyframes | None) -> _Path | None:
    """The path of the root over time. It begins and ends at rest where no whole pose says what the body does there."""
    if asked.root_path is None:
        return None
    moves = whole is not None
    try:
        return asked.root_path.over_time((not moves, not moves))
    except ValueError as error:
        raise InputError(f"{where}: root_path {error}") from error


def _postures(
    where: str, asked: PartialValues, way: _Path | None, whole: Keyframes | None, scene: Path | None, body: ShapedBody
) -> dict[int, Posture]:
    """Postures by frame, before the solve: those wished for, and standing at ends of the path that no pose covers."""
    objects = ()
    if any(isinstance(one.sit_on or one.hand_on or one.stand_at, str) for one in asked.postures):
        if scene is None:
            raise InputError(f"{where}: postures at objects want --scene, which has the objects")
        objects = read_objects(mesh_path(scene))
    found: dict[int, Posture] = {}
    for wish in asked.postures:
        if wish.at in found:
            raise InputError(f"{where}: frame {wish.at} is given two postures; keep one")
        found[wish.at] = place(wish, objects, body, where)
    frames = [*found, *(() if whole is None else whole.frame_index)]
    if way is not None:
        start, places_m = way
        stop = start + len(places_m) - 1
        if not frames or start < min(frames):
            found[start] = standing(places_m[0], _direction(places_m[1] - places_m[0]), body)
        if not frames or stop > max(frames):
            found[stop] = standing(places_m[-1], _direction(places_m[-1] - places_m[-2]), body)
    return found


def _direction(step_m: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    length_m = np.linalg.norm(step_m)
    return step_m / length_m if length_m > 0 else np.array([0.0, 1.0])


def _together(where: str, whole: Keyframes | None, postures: dict[int, Posture], body: ShapedBody) -> Keyframes:
    """All whole poses, in order."""
    frames, R, translation_m = list(postures), [], []
    for posture in postures.values():
        R.append(posture.R_parent_joint)
        translation_m.append(posture.translation_m)
    rest_m, shape = body.rest_joints_m, body.shape
    if whole is not None:
        frames, R = [*whole.frame_index, *frames], [*whole.R_parent_joint, *R]
        translation_m = [*whole.translation_m, *translation_m]
        rest_m, shape = whole.rest_joints_m, whole.shape
    return checked_keyframes(where, np.array(frames), np.stack(R), np.stack(translation_m), rest_m, shape)
