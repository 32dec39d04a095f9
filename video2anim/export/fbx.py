"""FBX by Blender, and the files it takes: a character `.glb` and a script.

FBX has no open specification, so it is left to Blender, which reads glTF and writes FBX. It runs as a process of its
own: a Blender program, or a Python that has its module `bpy`. Bones are named as in Mixamo's rig, which game engines
and retargeting tools recognize.
"""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from importlib import resources
from pathlib import Path

from video2anim.errors import StageError, UsageError
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
BLENDER_VARIABLE = "VIDEO2ANIM_BLENDER"
_SCRIPT = "blender_to_fbx.py"
_BLENDER_OPTIONS = ("--background", "--factory-startup", "--python-use-system-env", "--python-exit-code", "1")


def blender_command() -> tuple[str, ...] | None:
    """What runs a script inside Blender: the program or Python that `VIDEO2ANIM_BLENDER` names, else this Python where
    it has `bpy`, else `blender` on the PATH; None where there is none.

    Raises:
        UsageError: the variable names no program.
    """
    if named := os.environ.get(BLENDER_VARIABLE):
        if (program := shutil.which(Path(named).expanduser())) is None:
            raise UsageError(f"{BLENDER_VARIABLE}: want a Blender, or a Python that has bpy, found none at {named}")
        return _runner(program)
    if importlib.util.find_spec("bpy") is not None:
        return (sys.executable,)
    program = shutil.which("blender")
    return None if program is None else _runner(program)


def _runner(program: str) -> tuple[str, ...]:
    return (program,) if Path(program).name.startswith("python") else (program, *_BLENDER_OPTIONS, "--python")


def write_fbx(path: Path, motion: BodyMotion) -> None:
    """Write one person as `.fbx`: mesh, 22 bones along the limbs, and the motion at 30 fps from frame 0.

    Args:
        path: File to make.
        motion: The person.

    Raises:
        UsageError: there is no Blender.
        StageError: Blender failed; the message has its error.
    """
    if (blender := blender_command()) is None:
        raise UsageError(f"fbx: want Blender, found none; name it, or a Python that has bpy, in {BLENDER_VARIABLE}")
    with tempfile.TemporaryDirectory() as work:
        character, script = write_fbx_ready((motion,), Path(work))
        made = Path(work) / "made.fbx"
        # UIDs in FBX files are Python hashes of names.
        environment = {**os.environ, "PYTHONHASHSEED": "0"}
        done = subprocess.run(
            [*blender, str(script), "--", str(character), str(made)],
            capture_output=True, text=True, errors="replace", check=False, env=environment, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        if done.returncode or not made.is_file():
            told = [line.strip() for line in (done.stdout + done.stderr).splitlines() if "Error" in line]
            raise StageError(
                f"fbx: {blender[0]} could not convert {character.name}: {told[-1] if told else done.returncode}; "
                f"want Blender 4.2 or later, name another in {BLENDER_VARIABLE}"
            )
        shutil.copyfile(made, path)


def write_fbx_ready(people: tuple[BodyMotion, ...], folder: Path) -> tuple[Path, ...]:
    """Make the folder where it is missing, and in it `person_<id>.glb` for each person and the script for Blender."""
    folder.mkdir(exist_ok=True)
    written = []
    for motion in people:
        written.append(folder / f"person_{motion.person_id}.glb")
        write_scene_glb(written[-1], (character_of(motion),), None, camera=False, joint_names=MIXAMO_NAMES)
    script = folder / _SCRIPT
    script.write_text(resources.files("video2anim.export").joinpath("templates", _SCRIPT).read_text("utf-8"), "utf-8")
    return (*written, script)


def command_line(character: Path, script: Path, target: Path) -> str:
    """What to type where Blender is."""
    words = ("blender", "--background", "--python", str(script), "--", str(character), str(target))
    return shlex.join(words)
