"""A motion clip on the skeleton of its source. Meters, +Y up, quaternions w x y z."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from video2anim.geometry.rotations import matrix_from_quaternion
from video2anim.types.clip import FPS

MIN_FPS, MAX_FPS = 1.0, 1000.0
"""Of motion that can be read."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceSkeleton:
    """Joints of one source: where they sit when all rotations are identity, which is seldom a posture."""

    name: str
    names: tuple[str, ...]
    """Names ending in `_end` have no rotation of their own."""
    parents: Int[np.ndarray, "joints"]
    """-1 for the root; parents come first."""
    offsets_m: Float[np.ndarray, "joints 3"]
    """From the parent, in the parent's frame."""
    smpl_position: Int[np.ndarray, "22"]
    """Source joint that lies nearest to each SMPL joint, -1 = none."""
    smpl_rotation: Int[np.ndarray, "22"]
    """Source joint whose world orientation each SMPL joint follows, -1 = none."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceClip:
    """One motion on its own skeleton."""

    name: str
    source: str
    kind: str
    description: str
    origin: str
    """Where a known recording session has it (`subject_trial`), else empty."""
    fps: float
    uneven: bool
    """The person walks, climbs or hangs on objects that were not captured: y = 0 is no floor for this clip."""
    skeleton: SourceSkeleton
    root_position_m: Float[np.ndarray, "frames 3"]
    rotation_wxyz: Float[np.ndarray, "frames joints 4"]
    """Each joint's unit rotation relative to its parent."""
    source_fps: float = FPS
    floor_shift_m: float = 0.0
    """What was added to y so that the floor is y = 0."""
    glitch_frames: int = 0
    """Frames with a joint acceleration above 350 m/s^2."""
    license: str = ""
    """SPDX name, `own` or `unknown`; empty = as the source is known by its name (`scenemi.data.sources`)."""

    def forward(self) -> tuple[Float[np.ndarray, "frames joints 3"], Float[np.ndarray, "frames joints 3 3"]]:
        """World positions and world orientations of the source's joints."""
        R_parent_joint = matrix_from_quaternion(self.rotation_wxyz)
        R_world_joint = np.empty_like(R_parent_joint)
        joints_m = np.empty((*R_parent_joint.shape[:2], 3))
        for joint, parent in enumerate(self.skeleton.parents):
            if parent < 0:
                R_world_joint[:, joint], joints_m[:, joint] = R_parent_joint[:, joint], self.root_position_m
                continue
            R_world_joint[:, joint] = R_world_joint[:, parent] @ R_parent_joint[:, joint]
            joints_m[:, joint] = joints_m[:, parent] + R_world_joint[:, parent] @ self.skeleton.offsets_m[joint]
        return joints_m, R_world_joint

    def joints_m(self) -> Float[np.ndarray, "frames joints 3"]:
        """World positions of the source's joints."""
        return self.forward()[0]

    def world_rotations(self) -> Float[np.ndarray, "frames joints 3 3"]:
        """World orientations of the source's joints."""
        return self.forward()[1]

    def smpl_joints_m(self) -> Float[np.ndarray, "frames 22 3"]:
        """World positions of the nearest source joint for each SMPL joint; NaN where the source has none."""
        table = self.skeleton.smpl_position
        joints_m = self.joints_m()[:, table]
        joints_m[:, table < 0] = np.nan
        return joints_m
