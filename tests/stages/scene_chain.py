"""Runs depth..scene on a synthetic room."""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from synthetic_room import Room

from stages.complete import CompleteConfig, complete_objects
from stages.depth import DepthConfig, estimate_depth
from stages.metric import MetricConfig, fit_metric
from stages.place import PlaceConfig, place_objects
from stages.reconstruct import ReconstructConfig, reconstruct_objects
from stages.scene import SceneConfig, build_scene
from stages.segment import SegmentConfig, segment_plate
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    CompletedObjects,
    DepthClip,
    InstanceMasks,
    MetricDepth,
    ObjectMeshes,
    PlacedObjects,
    SceneModel,
)


@dataclass(frozen=True)
class Chain:
    """What each stage made, and the context they spoke to."""

    depth: DepthClip
    metric: MetricDepth
    masks: InstanceMasks
    completed: CompletedObjects
    meshes: ObjectMeshes
    placed: PlacedObjects
    scene: SceneModel
    ctx: StageContext


def depth_of(room: Room, ctx: StageContext) -> DepthClip:
    """The geometric provider never reads the clip's video, so none is given."""
    return estimate_depth(None, room.plate, room.bodies, room.camera, DepthConfig(provider="geometric"), ctx)  # type: ignore[arg-type]


@functools.cache
def run_chain(room: Room) -> Chain:
    """All seven stages with default configuration."""
    ctx = StageContext(Path())
    depth = depth_of(room, ctx)
    metric = fit_metric(depth, room.plate, room.bodies, MetricConfig(), ctx)
    masks = segment_plate(room.plate, metric, room.bodies, SegmentConfig(provider="geometric"), ctx)
    completed = complete_objects(room.plate, masks, metric, CompleteConfig(), ctx)
    meshes = reconstruct_objects(
        completed, masks, metric, room.plate, room.bodies, room.camera, ReconstructConfig(), ctx
    )
    placed = place_objects(meshes, masks, metric, room.plate, room.bodies, room.camera, PlaceConfig(), ctx)
    scene = build_scene(placed, metric, masks, room.plate, room.bodies, SceneConfig(), ctx)
    return Chain(depth, metric, masks, completed, meshes, placed, scene, ctx)


def all_finite(value: Any) -> bool:
    """Whether every number inside nested dataclasses, tuples and arrays is finite."""
    if isinstance(value, np.ndarray):
        return bool(np.isfinite(value).all())
    if isinstance(value, float):
        return bool(np.isfinite(value))
    if isinstance(value, tuple | list):
        return all(all_finite(item) for item in value)
    if is_dataclass(value):
        return all(all_finite(getattr(value, f.name)) for f in fields(value))
    return True
