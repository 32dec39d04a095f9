"""BVH of many naming conventions and rest poses: the same motion comes out."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenemi.data.bvh import parse_bvh, read_bvh
from scenemi.data.container import MotionArchive
from scenemi.data.joint_names import CONVENTIONS, map_joints, read_mapping
from scenemi.data.posture import on_smpl_joints, posture_problem
from scenemi.data.readers import read_clips
from scenemi.data.rest_pose import rest_axes
from scenemi.data.retarget import retarget
from scenemi.data.source_clip import SourceClip
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.errors import InputError, UsageError
from video2anim.geometry.rotations import matrix_from_axis_angle, matrix_from_quaternion
from video2anim.types import BodyShape
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES, PARENTS, forward_kinematics

MIXAMO = next(c for c in CONVENTIONS if c.name == "mixamo").table()
RIGIFY = next(c for c in CONVENTIONS if c.name == "rigify").table()
UNREAL = next(c for c in CONVENTIONS if c.name == "unreal").table()
LIMBS = [JOINT_INDEX[f"{s}_{j}"] for s in ("left", "right") for j in ("hip", "knee", "ankle", "elbow", "wrist")]


def bvh_text(
    clip: SourceClip,
    names: dict[str, str],
    *,
    scale: float = 100.0,
    rest: np.ndarray | None = None,
    axes: np.ndarray | None = None,
    fps: float = 30.0,
) -> str:
    """The clip of 22 joints as BVH.

    `rest` (22, 3, 3) turns each joint's frame in the zero pose (world orientation of the T-pose frame there), `axes`
    (3, 3) turns the whole world.
    """
    rest = np.tile(np.eye(3), (22, 1, 1)) if rest is None else rest
    axes = np.eye(3) if axes is None else axes
    offsets = np.einsum("jab,jb->ja", axes @ rest[np.maximum(PARENTS, 0)], clip.skeleton.offsets_m) * scale
    world = axes @ clip.world_rotations() @ np.swapaxes(rest, -1, -2) @ axes.T
    local = np.swapaxes(world[:, PARENTS], -1, -2) @ world
    local[:, 0] = world[:, 0]
    order: list[int] = []
    lines = ["HIERARCHY"]

    def put(joint: int, depth: int) -> None:
        order.append(joint)
        pad = "  " * depth
        lines.append(f"{pad}{'JOINT' if depth else 'ROOT'} {names[JOINT_NAMES[joint]]}")
        lines.append(pad + "{")
        lines.append(f"{pad}  OFFSET {' '.join(f'{x:.6f}' for x in (offsets[joint] if joint else np.zeros(3)))}")
        moves = "" if depth else "Xposition Yposition Zposition "
        lines.append(f"{pad}  CHANNELS {3 if depth else 6} {moves}Zrotation Xrotation Yrotation")
        children = np.flatnonzero(joint == PARENTS)
        for child in children:
            put(int(child), depth + 1)
        if not len(children):
            lines.extend([f"{pad}  End Site", pad + "  {", f"{pad}    OFFSET 0 1 0", pad + "  }"])
        lines.append(pad + "}")

    put(0, 0)
    lines += ["MOTION", f"Frames: {len(local)}", f"Frame Time: {1 / fps:.7f}"]
    path = clip.root_position_m @ axes.T * scale
    angles = [Rotation.from_matrix(local[:, j]).as_euler("ZXY", degrees=True) for j in order]
    lines += [" ".join(f"{x:.6f}" for x in row) for row in np.concatenate([path, *angles], axis=1)]
    return "\n".join(lines) + "\n"


@pytest.fixture
def written(tmp_path: Path, smpl_walk: SourceClip) -> Callable[..., Path]:
    def write(names: dict[str, str], **options: object) -> Path:
        path = tmp_path / "walk.bvh"
        path.write_text(bvh_text(smpl_walk, names, **options))  # pyright: ignore[reportArgumentType]
        return path

    return write


def a_pose() -> np.ndarray:
    """Arms hanging 50 degrees from the T-pose."""
    rest = np.tile(np.eye(3), (22, 1, 1))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        for joint in ("shoulder", "elbow", "wrist"):
            rest[JOINT_INDEX[f"{side}_{joint}"]] = matrix_from_axis_angle(np.array([0, 0, sign * np.radians(50)]))
    return rest


def expect_same(got: SourceClip, want: SourceClip, *, within_m: float = 2e-3, turn_rad: float = 0.02) -> None:
    """Joints relative to the pelvis and rotations agree."""
    a, b = (c.smpl_joints_m() - c.smpl_joints_m()[:, :1] for c in (got, want))
    assert np.abs(a - b)[:, LIMBS].max() < within_m
    ra, rb = (matrix_from_quaternion(c.rotation_wxyz)[:, LIMBS] for c in (got, want))
    assert np.abs(ra - rb).max() < turn_rad


@pytest.mark.parametrize("prefix", ["", "mixamorig:", "mixamorig1_"])
@pytest.mark.parametrize(("unit", "scale"), [("cm", 100.0), ("m", 1.0), ("inch", 1 / 0.0254)])
def test_mixamo_names_in_any_unit(
    written: Callable[..., Path], smpl_walk: SourceClip, prefix: str, unit: str, scale: float
) -> None:
    clip = read_bvh(written({joint: prefix + name for joint, name in MIXAMO.items()}, scale=scale))
    assert f"lengths in {unit} (guessed" in clip.description
    assert (clip.fps, clip.name) == (30.0, "walk")
    expect_same(clip, smpl_walk)
    assert clip.floor_shift_m == pytest.approx(clip.root_position_m[0, 1] - smpl_walk.root_position_m[0, 1], abs=1e-4)


@pytest.mark.parametrize("names", [RIGIFY, UNREAL, {n: n for n in JOINT_NAMES}], ids=["rigify", "unreal", "smpl"])
def test_other_conventions(written: Callable[..., Path], smpl_walk: SourceClip, names: dict[str, str]) -> None:
    expect_same(read_bvh(written(names)), smpl_walk)


def test_an_a_pose_is_straightened(written: Callable[..., Path], smpl_walk: SourceClip) -> None:
    clip = read_bvh(written(MIXAMO, rest=a_pose()))
    expect_same(clip, smpl_walk)


def test_z_up_is_seen(written: Callable[..., Path], smpl_walk: SourceClip) -> None:
    z_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    expect_same(read_bvh(written(MIXAMO, axes=z_up)), smpl_walk)
    kept = read_bvh(written(MIXAMO, axes=z_up), keep_floor=True)
    np.testing.assert_allclose(kept.root_position_m, smpl_walk.root_position_m, atol=1e-4)


def test_other_frame_rates_become_30(written: Callable[..., Path], smpl_walk: SourceClip) -> None:
    clip = read_bvh(written(MIXAMO, fps=60.0), keep_floor=True)
    assert (clip.fps, round(clip.source_fps)) == (30.0, 60)
    np.testing.assert_allclose(clip.root_position_m, smpl_walk.root_position_m[::2], atol=1e-4)
    assert len(read_bvh(written(MIXAMO, fps=25.0)).root_position_m) == pytest.approx(143, abs=1)


def test_a_bone_pose_needs_a_frame_to_rest_in(written: Callable[..., Path], smpl_walk: SourceClip) -> None:
    """All bones along +X in the zero pose, as some exporters write."""
    rest = np.stack([align_x(bone) for bone in bones(smpl_walk)])
    with pytest.raises(InputError, match="no rest pose"):
        read_bvh(written(MIXAMO, rest=rest))
    upright = replace(
        smpl_walk,
        root_position_m=np.concatenate([smpl_walk.root_position_m[:1], smpl_walk.root_position_m]),
        rotation_wxyz=np.concatenate([np.tile([1.0, 0, 0, 0], (1, 22, 1)), smpl_walk.rotation_wxyz]),
    )
    path = written(MIXAMO)
    path.write_text(bvh_text(upright, MIXAMO, rest=rest))
    expect_same(read_bvh(path, rest_frame=0, skip_frames=1), smpl_walk)


def bones(clip: SourceClip) -> np.ndarray:
    """Direction from each joint to its first child."""
    joints = np.zeros((22, 3))
    for joint, parent in enumerate(PARENTS):
        joints[joint] = clip.skeleton.offsets_m[joint] + (joints[parent] if parent >= 0 else 0)
    child = [int(np.flatnonzero(j == PARENTS)[0]) if (j == PARENTS).any() else -1 for j in range(22)]
    return np.stack([joints[c] - joints[j] if c >= 0 else np.array([1.0, 0, 0]) for j, c in enumerate(child)])


def align_x(bone: np.ndarray) -> np.ndarray:
    """A rotation that takes the bone's direction to +X."""
    x = bone / np.linalg.norm(bone)
    y = np.cross([0.3, 0.2, 0.9], x)
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)])


def test_given_mapping_wins_and_gaps_are_named(written: Callable[..., Path], tmp_path: Path) -> None:
    odd = {joint: f"bone{i}" for i, joint in enumerate(JOINT_NAMES)}
    with pytest.raises(InputError, match=r"left_hip, right_hip.*JSON mapping"):
        read_bvh(written(odd))
    table = tmp_path / "map.json"
    table.write_text(json.dumps(odd))
    assert read_bvh(written(odd), mapping=read_mapping(table)).skeleton.names == JOINT_NAMES
    part = {**MIXAMO, "left_knee": "Gamba"}
    with pytest.raises(InputError, match="no joint found for left_knee among"):
        read_bvh(written(part))
    assert read_bvh(written(part), mapping={"left_knee": "Gamba"}).skeleton.names == JOINT_NAMES
    with pytest.raises(InputError, match="'elbow' \\(no SMPL joint\\)"):
        read_bvh(written(MIXAMO), mapping={"elbow": "LeftArm"})
    table.write_text("[1]")
    with pytest.raises(InputError, match="JSON object"):
        read_mapping(table)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.replace("HIERARCHY", "HIERARCHIE"), "no BVH file"),
        (lambda t: t.replace("Zrotation", "Wrotation", 1), "unknown channel"),
        (lambda t: t[: t.index("MOTION") - 4] + t[t.index("MOTION") :], "cut off|broken"),
        (lambda t: t.rsplit(" ", 1)[0], "finite numbers"),
        (lambda t: t.replace("Frames: 120", "Frames: 0"), "finite numbers"),
        (lambda t: t.replace("Frame Time: 0.0333333", "Frame Time: 0"), "finite numbers"),
        (lambda t: t[: t.index("Frame Time")], "want 'Frames:'"),
    ],
)
def test_broken_files_get_one_line(written: Callable[..., Path], change: Callable[[str], str], message: str) -> None:
    path = written(MIXAMO)
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=message) as caught:
        read_bvh(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_odd_sizes_and_units_are_refused(written: Callable[..., Path]) -> None:
    with pytest.raises(InputError, match="give the unit"):
        read_bvh(written(MIXAMO, scale=7e4))
    assert "in cm," not in read_bvh(written(MIXAMO, scale=100.0), unit="cm").description
    with pytest.raises(UsageError, match="want one of m, cm"):
        read_bvh(written(MIXAMO), unit="ell")
    with pytest.raises(InputError, match="cannot read"):
        parse_bvh("nowhere.bvh")


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("dataset-1_bow_normal_001.bvh", "bandai1_bow_normal_001"),
        ("dataset-2_walk-turn-left_normal_001.bvh", "bandai2_walk-turn-left_normal_001"),
    ],
)
def test_bandai_files_equal_the_archive(shared_motion: Path, file: str, name: str) -> None:
    clip = read_bvh(shared_motion / "raw" / file)
    want = MotionArchive.read(shared_motion / "bandai.npz").clip(name)
    np.testing.assert_allclose(clip.smpl_joints_m(), want.smpl_joints_m(), atol=1.5e-3)
    order = [clip.skeleton.names.index(joint) for joint in want.skeleton.names]
    np.testing.assert_allclose(clip.world_rotations()[:, order], want.world_rotations(), atol=1e-3)
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    a, b = retarget(clip, body), retarget(want, body)
    np.testing.assert_allclose(a.R_parent_joint, b.R_parent_joint, atol=0.05)
    assert read_clips(shared_motion / "raw" / file)[0].name == Path(file).stem


def test_daz_file_is_known_by_its_names(shared_motion: Path) -> None:
    clip = read_bvh(shared_motion / "raw" / "cmu_daz_standard.bvh")
    want = MotionArchive.read(shared_motion / "cmu.npz").clip("cmudaz_martial_04")
    for table in ("smpl_position", "smpl_rotation"):
        mine = [clip.skeleton.names[j] if j >= 0 else "" for j in getattr(clip.skeleton, table)]
        theirs = [want.skeleton.names[j] if j >= 0 else "" for j in getattr(want.skeleton, table)]
        assert mine == theirs
    np.testing.assert_allclose(rest_axes(clip.skeleton), rest_axes(want.skeleton), atol=2e-3)


@pytest.mark.parametrize("name", ["cmu_02_01", "cmucc_07_10", "cmudaz_martial_04", "cmuh_140_03"])
def test_captured_clips_on_smpl_joints_keep_their_joints(shared_motion: Path, name: str) -> None:
    clip = MotionArchive.read(shared_motion / "cmu.npz").clip(name)
    moved = on_smpl_joints(clip, rest_axes(clip.skeleton))
    error_m = np.linalg.norm(moved.smpl_joints_m() - clip.smpl_joints_m(), axis=-1)
    assert np.nanmean(error_m) < 0.012
    assert np.nanmax(error_m[:, [4, 5, 7, 8]]) < 1e-6
    assert rest_axes(moved.skeleton).shape == (22, 3, 3)


def test_postures_are_judged(smpl_walk: SourceClip) -> None:
    rest = shaped_body(BodyShape("anny", dict(ADULT))).rest_joints_m
    assert posture_problem(rest) is None
    swapped = rest * [-1.0, 1.0, 1.0]
    assert "left and right exchanged" in str(posture_problem(swapped))
    R = np.tile(np.eye(3), (22, 1, 1))
    R[JOINT_INDEX["left_hip"]] = matrix_from_axis_angle(np.array([-1.2, 0, 0]))
    assert "left leg" in str(posture_problem(forward_kinematics(R, np.zeros(3), rest)[0]))
    assert "elbow" in str(posture_problem(bent_elbow(rest)))


def bent_elbow(rest: np.ndarray) -> np.ndarray:
    R = np.tile(np.eye(3), (22, 1, 1))
    R[JOINT_INDEX["right_elbow"]] = matrix_from_axis_angle(np.array([0, 1.5, 0]))
    return forward_kinematics(R, np.zeros(3), rest)[0]


def test_every_convention_maps_itself() -> None:
    for convention in CONVENTIONS:
        table = convention.table()
        names = [*table.values(), *(name for name in convention.rotation.values() if name)]
        found = map_joints(names)
        assert found.position == table, convention.name
