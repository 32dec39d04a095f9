"""Procedural motions in the file format of captured motion."""

from __future__ import annotations

import numpy as np

from scenemi.data.container import SourceClip, SourceSkeleton
from video2anim.body.shaped_body import ShapedBody
from video2anim.geometry.rotations import continuous_quaternions, quaternion_from_matrix
from video2anim.lab.synth.world import ProceduralMotion
from video2anim.types.clip import FPS
from video2anim.types.skeleton import JOINT_NAMES, PARENTS

_UNEVEN = ("step_up", "lie")
"""Kinds whose feet stand or lie above the floor."""


def to_source_clip(motion: ProceduralMotion, body: ShapedBody, name: str | None = None) -> SourceClip:
    """The motion on the body's own 22-joint skeleton, as a clip of source `synthetic`."""
    rest = body.rest_joints_m
    offsets = rest - np.where(PARENTS[:, None] < 0, 0.0, rest[np.maximum(PARENTS, 0)])
    offsets[0] = 0.0
    table = np.arange(22)
    shape = "_".join(f"{key[0]}{round(100 * value)}" for key, value in sorted(body.shape.parameters.items()))
    skeleton = SourceSkeleton(f"smpl22_{shape}", JOINT_NAMES, PARENTS.copy(), offsets, table, table.copy())
    return SourceClip(
        name=motion.name if name is None else name,
        source="synthetic",
        kind=motion.kind,
        description=f"procedural {motion.kind.replace('_', ' ')}, made by video2anim",
        origin="",
        fps=FPS,
        uneven=motion.kind in _UNEVEN,
        skeleton=skeleton,
        root_position_m=motion.translation_m + rest[0],
        rotation_wxyz=continuous_quaternions(quaternion_from_matrix(motion.R_parent_joint)),
    )
