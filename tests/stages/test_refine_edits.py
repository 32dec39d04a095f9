"""Editing: a moved keyframe or object changes the windows that hold it, and no frame before them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from synthetic import planted_walk, with_root_shift

import scenemi.prior
from stages.refine import RefineConfig, refine_motion
from video2anim.geometry.scene_mesh import box_mesh, world_mesh
from video2anim.geometry.sdf import build_sdf_grid
from video2anim.pipeline.stage import StageContext
from video2anim.types import BodyMotion, KeyframedMotion, Mesh, SceneModel

FRAMES, EDITED = 270, 235
WINDOW, STEP = 121, 61


def scene(box_z_m: float | None) -> SceneModel:
    """A floor along the walk, and a box beside it."""
    solids = []
    if box_z_m is not None:
        T_world_object = np.eye(4)
        T_world_object[[0, 2], 3] = 0.25, box_z_m
        solids = [world_mesh(box_mesh(0.3, 0.6, 0.3), T_world_object, 1.0)]
    grid = build_sdf_grid(solids, np.array([[-1.5, -0.4, -1.2], [1.5, 2.0, 11.0]]), 0.1)
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3), dtype=np.uint8))
    return SceneModel((), empty, empty, grid.sdf_m, grid.origin_m, grid.spacing_m)


def refined(motion: BodyMotion, world: SceneModel) -> BodyMotion:
    keys = np.union1d(np.arange(0, FRAMES, 5), [FRAMES - 1])
    made = refine_motion(KeyframedMotion((motion,), (keys,)), world, RefineConfig(), StageContext(Path()))
    return made.people[0]


def first_change(one: BodyMotion, other: BodyMotion) -> int:
    """First frame that differs by a bit; the number of frames if none does."""
    same = (one.R_parent_joint == other.R_parent_joint).all((1, 2, 3)) & (one.T_world_root == other.T_world_root).all(
        (1, 2)
    )
    return int(np.argmin(same)) if not same.all() else FRAMES


def start_of_window_with(frame: int) -> int:
    """Where the first window begins that holds the frame."""
    return next(start for start in range(0, FRAMES, STEP) if start + WINDOW > frame)


@pytest.mark.parametrize("prior", ["interpolation", "scenemi"])
def test_a_moved_keyframe_changes_nothing_before_its_windows(
    prior: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if prior == "interpolation":
        monkeypatch.setattr(scenemi.prior, "WEIGHTS_FOLDER", tmp_path)
    walk = planted_walk(FRAMES)
    shift_m = np.zeros((FRAMES, 3))
    shift_m[EDITED - 15 : EDITED + 16, 0] = 0.05
    before, after = (refined(motion, scene(None)) for motion in (walk, with_root_shift(walk, shift_m)))
    changed = first_change(before, after)
    # The filter that takes out jitter, and feet that fade into their lock, reach a little beyond a window.
    assert start_of_window_with(EDITED - 15) - 30 <= changed <= EDITED
    moved_m = after.T_world_root[EDITED, 0, 3] - before.T_world_root[EDITED, 0, 3]
    assert moved_m == pytest.approx(0.05, abs=0.03)


def test_a_moved_object_changes_nothing_before_its_windows() -> None:
    """With the prior that knows the scene: a box beside the path's end is put on it."""
    walk = planted_walk(FRAMES)
    end_z_m = float(walk.T_world_root[EDITED, 2, 3])
    far, near = (refined(walk, scene(z)) for z in (10.0, end_z_m))
    changed = first_change(far, near)
    reached = int(np.argmax(walk.T_world_root[:, 2, 3] > end_z_m - 2.5))
    assert changed >= start_of_window_with(reached) - 30
