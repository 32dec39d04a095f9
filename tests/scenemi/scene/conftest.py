"""A mesh room, and motions to draw scenes around."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scene_motions import FRAMES, Window, canonical, procedural_window
from synthetic import planted_walk

from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.types.motion import BodyShape


@pytest.fixture(scope="session")
def adult() -> ShapedBody:
    return shaped_body(BodyShape("anny", dict(ADULT)))


@pytest.fixture(scope="session")
def walk(adult: ShapedBody) -> Window:
    motion = planted_walk(FRAMES)
    return canonical(adult, motion.R_parent_joint, motion.T_world_root[:, :3, 3], np.zeros((FRAMES, 22), bool))


@pytest.fixture(scope="session")
def sit(adult: ShapedBody) -> Window:
    return procedural_window("sit", adult, 0)


@pytest.fixture(scope="session")
def step_up(adult: ShapedBody) -> Window:
    return procedural_window("step_up", adult, 3)


@pytest.fixture(scope="session")
def furnished_room() -> trimesh.Trimesh:
    """Boxes, a ball and a floor of two large triangles; boxes overlap."""
    rng = np.random.default_rng(0)
    parts = []
    for _ in range(8):
        box = trimesh.creation.box(rng.uniform(0.2, 1.0, 3))
        box.apply_transform(trimesh.transformations.rotation_matrix(rng.uniform(0, 1.5), [0, 1, 0]))
        parts.append(box.apply_translation(rng.uniform([-2, 0.3, -2], [2, 1, 2])))
    parts.append(trimesh.creation.icosphere(2, 0.4).apply_translation([0.3, 1.0, 0.2]))
    corners = [[-3, 0, -3], [-3, 0, 3], [3, 0, 3], [3, 0, -3]]
    return trimesh.util.concatenate([*parts, trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]])])
