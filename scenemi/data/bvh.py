"""BVH files of any skeleton whose joints can be named."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scenemi.data.import_clip import (
    UNITS_M,
    Up,
    at_fps,
    guess_unit,
    on_floor,
    retargetable,
    skeleton_of,
    upright,
    with_glitches,
)
from scenemi.data.joint_names import JointMap, map_joints
from scenemi.data.plain_files import MAX_NUMBER, read_text
from scenemi.data.source_clip import SourceClip
from video2anim.errors import InputError, UsageError, one_line
from video2anim.geometry.rotations import continuous_quaternions

STRETCH = 0.02
"""Bones may change their length by this share of the leg; beyond, the file cannot be a skeleton of fixed lengths."""
_MAX_JOINTS, _MAX_CHANNELS = 2000, 6
"""Of one file and of one joint: far more than bodies with hands and faces have; six is all that BVH has."""
_CHANNEL = re.compile(r"^([XYZ])(position|rotation)$", re.IGNORECASE)


@dataclass(frozen=True, slots=True, eq=False)
class BvhFile:
    """Content of a BVH file, in its own units."""

    names: tuple[str, ...]
    """End sites are `<joint>_end`."""
    parents: tuple[int, ...]
    offsets: Float[np.ndarray, "joints 3"]
    frame_time_s: float
    position: Float[np.ndarray, "frames joints 3"]
    """Position of each joint in its parent's frame: the channels where it has any, else the offset."""
    rotation_wxyz: Float[np.ndarray, "frames joints 4"]


def read_bvh(
    path: str | Path,
    *,
    unit: str | None = None,
    up: Up = "auto",
    mapping: Mapping[str, str] | None = None,
    rest_frame: int | None = None,
    skip_frames: int = 0,
    keep_floor: bool = False,
    source: str = "bvh",
    kind: str = "unknown",
) -> SourceClip:
    """A BVH file as a clip at 30 fps, ready for retargeting.

    Args:
        path: file.
        unit: of lengths, a key of `UNITS_M`; None = guessed from the legs (`description` says so).
        up: axis that points up; `auto` goes by the trunk.
        mapping: SMPL joint -> joint of the file, where names are of no known convention.
        rest_frame: frame that shows a rest posture, where the zero pose is none.
        skip_frames: frames to leave out at the start (rest poses put there by exporters).
        keep_floor: y = 0 of the file is the floor; else the floor is found below the feet.
        source: name of the collection, for licenses and balance.
        kind: kind of motion.

    Raises:
        InputError: the file is broken, joints cannot be named, or no rest pose is found.
        UsageError: an unknown unit.
    """
    path = Path(path)
    if unit is not None and unit not in UNITS_M:
        raise UsageError(f"unit: want one of {', '.join(UNITS_M)}, got {unit!r}")
    file = parse_bvh(path)
    joints = map_joints(file.names, mapping, str(path))
    file = _from_pelvis(file, joints, str(path))
    leg = _leg_length(file, joints)
    used = unit or guess_unit(leg, str(path))
    scale = UNITS_M[used]
    clip = SourceClip(
        name=path.stem,
        source=source,
        kind=kind,
        description=f"BVH, {joints.convention} names, lengths in {used}{'' if unit else ' (guessed from the legs)'}",
        origin="",
        fps=1.0 / file.frame_time_s,
        uneven=False,
        skeleton=skeleton_of(joints.convention, file.names, file.parents, file.offsets * scale, joints),
        root_position_m=file.position[:, 0] * scale,
        rotation_wxyz=continuous_quaternions(file.rotation_wxyz),
        source_fps=1.0 / file.frame_time_s,
    )
    clip = retargetable(upright(clip, up), joints, rest_frame=rest_frame, where=str(path))
    if not 0 <= skip_frames < len(clip.root_position_m):
        raise UsageError(f"{path}: skip_frames {skip_frames} leaves nothing of {len(clip.root_position_m)} frames")
    clip = at_fps(_cut(clip, skip_frames))
    return with_glitches(clip if keep_floor else on_floor(clip))


def parse_bvh(path: str | Path) -> BvhFile:
    """Read a BVH file as it is.

    Raises:
        InputError: the file is missing or no BVH.
    """
    path = Path(path)
    head, _, tail = read_text(path, "BVH file").partition("MOTION")
    tokens = head.split()
    if not tokens or tokens[0].upper() != "HIERARCHY" or not tail:
        raise InputError(f"{path}: no BVH file, want HIERARCHY and MOTION")
    try:
        names, parents, offsets, channels = _hierarchy(tokens)
        frames, frame_time_s, values = _motion(tail)
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: broken BVH file: {one_line(error)}") from error
    width = sum(len(group) for group in channels)
    if values.size != frames * width or frames < 1 or not frame_time_s > 0 or not np.isfinite(values).all():
        raise InputError(
            f"{path}: want {frames} frames of {width} finite numbers at a frame time above 0, "
            f"got {values.size} numbers and {frame_time_s:g} s"
        )
    if not max(np.abs(offsets).max(), np.abs(values).max()) <= MAX_NUMBER:  # nor NaN
        raise InputError(f"{path}: broken BVH file: want numbers up to {MAX_NUMBER:g}, whatever the unit")
    position, rotation = _channels(values.reshape(frames, width), offsets, channels)
    return BvhFile(tuple(names), tuple(parents), offsets, frame_time_s, position, rotation)


def _hierarchy(tokens: list[str]) -> tuple[list[str], list[int], np.ndarray, list[list[tuple[str, str]]]]:
    names: list[str] = []
    taken: set[str] = set()
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[list[tuple[str, str]]] = []
    open_joints: list[int] = []
    at = 1
    while at < len(tokens):
        word = tokens[at].upper()
        if word in ("ROOT", "JOINT", "END"):
            if word == "ROOT" and names:
                raise ValueError("more than one ROOT; split the file")
            if len(names) == _MAX_JOINTS:
                raise ValueError(f"more than {_MAX_JOINTS} joints")
            stop = tokens.index("{", at)
            label = " ".join(tokens[at + 1 : stop])
            parents.append(open_joints[-1] if open_joints else -1)
            names.append(_fresh(taken, f"{names[parents[-1]]}_end" if word == "END" else label))
            taken.add(names[-1])
            offsets.append([0.0, 0.0, 0.0])
            channels.append([])
            open_joints.append(len(names) - 1)
            at = stop + 1
        elif word == "OFFSET":
            x, y, z = (float(token) for token in tokens[at + 1 : at + 4])
            offsets[open_joints[-1]] = [x, y, z]
            at += 4
        elif word == "CHANNELS":
            count = int(tokens[at + 1])
            if not 0 <= count <= _MAX_CHANNELS:
                raise ValueError(f"want 0 to {_MAX_CHANNELS} channels of a joint, got {tokens[at + 1][:20]}")
            channels[open_joints[-1]] = [_channel(token) for token in tokens[at + 2 : at + 2 + count]]
            at += 2 + count
        elif word == "}":
            open_joints.pop()
            at += 1
        else:
            raise ValueError(f"unexpected {tokens[at]!r} in the hierarchy")
    if open_joints or not names:
        raise ValueError("the hierarchy is cut off")
    return names, parents, np.array(offsets), channels


def _channel(token: str) -> tuple[str, str]:
    match = _CHANNEL.match(token)
    if match is None:
        raise ValueError(f"unknown channel {token!r}")
    return match[1].upper(), match[2].lower()


def _fresh(taken: set[str], name: str) -> str:
    """The name, numbered where it is taken."""
    number, result = 2, name
    while result in taken:
        result, number = f"{name}_{number}", number + 1
    return result


def _motion(tail: str) -> tuple[int, float, np.ndarray]:
    match = re.match(r"\s*Frames:?\s*(\d+)\s*Frame\s+Time:?\s*([-+.\deE]+)", tail, re.IGNORECASE)
    if match is None:
        raise ValueError("want 'Frames:' and 'Frame Time:' after MOTION")
    return int(match[1]), float(match[2]), np.array(tail[match.end() :].split(), float)


def _channels(
    values: np.ndarray, offsets: np.ndarray, channels: list[list[tuple[str, str]]]
) -> tuple[np.ndarray, np.ndarray]:
    """Local positions and quaternions of every joint."""
    position = np.tile(offsets, (len(values), 1, 1))
    rotation = np.tile([1.0, 0.0, 0.0, 0.0], (len(values), len(offsets), 1))
    at = 0
    for joint, group in enumerate(channels):
        columns = values[:, at : at + len(group)]
        at += len(group)
        turns = [(i, axis) for i, (axis, what) in enumerate(group) if what == "rotation"]
        for i, (axis, what) in enumerate(group):
            if what == "position":
                position[:, joint, "XYZ".index(axis)] = columns[:, i]
        if turns:
            total = Rotation.identity(len(values))
            for i, axis in turns:
                total = total * Rotation.from_rotvec(columns[:, i, None] * np.eye(3)["XYZ".index(axis)], degrees=True)
            rotation[:, joint] = np.roll(total.as_quat(), 1, axis=-1)
    return position, rotation


def _from_pelvis(file: BvhFile, joints: JointMap, where: str) -> BvhFile:
    """The part of the skeleton below the pelvis, with constant offsets; the pelvis is its root, in the world."""
    pelvis = file.names.index(joints.position["pelvis"])
    keep = [pelvis]
    for joint, parent in enumerate(file.parents):
        if parent in keep:
            keep.append(joint)
    lost = [name for name in joints.position.values() if file.names.index(name) not in keep]
    if lost:
        raise InputError(f"{where}: {', '.join(lost)} do not descend from {file.names[pelvis]!r}; check the mapping")
    root = file.position[:, pelvis].copy()
    turn = Rotation.from_quat(np.roll(file.rotation_wxyz[:, pelvis], -1, axis=-1))
    ancestor = file.parents[pelvis]
    while ancestor >= 0:
        above = Rotation.from_quat(np.roll(file.rotation_wxyz[:, ancestor], -1, axis=-1))
        root, turn = above.apply(root) + file.position[:, ancestor], above * turn
        ancestor = file.parents[ancestor]
    offsets = np.median(file.position[:, keep], axis=0)
    offsets[0] = 0.0
    rotation = file.rotation_wxyz[:, keep].copy()
    rotation[:, 0] = np.roll(turn.as_quat(), 1, axis=-1)
    position = file.position[:, keep].copy()
    position[:, 0] = root
    parents = tuple(-1 if joint == pelvis else keep.index(file.parents[joint]) for joint in keep)
    part = BvhFile(tuple(file.names[j] for j in keep), parents, offsets, file.frame_time_s, position, rotation)
    used = [part.names.index(name) for name in joints.position.values() if name != joints.position["pelvis"]]
    stretch = np.linalg.norm(position[:, used] - offsets[used], axis=-1)
    worst = int(stretch.max(0).argmax())
    if stretch[:, worst].max() > STRETCH * _leg_length(part, joints):
        raise InputError(
            f"{where}: the bone to {part.names[used[worst]]!r} changes its length in time; export rotations only"
        )
    return part


def _leg_length(file: BvhFile, joints: JointMap) -> float:
    """Hip to ankle along the left leg, in the file's unit."""
    joint, hip = (file.names.index(joints.position[name]) for name in ("left_ankle", "left_hip"))
    length = 0.0
    while joint not in (hip, -1):
        length += float(np.linalg.norm(file.offsets[joint]))
        joint = file.parents[joint]
    return length


def _cut(clip: SourceClip, start: int) -> SourceClip:
    return replace(clip, root_position_m=clip.root_position_m[start:], rotation_wxyz=clip.rotation_wxyz[start:])
