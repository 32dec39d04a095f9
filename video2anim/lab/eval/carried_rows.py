"""Evaluation group `carried`: estimated paths of moved objects against true ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from video2anim.geometry.projection import transform_points
from video2anim.lab.eval.alignment import FrameMatch
from video2anim.lab.eval.model import Group, make_group
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.true_scene import read_glb
from video2anim.lab.eval.truth import TrueObject, Truth
from video2anim.types import PlacedObject, SceneModel
from video2anim.types.quality import Quality

SAME_PATH_M = 1.0
"""Largest mean distance between an estimated path and the true path that it is matched to."""
MOVES_M = 1e-3
"""An object moves in a frame if a corner of its box is farther than this from its place in the previous frame."""
_OLD = "the truth folder is of an older version without motion of objects; make the clip again"
CARRIED = (
    Quality("carried_found", math.nan, "ratio", "higher"),
    Quality("carried_path_m", math.nan, "m", "lower"),
    Quality("carried_false", math.nan, "count", "lower"),
)

_UNDEFINED = {
    "carried_found": "nothing is moved in the clip",
    "carried_path_m": "no path was matched to an object that is moved",
}


@dataclass(frozen=True, slots=True, eq=False)
class MovedObject:
    """A true moved object, and the estimated path matched to it."""

    object_id: int
    """In the truth."""
    label: str
    estimate_id: int | None
    """ID of the estimated object; None if no path is matched."""
    error_m: Float[np.ndarray, "frames"]
    """Distance of the box centers in each common frame from the first to the last in which it moves; empty without a
    path."""
    hold_error_frames: float
    """Mean absolute error of the first and the last frame held; NaN without a hold."""


@dataclass(frozen=True, slots=True, eq=False)
class MovedObjects:
    """All true moved objects, and the number of estimated paths that match none."""

    objects: tuple[MovedObject, ...]
    false_paths: int


def carried_group(
    result: SceneResult, truth: Truth, frames: FrameMatch, T_true_estimate: Float[np.ndarray, "4 4"] | str
) -> Group:
    """The group `carried`: paths of moved objects in the finished scene."""
    title, scene = "Moved objects", result.scene
    if scene is None or isinstance(T_true_estimate, str):
        why = result.why(SceneModel) or str(T_true_estimate)
        return make_group("carried", title, CARRIED, {"value": why})
    if any(item.is_moving and item.T_world_object_frames is None for item in truth.objects):
        return make_group("carried", title, CARRIED, {"value": _OLD})
    found = moved_objects(scene.objects, truth, frames, T_true_estimate)
    return make_group(
        "carried", title, CARRIED, {"value": carried_numbers(found)}, undefined=_UNDEFINED, note=_note(found)
    )


def carried_numbers(found: MovedObjects) -> dict[str, float]:
    """The values of the group's rows; every object has the same weight."""
    errors_m = [float(obj.error_m.mean()) for obj in found.objects if obj.estimate_id is not None]
    return {
        "carried_found": len(errors_m) / len(found.objects) if found.objects else np.nan,
        "carried_path_m": float(np.mean(errors_m)) if errors_m else np.nan,
        "carried_false": float(found.false_paths),
    }


def _note(found: MovedObjects) -> str:
    notes = [f"{obj.label}: {'found' if obj.estimate_id is not None else 'not found'}" for obj in found.objects]
    return f"{', '.join(notes)}." if notes else ""


def moved_objects(
    objects: Sequence[PlacedObject], truth: Truth, frames: FrameMatch, T_true_estimate: Float[np.ndarray, "4 4"]
) -> MovedObjects:
    """Estimated paths and true objects, matched one to one by the least mean distance of their box centers."""
    true = [item for item in truth.objects if item.T_world_object_frames is not None]
    estimated = [obj for obj in objects if obj.path]
    spans = [_span(item, frames) for item in true]
    error_m = [
        [_distances(obj, item, span, frames, T_true_estimate) for item, span in zip(true, spans, strict=True)]
        for obj in estimated
    ]
    mean_m = np.array([[e.mean() if len(e) else np.inf for e in row] for row in error_m]).reshape(
        len(estimated), len(true)
    )
    near = mean_m <= SAME_PATH_M
    rows, columns = linear_sum_assignment(np.where(near, mean_m, 1e6))
    pairs = {int(j): int(i) for i, j in zip(rows, columns, strict=True) if near[i, j]}
    matched = [
        MovedObject(
            item.object_id, item.label, estimated[pairs[j]].object_id, error_m[pairs[j]][j],
            hold_error(estimated[pairs[j]], item, frames),
        )
        if j in pairs
        else MovedObject(item.object_id, item.label, None, np.zeros(0), np.nan)
        for j, item in enumerate(true)
    ]  # fmt: skip
    return MovedObjects(tuple(matched), len(estimated) - len(pairs))


def hold_error(obj: PlacedObject, item: TrueObject, frames: FrameMatch) -> float:
    """Mean absolute error of the first and the last frame in which somebody holds the object, in frames."""
    held = np.flatnonzero(item.held[frames.true_index] & frames.known) if item.held is not None else np.zeros(0)
    holds = obj.path[0].holds
    if not len(held) or not holds:
        return float("nan")
    first, last = min(hold.first_frame for hold in holds), max(hold.last_frame for hold in holds)
    return 0.5 * float(abs(first - held[0]) + abs(last - held[-1]))


def _box(vertices_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return vertices_m.min(0).astype(np.float64), vertices_m.max(0).astype(np.float64)


def _span(item: TrueObject, frames: FrameMatch) -> Int[np.ndarray, "span"]:
    """Frames of the estimate that match true frames from the first to the last in which the object moves."""
    T = item.T_world_object_frames
    assert T is not None
    low, high = _box(read_glb(item.file).vertices_m)
    corners = np.stack(np.meshgrid(*np.stack([low, high], -1), indexing="ij"), -1).reshape(-1, 3)
    world_m = corners @ np.swapaxes(T[:, :3, :3], -1, -2) + T[:, None, :3, 3]
    moves = np.flatnonzero(np.linalg.norm(np.diff(world_m, axis=0), axis=-1).max(1) > MOVES_M)
    if not len(moves):
        return np.zeros(0, np.int64)
    inside = (frames.true_index >= moves[0]) & (frames.true_index <= moves[-1] + 1)
    return np.flatnonzero(frames.known & inside)


def _distances(
    placed: PlacedObject, item: TrueObject, span: np.ndarray, frames: FrameMatch, T_true_estimate: np.ndarray
) -> Float[np.ndarray, "span"]:
    """Distance of the two box centers in each frame of a span, meters; empty if the path cannot be compared."""
    T_path, T_true = placed.path[0].T_world_object, item.T_world_object_frames
    assert T_true is not None
    if not len(placed.mesh.vertices_m) or len(T_path) != len(frames.true_index):
        return np.zeros(0)
    estimated = placed.scale * 0.5 * sum(_box(placed.mesh.vertices_m))
    true = 0.5 * sum(_box(read_glb(item.file).vertices_m))
    estimated_m = transform_points(T_true_estimate, T_path[span, :3, :3] @ estimated + T_path[span, :3, 3])
    T_same = T_true[frames.true_index[span]]
    return np.linalg.norm(estimated_m - (T_same[:, :3, :3] @ true + T_same[:, :3, 3]), axis=-1)
