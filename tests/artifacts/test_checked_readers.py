"""Stage folders that somebody edited: taken where they are sound, refused in one line where they are not."""

from __future__ import annotations

import json
import os
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from unchecked import unchecked
from walk_scene import box_mesh, room, walk

from video2anim.artifacts.codec import read_value, write_value
from video2anim.artifacts.folder import folder_digest, value_digest
from video2anim.artifacts.images import read_png
from video2anim.artifacts.manifest import Manifest, read_manifest
from video2anim.artifacts.meshes import read_ply, write_ply
from video2anim.artifacts.motion_io import read_motion, write_motion
from video2anim.errors import ArtifactError
from video2anim.types import (
    BodyTracks,
    ExportedFiles,
    InstanceMasks,
    KeyframedMotion,
    Mesh,
    ObjectInstance,
    ObjectMesh,
    ObjectMeshes,
    PayloadFile,
    PersonTrack,
    PersonTracks,
    RefinedMotion,
    SourceInfo,
    VideoClip,
)
from video2anim.types.motion_arrays import motion_arrays
from video2anim.types.quality import Quality

FRAMES, HEIGHT, WIDTH = 6, 9, 12


def clip_in(folder: Path, frames: int = FRAMES) -> VideoClip:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "video.mp4").write_bytes(b"x")
    time_s = np.arange(frames) / 30.0
    source = SourceInfo("h264", "yuv420p", WIDTH, HEIGHT, 0, 1.0, 30.0, frames, frames, frames / 30.0, 0.0)
    return VideoClip(
        PayloadFile(folder / "video.mp4"), WIDTH, HEIGHT, 30.0, time_s, time_s, source, ((0.0, 1.0),), 0, (),
    )  # fmt: skip


def written(value: Any, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_value(value, folder)
    return folder


def refused(kind: type, folder: Path, clip: VideoClip | None = None) -> str:
    with pytest.raises(ArtifactError) as caught:
        read_value(kind, folder, clip)
    message = str(caught.value)
    assert "\n" not in message
    assert str(folder) in message
    assert len(message) < 700
    return message


def edit_json(folder: Path, change: Callable[[Any], Any]) -> None:
    data = json.loads((folder / "value.json").read_text())
    changed = change(data)
    (folder / "value.json").write_text(json.dumps(data if changed is None else changed))


# Motions


def edited_motion(path: Path, **changes: Any) -> Path:
    """A motion file with some arrays replaced, or changed by a function."""
    arrays = motion_arrays(walk(FRAMES))
    for key, change in changes.items():
        arrays[key] = change(arrays[key].copy()) if callable(change) else change
    np.savez(path, allow_pickle=False, **arrays)
    return path


def test_joints_follow_from_what_was_edited(tmp_path: Path) -> None:
    """A turned joint, a moved root: joints that were left as they were do not count."""
    before = walk(FRAMES)
    turned = before.R_parent_joint.copy()
    turned[:, 16] = turned[:, 16] @ np.diag([1.0, -1.0, -1.0])
    moved = before.T_world_root.copy()
    moved[:, :3, 3] += (1.0, 0.0, 0.0)
    found = read_motion(edited_motion(tmp_path / "m.npz", R_parent_joint=turned, T_world_root=moved))
    expected = before.with_pose(translation_world_m=moved[:, :3, 3], R_parent_joint=turned)
    np.testing.assert_allclose(found.joints_world_m, expected.joints_world_m, atol=1e-12)
    np.testing.assert_allclose(found.joints_world_m[:, 0] - before.joints_world_m[:, 0], [[1, 0, 0]] * FRAMES)
    assert np.abs(found.joints_world_m[:, 20] - before.joints_world_m[:, 20] - (1, 0, 0)).max() > 0.1


def test_a_file_as_written_is_read_to_the_same_bits(tmp_path: Path) -> None:
    before = walk(FRAMES)
    write_motion(tmp_path / "m.npz", before)
    again = read_motion(tmp_path / "m.npz")
    for name in ("joints_world_m", "T_world_root", "R_parent_joint", "valid", "contact"):
        np.testing.assert_array_equal(getattr(again, name), getattr(before, name))


def scaled_and_mirrored(R: np.ndarray) -> np.ndarray:
    R[:, 1:5] *= 2
    R[:, 0] *= -1
    return R


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"R_parent_joint": lambda R: R * 2}, "R_parent_joint: want rotation matrices"),
        ({"R_parent_joint": lambda R: R * 0}, "R_parent_joint: want rotation matrices"),
        ({"R_parent_joint": lambda R: -R}, "R_parent_joint: want rotation matrices"),
        ({"R_parent_joint": lambda R: R * 1e200}, "R_parent_joint: want rotation matrices"),
        ({"R_parent_joint": scaled_and_mirrored}, r"R_parent_joint: want rotation matrices.* at \[0, 0\]"),
        ({"R_parent_joint": lambda R: R.astype(str)}, "R_parent_joint: want float64, got <U"),
        ({"R_parent_joint": lambda R: R.astype(complex)}, "R_parent_joint: want float64, got complex128"),
        ({"R_parent_joint": lambda R: R[:, :21]}, r"R_parent_joint: want shape \(6, 22, 3, 3\), got \(6, 21, 3, 3\)"),
        ({"T_world_root": lambda T: T @ np.diag([-1.0, 1, -1, 1])}, "want the rotation of R_parent_joint"),
        ({"T_world_root": lambda T: T * np.nan}, "T_world_root: want finite"),
        ({"T_world_root": lambda T: T + 1e9 * (np.arange(4) == 3)}, "T_world_root: want rigid transforms"),
        ({"T_world_camera": lambda T: T * 2}, "T_world_camera: want rigid transforms"),
        ({"frame_time_s": lambda t: t[::-1]}, r"frame_time_s: want numbers that rise .* at \[1\]"),
        ({"frame_time_s": lambda t: 0 * t}, "frame_time_s: want numbers that rise"),
        ({"rest_joints_m": lambda p: p * np.nan}, "rest_joints_m: want finite"),
        ({"rest_joints_m": lambda p: p + 1}, "rest_joints_m: want the origin"),
        ({"shape_values": lambda v: v * np.nan}, "shape_values: want finite"),
        ({"shape_values": np.zeros(3)}, "shape_values: want shape"),
        ({"joint_names": lambda names: names[::-1]}, "joint_names, parents: want the 22 joints"),
        ({"parents": lambda parents: parents[::-1]}, "joint_names, parents: want the 22 joints"),
        ({"valid": lambda v: v.astype(str)}, "valid: want bool"),
        ({"contact": lambda c: c + 7}, "contact: want numbers from 0 to 1"),
        ({"intrinsics": np.array([500.0, -500, 1, 1, 640, 360])}, "intrinsics.fy_px: input should be greater than 0"),
        ({"intrinsics": np.array([500.0, 500, 1, 1, 640, 0.5])}, "intrinsics.height_px"),
        ({"intrinsics": np.zeros(3)}, r"intrinsics: want shape \(6,\), got \(3,\)"),
        ({"person_id": np.array(-4)}, "person_id"),
        ({"person_id": np.array("one")}, "person_id: want int64"),
    ],
)  # fmt: skip
def test_what_is_no_motion_is_refused(tmp_path: Path, changes: dict[str, Any], wanted: str) -> None:
    path = edited_motion(tmp_path / "m.npz", **changes)
    with pytest.raises(ArtifactError, match=wanted) as caught:
        read_motion(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_motion_without_frames_is_refused(tmp_path: Path) -> None:
    rows = {key: lambda a: a[:0] for key in ("frame_time_s", "valid", "T_world_root", "R_parent_joint", "contact",
                                             "T_world_camera", "joints_world_m", "joints_camera_m")}  # fmt: skip
    with pytest.raises(ArtifactError, match="at least one of frames"):
        read_motion(edited_motion(tmp_path / "m.npz", **rows))


def test_sound_edits_of_a_motion_are_taken(tmp_path: Path) -> None:
    """Whole numbers for fractions, single precision, the other byte order, compressed, and keys of the user's own."""
    arrays = motion_arrays(walk(FRAMES)) | {"my_notes": np.array("waves"), "contact": np.ones((FRAMES, 22), int)}
    arrays["R_parent_joint"] = arrays["R_parent_joint"].astype(np.float32)
    arrays["T_world_root"] = arrays["T_world_root"].astype(">f8")
    np.savez_compressed(tmp_path / "m.npz", allow_pickle=False, **arrays)
    found = read_motion(tmp_path / "m.npz")
    assert (found.contact.dtype, found.contact.min(), found.T_world_root.dtype.isnative) == (np.float64, 1.0, True)
    np.testing.assert_allclose(found.joints_world_m, walk(FRAMES).joints_world_m, atol=1e-5)


def test_motions_of_a_stage_have_the_clips_frames(tmp_path: Path) -> None:
    clip = clip_in(tmp_path / "01_ingest")
    folder = written(
        RefinedMotion((walk(5),), ("scenemi",), (1.0,), (walk(5),), room()), tmp_path / "stages" / "14_refine"
    )
    assert read_value(RefinedMotion, folder).people[0].frame_count == 5
    assert r"frame_time_s: want shape (6,), got (5,)" in refused(RefinedMotion, folder, clip)
    folder = written(unchecked(BodyTracks(()), people=(walk(6), walk(5, 2))), tmp_path / "stages" / "04_humans")
    assert "want shape (6,), got (5,)" in refused(BodyTracks, folder)


def test_motions_of_several_fields_have_files_of_their_own(tmp_path: Path) -> None:
    people, others = (walk(5), walk(5, 2)), (walk(5, side_m=1.0), walk(5, 2, side_m=-1.0))
    folder = written(
        RefinedMotion(people, ("none",) * 2, (0.0,) * 2, others, room()), tmp_path / "stages" / "14_refine"
    )
    assert {p.name for p in folder.glob("*.npz")} >= {
        "motion.npz", "motion_2.npz", "without_prior.npz", "without_prior_2.npz",
    }  # fmt: skip
    read = read_value(RefinedMotion, folder)
    for mine, wanted in zip((*read.people, *read.without_prior), (*people, *others), strict=True):
        np.testing.assert_array_equal(mine.R_parent_joint, wanted.R_parent_joint)
        np.testing.assert_array_equal(mine.T_world_root, wanted.T_world_root)


def test_keyframes_are_frames_of_the_clip(tmp_path: Path) -> None:
    for wrong in ([0, 5, 6], [-1, 2], [3, 3], [4, 1]):
        value = unchecked(KeyframedMotion((), ()), people=(walk(FRAMES),), keyframe_index=(np.array(wrong),))
        folder = written(value, tmp_path / "stages" / f"13_k{wrong[0]}")
        assert "want numbers of frames" in refused(KeyframedMotion, folder)
    folder = written(unchecked(KeyframedMotion((), ()), people=(walk(FRAMES),)), tmp_path / "stages" / "13_none")
    assert "keyframe_index: want one of each of the 1 people, got 0" in refused(KeyframedMotion, folder)


# Archives


def test_members_that_nobody_asks_for_are_not_unpacked(tmp_path: Path) -> None:
    """Damage in an unknown member does not matter, as it is never touched."""
    path = tmp_path / "m.npz"
    np.savez(path, allow_pickle=False, **motion_arrays(walk(FRAMES)), noise=np.full(4000, 7.5))
    data = path.read_bytes()
    at = data.index(struct.pack("<d", 7.5) * 100)
    path.write_bytes(data[:at] + b"\0" * 800 + data[at + 800 :])
    assert read_motion(path).frame_count == FRAMES
    at = data.index(struct.pack("<d", motion_arrays(walk(FRAMES))["frame_time_s"][1]))
    path.write_bytes(data[:at] + b"\1" * 8 + data[at + 8 :])
    with pytest.raises(ArtifactError, match=r"m\.npz is damaged"):
        read_motion(path)


def npy(shape: tuple[int, ...], data: bytes) -> bytes:
    header = repr({"descr": "<f8", "fortran_order": False, "shape": shape}).encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


def zip_of(
    name: bytes, data: bytes, *, method: int = 0, claimed: int | None = None, packed: bytes | None = None
) -> bytes:
    """A zip archive of one member that may lie about its size."""
    body, crc, claimed = data if packed is None else packed, zlib.crc32(data), len(data) if claimed is None else claimed
    common = struct.pack("<HHHHHIIIHH", 20, 0, method, 0, 33, crc, len(body), claimed, len(name), 0)
    local = b"PK\x03\x04" + common + name + body
    central = b"PK\x01\x02\x14\x00" + common + struct.pack("<HHHII", 0, 0, 0, 0, 0) + name
    return local + central + b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(central), len(local), 0)


@pytest.mark.parametrize(
    "member",
    [
        zip_of(b"frame_time_s.npy", npy((10**12,), b"")),
        zip_of(b"frame_time_s.npy", npy((10**8,), b""), claimed=8 * 10**8 + 128),
        zip_of(b"frame_time_s.npy", npy((-1,), b"")),
        zip_of(b"frame_time_s.npy", npy((3,), b"\0" * 24), method=14),
        zip_of(b"frame_time_s.npy", b"no array"),
        zip_of(b"frame_time_s", npy((3,), b"\0" * 24)),
        b"PK\x03\x04",
        npy((3,), b"\0" * 24),
    ],
    ids=["a terabyte", "a gigabyte", "negative", "lzma", "no array", "no suffix", "cut off", "no zip"],
)
def test_archives_that_lie_are_refused_before_memory_is_taken(tmp_path: Path, member: bytes) -> None:
    import tracemalloc

    (tmp_path / "m.npz").write_bytes(member)
    tracemalloc.start()
    try:
        with pytest.raises(ArtifactError, match=r"m\.npz"):
            read_motion(tmp_path / "m.npz")
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
@pytest.mark.parametrize("name", ["motion.npz", "value.json"])
def test_what_is_no_regular_file_does_not_block(tmp_path: Path, kind: str, name: str) -> None:
    folder = written(BodyTracks((walk(FRAMES),)), tmp_path / "stages" / "04_humans")
    (folder / name).unlink()
    if kind == "pipe":
        os.mkfifo(folder / name)
    elif kind == "folder":
        (folder / name).mkdir()
    else:
        (folder / name).symlink_to("/dev/zero")
    assert name in refused(BodyTracks, folder)
    assert value_digest(folder)
    if name == "motion.npz":
        with pytest.raises(ArtifactError):
            read_motion(folder / name)


# What value.json names


@pytest.mark.parametrize(
    "name", ["../secret", "../../secret", "/etc/passwd", "link", "deep/link", "a\0b", "x" * 5000, "", ".", "none"]
)
def test_files_outside_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    folder = written(ExportedFiles(()), tmp_path / "stages" / "15_export")
    (tmp_path / "stages" / "secret").write_text("s")
    (folder / "link").symlink_to("../secret")
    (folder / "deep").symlink_to("..")
    (folder / "value.json").write_text(json.dumps({"files": [{"$file": name}]}))
    assert "want" in refused(ExportedFiles, folder)


@pytest.mark.parametrize(("kind", "key", "value"), [
    ("$mesh", "mesh", ObjectMeshes((ObjectMesh(1, "a", "box", box_mesh((1, 1, 1), (9, 9, 9)), np.eye(4)),))),
    ("$image", "mask", InstanceMasks("p", (ObjectInstance(1, "a", 0.5, np.zeros(4), np.ones((4, 4), bool)),),
                                     np.ones((4, 4), bool))),
    ("$motion", "people", BodyTracks((walk(3),))),
])  # fmt: skip
def test_every_kind_of_reference_stays_inside(tmp_path: Path, kind: str, key: str, value: Any) -> None:
    folder = written(value, tmp_path / "stages" / "04_x")
    text = (folder / "value.json").read_text()
    name = re.search(rf'"\{kind}": "([^"]+)"', text)
    assert name is not None
    assert read_value(type(value), folder) is not None
    (folder / name[1]).rename(tmp_path / "stages" / name[1])
    (folder / "value.json").write_text(text.replace(name[1], f"../{name[1]}"))
    assert "inside the folder" in refused(type(value), folder)
    (folder / "value.json").write_text(text)
    (folder / name[1]).symlink_to(f"../{name[1]}")
    assert "inside the folder" in refused(type(value), folder)


# Structure and scalars


def clip_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "stages" / "01_ingest"
    return written(clip_in(folder), folder)


@pytest.mark.parametrize(
    ("key", "wrong"),
    [
        ("fps", -1), ("fps", "30"), ("fps", None), ("fps", float("nan")), ("fps", True), ("width_px", None),
        ("width_px", 12.5), ("width_px", 0), ("shot_index", True), ("shot_index", "yes"), ("shots_s", [[0.0]]),
        ("shots_s", 3), ("warnings", None), ("warnings", [3]), ("video", "video.mp4"), ("video", {"$file": 3}),
        ("frame_time_s", {"$array": "no such"}), ("frame_time_s", [0.0, 1.0]), ("source", {}), ("unknown", 1),
        ("frame_time_s", {"$image": "video.mp4", "dtype": "bool"}), ("source", {"$array": "frame_time_s"}),
    ],
)  # fmt: skip
def test_fields_of_the_wrong_kind_are_refused(tmp_path: Path, key: str, wrong: Any) -> None:
    folder = clip_folder(tmp_path)
    assert read_value(VideoClip, folder).fps == 30.0
    edit_json(folder, lambda data: data.update({key: wrong}))
    assert key in refused(VideoClip, folder) or "no such" in refused(VideoClip, folder)


def test_missing_fields_and_other_documents_are_refused(tmp_path: Path) -> None:
    folder = clip_folder(tmp_path)
    text = (folder / "value.json").read_text()
    for key in json.loads(text):
        (folder / "value.json").write_text(text)
        edit_json(folder, lambda data, key=key: {k: v for k, v in data.items() if k != key})
        assert f"value.json: {key}: field required" in refused(VideoClip, folder)
    for other in (
        "[]",
        "null",
        "3",
        '"text"',
        "[" * 10**5,
        '{"a":' * 10**4,
        "",
        "\x00",
        '{"fps": 1' + "0" * 5000 + "}",
    ):
        (folder / "value.json").write_text(other)
        assert "value.json" in refused(VideoClip, folder)
    (folder / "value.json").write_bytes('{"fps": "ä"}'.encode("latin-1"))
    assert "value.json" in refused(VideoClip, folder)


def test_persons_to_work_on_are_among_the_tracked(tmp_path: Path) -> None:
    rows = np.ones(3, bool)
    track = PersonTrack(
        4, rows, np.ones(3), np.ones((3, 4)), np.ones((3, 33, 2)), np.full((3, 33, 3), np.nan), np.ones((3, 33)),
        np.zeros((3, 64, 64), np.uint8), np.ones((3, 2, 3)),
    )  # fmt: skip
    longer = unchecked(track, valid=np.ones(4, bool))
    good = written(PersonTracks((track,), (4,)), tmp_path / "stages" / "02_a")
    assert np.isnan(read_value(PersonTracks, good).people[0].landmarks_m).all(), (
        "gaps are allowed where the type says so"
    )
    bad = written(unchecked(PersonTracks((track,), (4,)), selected_ids=(5,)), tmp_path / "stages" / "02_b")
    assert "selected_ids: want numbers among [4], got (5,)" in refused(PersonTracks, bad)
    uneven = written(PersonTracks((longer,), (4,)), tmp_path / "stages" / "02_c")
    assert "people.0.score: want shape (4,), got (3,)" in refused(PersonTracks, uneven)


def test_an_object_may_be_taken_out(tmp_path: Path) -> None:
    """The names of the others' files stay as they are."""
    objects = tuple(ObjectMesh(i, "a", "box", box_mesh((i, 1, 1), (9, 9, 9)), np.eye(4)) for i in (1, 2, 3))
    folder = written(ObjectMeshes(objects), tmp_path / "stages" / "10_reconstruct")
    edit_json(folder, lambda data: {"objects": data["objects"][::2]})
    assert [obj.object_id for obj in read_value(ObjectMeshes, folder).objects] == [1, 3]
    edit_json(folder, lambda data: data["objects"][0].update(label="sofa"))
    assert read_value(ObjectMeshes, folder).objects[0].label == "sofa"


MANIFEST = Manifest("a", 1, "k", {"x": 1}, {}, {}, 0, "o", 0.5, 9.0,
                    [asdict(Quality("q", float("nan"), "m"))], ["w"], {})  # fmt: skip


@pytest.mark.parametrize(
    ("key", "wrong"),
    [
        ("wall_time_s", "long"), ("qualities", 3), ("qualities", [{}]), ("qualities", [{"key": "q", "value": "x"}]),
        ("warnings", None), ("warnings", [1]), ("key", 7), ("config", []), ("inputs", {"A": 1}), ("extra", 1),
    ],
)  # fmt: skip
def test_manifests_are_checked(tmp_path: Path, key: str, wrong: Any) -> None:
    MANIFEST.write(tmp_path)
    assert repr(read_manifest(tmp_path)) == repr(MANIFEST)
    data = json.loads((tmp_path / "manifest.json").read_text()) | {key: wrong}
    (tmp_path / "manifest.json").write_text(json.dumps(data))
    with pytest.raises(ArtifactError, match=key) as caught:
        read_manifest(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_manifest_from_before_keys_is_read_without_its_qualities(tmp_path: Path) -> None:
    MANIFEST.write(tmp_path)
    old = {"name": "foot skating (gmd)", "value": 0.1, "unit": "", "better": "lower"}
    data = json.loads((tmp_path / "manifest.json").read_text()) | {"qualities": [old]}
    (tmp_path / "manifest.json").write_text(json.dumps(data))
    assert read_manifest(tmp_path) == replace(MANIFEST, qualities=[])


def test_a_manifest_that_is_nested_deeply_or_a_pipe(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"a":' * 10**5)
    with pytest.raises(ArtifactError, match=r"manifest\.json"):
        read_manifest(tmp_path)
    (tmp_path / "manifest.json").unlink()
    os.mkfifo(tmp_path / "manifest.json")
    with pytest.raises(ArtifactError, match="regular file"):
        read_manifest(tmp_path)


# Masks and pictures


def masks_folder(tmp_path: Path) -> Path:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[2:5, 3:7] = True
    value = InstanceMasks("p", (ObjectInstance(1, "a", 0.5, np.zeros(4), mask),), np.zeros((HEIGHT, WIDTH), bool))
    return written(value, tmp_path / "stages" / "07_segment")


def as_painted(mask: np.ndarray, kind: str) -> np.ndarray:
    """A mask as a paint program saves it."""
    wide = mask.astype(np.uint16) * 65535
    byte = mask.astype(np.uint8) * 255
    return {
        "8 bit gray": byte, "16 bit gray": wide, "color": byte[..., None].repeat(3, -1),
        "16 bit color": wide[..., None].repeat(3, -1),
        "16 bit dark": np.where(mask, 40000, 300).astype(np.uint16),
        "opaque": np.dstack([byte, byte, byte, np.full_like(byte, 255)]),
        "erased": np.dstack([np.full_like(byte, 255)] * 3 + [byte]),
    }[kind]  # fmt: skip


@pytest.mark.parametrize(
    "kind", ["8 bit gray", "16 bit gray", "color", "16 bit color", "16 bit dark", "opaque", "erased"]
)
def test_masks_of_paint_programs(tmp_path: Path, kind: str) -> None:
    folder = masks_folder(tmp_path)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[1:8, 2] = True
    cv2.imwrite(str(folder / "instances.0.mask.png"), as_painted(mask, kind))
    np.testing.assert_array_equal(read_value(InstanceMasks, folder).instances[0].mask, mask)


@pytest.mark.parametrize(
    ("picture", "wanted"),
    [
        (np.full((1, 1), 255, np.uint8), "(9, 12), got (1, 1)"),
        (np.full((4, 6), 255, np.uint8), "(9, 12), got (4, 6)"),
        (np.full((WIDTH, HEIGHT), 255, np.uint8), "(9, 12), got (12, 9)"),
        (np.zeros((HEIGHT, WIDTH), np.uint8), "at least one pixel"),
        (np.full((HEIGHT, WIDTH), 200, np.uint16), "at least one pixel"),
        (np.dstack([np.full((HEIGHT, WIDTH), 255, np.uint8)] * 3 + [np.zeros((HEIGHT, WIDTH), np.uint8)]), "at least"),
    ],
)
def test_masks_of_another_size_or_without_pixels_are_refused(tmp_path: Path, picture: np.ndarray, wanted: str) -> None:
    folder = masks_folder(tmp_path)
    cv2.imwrite(str(folder / "instances.0.mask.png"), picture)
    message = refused(InstanceMasks, folder, clip_in(tmp_path / "clip"))
    assert wanted in message
    assert "instances.0.mask.png" in message


def test_a_floor_that_nobody_sees_is_no_fault(tmp_path: Path) -> None:
    assert not read_value(InstanceMasks, masks_folder(tmp_path)).floor_mask.any()


def test_pictures_have_eight_bits_and_no_holes(tmp_path: Path) -> None:
    path, uint8 = tmp_path / "p.png", np.dtype(np.uint8)
    for wrong in (np.zeros((4, 4, 3), np.uint16), np.zeros((4, 4, 4), np.uint8)):
        cv2.imwrite(str(path), wrong)
        with pytest.raises(ArtifactError, match="8 bits per channel"):
            read_png(path, uint8)
    cv2.imwrite(str(path), np.dstack([np.full((4, 4), tone, np.uint8) for tone in (30, 20, 10, 255)]))
    np.testing.assert_array_equal(read_png(path, uint8)[0, 0], (10, 20, 30))


def test_a_picture_of_a_billion_pixels_is_refused_by_its_header(tmp_path: Path) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 60000, 60000, 8, 6, 0, 0, 0))
    data = b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    (tmp_path / "p.png").write_bytes(data)
    with pytest.raises(ArtifactError, match="60000 x 60000"):
        read_png(tmp_path / "p.png", np.dtype(np.uint8))


# Meshes


def ply(vertices: str, faces: str, extra: str = "") -> bytes:
    points, polygons = vertices.split(";"), [face for face in faces.split(";") if face]
    head = f"ply\nformat ascii 1.0\n{extra}element vertex {len(points)}\nproperty float x\nproperty float y\n"
    head += f"property float z\nelement face {len(polygons)}\nproperty list uchar int vertex_indices\nend_header\n"
    return (head + "\n".join([*points, *polygons]) + "\n").encode()


@pytest.mark.parametrize(
    ("data", "wanted"),
    [
        (ply("nan 0 0;1 0 0;0 1 0", "3 0 1 2"), "finite"),
        (ply("0 0 0;1e6 0 0;0 1 0", "3 0 1 2"), "10 km"),
        (ply("0 0 0;1 0 0;0 1 0", "3 0 1 -2"), "triangles"),
        (ply("0 0 0;1 0 0;0 1 0", "3 0 1 7"), "triangles|damaged"),
        (ply("0 0 0;1 0 0;2 0 0", "3 0 1 2"), "with an area"),
        (ply("0 0 0;1 0 0;0 1 0", ""), "mesh|damaged"),
        (ply("0 0 0;1 0 0;0 1 0", "3 0 1 2").replace(b"vertex 3", b"vertex 1000000000"), "damaged"),
        (b"ply\n", "m.ply"),
        (b"", "m.ply"),
    ],
)  # fmt: skip
def test_what_is_no_mesh_is_refused(tmp_path: Path, data: bytes, wanted: str) -> None:
    (tmp_path / "m.ply").write_bytes(data)
    with pytest.raises(ArtifactError, match=wanted) as caught:
        read_ply(tmp_path / "m.ply")
    assert str(tmp_path / "m.ply") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_object_has_triangles(tmp_path: Path) -> None:
    obj = ObjectMesh(1, "a", "box", box_mesh((1, 1, 1), (9, 9, 9)), np.eye(4))
    folder = written(ObjectMeshes((obj,)), tmp_path / "stages" / "10_reconstruct")
    write_ply(folder / "objects.0.mesh.ply", Mesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8)))
    assert "at least one pixel or triangle" in refused(ObjectMeshes, folder)
    trimesh.creation.icosphere(1).export(folder / "objects.0.mesh.ply")
    assert len(read_value(ObjectMeshes, folder).objects[0].mesh.faces) == 80


# What counts as an edit


def test_stray_files_are_no_edit(tmp_path: Path) -> None:
    folder = masks_folder(tmp_path)
    before = value_digest(folder)
    assert before == folder_digest(folder), "folders made before have the same digest"
    for stray in (".DS_Store", "Thumbs.db", "instances.0.mask.png~", ".directory"):
        (folder / stray).write_bytes(b"x")
    (folder / "__MACOSX").mkdir()
    (folder / "__MACOSX" / "._value.json").write_bytes(b"x")
    os.mkfifo(folder / "pipe")
    assert value_digest(folder) == before


@pytest.mark.parametrize("name", ["value.json", "arrays.npz", "floor_mask.png", "instances.0.mask.png"])
def test_every_file_of_the_value_counts(tmp_path: Path, name: str) -> None:
    folder = masks_folder(tmp_path)
    before = value_digest(folder)
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data + b" ")
    assert value_digest(folder) != before
    (folder / name).unlink()
    assert value_digest(folder) != before
    os.mkfifo(folder / name)
    assert value_digest(folder) != before
    (folder / name).unlink()
    (folder / name).write_bytes(data)
    assert value_digest(folder) == before
