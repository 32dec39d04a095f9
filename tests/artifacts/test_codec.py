"""Values survive the trip to a folder and back; damage is one line that names the file."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from unchecked import unchecked
from walk_scene import room, room_with_carried_box, walk

from video2anim.artifacts.codec import read_value, write_value
from video2anim.artifacts.folder import atomic_directory, folder_digest, remove_unfinished
from video2anim.artifacts.images import read_png, write_png
from video2anim.artifacts.manifest import Manifest, read_manifest
from video2anim.artifacts.meshes import read_ply, write_ply
from video2anim.artifacts.motion_io import read_motion, write_motion
from video2anim.errors import ArtifactError
from video2anim.types import BodyTracks, Hold, Mesh, PayloadFile, PersonQuality, SceneModel, Storage, stored


@dataclass(frozen=True)
class Inner:
    name: str
    values: np.ndarray


@dataclass(frozen=True)
class Everything:
    number: float
    missing: float | None
    words: tuple[str, ...]
    pair: tuple[int, float]
    inner: Inner
    many: tuple[Inner, ...]
    flags: np.ndarray
    mask: np.ndarray = stored(Storage.IMAGE)
    picture: np.ndarray = stored(Storage.IMAGE)


def everything() -> Everything:
    rng = np.random.default_rng(0)
    inner = Inner("a", rng.normal(size=(3, 2)))
    return Everything(
        1 / 3, None, ("x", "ü"), (3, 0.1), inner, (inner, Inner("b", np.arange(4))),
        rng.random((2, 3)) > 0.5, rng.random((7, 5)) > 0.5, rng.integers(0, 256, (7, 5, 3), np.uint8),
    )  # fmt: skip


def test_round_trip(tmp_path: Path) -> None:
    value = everything()
    write_value(value, tmp_path)
    again = read_value(Everything, tmp_path)
    assert (again.number, again.missing, again.words, again.pair) == (value.number, None, value.words, value.pair)
    assert [item.name for item in again.many] == ["a", "b"]
    for name in ("mask", "picture", "flags"):
        np.testing.assert_array_equal(getattr(again, name), getattr(value, name))
        assert getattr(again, name).dtype == getattr(value, name).dtype
    np.testing.assert_array_equal(again.many[0].values, value.inner.values)
    assert {p.name for p in tmp_path.iterdir()} == {"value.json", "arrays.npz", "masks.npz", "mask.png", "picture.png"}


def test_same_value_gives_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_value(everything(), tmp_path / name)
    assert folder_digest(tmp_path / "a") == folder_digest(tmp_path / "b")


def test_scene_and_motion_round_trip(tmp_path: Path) -> None:
    scene, people = room(), (walk(6, 4), walk(6, 9))
    quality = (
        PersonQuality(2.5, 0.01, 160.0, 0.1, 0.04, 1.0, 1.55, 0.0),
        PersonQuality(9.5, 0.06, 900.0, float("nan"), 0.3, 0.4, 1.1, 0.2, ("seen in too few frames",)),
    )
    for name, value in (("scene", scene), ("bodies", BodyTracks(people, quality))):
        (tmp_path / name).mkdir()
        write_value(value, tmp_path / name)
    again: SceneModel = read_value(SceneModel, tmp_path / "scene")
    np.testing.assert_allclose(again.objects[0].mesh.vertices_m, scene.objects[0].mesh.vertices_m, atol=1e-6)
    np.testing.assert_array_equal(again.sdf_m, scene.sdf_m)
    bodies: BodyTracks = read_value(BodyTracks, tmp_path / "bodies")
    assert [motion.person_id for motion in bodies.people] == [4, 9]
    assert repr(bodies.quality) == repr(quality)  # nan is not equal to itself
    assert {"motion.npz", "motion_9.npz"} <= {p.name for p in (tmp_path / "bodies").iterdir()}
    for before, after in zip(people, bodies.people, strict=True):
        np.testing.assert_array_equal(before.joints_world_m, after.joints_world_m)
        np.testing.assert_array_equal(before.valid, after.valid)
        assert before.shape == after.shape
        assert before.intrinsics == after.intrinsics


def test_a_carried_object_round_trip(tmp_path: Path) -> None:
    scene = room_with_carried_box(24)
    write_value(scene, tmp_path)
    (placed,), (before,) = read_value(SceneModel, tmp_path).objects, scene.objects
    np.testing.assert_array_equal(placed.path[0].T_world_object, before.path[0].T_world_object)
    assert placed.holds == before.holds == (Hold(1, "right hand", 6, 18),)
    for frame in (0, 12, 23):
        np.testing.assert_array_equal(placed.pose(frame), before.path[0].T_world_object[frame])
    np.testing.assert_array_equal(room().objects[0].pose(7), before.T_world_object)
    assert room().objects[0].holds == ()
    bent = before.path[0].T_world_object.copy()
    bent[3, 0, 0] += 0.1
    wrong = replace(before, path=(unchecked(before.path[0], T_world_object=bent),))
    write_value(replace(scene, objects=(wrong,)), tmp_path)
    with pytest.raises(ArtifactError, match="rigid"):
        read_value(SceneModel, tmp_path)


def test_nothing_is_pickled(tmp_path: Path) -> None:
    write_value(everything(), tmp_path)
    write_motion(tmp_path / "motion.npz", walk(3))
    for path in tmp_path.glob("*.npz"):
        with np.load(path, allow_pickle=False) as archive:
            assert all(archive[key].dtype.kind in "fiubU" for key in archive.files)
    with pytest.raises(TypeError, match="no form on disk"):
        write_value(replace(everything(), words=object()), tmp_path)


def test_payload_file_is_stored_by_name(tmp_path: Path) -> None:
    @dataclass(frozen=True)
    class Holder:
        file: PayloadFile

    (tmp_path / "clip.mp4").write_bytes(b"x")
    write_value(Holder(PayloadFile(tmp_path / "clip.mp4")), tmp_path)
    assert json.loads((tmp_path / "value.json").read_text()) == {"file": {"$file": "clip.mp4"}}
    moved = tmp_path.rename(tmp_path.with_name("moved"))
    Holder.__annotations__["file"] = PayloadFile
    assert read_value(Holder, moved).file.path == moved / "clip.mp4"


@pytest.mark.parametrize("name", ["arrays.npz", "masks.npz", "mask.png", "value.json"])
@pytest.mark.parametrize("damage", ["halved", "empty", "gone", "garbage"])
def test_damage_is_one_line_with_file_and_remedy(tmp_path: Path, name: str, damage: str) -> None:
    folder = tmp_path / "stages" / "02_track"
    folder.mkdir(parents=True)
    write_value(everything(), folder)
    path = folder / name
    data = path.read_bytes()
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes({"halved": data[: len(data) // 2], "empty": b"", "garbage": b"\x00garbage" * 9}[damage])
    with pytest.raises(ArtifactError) as caught:
        read_value(Everything, folder)
    message = str(caught.value)
    assert "\n" not in message
    assert str(folder) in message
    assert f"video2anim stage {tmp_path} track --discard-edits" in message
    assert damage == "gone" or name in message


@pytest.mark.parametrize("key", ["T_world_root", "valid", "rest_joints_m", "intrinsics"])
def test_motion_file_without_a_key(tmp_path: Path, key: str) -> None:
    path = tmp_path / "motion.npz"
    write_motion(path, walk(4))
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files if name != key}
    np.savez(path, allow_pickle=False, **arrays)
    with pytest.raises(ArtifactError, match=key):
        read_motion(path)


def test_motion_file_with_nan_or_wrong_shape(tmp_path: Path) -> None:
    path, motion = tmp_path / "motion.npz", walk(4)
    joints = motion.joints_world_m.copy()
    joints[2, 3] = np.nan
    write_motion(path, unchecked(motion, joints_world_m=joints))
    with pytest.raises(ArtifactError, match=r"joints_world_m: want finite"):
        read_motion(path)
    write_motion(path, unchecked(motion, contact=motion.contact[:, :5]))
    with pytest.raises(ArtifactError, match=r"contact: want shape \(4, 22\), got \(4, 5\)"):
        read_motion(path)


def test_masks_may_be_edited_in_a_paint_program(tmp_path: Path) -> None:
    gray = np.zeros((4, 6, 3), np.uint8)
    gray[1:3, 2:5] = 200
    write_png(tmp_path / "m.png", gray)
    mask = read_png(tmp_path / "m.png", np.dtype(bool))
    assert mask.dtype == bool
    assert mask.sum() == 6
    with pytest.raises(TypeError, match="uint8"):
        write_png(tmp_path / "f.png", np.zeros((2, 2)))


def test_meshes(tmp_path: Path) -> None:
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8))
    write_ply(tmp_path / "e.ply", empty)
    assert read_ply(tmp_path / "e.ply").vertices_m.shape == (0, 3)
    mesh = room().objects[0].mesh
    write_ply(tmp_path / "b.ply", mesh)
    again = read_ply(tmp_path / "b.ply")
    np.testing.assert_array_equal(again.faces, mesh.faces)
    np.testing.assert_array_equal(again.vertex_rgb, mesh.vertex_rgb)
    other = trimesh.load_mesh(tmp_path / "b.ply", process=False)
    assert other.is_watertight
    trimesh.creation.box().export(tmp_path / "plain.ply")
    assert len(read_ply(tmp_path / "plain.ply").faces) == 12
    (tmp_path / "cloud.ply").write_bytes(trimesh.PointCloud(np.eye(3)).export(file_type="ply"))
    with pytest.raises(ArtifactError, match=r"cloud\.ply"):
        read_ply(tmp_path / "cloud.ply")


def test_folder_is_whole_or_absent(tmp_path: Path) -> None:
    final = tmp_path / "stages" / "01_a"

    def fail_half_way() -> None:
        with atomic_directory(final) as work:
            (work / "x").write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert list(final.parent.iterdir()) == []
    for text in ("first", "second"):
        with atomic_directory(final) as work:
            (work / "x").write_text(text)
            assert not final.exists() or (final / "x").read_text() == "first", (
                "the old one stays until the new is whole"
            )
        assert (final / "x").read_text() == text
    with pytest.raises(KeyboardInterrupt), atomic_directory(final) as work:
        raise KeyboardInterrupt
    assert (final / "x").read_text() == "second"
    assert [path.name for path in final.parent.iterdir()] == ["01_a"]


def test_leftovers_are_removed_and_nothing_else(tmp_path: Path) -> None:
    for name in (".unfinished-01_a-xyz", "01_a"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x").write_text("1")
    remove_unfinished(tmp_path)
    remove_unfinished(tmp_path / "nowhere")
    assert [path.name for path in tmp_path.iterdir()] == ["01_a"]


def test_digest_sees_names_and_bytes_but_not_the_manifest(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    digests = [folder_digest(tmp_path)]
    (tmp_path / "manifest.json").write_text("{}")
    assert folder_digest(tmp_path) == digests[0]
    (tmp_path / "a").write_text("2")
    digests.append(folder_digest(tmp_path))
    (tmp_path / "a").rename(tmp_path / "b")
    digests.append(folder_digest(tmp_path))
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "c").touch()
    digests.append(folder_digest(tmp_path))
    assert len(set(digests)) == 4


def test_manifest_round_trip(tmp_path: Path) -> None:
    manifest = Manifest("a", 1, "k", {"x": 1}, {"T": "d"}, {}, 0, "o", 0.5, 9.0, [], ["careful"], {"numpy": "2"})
    manifest.write(tmp_path)
    assert read_manifest(tmp_path) == manifest
