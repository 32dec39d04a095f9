"""Scenes and runs of stage keyframes that its tests share."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import patch

import numpy as np
import trimesh

from stages.keyframes import KeyframesConfig, optimize_keyframes
from video2anim.geometry.sdf import build_sdf_grid
from video2anim.motion import keyframe_roots
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
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


def without_depth(motion: BodyMotion) -> MetricDepth:
    """Bodies alone."""
    empty, none = np.zeros(DEPTH_SIZE), np.zeros((0, *DEPTH_SIZE))
    return MetricDepth(
        1.0, 0.0, 0.0, 0.0, 0.0, 0.0, False, "person too small", np.zeros(0, int), none, none > 0, empty, empty > 0,
        {}, BodyTracks((motion,)),
    )  # fmt: skip


def optimize(raw: BodyMotion, where: SceneModel, **weights: float) -> tuple[KeyframedMotion, StageContext]:
    """The stage on one person, with weights of `keyframe_roots`."""
    ctx = StageContext(Path())
    with patch.dict(vars(keyframe_roots), weights):
        return optimize_keyframes(where, without_depth(raw), KeyframesConfig(), ctx), ctx


def quality(ctx: StageContext, name: str) -> float:
    """A quality number by its name."""
    return next(q.value for q in ctx.qualities if q.key == name)


def root_m(motion: BodyMotion) -> np.ndarray:
    """Root positions (T, 3)."""
    return motion.T_world_root[:, :3, 3]
