"""Scenes, depth and runs of stage keyframes that its tests share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import trimesh
from synthetic import body_vertices

from stages.keyframes import KeyframesConfig, optimize_keyframes
from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.geometry.sdf import build_sdf_grid
from video2anim.motion import keyframe_roots
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    BackgroundImage,
    BodyMotion,
    BodyTracks,
    KeyframedMotion,
    Mesh,
    MetricDepth,
    RoomPiece,
    SceneModel,
)

DEPTH_SIZE = (90, 160)


def scene(
    box_at_m: tuple[float, float, float] = (5.0, 0.45, 0.0), size_m: tuple[float, float, float] = (0.5, 0.9, 0.4)
) -> SceneModel:
    """A floor and a box, by default one that is out of the way."""
    shape = trimesh.creation.box(size_m)
    shape.apply_translation(box_at_m)
    mesh = Mesh(np.asarray(shape.vertices), np.asarray(shape.faces), np.zeros((8, 3), dtype=np.uint8))
    grid = build_sdf_grid([mesh], np.array([[-1.5, -0.4, -1.2], [1.5, 2.0, 4.0]]), 0.05)
    return SceneModel((), RoomPiece("floor", mesh), (), grid.sdf_m, grid.origin_m, grid.spacing_m)


def no_depth(motion: BodyMotion) -> tuple[MetricDepth, BackgroundImage]:
    """Depth that is not trusted."""
    return depth_of(motion, np.zeros(0, dtype=np.int64), trusted=False)


def depth_of(motion: BodyMotion, frames: np.ndarray, *, trusted: bool = True) -> tuple[MetricDepth, BackgroundImage]:
    """Depth maps of the body alone, by splatting its vertices."""
    height, width = DEPTH_SIZE
    intrinsics = motion.intrinsics.resized(width, height)
    depth_m = np.full((len(frames), height, width), np.inf)
    vertices_m = body_vertices(motion)
    for row, frame in enumerate(frames):
        camera_m = transform_points(invert_rigid(motion.T_world_camera[frame]), vertices_m[frame].astype(np.float64))
        pixel = np.rint(project(camera_m, intrinsics)).astype(int)
        inside = ((pixel >= 0) & (pixel < [width, height])).all(axis=1)
        np.minimum.at(depth_m[row], (pixel[inside, 1], pixel[inside, 0]), camera_m[inside, 2])
    seen = np.isfinite(depth_m)
    depth_m = np.where(seen, depth_m, 0.0)
    empty = np.zeros(DEPTH_SIZE)
    metric = MetricDepth(
        1.0, 0.0, 0.0, 0.0, 0.0, 0.0, trusted, "person too small", frames, depth_m, seen, empty, empty > 0,
        {}, BodyTracks((motion,)),
    )  # fmt: skip
    picture = np.zeros((motion.intrinsics.height_px, motion.intrinsics.width_px, 3), dtype=np.uint8)
    return metric, BackgroundImage(picture, empty + 1, frames, seen, seen)


def optimize(
    raw: BodyMotion, where: SceneModel, depth: tuple[MetricDepth, BackgroundImage] | None = None, **weights: float
) -> tuple[KeyframedMotion, StageContext]:
    """The stage on one person, with weights of `keyframe_roots`."""
    ctx = StageContext(Path())
    metric, background = depth or no_depth(raw)
    bodies = replace(metric, bodies=BodyTracks((raw,)))
    with patch.dict(vars(keyframe_roots), weights):
        return optimize_keyframes(where, bodies, background, KeyframesConfig(), ctx), ctx


def quality(ctx: StageContext, name: str) -> float:
    """A quality number by its name."""
    return next(q.value for q in ctx.qualities if q.key == name)


def root_m(motion: BodyMotion) -> np.ndarray:
    """Root positions (T, 3)."""
    return motion.T_world_root[:, :3, 3]
