"""What several tests of the command line share: a call of it, keyframes and an archive that are good."""

from __future__ import annotations

import contextlib
import io
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from synthetic import planted_walk

from scenemi.cli import main as cli
from scenemi.data.container import write_archive
from scenemi.data.source_clip import SourceClip, SourceSkeleton
from video2anim.geometry.rotations import quaternion_from_matrix
from video2anim.types.skeleton import JOINT_NAMES, PARENTS

KEYS = np.array([0, 15, 40, 60])


@dataclass(frozen=True)
class Answer:
    """What a command said and how it ended."""

    code: int
    out: str
    err: str


def scenemi(*words: str | Path) -> Answer:
    """Run a command in this process; what is no error of the project comes out as it is."""
    out, err, before, code = io.StringIO(), io.StringIO(), sys.argv, 0
    sys.argv = ["scenemi", *map(str, words)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            cli.run()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(bool(end.code))
    finally:
        sys.argv = before
    return Answer(code, out.getvalue(), err.getvalue())


def keyframe_arrays() -> dict[str, Any]:
    """Four poses of a walk."""
    motion = planted_walk(61)
    return {
        "frame_index": KEYS,
        "R_parent_joint": motion.R_parent_joint[KEYS],
        "translation_m": motion.T_world_root[KEYS, :3, 3],
    }


def walk_clip(frames: int, **changes: Any) -> SourceClip:
    """A walk on the 22 SMPL joints."""
    motion = planted_walk(frames)
    rest = motion.rest_joints_m
    same = np.arange(22)
    offsets_m = rest - np.where(PARENTS[:, None] >= 0, rest[PARENTS], 0.0)
    clip = SourceClip(
        name="walk", source="synthetic", kind="walk", description="a walk", origin="", fps=30.0, uneven=False,
        skeleton=SourceSkeleton("smpl22", JOINT_NAMES, PARENTS.copy(), offsets_m, same, same),
        root_position_m=motion.T_world_root[:, :3, 3], rotation_wxyz=quaternion_from_matrix(motion.R_parent_joint),
    )  # fmt: skip
    return replace(clip, **changes)


def walk_archive(path: Path, frames: int) -> Path:
    """An archive of one walk."""
    write_archive(path, [walk_clip(frames)])
    return path


def walk_bvh(path: Path, frames: int = 61) -> Path:
    """The walk as a BVH file."""
    from video2anim.export.bvh import write_bvh
    from video2anim.export.character import character_of

    write_bvh(path, character_of(planted_walk(frames)))
    return path
