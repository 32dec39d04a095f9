"""A character file and a Blender script that turns it into FBX.

FBX has no open specification, so it is left to Blender, which reads glTF and writes FBX. Each person gets one `.glb`
with skin and animation only, and bones named as in Mixamo's rig, which game engines and retargeting tools recognise.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from video2anim.export.character import character_of
from video2anim.export.glb import write_scene_glb
from video2anim.types import BodyMotion

MIXAMO_NAMES = tuple(
    f"mixamorig:{bone}"
    for bone in (
        "Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot",
        "RightFoot", "Spine2", "LeftToeBase", "RightToeBase", "Neck", "LeftShoulder", "RightShoulder",
        "Head", "LeftArm", "RightArm", "LeftForeArm", "RightForeArm", "LeftHand", "RightHand",
    )
)  # fmt: skip
"""Bone names in SMPL joint order."""
_SCRIPT = "blender_to_fbx.py"


def write_fbx_ready(people: tuple[BodyMotion, ...], out_dir: Path) -> tuple[Path, ...]:
    """Write `fbx_ready/person_<id>.glb` for each person and the Blender script beside them.

    Convert with `blender --background --python blender_to_fbx.py -- person_1.glb person_1.fbx`.
    """
    folder = out_dir / "fbx_ready"
    folder.mkdir(exist_ok=True)
    written = []
    for motion in people:
        written.append(folder / f"person_{motion.person_id}.glb")
        write_scene_glb(written[-1], (character_of(motion),), None, camera=False, joint_names=MIXAMO_NAMES)
    script = folder / _SCRIPT
    script.write_text(resources.files("video2anim.export").joinpath("templates", _SCRIPT).read_text("utf-8"), "utf-8")
    return (*written, script)
