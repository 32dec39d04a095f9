"""Motion clips for tests: real ones beside the checkout, and one made here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from synthetic import FPS, planted_walk

from scenemi.data.source_clip import SourceClip, SourceSkeleton
from video2anim.geometry.rotations import quaternion_from_matrix
from video2anim.types.skeleton import JOINT_NAMES, PARENTS

REPOSITORY = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="session")
def shared_motion() -> Path:
    """Captured clips of all sources."""
    motion = REPOSITORY.parent / "shared" / "motion"
    if not motion.is_dir():
        pytest.skip(f"motion data not found at {motion}")
    return motion


@pytest.fixture(scope="session")
def smpl_walk() -> SourceClip:
    """A planted walk on the 22 SMPL joints of a middle-sized body."""
    motion = planted_walk(120)
    rest = motion.rest_joints_m
    offsets_m = rest - np.where(PARENTS[:, None] >= 0, rest[PARENTS], 0.0)
    same = np.arange(22)
    skeleton = SourceSkeleton("smpl22", JOINT_NAMES, PARENTS.copy(), offsets_m, same, same)
    return SourceClip(
        name="walk_a",
        source="synthetic",
        kind="walk",
        description="a walk",
        origin="",
        fps=FPS,
        uneven=False,
        skeleton=skeleton,
        root_position_m=motion.T_world_root[:, :3, 3].copy(),
        rotation_wxyz=quaternion_from_matrix(motion.R_parent_joint),
    )
