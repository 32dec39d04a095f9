"""Exported files opened in Blender: joints are where the motion has them, bones lie along limbs, lenses are lenses."""

from __future__ import annotations

import hashlib
import json
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from walk_scene import room, walk

from video2anim.errors import StageError
from video2anim.export import ExportScene, write_format
from video2anim.export.fbx import MIXAMO_NAMES, blender_command, write_fbx
from video2anim.geometry.projection import transform_points
from video2anim.types import BodyMotion
from video2anim.types.skeleton import JOINT_NAMES

SCRIPT = Path(__file__).with_name("blender_reads.py")
FRAMES = 260
"""More than the 250 that Blender shows when told nothing."""
LOOKED_AT = (0, 1, 77, 180, 250, 259)
JOINT_TOLERANCE_M = 2e-5
"""float32 in files and in Blender; the files' own writers are right to 0.002 mm."""
FORMATS = ("glb", "usd", "bvh", "fbx")

pytestmark = pytest.mark.skipif(
    blender_command() is None,
    reason="no Blender: `make .venv/.programs`, or name a Blender or a Python that has bpy in VIDEO2ANIM_BLENDER",
)


@dataclass(frozen=True)
class Seen:
    """What Blender saw in one file."""

    mesh_corners_m: dict[str, np.ndarray]
    """The first vertices of every mesh; of the skin they are at rest."""
    stored_scales: dict[str, list[float]]
    """Of the nodes in an FBX file."""
    action_frames: list[float]
    joints_m: np.ndarray
    limb_cosine: dict[str, float]
    """Between each bone and the line to its child, where it has one child or the spine goes on."""
    cameras: list[tuple[str, float, float, float, float]]


@pytest.fixture(scope="module")
def motion() -> BodyMotion:
    return walk(FRAMES)


@pytest.fixture(scope="module")
def seen(motion: BodyMotion, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Seen]:
    folder = tmp_path_factory.mktemp("blender")
    paths = {name: write_format(name, ExportScene((motion,), room()), folder)[0] for name in FORMATS}
    blender = blender_command()
    assert blender is not None
    words = [str(folder / "seen.json"), ",".join(map(str, LOOKED_AT)), *map(str, paths.values())]
    done = subprocess.run([*blender, str(SCRIPT), "--", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((folder / "seen.json").read_text())
    return {name: as_seen(found[str(path)]) for name, path in paths.items()}


def as_seen(raw: dict) -> Seen:
    def plain(bone: str) -> str:
        name = bone.split("/")[-1]
        return JOINT_NAMES[MIXAMO_NAMES.index(name)] if name in MIXAMO_NAMES else name

    heads = {plain(bone): np.array(path) for bone, path in raw["heads_zup_m"].items()}
    zup_m = np.stack([heads[name] for name in JOINT_NAMES], axis=1)
    limbs = {plain(bone): (np.array(head), np.array(tail)) for bone, (head, tail, _) in raw["limbs"].items()}
    parents = {plain(bone): parent and plain(parent) for bone, (_, _, parent) in raw["limbs"].items()}
    cosine = {}
    for child, parent in parents.items():
        if parent and (parent not in ("pelvis", "spine3") or child == "neck"):
            head, tail = limbs[parent]
            bone, line = tail - head, limbs[child][0] - head
            cosine[parent] = float(bone @ line / np.linalg.norm(bone) / np.linalg.norm(line))
    corners_m = {name: yup(np.array(points)) for name, points in raw["mesh_corners_zup_m"].items()}
    return Seen(corners_m, raw["stored_scales"], raw["action_frames"], yup(zup_m), cosine, raw["cameras"])


def yup(points_zup_m: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(points_zup_m, -1, 0)
    return np.stack([x, z, -y], -1)


@pytest.mark.parametrize("name", FORMATS)
def test_joints_are_where_the_motion_has_them(name: str, seen: dict[str, Seen], motion: BodyMotion) -> None:
    error_m = np.linalg.norm(seen[name].joints_m - motion.joints_world_m[list(LOOKED_AT)], axis=-1)
    assert error_m.max() < JOINT_TOLERANCE_M
    assert seen[name].action_frames == pytest.approx([0, FRAMES - 1]), "all frames and no others"


@pytest.mark.parametrize("name", ["glb", "usd", "fbx"])
def test_bones_lie_along_the_limbs(name: str, seen: dict[str, Seen]) -> None:
    assert len(seen[name].limb_cosine) == 16
    assert min(seen[name].limb_cosine.values()) > 0.999, seen[name].limb_cosine


@pytest.mark.parametrize("name", ["glb", "usd"])
def test_objects_stand_where_they_are_placed(name: str, seen: dict[str, Seen]) -> None:
    placed = room().objects[0]
    expected_m = transform_points(placed.T_world_object, placed.scale * placed.mesh.vertices_m)
    np.testing.assert_allclose(seen[name].mesh_corners_m["object_3_storage_box"], expected_m, atol=JOINT_TOLERANCE_M)


def test_fbx_is_the_character_at_scale_one(seen: dict[str, Seen]) -> None:
    assert set(seen["fbx"].mesh_corners_m) == {"person_1_body"}, "no ball of Blender's for drawing bones"
    assert {"person_1", "person_1_body", *MIXAMO_NAMES} <= set(seen["fbx"].stored_scales)
    for name, scale in seen["fbx"].stored_scales.items():
        assert scale == pytest.approx([1.0, 1.0, 1.0], abs=1e-5), name


@pytest.mark.parametrize("name", ["glb", "usd"])
def test_the_lens_is_one_of_a_camera(name: str, seen: dict[str, Seen], motion: BodyMotion) -> None:
    (camera,) = seen[name].cameras
    fit, lens_mm, width_mm, height_mm, clip_end_m = camera
    intrinsics = motion.intrinsics
    if fit == "VERTICAL":
        assert lens_mm / height_mm == pytest.approx(intrinsics.fy_px / intrinsics.height_px, rel=1e-5)
    else:
        assert lens_mm / width_mm == pytest.approx(intrinsics.fx_px / intrinsics.width_px, rel=1e-5)
    assert width_mm == pytest.approx(36.0, rel=1e-5)
    assert clip_end_m == pytest.approx(1000.0)


def test_fbx_of_the_same_motion_is_the_same_file(tmp_path: Path) -> None:
    digests = set()
    for name in ("a.fbx", "b.fbx"):
        write_fbx(tmp_path / name, walk(4))
        digests.add(hashlib.sha256((tmp_path / name).read_bytes()).hexdigest())
    assert len(digests) == 1


def test_every_person_gets_a_file(tmp_path: Path) -> None:
    people = (walk(4), walk(4, 7, side_m=-1.0))
    written = write_format("fbx", ExportScene(people, None), tmp_path / "my.fbx")
    assert [path.name for path in written] == ["my.fbx", "my_7.fbx"]
    assert all(path.read_bytes().startswith(b"Kaydara FBX Binary") for path in written)


def test_a_failing_blender_is_told_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "blender"
    program.write_text("#!/bin/sh\necho 'Error: too old'\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("VIDEO2ANIM_BLENDER", str(program))
    with pytest.raises(StageError, match=r"^fbx: .*blender could not convert person_1.glb: Error: too old; [^\n]*$"):
        write_format("fbx", ExportScene((walk(4),), None), tmp_path)
    assert not (tmp_path / "motion.fbx").exists()
