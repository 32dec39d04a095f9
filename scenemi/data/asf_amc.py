"""Acclaim ASF skeletons with AMC motion, as the CMU database publishes them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scenemi.data.import_clip import (
    UNITS_M,
    at_fps,
    on_floor,
    retargetable,
    skeleton_of,
    with_glitches,
)
from scenemi.data.joint_names import map_joints
from scenemi.data.plain_files import MAX_NUMBER, read_text
from scenemi.data.source_clip import SourceClip
from video2anim.errors import InputError, one_line
from video2anim.geometry.rotations import continuous_quaternions, quaternion_from_matrix

_FINGERS = ("lfingers", "lthumb", "rfingers", "rthumb")
_INCH_M = UNITS_M["inch"]
_CHANNEL = re.compile("[tr][xyz]")


@dataclass(frozen=True, slots=True, eq=False)
class AsfBone:
    """One bone: from its joint, which bears its name, along `direction`."""

    name: str
    direction: Float[np.ndarray, "3"]
    length_m: float
    R_axis: Float[np.ndarray, "3 3"]
    """Orientation of the axes about which the channels turn."""
    channels: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class AsfSkeleton:
    """Bones (`root` first, parents before children) and what the root's channels mean."""

    bones: tuple[AsfBone, ...]
    parents: tuple[int, ...]
    unit_m: float
    degrees: bool


def read_asf_amc(
    asf: str | Path, amc: str | Path, *, fps: float = 120.0, source: str = "cmu_asfamc", kind: str = "unknown"
) -> SourceClip:
    """A motion at 30 fps on the skeleton of its subject, feet on y = 0, without fingers and thumbs.

    Lengths follow the rule of the CMU database: a unit is an inch over the `length` of the file's `:units`.

    Args:
        asf: skeleton of the subject.
        amc: motion.
        fps: of the motion; the files do not say (CMU: 120, a few subjects 60).
        source: name of the collection.
        kind: kind of motion.

    Raises:
        InputError: a file is missing, broken, or names other bones than the other.
    """
    skeleton = read_asf(asf)
    amc = Path(amc)
    rows = _amc_rows(amc)
    bones = [i for i, bone in enumerate(skeleton.bones) if bone.name not in _FINGERS]
    unknown = {name for row in rows for name in row} - {bone.name for bone in skeleton.bones}
    if unknown or not fps > 0:
        raise InputError(f"{amc}: moves {', '.join(sorted(unknown))}, which {asf} has not; give the subject's own ASF")
    root_m, rotation = _pose(skeleton, rows, amc)
    names, parents, offsets = _joints(skeleton, bones)
    pad = np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), len(names) - len(bones), 1))
    joints = map_joints(names, None, str(asf))
    clip = SourceClip(
        name=amc.stem,
        source=source,
        kind=kind,
        description="ASF/AMC",
        origin=amc.stem,
        fps=fps,
        uneven=False,
        skeleton=skeleton_of(f"asf_{Path(asf).stem}", names, parents, offsets, joints),
        root_position_m=root_m,
        rotation_wxyz=continuous_quaternions(np.concatenate([rotation[:, bones], pad], axis=1)),
        source_fps=fps,
    )
    return with_glitches(on_floor(at_fps(retargetable(clip, joints, where=str(asf)))))


def read_asf(path: str | Path) -> AsfSkeleton:
    """Skeleton of a subject.

    Raises:
        InputError: the file is missing or no ASF.
    """
    path = Path(path)
    sections = _sections(path)
    try:
        units = dict(line.split()[:2] for line in sections["units"])
        degrees = units.get("angle", "deg").startswith("deg")
        length = _numbers([units.get("length", "1")])[0]
        if not length > 0:
            raise ValueError(f"want a unit of length above 0, got {length:g}")
        unit_m = _INCH_M / length
        root = dict((line.split()[0], line.split()[1:]) for line in sections["root"])
        order = _channels(root["order"])
        bones = [AsfBone("root", np.zeros(3), 0.0, _euler(root["orientation"], root["axis"][0], degrees), order)]
        bones += _bones(sections["bonedata"], unit_m, degrees)
        parents = _parents(sections["hierarchy"], [bone.name for bone in bones])
        ordered = sorted(range(len(bones)), key=lambda bone: _depth(bone, parents))
        place = {bone: at for at, bone in enumerate(ordered)}
        return AsfSkeleton(
            tuple(bones[bone] for bone in ordered),
            tuple(place[parents[bone]] if parents[bone] >= 0 else -1 for bone in ordered),
            unit_m,
            degrees,
        )
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(f"{path}: broken ASF skeleton: {type(error).__name__} {one_line(error)}") from error


def _sections(path: Path) -> dict[str, list[str]]:
    """Lines below each `:keyword`, without comments."""
    lines = read_text(path, "ASF skeleton").splitlines()
    sections: dict[str, list[str]] = {}
    keyword = ""
    for line in lines:
        text = line.split("#")[0].strip()
        if text.startswith(":"):
            keyword = text[1:].split()[0].lower()
            sections[keyword] = []
        elif text and keyword:
            sections[keyword].append(text)
    return sections


def _bones(lines: list[str], unit_m: float, degrees: bool) -> list[AsfBone]:
    bones: list[AsfBone] = []
    entry: dict[str, list[str]] = {}
    for line in lines:
        word, *rest = line.split()
        if word == "begin":
            entry = {}
        elif word == "end":
            direction = _numbers(entry["direction"], 3)
            if not np.linalg.norm(direction) > 0:
                raise ValueError(f"bone {entry['name'][0]!r} has no direction")
            bones.append(
                AsfBone(
                    entry["name"][0],
                    direction / np.linalg.norm(direction),
                    _numbers(entry["length"][:1], 1)[0] * unit_m,
                    _euler(entry["axis"][:3], entry["axis"][3], degrees),
                    _channels(entry.get("dof", [])),
                )
            )
        else:
            entry[word] = rest
    return bones


def _numbers(words: list[str], count: int | None = None) -> Float[np.ndarray, "words"]:
    """Words as numbers of a size that lengths and angles may have."""
    numbers = np.array([float(word) for word in words])
    if (count is not None and len(numbers) != count) or not (np.abs(numbers) <= MAX_NUMBER).all():
        raise ValueError(f"want {count or 'finite'} numbers, got {' '.join(words)[:60]!r}")
    return numbers


def _channels(words: list[str]) -> tuple[str, ...]:
    """Channels of a bone: a turn about or a move along an axis."""
    channels = tuple(word.lower() for word in words)
    if not all(_CHANNEL.fullmatch(channel) for channel in channels):
        raise ValueError(f"unknown channel among {' '.join(words)[:40]!r}")
    return channels


def _parents(lines: list[str], names: list[str]) -> list[int]:
    parents = [-1] * len(names)
    for line in lines:
        parent, *children = line.split()
        if parent in ("begin", "end"):
            continue
        for child in children:
            parents[names.index(child)] = names.index(parent)
    if any(parent < 0 for parent in parents[1:]):
        raise ValueError("a bone is in no hierarchy")
    return parents


def _depth(bone: int, parents: list[int]) -> int:
    depth = 0
    while bone >= 0 and depth <= len(parents):
        bone, depth = parents[bone], depth + 1
    return depth


def _euler(values: list[str], order: str, degrees: bool) -> Float[np.ndarray, "3 3"]:
    """Rotation about fixed axes, in the order of the letters."""
    return Rotation.from_euler(order.lower(), _numbers(values[:3], 3), degrees=degrees).as_matrix()


def _amc_rows(path: Path) -> list[dict[str, list[float]]]:
    """Channels of each bone in each frame."""
    lines = read_text(path, "AMC motion").splitlines()
    rows: list[dict[str, list[float]]] = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0][0] in "#:":
            continue
        if len(words) == 1 and words[0].isdigit():
            rows.append({})
            continue
        try:
            rows[-1][words[0]] = _numbers(words[1:]).tolist()
        except (ValueError, IndexError) as error:
            raise InputError(f"{path}: line {number} is no AMC data: {line[:60]!r}") from error
    if not rows:
        raise InputError(f"{path}: AMC file without frames")
    return rows


def _pose(
    skeleton: AsfSkeleton, rows: list[dict[str, list[float]]], path: Path
) -> tuple[Float[np.ndarray, "frames 3"], Float[np.ndarray, "frames bones 4"]]:
    """Root path and local rotations; all rotations identity is the pose of the ASF file, axes parallel to the world."""
    root_m = np.zeros((len(rows), 3))
    rotation = np.empty((len(rows), len(skeleton.bones), 4))
    for number, bone in enumerate(skeleton.bones):
        try:
            values = np.array([row.get(bone.name, [0.0] * len(bone.channels)) for row in rows], float)
            values = values.reshape(len(rows), len(bone.channels))
        except ValueError as error:
            raise InputError(f"{path}: bone {bone.name!r} wants {len(bone.channels)} numbers in each frame") from error
        turn = Rotation.identity(len(rows))
        for channel, column in zip(bone.channels, values.T, strict=True):
            axis = np.eye(3)["xyz".index(channel[1])]
            if channel[0] == "t":
                root_m += column[:, None] * axis * skeleton.unit_m
            else:
                turn = Rotation.from_rotvec(column[:, None] * axis, degrees=skeleton.degrees) * turn
        rotation[:, number] = quaternion_from_matrix(bone.R_axis @ turn.as_matrix() @ bone.R_axis.T)
    return root_m, rotation


def _joints(skeleton: AsfSkeleton, kept: list[int]) -> tuple[list[str], list[int], Float[np.ndarray, "joints 3"]]:
    """Names, parents and offsets of the kept bones' joints and of the ends of bones without children."""
    names = [skeleton.bones[i].name for i in kept]
    parents = [kept.index(skeleton.parents[i]) if skeleton.parents[i] >= 0 else -1 for i in kept]
    ends = [skeleton.bones[i].direction * skeleton.bones[i].length_m for i in kept]
    offsets = [np.zeros(3) if parent < 0 else ends[parent] for parent in parents]
    for bone in range(len(kept)):
        if bone not in parents:
            names.append(f"{names[bone]}_end")
            parents.append(bone)
            offsets.append(ends[bone])
    return names, parents, np.array(offsets)
