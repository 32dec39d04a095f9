"""A motion archive of walks of several lengths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from synthetic import FPS, planted_walk

from scenemi.data.container import MotionArchive, write_archive
from scenemi.data.source_clip import SourceClip, SourceSkeleton
from scenemi.evaluation.windows import EvaluationWindow, cut_windows
from video2anim.geometry.rotations import quaternion_from_matrix
from video2anim.types.skeleton import JOINT_NAMES, PARENTS

LENGTHS = {"walk_260": 260, "walk_122": 122, "walk_121": 121, "walk_120": 120}


def walk_clip(name: str, frames: int) -> SourceClip:
    """A planted walk on the 22 SMPL joints."""
    motion = planted_walk(frames, speed_m_s=0.6 + 0.002 * frames)
    rest = motion.rest_joints_m
    offsets_m = rest - np.where(PARENTS[:, None] >= 0, rest[PARENTS], 0.0)
    same = np.arange(22)
    return SourceClip(
        name=name, source="synthetic", kind="walk", description="a walk", origin="", fps=FPS, uneven=False,
        skeleton=SourceSkeleton("smpl22", JOINT_NAMES, PARENTS.copy(), offsets_m, same, same),
        root_position_m=motion.T_world_root[:, :3, 3].copy(),
        rotation_wxyz=quaternion_from_matrix(motion.R_parent_joint),
    )  # fmt: skip


@pytest.fixture(scope="session")
def archive_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Walks of 260, 122, 121 and 120 frames."""
    path = tmp_path_factory.mktemp("archive") / "walks.npz"
    write_archive(path, [walk_clip(name, frames) for name, frames in LENGTHS.items()])
    return path


@pytest.fixture(scope="session")
def short_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One walk of 120 frames."""
    path = tmp_path_factory.mktemp("archive") / "short.npz"
    write_archive(path, [walk_clip("walk_120", 120)])
    return path


@pytest.fixture(scope="session")
def windows(archive_file: Path) -> tuple[EvaluationWindow, ...]:
    """Its windows."""
    return cut_windows([MotionArchive.read(archive_file)])
