"""Animated characters of glTF binary files (`.glb`), as Blender and this project write them.

glTF is in meters with +Y up. A character is a skin; its joints are found by their names. Poses are read at 30 frames
per second from the first key on, as orientations in the world relative to the rest pose, so that the axes of the bones
do not matter. The rest pose is that of the nodes where this is a posture, else the pose in which the skin was bound.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from pydantic import BaseModel, FiniteFloat

from scenemi.data.adults import adult_with
from scenemi.data.bvh import STRETCH
from scenemi.data.gltf_nodes import GltfFile, Posed, read_gltf
from scenemi.data.import_clip import guess_unit, retargetable, skeleton_of
from scenemi.data.joint_names import JointMap, map_joints
from scenemi.data.plain_files import MAX_FRAMES, checked
from scenemi.data.posture import body_axes, posture_problem
from scenemi.data.source_clip import SourceClip
from scenemi.metrics import UP
from video2anim.body.anny_body import shaped_body
from video2anim.body.legs import LEGS
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError, UsageError
from video2anim.geometry.rotations import continuous_quaternions, quaternion_from_matrix
from video2anim.types.clip import FPS
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import JOINT_NAMES

_BAKED_S = 0.1
"""Keys nearer than this (in the median) are every frame of a motion, not poses that somebody set."""


class _Shape(BaseModel):
    model: str
    parameters: dict[str, FiniteFloat]


class _Extras(BaseModel):
    shape: _Shape


@dataclass(frozen=True, slots=True, eq=False)
class GltfMotion:
    """An animated character."""

    clip: SourceClip
    """At 30 frames per second from its first key on, ready for retargeting."""
    key_frames: Int[np.ndarray, "keys"]
    """Frames that hold the keys of the animation, where those are poses that somebody set; empty where a pose for every
    frame was written."""
    body: ShapedBody
    """That of the file's `shape` (files of this project), else an adult whose legs are as long as the character's."""


@dataclass(frozen=True, slots=True, eq=False)
class _Figure:
    """Joints of one skin from its pelvis on, parents first."""

    joints: JointMap
    nodes: tuple[int, ...]
    names: tuple[str, ...]
    parents: tuple[int, ...]
    rest: Posed


def read_gltf_motion(path: Path, mapping: Mapping[str, str] | None = None) -> GltfMotion:
    """The first animated character of a `.glb`.

    Args:
        path: the file.
        mapping: SMPL joint -> node of the file, where names are of no known convention.

    Raises:
        InputError: the file is broken, has no skin whose joints can be named, no animation of it, or lies on its side.
    """
    file = read_gltf(path)
    figure = _figure(file, mapping, str(path))
    moved = set(figure.nodes) | {above for node in figure.nodes for above in file.ancestors(node)}
    channels = next((found for one in file.animations if (found := [c for c in one if c.node in moved])), [])
    key_s = np.unique(np.concatenate([channel.time_s for channel in channels])) if channels else np.zeros(0)
    if not len(key_s):
        raise InputError(f"{path}: no animation of the character; give its poses keys, and export animations")
    if (key_s[-1] - key_s[0]) * FPS >= MAX_FRAMES:
        raise InputError(f"{path}: want at most an hour of motion, got {key_s[-1] - key_s[0]:.0f} s")
    key_frames = np.unique(np.rint((key_s - key_s[0]) * FPS).astype(np.int64))
    time_s = key_s[0] + np.arange(key_frames[-1] + 1) / FPS
    clip = _clip(path, figure, file.posed(figure.nodes, channels, time_s))
    baked = len(key_s) > 1 and float(np.median(np.diff(key_s))) < _BAKED_S
    body = _own_body(file, figure, str(path)) or adult_with(_length_m, _leg_m(figure))
    return GltfMotion(clip, key_frames[:0] if baked else key_frames, body)


def _figure(file: GltfFile, mapping: Mapping[str, str] | None, where: str) -> _Figure:
    """The first skin whose joints can be named."""
    problem: InputError | None = None
    for skin in file.skins:
        try:
            joints = map_joints([file.names[node] for node in skin.nodes], mapping, where)
        except InputError as error:
            problem = problem or error
            continue
        pelvis = next(node for node in skin.nodes if file.names[node] == joints.position["pelvis"])
        nodes = file.descendants(pelvis)
        names = tuple(file.names[node] for node in nodes)
        if lost := [name for name in joints.position.values() if name not in names]:
            raise InputError(f"{where}: {', '.join(lost)} do not descend from {names[0]!r}")
        parents = tuple(nodes.index(file.parents[node]) if node != pelvis else -1 for node in nodes)
        rests = [file.posed(nodes, (), np.zeros(1)), file.bound(nodes, skin)]
        figure = [_Figure(joints, nodes, names, parents, rest) for rest in rests]
        return next((one for one in figure if _is_posture(one)), figure[0])
    raise problem or InputError(f"{where}: no character, the file has no skin; export the armature with its mesh")


def _named_m(figure: _Figure) -> Float[np.ndarray, "22 3"]:
    at = [figure.names.index(figure.joints.position[name]) if name in figure.joints.position else -1
          for name in JOINT_NAMES]  # fmt: skip
    named_m = figure.rest.position_m[0, at].copy()
    named_m[np.array(at) < 0] = np.nan
    return named_m


def _is_posture(figure: _Figure) -> bool:
    return posture_problem(_named_m(figure)) is None


def _leg_m(figure: _Figure) -> float:
    return _length_m(_named_m(figure))


def _length_m(joints_m: Float[np.ndarray, "22 3"]) -> float:
    """Thigh and shin."""
    leg = LEGS[0]
    bones = (joints_m[leg.hip] - joints_m[leg.knee], joints_m[leg.knee] - joints_m[leg.ankle])
    return float(sum(np.linalg.norm(bone) for bone in bones))


def _clip(path: Path, figure: _Figure, posed: Posed) -> SourceClip:
    """The motion, in joint frames that are parallel to the world at rest."""
    where, rest = str(path), figure.rest
    leg_m = _leg_m(figure)
    if (unit := guess_unit(leg_m, where)) != "m":
        raise InputError(f"{where}: legs of {leg_m:.3g} m, as if in {unit}; apply the scale, glTF is in meters")
    named_m = _named_m(figure)
    if _is_posture(figure) and body_axes(named_m)[:, 1].argmax() != UP:
        raise InputError(f"{where}: the rest pose does not stand along +Y, which is up in glTF; export with +Y up")
    R_world = posed.R_world @ rest.R_world.swapaxes(-1, -2)
    R_local = R_world.copy()
    offsets_m = np.zeros_like(rest.position_m[0])
    for joint, parent in enumerate(figure.parents):
        if parent >= 0:
            R_local[:, joint] = R_world[:, parent].swapaxes(-1, -2) @ R_world[:, joint]
            offsets_m[joint] = rest.position_m[0, joint] - rest.position_m[0, parent]
    joints = replace(figure.joints, convention="gltf")  # frames are parallel to the world, whatever the names
    clip = SourceClip(
        name=path.stem, source="gltf", kind="unknown", description=f"glTF, {figure.joints.convention} names", origin="",
        fps=FPS, uneven=False, skeleton=skeleton_of("gltf", figure.names, figure.parents, offsets_m, joints),
        root_position_m=posed.position_m[:, 0],
        rotation_wxyz=continuous_quaternions(quaternion_from_matrix(R_local)), source_fps=FPS,
    )  # fmt: skip
    used = clip.skeleton.smpl_position[clip.skeleton.smpl_position >= 0]
    off_m = np.linalg.norm(clip.joints_m()[:, used] - posed.position_m[:, used], axis=-1)
    if off_m.max() > STRETCH * leg_m:
        worst = figure.names[used[int(off_m.max(0).argmax())]]
        raise InputError(f"{where}: the bone to {worst!r} changes its length in time; export rotations only")
    return retargetable(clip, joints, where=where)


def _own_body(file: GltfFile, figure: _Figure, where: str) -> ShapedBody | None:
    """The body that the file names in the extras of the armature."""
    for node in file.ancestors(figure.nodes[0]):
        if "shape" in file.extras[node]:
            shape = checked(_Extras, where, file.extras[node]).shape
            try:
                return shaped_body(BodyShape(shape.model, dict(shape.parameters)))
            except UsageError as error:
                raise InputError(f"{where}: {error}") from error
    return None
