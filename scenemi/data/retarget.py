"""Source motion onto a body of the 22 SMPL joints: same limb directions, feet on the floor.

Joint orientations are carried over with the change of rest pose. The path of the hips is scaled by the length of the
legs. Then each foot is planted where it stands (sole on y = 0, joints still), the hips are raised or lowered smoothly
so that the legs reach, and the legs follow by inverse kinematics about the knee's own hinge.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from scenemi.contacts import ContactConfig, foot_contacts
from scenemi.data.body_measure import BodyMeasure, measure_body
from scenemi.data.container import SourceClip, SourceSkeleton
from scenemi.data.foot_plant import FootPose, place_foot, pose_foot, turned_about
from scenemi.data.hinge_limb import bend_leg, move_wrist
from scenemi.data.hip_path import height_correction, out_of_floor, reach_drop, scaled_path
from scenemi.data.rest_pose import rest_axes
from video2anim.body.legs import LEGS
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError
from video2anim.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from video2anim.types.skeleton import JOINT_INDEX, PARENTS

_CHAINS = (("pelvis", "spine1", "spine2", "spine3"), ("spine3", "neck", "head"))
"""Joints without a source between joints with one turn in equal shares."""
_FLAT_FRAMES = 5
"""With so many flat frames half of the tilt is believed: few frames may be a step on an edge (not measured)."""
_FLOOR_TOE_M = 0.10
"""Toe joints of feet on the capture floor are at most this high (measured: 0.02 to 0.045 m); mats begin at 0.21 m."""
_SAME_LEVEL_M = 0.06
"""Soles within this of the lowest stand on the same ground: a third of a step."""
_MAX_FOOT_TILT_RAD = 0.35
"""Largest difference between a clip's standing foot and its family's that is taken for the shape of its skeleton."""


@dataclass(frozen=True, slots=True)
class RetargetConfig:
    """How feet are held."""

    contact: ContactConfig = field(default_factory=ContactConfig)
    blend_s: float = 0.27
    """Time in which a correction of a foot fades before and after it stands."""
    height_smoothing_s: float = 0.17
    """Standard deviation of the smoothing of the hips' height correction."""
    settle_s: float = blend_s
    """The same where hips must go down for a leg to reach, or up for the body to clear the floor."""
    still_m: float = 0.005
    """A contact is dropped where the planted joint still moves more than this in a frame, or its sole is off the floor
    by more (leg out of reach)."""


@dataclass(frozen=True, slots=True, eq=False)
class RetargetedMotion:
    """Motion of the 22 joints for one body; world +Y up, floor at y = 0."""

    translation_m: Float[np.ndarray, "frames 3"]
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    contact: Bool[np.ndarray, "frames 22"]
    """Ankle = heel down, foot = ball down."""
    name: str
    kind: str
    source: str


def retarget(clip: SourceClip, body: ShapedBody, config: RetargetConfig | None = None) -> RetargetedMotion:
    """A source clip on a body.

    Clips marked `uneven` keep their feet still where they stood, at any height: their floor is not captured.

    Raises:
        InputError: the skeleton is of no known family, or the clip has fewer than 2 frames.
    """
    config = config or RetargetConfig()
    if len(clip.root_position_m) < 2:
        raise InputError(f"clip {clip.name!r}: want at least 2 frames to retarget, got {len(clip.root_position_m)}")
    joints_m, R_source = clip.forward()
    named_m = joints_m[:, clip.skeleton.smpl_position]
    R_world = carried_over(R_source, clip.skeleton.smpl_rotation, rest_axes(clip.skeleton))
    measure = measure_body(body)
    has_floor = not clip.uneven
    blend, settle = (max(2, round(time_s * clip.fps)) for time_s in (config.blend_s, config.settle_s))

    feet = _posed_feet(clip, named_m, R_world, measure, blend, config)
    relative_m = _positions(R_world, body.rest_joints_m)
    root_m = scaled_path(named_m, relative_m, body)
    if has_floor:
        root_m[:, 1] += height_correction(root_m, relative_m, feet, config.height_smoothing_s * clip.fps)
        root_m[:, 1] += out_of_floor(root_m, relative_m, R_world, measure.trunk, settle)
    ankles_m = _placed(root_m, relative_m, feet, measure, blend, has_floor)
    root_m[:, 1] -= reach_drop(root_m, relative_m, feet, ankles_m, measure, settle)
    if has_floor:
        root_m[:, 1] += out_of_floor(root_m, relative_m, R_world, measure.trunk, settle)
        _lift_hands(R_world, root_m, relative_m, body, measure, settle)
        relative_m = _positions(R_world, body.rest_joints_m)
        root_m[:, 1] += out_of_floor(root_m, relative_m, R_world, measure.above_feet, settle)
    ankles_m = _placed(root_m, relative_m, feet, measure, blend, has_floor)
    for foot, leg, ankle_m, bones in zip(feet, LEGS, ankles_m, measure.legs, strict=True):
        hip_m = root_m + relative_m[:, leg.hip]
        R_world[:, leg.hip], R_world[:, leg.knee] = bend_leg(R_world[:, leg.hip], hip_m, ankle_m, bones)
        R_world[:, leg.ankle] = foot.R_world_ankle
        R_world[:, leg.toe] = foot.R_world_ankle @ turned_about(0, -foot.toe_bend_rad)
    posed_m = root_m[:, None] + _positions(R_world, body.rest_joints_m)
    if not has_floor:
        rise_m = _onto_floor_m(posed_m, named_m, feet)
        root_m[:, 1] += rise_m
        posed_m[..., 1] += rise_m
    contact = _true_contacts(posed_m, feet, has_floor, config.still_m)
    return RetargetedMotion(root_m, _local(R_world), contact, clip.name, clip.kind, clip.source)


def carried_over(
    R_source: Float[np.ndarray, "frames joints 3 3"],
    smpl_rotation: Int[np.ndarray, "22"],
    axes: Float[np.ndarray, "22 3 3"],
) -> Float[np.ndarray, "frames 22 3 3"]:
    """World orientations of the 22 joints; joints that the source lacks are filled from their neighbors.

    Args:
        R_source: world orientations of the source's joints.
        smpl_rotation: source joint of each SMPL joint.
        axes: change of rest pose as from `rest_axes`, NaN where the source has none.
    """
    R_world = R_source[:, smpl_rotation] @ np.where(np.isnan(axes), 0.0, axes)
    known = ~np.isnan(axes[:, 0, 0])
    for chain in _CHAINS:
        numbers = [JOINT_INDEX[name] for name in chain]
        anchors = [i for i, joint in enumerate(numbers) if known[joint]]
        for first, last in itertools.pairwise(anchors):
            if last - first > 1:
                start = R_world[:, numbers[first]]
                turn = axis_angle_from_matrix(np.swapaxes(start, -1, -2) @ R_world[:, numbers[last]])
                for i in range(first + 1, last):
                    R_world[:, numbers[i]] = start @ matrix_from_axis_angle(turn * (i - first) / (last - first))
                    known[numbers[i]] = True
    for joint, parent in enumerate(PARENTS):
        if not known[joint]:
            R_world[:, joint] = R_world[:, parent]
    return R_world


def _posed_feet(
    clip: SourceClip,
    named_m: np.ndarray,
    R_world: np.ndarray,
    measure: BodyMeasure,
    blend: int,
    config: RetargetConfig,
) -> list[FootPose]:
    """When each foot stands, and how it is turned."""
    has_floor = not clip.uneven
    feet: list[FootPose] = []
    for leg, sole in zip(LEGS, measure.soles, strict=True):
        touching = foot_contacts(
            named_m[:, leg.ankle],
            named_m[:, leg.toe],
            _flat_rise_m(clip.skeleton, leg.ankle, leg.toe),
            clip.fps,
            has_floor=has_floor,
            config=config.contact,
        )
        flat = touching[:, 0] & touching[:, 1]
        R_ankle = _leveled(R_world[:, leg.ankle], flat) if has_floor else R_world[:, leg.ankle]
        feet.append(pose_foot(R_ankle, touching, sole, blend, has_floor=has_floor))
    return feet


def _flat_rise_m(skeleton: SourceSkeleton, ankle: int, toe: int) -> float:
    """How much higher than the toe joint the ankle lies when the sole is flat."""
    toe_offset_m = skeleton.offsets_m[skeleton.smpl_position[toe]]
    return float(-rest_axes(skeleton)[ankle][:, 1] @ toe_offset_m)


def _leveled(R_world_ankle: np.ndarray, flat: Bool[np.ndarray, "frames"]) -> Float[np.ndarray, "frames 3 3"]:
    """Foot orientations turned by a constant so that the clip's flat foot is level."""
    count = int(flat.sum())
    if count == 0:
        return R_world_ankle
    up = np.median(R_world_ankle[flat, 1], axis=0)
    axis = np.cross([0.0, 1.0, 0.0], up)
    sine = float(np.linalg.norm(axis))
    angle = min(float(np.arctan2(sine, up[1])), _MAX_FOOT_TILT_RAD) * count / (count + _FLAT_FRAMES)
    return R_world_ankle @ matrix_from_axis_angle(axis / max(sine, 1e-12) * angle)


def _positions(R_world: np.ndarray, rest_joints_m: np.ndarray) -> Float[np.ndarray, "frames 22 3"]:
    """Joints relative to the pelvis."""
    parents = PARENTS[1:]
    bones = (R_world[:, parents] @ (rest_joints_m[1:] - rest_joints_m[parents])[..., None])[..., 0]
    joints_m = np.zeros((len(R_world), 22, 3))
    for joint in range(1, 22):
        joints_m[:, joint] = joints_m[:, PARENTS[joint]] + bones[:, joint - 1]
    return joints_m


def _local(R_world: np.ndarray) -> Float[np.ndarray, "frames 22 3 3"]:
    R_parent_joint = np.swapaxes(R_world[:, PARENTS], -1, -2) @ R_world
    R_parent_joint[:, 0] = R_world[:, 0]
    return R_parent_joint


def _placed(
    root_m: np.ndarray, relative_m: np.ndarray, feet: list[FootPose], measure: BodyMeasure, blend: int, has_floor: bool
) -> list[np.ndarray]:
    """Path of each ankle for this path of the hips."""
    paths_m = []
    for foot, leg, sole, bones in zip(feet, LEGS, measure.soles, measure.legs, strict=True):
        reach = np.linalg.norm(relative_m[:, leg.ankle] - relative_m[:, leg.hip], axis=-1) / bones.length_m
        paths_m.append(place_foot(foot, root_m + relative_m[:, leg.ankle], reach, sole, blend, has_floor=has_floor))
    return paths_m


def _lift_hands(
    R_world: np.ndarray,
    root_m: np.ndarray,
    relative_m: np.ndarray,
    body: ShapedBody,
    measure: BodyMeasure,
    radius: int,
) -> None:
    """Bend arms whose hands would be under the floor; changes shoulders and elbows in `R_world`."""
    for side, hull, axis in zip(("left", "right"), measure.hands, (-1.0, 1.0), strict=True):
        lift = out_of_floor(root_m, relative_m, R_world, hull, radius)
        if not lift.any():
            continue
        shoulder, elbow, wrist = (JOINT_INDEX[f"{side}_{name}"] for name in ("shoulder", "elbow", "wrist"))
        rest_m = body.rest_joints_m
        R_world[:, shoulder], R_world[:, elbow] = move_wrist(
            R_world[:, shoulder],
            R_world[:, elbow],
            (rest_m[elbow] - rest_m[shoulder], rest_m[wrist] - rest_m[elbow]),
            np.array([0.0, axis, 0.0]),
            lift[:, None] * [0.0, 1.0, 0.0],
        )


def _onto_floor_m(
    posed_m: Float[np.ndarray, "frames 22 3"], named_m: Float[np.ndarray, "frames 22 3"], feet: list[FootPose]
) -> float:
    """Constant rise (m) that puts the soles that stand lowest on y = 0, the capture floor; 0 where nobody stands near
    it: then what carried the feet was not captured.

    Args:
        posed_m: joints on the body.
        named_m: joints of the source.
        feet: of the body.
    """
    soles_m, toes_m = [], []
    for foot, leg in zip(feet, LEGS, strict=True):
        flat = foot.contact.all(1)
        soles_m.append((posed_m[:, leg.ankle, 1] + foot.lowest_m)[flat])
        toes_m.append(named_m[flat, leg.toe, 1])
    soles, toes = np.concatenate(soles_m), np.concatenate(toes_m)
    if not len(soles) or np.percentile(toes, 5) > _FLOOR_TOE_M:
        return 0.0
    return -float(np.median(soles[soles < np.percentile(soles, 5) + _SAME_LEVEL_M]))


def _true_contacts(
    joints_m: np.ndarray, feet: list[FootPose], has_floor: bool, still_m: float
) -> Bool[np.ndarray, "frames 22"]:
    """Contacts that came true: the joint is still and, with a floor, the sole is on it."""
    contact = np.zeros(joints_m.shape[:2], bool)
    for foot, leg in zip(feet, LEGS, strict=True):
        off_floor = np.abs(joints_m[:, leg.ankle, 1] + foot.lowest_m) > still_m
        for joint, flags in ((leg.ankle, foot.contact[:, 0]), (leg.toe, foot.contact[:, 1])):
            moving = np.linalg.norm(np.diff(joints_m[:, joint], axis=0), axis=-1) > still_m
            bad = np.concatenate([[False], moving & flags[1:] & flags[:-1]])
            contact[:, joint] = flags & ~bad & ~(off_floor & has_floor)
    return contact
