"""Which joint of a foreign skeleton stands for which of the 22 SMPL joints, by the naming conventions in use."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from video2anim.errors import InputError
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES

_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_LIMBS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")
OPTIONAL = ("spine1", "spine2", "spine3", "left_collar", "right_collar")
"""Joints that a skeleton may lack; of neck and head it may lack one."""


@dataclass(frozen=True, slots=True)
class Convention:
    """Names of one kind of skeleton; `{}` in a limb's name is the side."""

    name: str
    sides: tuple[str, str]
    trunk: tuple[str | None, ...]
    """Pelvis, spine1 to 3, neck, head."""
    limbs: tuple[str | None, ...]
    """Hip, knee, ankle, foot (ball), collar, shoulder, elbow, wrist."""
    rotation: Mapping[str, str | None] = field(default_factory=dict)
    """Joints whose orientation is taken from another joint than their position; None = from none."""

    def table(self) -> dict[str, str]:
        """SMPL joint name -> source joint name, where the convention has one."""
        table = {name: source for name, source in zip(_TRUNK, self.trunk, strict=True) if source}
        for side, text in zip(("left", "right"), self.sides, strict=True):
            table |= {
                f"{side}_{limb}": pattern.format(text)
                for limb, pattern in zip(_LIMBS, self.limbs, strict=True)
                if pattern
            }
        return table


_MIXAMO_LIMBS = ("{}UpLeg", "{}Leg", "{}Foot", "{}ToeBase", "{}Shoulder", "{}Arm", "{}ForeArm", "{}Hand")
_RIGIFY_LIMBS = ("thigh.{}", "shin.{}", "foot.{}", "toe.{}", "shoulder.{}", "upper_arm.{}", "forearm.{}", "hand.{}")
_SMPL_LIMBS = ("{}_hip", "{}_knee", "{}_ankle", "{}_foot", "{}_collar", "{}_shoulder", "{}_elbow", "{}_wrist")
_SMPL_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_OF_HEAD_DOWN = {"spine1": "LowerBack", "spine2": "Spine", "spine3": "Spine1", "neck": "Neck1"}
CONVENTIONS: tuple[Convention, ...] = (
    Convention("smpl", ("left", "right"), _SMPL_TRUNK, _SMPL_LIMBS),
    Convention("smpl", ("L", "R"), _SMPL_TRUNK, _SMPL_LIMBS),
    Convention(
        "mixamo", ("Left", "Right"), ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"), _MIXAMO_LIMBS
    ),
    Convention(
        "lafan",
        ("Left", "Right"),
        ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"),
        ("{}UpLeg", "{}Leg", "{}Foot", "{}Toe", "{}Shoulder", "{}Arm", "{}ForeArm", "{}Hand"),
    ),
    Convention(
        "cmu38",
        ("Left", "Right"),
        ("Hips", "Spine", "Spine1", "Neck", "Neck1", "Head"),
        (*_MIXAMO_LIMBS[:7], "{}FingerBase"),
        _OF_HEAD_DOWN,
    ),
    Convention(
        "asf",
        ("l", "r"),
        ("root", "upperback", "thorax", "lowerneck", "upperneck", "head"),
        ("{}femur", "{}tibia", "{}foot", "{}toes", "{}clavicle", "{}humerus", "{}radius", "{}hand"),
        {"spine1": "lowerback", "spine2": "upperback", "spine3": "thorax"},
    ),
    Convention(
        "cc",
        ("L", "R"),
        ("CC_Base_Hip", "CC_Base_Waist", "CC_Base_Spine01", "CC_Base_Spine02", "CC_Base_NeckTwist01", "CC_Base_Head"),
        (
            "CC_Base_{}_Thigh", "CC_Base_{}_Calf", "CC_Base_{}_Foot", "CC_Base_{}_ToeBase",
            "CC_Base_{}_Clavicle", "CC_Base_{}_Upperarm", "CC_Base_{}_Forearm", "CC_Base_{}_Hand",
        ),
    ),
    Convention(
        "daz",
        ("l", "r"),
        ("hip", "abdomen", "chest", None, "neck", "head"),
        ("{}Thigh", "{}Shin", "{}Foot", "{}Foot_end", "{}Collar", "{}Shldr", "{}ForeArm", "{}Hand"),
        {"spine2": None, "spine3": "chest", "left_foot": None, "right_foot": None},
    ),
    Convention(
        "bandai",
        ("L", "R"),
        ("Hips", "Spine", "Chest", None, "Neck", "Head"),
        (
            "UpperLeg_{}", "LowerLeg_{}", "Foot_{}", "Toes_{}", "Shoulder_{}", "UpperArm_{}", "LowerArm_{}", "Hand_{}",
        ),
        {"spine2": None, "spine3": "Chest"},
    ),
    Convention(
        "rigify", ("L", "R"), ("spine", "spine.001", "spine.002", "spine.003", "spine.004", "spine.006"), _RIGIFY_LIMBS
    ),
    Convention("blender", ("L", "R"), ("hips", "spine", "chest", None, "neck", "head"), _RIGIFY_LIMBS),
    Convention(
        "unreal",
        ("l", "r"),
        ("pelvis", "spine_01", "spine_02", "spine_03", "neck_01", "head"),
        ("thigh_{}", "calf_{}", "foot_{}", "ball_{}", "clavicle_{}", "upperarm_{}", "lowerarm_{}", "hand_{}"),
    ),
    Convention(
        "poser",
        ("Left", "Right"),
        ("Hips", "Chest", "Chest2", "Chest3", "Neck", "Head"),
        ("{}Hip", "{}Knee", "{}Ankle", "{}Toe", "{}Collar", "{}Shoulder", "{}Elbow", "{}Wrist"),
    ),
)  # fmt: skip
"""Names of joints by program; numbers are parts of names."""


@dataclass(frozen=True, slots=True)
class JointMap:
    """Source joints of the SMPL joints."""

    convention: str
    """Name of the convention, or `given`."""
    position: dict[str, str]
    rotation: dict[str, str]


def map_joints(names: Sequence[str], given: Mapping[str, str] | None = None, where: str = "skeleton") -> JointMap:
    """Find the SMPL joints among joint names.

    Args:
        names: joints of the skeleton; end points are `<joint>_end`.
        given: SMPL joint -> source joint, goes before what is found.
        where: of what the error speaks.

    Raises:
        InputError: joints are missing; it names them.
    """
    given = dict(given or {})
    unknown = [f"{key!r} (no SMPL joint)" for key in given if key not in JOINT_INDEX]
    unknown += [f"{value!r} (not in the skeleton)" for value in given.values() if value not in names]
    if unknown:
        raise InputError(f"{where}: joint mapping names {', '.join(unknown)}; SMPL joints are {', '.join(JOINT_NAMES)}")
    known = {_plain(name): name for name in reversed(names)}
    best, found = CONVENTIONS[0], {}
    for convention in CONVENTIONS:
        table = {joint: known[key] for joint, name in convention.table().items() if (key := _plain(name)) in known}
        if len(table) > len(found):
            best, found = convention, table
    complete = len(given) == len(JOINT_NAMES)
    position = given if complete else {**_with_toe_ends(found, names), **given}
    missing = [joint for joint in JOINT_NAMES if joint not in position and joint not in (*OPTIONAL, "neck", "head")]
    if "neck" not in position and "head" not in position:
        missing.append("neck or head")
    if missing:
        raise InputError(
            f"{where}: no joint found for {', '.join(missing)} among {', '.join(names[:30])}; "
            "give a JSON mapping of these SMPL joints to joints of the skeleton"
        )
    turned = {joint: best.rotation.get(joint, source) for joint, source in position.items() if joint not in given}
    turned |= {joint: name for joint, name in best.rotation.items() if joint not in position and name in names}
    rotation = {joint: known.get(_plain(name), name) for joint, name in turned.items() if name} | given
    rotation = {joint: name for joint, name in rotation.items() if not name.endswith("_end")}
    return JointMap("given" if complete else best.name, position, rotation)


def read_mapping(path: str | Path) -> dict[str, str]:
    """A user's mapping: a JSON object of SMPL joint -> source joint.

    Raises:
        InputError: the file is missing or no such object.
    """
    path = Path(path)
    try:
        table = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: joint mapping cannot be read as JSON: {error}") from error
    if not isinstance(table, dict) or not all(isinstance(value, str) for value in table.values()):
        raise InputError(f"{path}: want a JSON object of SMPL joint name to joint name of the skeleton")
    return table


def _plain(name: str) -> str:
    """Joint name without namespace, prefix, case and separators."""
    name = name.rsplit(":", 1)[-1].rsplit("|", 1)[-1]
    name = re.sub(r"^(mixamorig\d*_|[mf]_avg_|DEF-|ORG-|Character\d+_|Bip\d+ )", "", name)
    return re.sub(r"[\s_.\-]", "", name).lower()


def _with_toe_ends(found: Mapping[str, str], names: Sequence[str]) -> dict[str, str]:
    """Ends of feet stand for toes where there are none."""
    table = dict(found)
    for side in ("left", "right"):
        end = f"{found.get(f'{side}_ankle')}_end"
        if f"{side}_foot" not in table and end in names:
            table[f"{side}_foot"] = end
    return table
