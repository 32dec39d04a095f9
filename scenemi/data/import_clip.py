"""What all importers of foreign motion share: upright, meters, floor, 30 fps, a skeleton that can be retargeted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from scenemi.data.interpolate import blended, cubic_taps, unit
from scenemi.data.joint_names import JointMap
from scenemi.data.plain_files import MAX_FRAMES
from scenemi.data.posture import on_smpl_joints, posture_axes, posture_problem
from scenemi.data.source_clip import MAX_FPS, MIN_FPS, SourceClip, SourceSkeleton
from scenemi.metrics import STANCE_SPEED_M_S
from video2anim.errors import InputError
from video2anim.geometry.rotations import continuous_quaternions, matrix_from_quaternion, quaternion_from_matrix
from video2anim.types.clip import FPS
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES

Up = Literal["auto", "y", "z"]
UNITS_M: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "cmu": 0.0254 / 0.45}
"""Length units in meters; `cmu` is that of the ASF files of the CMU database."""
FAMILIES = ("asf", "cmu38", "cc", "daz", "bandai")
"""Conventions whose joint axes are in `scenemi.data.rest_pose`."""
GLITCH_M_S2 = 350.0
"""A joint that accelerates more than this is a fault of the capture."""
_LEG_M = 0.83
"""Hip to ankle of a middle adult."""
_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""R_world_file of a file with z up (x stays)."""


def guess_unit(leg_length: float, where: str) -> str:
    """Unit in which a leg (hip to ankle) is nearest to an adult's.

    Raises:
        InputError: no unit gives a leg of a person.
    """
    off = dict.fromkeys(UNITS_M, np.inf)
    if 0 < leg_length < np.inf:
        off = {name: abs(np.log(leg_length * meters / _LEG_M)) for name, meters in UNITS_M.items()}
    unit_name = min(off, key=lambda name: off[name])
    if not off[unit_name] < np.log(1.45):
        raise InputError(
            f"{where}: a leg of {leg_length:.4g} units is no person's in {', '.join(UNITS_M)}; give the unit"
        )
    return unit_name


def smpl_tables(names: Sequence[str], joints: JointMap) -> tuple[np.ndarray, np.ndarray]:
    """Position and rotation table of a `SourceSkeleton`."""
    return tuple(
        np.array([names.index(table[joint]) if joint in table else -1 for joint in JOINT_NAMES])
        for table in (joints.position, joints.rotation)
    )  # pyright: ignore[reportReturnType]


def upright(clip: SourceClip, up: Up = "auto") -> SourceClip:
    """The clip in a world with +Y up. `auto` goes by the direction of the trunk over the clip."""
    if up == "auto":
        named_m = clip.smpl_joints_m()
        hips = named_m[:, [JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]].mean(1)
        arms = named_m[:, [JOINT_INDEX["left_shoulder"], JOINT_INDEX["right_shoulder"]]].mean(1)
        trunk = (arms - hips).mean(0)
        up = "z" if trunk[2] > 2 * abs(trunk[1]) else "y"
    if up == "y":
        return clip
    rotation = clip.rotation_wxyz.copy()
    rotation[:, 0] = continuous_quaternions(quaternion_from_matrix(_Z_UP @ matrix_from_quaternion(rotation[:, 0])))
    return replace(clip, root_position_m=clip.root_position_m @ _Z_UP.T, rotation_wxyz=rotation)


def at_fps(clip: SourceClip, fps: float = FPS) -> SourceClip:
    """The clip at a frame rate: frames are picked where the rates divide, else interpolated.

    Raises:
        InputError: an impossible frame rate, or more than an hour of motion.
    """
    if not MIN_FPS <= clip.fps <= MAX_FPS or len(clip.root_position_m) / clip.fps > MAX_FRAMES / fps:
        raise InputError(
            f"{clip.name}: want {MIN_FPS:g} to {MAX_FPS:g} frames per second and at most an hour of motion, got "
            f"{len(clip.root_position_m)} frames at {clip.fps:g} per second"
        )
    step = clip.fps / fps
    count = int(np.floor((len(clip.root_position_m) - 1) / step + 1e-6)) + 1
    position = np.arange(count) * step
    if abs(step - round(step)) < 0.005 * step and round(step) >= 1:
        rows = np.arange(0, len(clip.root_position_m), round(step))
        return replace(
            clip, fps=fps, root_position_m=clip.root_position_m[rows], rotation_wxyz=clip.rotation_wxyz[rows]
        )
    rows, weights = cubic_taps(position, np.full(count, len(clip.root_position_m)))
    rotation = unit(blended(continuous_quaternions(clip.rotation_wxyz), rows, weights))
    return replace(clip, fps=fps, root_position_m=blended(clip.root_position_m, rows, weights), rotation_wxyz=rotation)


def on_floor(clip: SourceClip) -> SourceClip:
    """The clip moved so that y = 0 is the height of a standing toe joint (20th percentile of slow, low frames)."""
    toes_m = clip.smpl_joints_m()[:, [JOINT_INDEX["left_foot"], JOINT_INDEX["right_foot"]]]
    height = toes_m[..., 1]
    if len(height) > 1:
        speed = np.linalg.norm(np.gradient(toes_m, axis=0), axis=-1) * clip.fps
        low = height < np.percentile(height, 50)
        chosen = height[(speed < STANCE_SPEED_M_S) & low]
        height = chosen if len(chosen) else height
    shift = -float(np.percentile(height, 20))
    return replace(
        clip,
        root_position_m=clip.root_position_m + np.array([0.0, shift, 0.0]),
        floor_shift_m=clip.floor_shift_m + shift,
    )


def with_glitches(clip: SourceClip) -> SourceClip:
    """The clip with its count of frames in which a joint accelerates beyond 350 m/s^2."""
    joints_m = clip.joints_m()
    if len(joints_m) < 3:
        return replace(clip, glitch_frames=0)
    speed_up = np.linalg.norm(np.diff(joints_m, n=2, axis=0), axis=-1).max(1) * clip.fps**2
    return replace(clip, glitch_frames=int((speed_up > GLITCH_M_S2).sum()))


def retargetable(clip: SourceClip, joints: JointMap, *, rest_frame: int | None = None, where: str = "") -> SourceClip:
    """The clip on a skeleton whose rest pose is known.

    Families with known joint axes stay on their own skeleton. Others come on the 22 SMPL joints, by the zero pose of
    the file where that is a posture, else by the first frame in which the figure stands with arms and legs straight.

    Args:
        clip: upright, on its own skeleton.
        joints: which joint is which.
        rest_frame: frame in which the figure stands upright with straight limbs.
        where: of what the error speaks.

    Raises:
        InputError: neither the zero pose nor the frame is such a posture.
    """
    zero = replace(
        clip,
        root_position_m=np.zeros((1, 3)),
        rotation_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (1, len(clip.skeleton.names), 1)),
    )
    problem = posture_problem(zero.smpl_joints_m()[0])
    if rest_frame is None and joints.convention in FAMILIES and (joints.convention != "bandai" or problem):
        return clip
    if rest_frame is None and problem is None:
        return on_smpl_joints(clip, _axes(zero, 0))
    frame = 0 if rest_frame is None else rest_frame
    if not 0 <= frame < len(clip.root_position_m):
        raise InputError(f"{where}: rest frame {frame} is outside of {len(clip.root_position_m)} frames")
    in_frame = posture_problem(clip.smpl_joints_m()[frame])
    if in_frame is None:
        return on_smpl_joints(clip, _axes(clip, frame))
    raise InputError(
        f"{where}: no rest pose: in the zero pose {problem or 'all is well'}, in frame {frame} {in_frame}; "
        "name a frame in which the figure stands upright with straight legs and arms"
    )


def _axes(clip: SourceClip, frame: int) -> Float[np.ndarray, "22 3 3"]:
    return posture_axes(clip.smpl_joints_m()[frame], clip.world_rotations()[frame], clip.skeleton)


def skeleton_of(
    name: str, names: Sequence[str], parents: Sequence[int], offsets: np.ndarray, joints: JointMap
) -> SourceSkeleton:
    """A skeleton with its SMPL tables."""
    position, rotation = smpl_tables(list(names), joints)
    return SourceSkeleton(name, tuple(names), np.asarray(parents, np.int64), np.asarray(offsets), position, rotation)
