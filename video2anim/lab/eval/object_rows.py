"""Evaluation groups of objects: `segment` (masks), `complete` (amodal masks), `objects` (shapes and places)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment

from video2anim.geometry.projection import transform_points
from video2anim.lab.eval.alignment import match_frames, resample_nearest, truth_from_estimate
from video2anim.lab.eval.boxes import OrientedBox, box_iou_3d, box_of, chamfer_m, rest_height_m, surface_points
from video2anim.lab.eval.model import Group, make_group
from video2anim.lab.eval.picture_rows import mask_iou
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.true_scene import read_glb, world_mesh
from video2anim.lab.eval.truth import TrueObject, Truth
from video2anim.types import (
    CompletedObjects,
    InstanceMasks,
    Mesh,
    ObjectMeshes,
    PlacedObjects,
    SceneModel,
)
from video2anim.types.quality import Quality

MIN_VISIBLE_PX = 2000
"""Minimum number of visible pixels of a piece of furniture that counts."""
FOUND_IOU = 0.5
"""Minimum mask IoU of an instance that is found."""
SAME_IOU = 0.25
"""Minimum mask IoU of two objects whose shapes are compared."""
SAME_PLACE_M = 0.5
"""Largest distance of the centers of two objects that are matched without a mask."""
_IGNORED_SHARE = 0.5
"""An unmatched instance with this share of its pixels on objects that do not count is ignored."""
SEGMENT = (
    Quality("floor_iou", math.nan, "ratio", "higher"),
    Quality("precision", math.nan, "ratio", "higher"),
    Quality("recall", math.nan, "ratio", "higher"),
    Quality("f1", math.nan, "ratio", "higher"),
    Quality("best_iou", math.nan, "ratio", "higher"),
)
COMPLETE = (
    Quality("amodal_iou", math.nan, "ratio", "higher"),
    Quality("visible_iou", math.nan, "ratio", "none"),
)
PER_OBJECT = (
    Quality("chamfer", math.nan, "m", "lower"),
    Quality("center_error", math.nan, "m", "lower"),
    Quality("box_iou", math.nan, "ratio", "higher"),
    Quality("height_error", math.nan, "m", "lower"),
    Quality("size_ratio", math.nan, "ratio", "near_1"),
)
OBJECTS = (Quality("reconstructed", math.nan, "ratio", "higher"), *PER_OBJECT)
_UNDEFINED = {
    "floor_iou": "no floor is seen",
    "precision": "no instance was found",
    **dict.fromkeys(("recall", "f1", "best_iou", "reconstructed"), "no furniture is seen well enough"),
    **dict.fromkeys((measure.key for measure in (*COMPLETE, *PER_OBJECT)), "no object was matched"),
}
_SEED = 0
"""Seed of the points drawn on surfaces."""


class _Object(Protocol):
    """Object type of the three stages that make shapes."""

    @property
    def object_id(self) -> int: ...
    @property
    def mesh(self) -> Mesh: ...
    @property
    def T_world_object(self) -> np.ndarray: ...


@dataclass(frozen=True, slots=True, eq=False)
class MaskMatch:
    """Overlap of the masks of stage segment with true furniture, at the size of the true maps."""

    masks: dict[int, Bool[np.ndarray, "height width"]]
    """Mask of each estimated object, by ID."""
    iou: Float[np.ndarray, "found furniture"]


def match_masks(instances: InstanceMasks, furniture: Sequence[TrueObject], truth: Truth) -> MaskMatch:
    """Mask IoU of every instance with every piece of furniture that counts."""
    shape = truth.background_instance.shape
    masks = {item.object_id: resample_nearest(item.mask, shape) for item in instances.instances}
    iou = [[mask_iou(mask, truth.mask(true.object_id)) for true in furniture] for mask in masks.values()]
    return MaskMatch(masks, np.nan_to_num(np.array(iou, np.float64).reshape(len(masks), len(furniture))))


def segment_group(result: SceneResult, truth: Truth) -> Group:
    """Floor and furniture in the background image."""
    title = "Segmentation"
    found = result.get(InstanceMasks)
    if found is None:
        return make_group("segment", title, SEGMENT, {"value": result.why(InstanceMasks)})
    furniture = truth.furniture(MIN_VISIBLE_PX)
    match = match_masks(found, furniture, truth)
    counted = instance_scores(match, furniture, truth)
    floor = resample_nearest(found.floor_mask, truth.floor_mask.shape)
    numbers = {
        "floor_iou": mask_iou(floor, truth.floor_mask) if truth.floor_mask.any() else np.nan,
        **counted,
        "best_iou": _best_iou(match, furniture),
    }
    note = f"{found.provider}: {len(found.instances)} instances, {len(furniture)} pieces of furniture count."
    return make_group("segment", title, SEGMENT, {"value": numbers}, undefined=_UNDEFINED, note=note)


def instance_scores(match: MaskMatch, furniture: Sequence[TrueObject], truth: Truth) -> dict[str, float]:
    """Precision, recall and F1 of instances at IoU 0.5; instances on objects that do not count are ignored."""
    rows, columns = linear_sum_assignment(-match.iou)
    right = {int(i) for i, j in zip(rows, columns, strict=True) if match.iou[i, j] >= FOUND_IOU}
    counting = {item.object_id for item in furniture}
    ignored = [item.object_id for item in truth.objects if item.is_furniture and item.object_id not in counting]
    on_ignored = np.isin(truth.background_instance, ignored)
    surplus = 0
    for i, mask in enumerate(match.masks.values()):
        if i not in right and not (mask.any() and on_ignored[mask].mean() >= _IGNORED_SHARE):
            surplus += 1
    claimed, true = len(right) + surplus, len(furniture)
    return {
        "precision": len(right) / claimed if claimed else np.nan,
        "recall": len(right) / true if true else np.nan,
        "f1": 2 * len(right) / (claimed + true) if true else np.nan,
    }


def _best_iou(match: MaskMatch, furniture: Sequence[TrueObject]) -> float:
    if not furniture:
        return float("nan")
    return float(match.iou.max(0).mean()) if len(match.iou) else 0.0


def complete_group(result: SceneResult, truth: Truth) -> Group:
    """Amodal masks of the objects whose visible masks were found."""
    title = "Completion behind other objects"
    completed, found = result.get(CompletedObjects), result.get(InstanceMasks)
    if completed is None or found is None:
        return make_group("complete", title, COMPLETE, {"value": result.why(CompletedObjects, InstanceMasks)})
    furniture = [item for item in truth.furniture(MIN_VISIBLE_PX) if item.object_id in truth.amodal]
    match = match_masks(found, furniture, truth)
    whole = {item.object_id: item.amodal_mask for item in completed.objects}
    numbers: dict[str, list[float]] = {"amodal_iou": [], "visible_iou": []}
    for number, j in pairs_by_mask(match).items():
        if number in whole:
            true = truth.amodal[furniture[j].object_id]
            numbers["amodal_iou"].append(mask_iou(resample_nearest(whole[number], true.shape), true))
            numbers["visible_iou"].append(mask_iou(match.masks[number], true))
    means = {key: float(np.mean(values)) if values else np.nan for key, values in numbers.items()}
    note = f"{len(numbers['amodal_iou'])} of {len(furniture)} pieces of furniture matched."
    return make_group("complete", title, COMPLETE, {"value": means}, undefined=_UNDEFINED, note=note)


def pairs_by_mask(match: MaskMatch) -> dict[int, int]:
    """One-to-one map from estimated object IDs to indices of the furniture that they overlap."""
    rows, columns = linear_sum_assignment(-match.iou)
    numbers = list(match.masks)
    return {numbers[i]: int(j) for i, j in zip(rows, columns, strict=True) if match.iou[i, j] >= SAME_IOU}


def objects_group(result: SceneResult, truth: Truth, T_true_estimate: Float[np.ndarray, "4 4"] | str) -> Group:
    """Shapes and places of furniture after the stages reconstruct, place and scene."""
    furniture = truth.furniture(MIN_VISIBLE_PX)
    instances = result.get(InstanceMasks)
    by_mask = pairs_by_mask(match_masks(instances, furniture, truth)) if instances is not None else {}
    columns: dict[str, dict[str, float] | str] = {}
    notes = [f"{len(furniture)} pieces of furniture count"]
    made = {"reconstruct": result.get(ObjectMeshes), "place": result.get(PlacedObjects), "scene": result.scene}
    for (name, value), kind in zip(made.items(), (ObjectMeshes, PlacedObjects, SceneModel), strict=True):
        if value is None or isinstance(T_true_estimate, str):
            columns[name] = result.why(kind) or str(T_true_estimate)
            continue
        columns[name] = _means(compared_objects(value.objects, furniture, by_mask, T_true_estimate), furniture)
        notes.append(f"{name}: {len(value.objects)} objects")
    return make_group(
        "objects", "Objects in space", OBJECTS, columns, undefined=_UNDEFINED, note="; ".join(notes) + "."
    )


def compared_objects(
    objects: Sequence[_Object],
    furniture: Sequence[TrueObject],
    by_mask: dict[int, int],
    T_true_estimate: Float[np.ndarray, "4 4"],
) -> list[tuple[Quality, ...]]:
    """The measures `PER_OBJECT` of every matched piece of furniture; `object_id` is that of the ground truth."""
    shapes = {obj.object_id: _own_box(obj, T_true_estimate) for obj in objects if len(obj.mesh.faces)}
    true_boxes = [box_of(read_glb(item.file).vertices_m, item.T_world_object) for item in furniture]
    pairs = match_objects({number: shape[0] for number, shape in shapes.items()}, true_boxes, by_mask)
    rows = []
    for number, j in pairs.items():
        box, vertices_m = shapes[number]
        obj = next(obj for obj in objects if obj.object_id == number)
        mesh = Mesh(vertices_m, obj.mesh.faces, obj.mesh.vertex_rgb)
        estimated_m = surface_points(mesh, np.random.default_rng(_SEED))
        true_m = surface_points(world_mesh(furniture[j]), np.random.default_rng(_SEED))
        values = (
            chamfer_m(estimated_m, true_m),
            float(np.linalg.norm(box.center_m - true_boxes[j].center_m)),
            box_iou_3d(box, true_boxes[j]),
            abs(rest_height_m(mesh) - rest_height_m(world_mesh(furniture[j]))),
            float(np.linalg.norm(box.half_m) / np.linalg.norm(true_boxes[j].half_m)),
        )
        object_id = furniture[j].object_id
        rows.append(
            tuple(replace(m, value=value, object_id=object_id) for m, value in zip(PER_OBJECT, values, strict=True))
        )
    return rows


def scene_objects(result: SceneResult, truth: Truth) -> list[tuple[Quality, ...]]:
    """`compared_objects` of the finished scene, aligned by the main person's camera; empty if a stage is missing."""
    scene, bodies, instances = result.scene, result.bodies, result.get(InstanceMasks)
    if scene is None or bodies is None:
        return []
    T = truth_from_estimate(bodies.main.T_world_camera, truth, match_frames(result.clip, truth))
    furniture = truth.furniture(MIN_VISIBLE_PX)
    by_mask = {} if instances is None else pairs_by_mask(match_masks(instances, furniture, truth))
    return compared_objects(scene.objects, furniture, by_mask, T)


def _means(rows: Sequence[tuple[Quality, ...]], furniture: Sequence[TrueObject]) -> dict[str, float]:
    """Means of each measure over matched pieces of furniture."""
    means = {
        measure.key: float(np.mean([row[i].value for row in rows])) if rows else np.nan
        for i, measure in enumerate(PER_OBJECT)
    }
    return {"reconstructed": len(rows) / len(furniture) if furniture else np.nan, **means}


def _own_box(obj: _Object, T_true_estimate: np.ndarray) -> tuple[OrientedBox, np.ndarray]:
    """Box of an estimated object in the true world, and its vertices there."""
    scaled_m = getattr(obj, "scale", 1.0) * obj.mesh.vertices_m.astype(np.float64)
    T_true_object = T_true_estimate @ obj.T_world_object
    return box_of(scaled_m, T_true_object), transform_points(T_true_object, scaled_m)


def match_objects(
    boxes: dict[int, OrientedBox], true_boxes: Sequence[OrientedBox], by_mask: dict[int, int]
) -> dict[int, int]:
    """Map from estimated to true objects: by mask where masks overlap, else by the distance of their centers."""
    pairs = {number: j for number, j in by_mask.items() if number in boxes}
    left = [number for number in boxes if number not in pairs]
    open_ = [j for j in range(len(true_boxes)) if j not in pairs.values()]
    gap_m = np.array(
        [[np.linalg.norm(boxes[number].center_m - true_boxes[j].center_m) for j in open_] for number in left]
    ).reshape(len(left), len(open_))
    rows, columns = linear_sum_assignment(np.where(gap_m <= SAME_PLACE_M, gap_m, 1e6))
    for i, j in zip(rows, columns, strict=True):
        if gap_m[i, j] <= SAME_PLACE_M:
            pairs[left[i]] = open_[j]
    return pairs
