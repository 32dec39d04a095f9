"""Runs segment..scene on a synthetic room of known depth."""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from synthetic_room import TRUE_RELIEF, Room

from stages.complete import CompleteConfig, complete_objects
from stages.metric import MetricConfig, fit_metric
from stages.place import PlaceConfig, place_objects
from stages.reconstruct import ReconstructConfig, reconstruct_objects
from stages.scene import SceneConfig, build_scene
from stages.segment import SegmentConfig, segment_background
from video2anim.geometry.projection import invert_rigid
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    CameraEstimate,
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
    masks: InstanceMasks
    metric: MetricDepth
    completed: CompletedObjects
    meshes: ObjectMeshes
    placed: PlacedObjects
    scene: SceneModel
    ctx: StageContext


def T_room_world(room: Room, chain: Chain) -> np.ndarray:
    """The room's world from the calibrated one, by the camera that both have."""
    return room.bodies.people[0].T_world_camera[0] @ invert_rigid(chain.metric.bodies.people[0].T_world_camera[0])


def depth_of(room: Room) -> DepthClip:
    """True depth in units of the median depth, of each sample with the person at the median depth of their joints."""
    unit_m = float(np.median(room.depth_m))
    value = np.repeat(room.depth_m[None] / unit_m, len(room.background.frame_index), axis=0)
    for sample, frame in enumerate(room.background.frame_index):
        joints_m = room.bodies.people[0].joints_camera_m[frame]
        value[sample][room.background.selected_mask[sample]] = np.median(joints_m[:, 2]) / unit_m
    known = np.repeat(room.depth_m[None] < 30, len(value), axis=0)
    return DepthClip(
        "depth", "truth", room.background.frame_index, value.astype(np.float32), (0.03 * value).astype(np.float32),
        known, room.depth_m / unit_m, known[0],
    )  # fmt: skip


def masks_of(room: Room, depth: DepthClip, config: SegmentConfig, ctx: StageContext) -> InstanceMasks:
    """Stage segment."""
    return segment_background(room.clip, room.background, depth, room.bodies, config, ctx)


def unfilmed(room: Room) -> CameraEstimate:
    """The room's camera as if it moved: there is no video in which somebody could move objects."""
    return replace(room.camera, is_static=False)


@functools.cache
def run_chain(room: Room) -> Chain:
    """All six stages with default configuration."""
    ctx = StageContext(Path())
    depth = depth_of(room)
    masks = masks_of(room, depth, SegmentConfig(provider="geometric", finder="none"), ctx)
    metric = fit_metric(room.clip, depth, room.background, room.camera, room.bodies, masks, MetricConfig(), ctx)
    completed = complete_objects(room.background, masks, metric, CompleteConfig(), ctx)
    meshes = reconstruct_objects(completed, masks, metric, room.background, ReconstructConfig(**TRUE_RELIEF), ctx)
    placed = place_objects(meshes, masks, metric, PlaceConfig(), ctx)
    scene = build_scene(room.clip, unfilmed(room), placed, metric, depth, masks, room.background, SceneConfig(), ctx)
    return Chain(depth, masks, metric, completed, meshes, placed, scene, ctx)


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
