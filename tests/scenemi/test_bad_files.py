"""Files that are damaged, forged or far too large: one line, exit code 3, and soon."""

from __future__ import annotations

import json
import os
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scenemi_cases import keyframe_arrays, scenemi, walk_archive, walk_bvh

from scenemi.data.bvh import parse_bvh
from scenemi.data.scene_file import read_scene
from scenemi.model.weights import load_weights
from scenemi.training.checkpoint import load_checkpoint
from scenemi.training.config import TrainConfig
from scenemi.training.noise import PipelineErrors
from video2anim.errors import InputError


def good_npz(path: Path, **changes: Any) -> Path:
    np.savez(path, **{**keyframe_arrays(), **changes})
    return path


def with_bytes(path: Path, change: Callable[[bytearray], None]) -> Path:
    data = bytearray(path.read_bytes())
    change(data)
    path.write_bytes(data)
    return path


def compressed(path: Path) -> Path:
    np.savez_compressed(path, **keyframe_arrays())
    return path


def damaged_zlib(path: Path) -> Path:
    file = compressed(path / "keys.npz")
    with zipfile.ZipFile(file) as archive:
        info = archive.getinfo("R_parent_joint.npy")

    def spoil(data: bytearray) -> None:
        start = info.header_offset + 30 + len(info.filename) + 20
        data[start : start + 40] = bytes(40)

    return with_bytes(file, spoil)


def encrypted(path: Path) -> Path:
    def spoil(data: bytearray) -> None:
        for signature, flag in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
            for found in re.finditer(re.escape(signature), bytes(data)):
                data[found.start() + flag] |= 1

    return with_bytes(good_npz(path / "keys.npz"), spoil)


def garbage_header(path: Path) -> Path:
    file = path / "keys.npz"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("R_parent_joint.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", 60) + b"{" * 59 + b"\n")
    return file


def huge_member(path: Path) -> Path:
    file = path / "keys.npz"
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (12500000000,), }"
    header += b" " * (117 - len(header)) + b"\n"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(
            "translation_m.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(80)
        )
    return file


def unpacked_large(path: Path) -> Path:
    """Each array says in the archive's directory that it unpacks to 3.75 GiB."""
    file = path / "keys.npz"
    np.savez(file, **keyframe_arrays())
    data, at = bytearray(file.read_bytes()), -1
    while (at := data.find(b"PK\x01\x02", at + 1)) >= 0:
        data[at + 24 : at + 28] = (15 * 2**28).to_bytes(4, "little")
    file.write_bytes(data)
    return file


def as_json(**changes: Any) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        given = {key: value.tolist() for key, value in keyframe_arrays().items()}
        (path / "keys.json").write_text(json.dumps({**given, **changes}))
        return path / "keys.json"

    return write


def raw_json(text: str) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        (path / "keys.json").write_text(text)
        return path / "keys.json"

    return write


def as_npz(**changes: Any) -> Callable[[Path], Path]:
    return lambda path: good_npz(path / "keys.npz", **changes)


def a_pipe(path: Path) -> Path:
    os.mkfifo(path / "keys.npz")
    return path / "keys.npz"


BAD_KEYFRAMES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "damaged zlib": (damaged_zlib, "cannot be read"),
    "encrypted": (encrypted, "cannot be read"),
    "garbage header": (garbage_header, "cannot be read"),
    "declared 100 GB": (huge_member, "cannot be read"),
    "unpacks to 15 GiB": (unpacked_large, "want at most 4,096 MiB"),
    "pipe": (a_pipe, "not a plain file"),
    "complex": (as_npz(translation_m=np.zeros((4, 3), complex)), "translation_m wants numbers or text"),
    "dates": (as_npz(translation_m=np.zeros((4, 3), "datetime64[s]")), "translation_m wants numbers or text"),
    "objects": (as_npz(translation_m=np.array([[None] * 3] * 4)), "cannot be read"),
    "text": (as_npz(translation_m=np.full((4, 3), "1.0")), "translation_m wants numbers"),
    "fps is NaN": (as_npz(fps=np.nan), "fps wants one finite number"),
    "fps is text": (as_json(fps="30"), "fps wants"),
    "fps is a list": (as_json(fps=[30, 30]), "fps wants one finite number"),
    "fps is null in a row": (as_json(fps=[None]), "fps wants"),
    "valid is 3": (as_json(valid=3), "valid wants shape (K,), got ()"),
    "valid is short": (as_json(valid=[True, True]), "valid wants shape (4,), got (2,)"),
    "names are 3": (as_json(shape_model="anny", shape_names=3), "shape_names wants a list of text"),
    "values are text": (
        as_json(shape_model="anny", shape_names=["height"], shape_values=["tall"]),
        "shape_values wants numbers",
    ),
    "shape unknown": (as_json(shape_model="nobody"), "nobody"),
    "nested deeply": (raw_json("[" * 100_000), "cannot be read as JSON"),
    "nested deeply in a table": (raw_json('{"fps": ' + "[" * 500 + "]" * 500 + "}"), "fps wants"),
    "400 digits": (as_json(translation_m=[[10**400, 0, 0]] * 4), "translation_m wants numbers"),
    "ragged": (as_json(translation_m=[[0, 0, 0], [0, 0]]), "translation_m wants numbers in rows of equal length"),
    "null": (as_json(translation_m=[[0, None, 0]] * 4), "translation_m wants numbers"),
    "not UTF-8": (lambda path: with_bytes(as_json()(path), lambda data: data.insert(1, 0xFF)), "cannot be read as"),
    "frame far away": (as_json(frame_index=[0, 15, 40, 10**9]), "want frames below 108000"),
    "frame far beyond integers": (as_json(frame_index=[0, 15, 40, 1e300]), "want frames below 108000"),
    "rotation overflows": (as_npz(R_parent_joint=np.full((4, 22, 3, 3), 1e200)), "no rotation matrix"),
    "angle overflows": (
        lambda path: good_npz(path / "keys.npz", R_parent_joint=np.zeros(0), axis_angle=np.full((4, 22, 3), 1e200)),
        "R_parent_joint wants shape (K, J, 3, 3), got (0,)",
    ),
    "root is a plane": (
        lambda path: (np.savez(path / "k.npz", R_parent_joint=np.eye(3), T_world_root=np.eye(4)), path / "k.npz")[1],
        "R_parent_joint wants shape",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_KEYFRAMES)
def test_bad_keyframe_files_end_in_one_line(name: str, tmp_path: Path) -> None:
    make, message = BAD_KEYFRAMES[name]
    done = scenemi("sample", "--keyframes", make(tmp_path), "--out", tmp_path / "m.npz", "--weights", "interpolation")
    assert done.code == 3, done.err
    assert message in done.err
    assert len(done.err.splitlines()) == 1
    assert len(done.err) < 600, "values of the file are not repeated"


def test_what_is_not_read_is_not_unpacked(tmp_path: Path) -> None:
    """A member that would not fit does no harm where no key names it."""
    file = good_npz(tmp_path / "keys.npz")
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("unused.npy", b"no array at all")
    done = scenemi("sample", "--keyframes", file, "--out", tmp_path / "m.npz", "--weights", "interpolation")
    assert done.code == 0, done.err


def test_a_motion_has_a_limit(tmp_path: Path) -> None:
    words = ("--keyframes", good_npz(tmp_path / "k.npz"), "--out", tmp_path / "m.npz", "--weights", "interpolation")
    done = scenemi("sample", *words, "--length", "1000000000")
    assert done.code == 2
    assert "--length" in done.err


def replaced(path: Path, pattern: str, by: str, count: int = 1) -> Path:
    text = path.read_text()
    assert re.search(pattern, text), pattern
    path.write_text(re.sub(pattern, by, text, count=count))
    return path


def many_joints(path: Path) -> Path:
    lines = "ROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Xrotation Yrotation Zrotation\n"
    lines += "JOINT a\n{\nOFFSET 0 1 0\nCHANNELS 0\n}\n" * 20_000
    (path / "walk.bvh").write_text(f"HIERARCHY\n{lines}}}\nMOTION\nFrames: 1\nFrame Time: 0.03\n0 0 0\n")
    return path / "walk.bvh"


BAD_BVH: dict[str, tuple[Callable[[Path], Path], str]] = {
    "channels below 0": (lambda p: replaced(walk_bvh(p / "w.bvh"), "CHANNELS 3", "CHANNELS -6"), "0 to 6 channels"),
    "channels without end": (lambda p: replaced(walk_bvh(p / "w.bvh"), "CHANNELS 3", "CHANNELS 99999999"), "channels"),
    "many joints of one name": (many_joints, "more than 2000 joints"),
    "a frame of years": (lambda p: replaced(walk_bvh(p / "w.bvh"), r"Frame Time: \S+", "Frame Time: 1e9"), "an hour"),
    "frames of nothing": (lambda p: replaced(walk_bvh(p / "w.bvh"), r"Frame Time: \S+", "Frame Time: 1e-9"), "1000 f"),
    "half an offset": (lambda p: replaced(walk_bvh(p / "w.bvh"), r"OFFSET (\S+ \S+) \S+", r"OFFSET \1"), "broken BVH"),
    "endless bones": (lambda p: replaced(walk_bvh(p / "w.bvh"), r"OFFSET \S+", "OFFSET 1e200"), "want numbers up to"),
    "digits": (lambda p: replaced(walk_bvh(p / "w.bvh"), r"Frames: \d+", "Frames: " + "9" * 5000), "broken BVH"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_BVH)
def test_bad_bvh_files_end_in_one_line(name: str, tmp_path: Path) -> None:
    make, message = BAD_BVH[name]
    done = scenemi("sample", "--keyframes", make(tmp_path), "--out", tmp_path / "m.npz", "--weights", "interpolation")
    assert (done.code, len(done.err.splitlines())) == (3, 1), done.err
    assert message in done.err


def box(path: Path) -> Path:
    trimesh.creation.box((1, 1, 1)).export(path)
    return path


def written(name: str, data: bytes | str) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        (path / name).write_bytes(data.encode() if isinstance(data, str) else data)
        return path / name

    return write


def scene_npz(**arrays: Any) -> Callable[[Path], Path]:
    return lambda path: (np.savez(path / "scene.npz", **arrays), path / "scene.npz")[1]


def nan_vertex(data: bytearray) -> None:
    data[84 + 12 : 84 + 16] = struct.pack("<f", np.nan)


def false_length(at: int) -> Callable[[bytearray], None]:
    def change(data: bytearray) -> None:
        data[at : at + 4] = struct.pack("<I", 10**9)

    return change


PROPERTIES = "property float x\nproperty float y\nproperty float z\n"
PLY = "ply\nformat ascii 1.0\nelement vertex {}\n" + PROPERTIES + "end_header\n0 0 0\n"
EYE = np.eye(3)
BAD_SCENES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "two coordinates": (written("s.obj", "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n"), "cannot be read as a scene"),
    "text faces": (scene_npz(vertices_m=EYE, faces=np.array([["a", "b", "c"]])), "faces wants numbers"),
    "scalar vertices": (scene_npz(vertices_m=3.0), "vertices_m wants shape (V, 3), got ()"),
    "fractional faces": (scene_npz(vertices_m=EYE, faces=np.array([[0, 1, 1.5]])), "whole numbers"),
    "complex points": (scene_npz(points_m=EYE.astype(complex)), "points_m wants numbers"),
    "a billion vertices": (written("s.ply", PLY.format(10**9)), "cut off or damaged"),
    "three of one vertex": (written("s.ply", PLY.format(3)), "s.ply: "),
    "NaN in STL": (lambda path: with_bytes(box(path / "s.stl"), nan_vertex), "holds NaN"),
    "long STL": (lambda path: with_bytes(box(path / "s.stl"), false_length(80)), "cut off or damaged"),
    "long GLB": (lambda path: with_bytes(box(path / "s.glb"), false_length(8)), "cut off or damaged"),
    "nested GLTF": (written("s.gltf", "[" * 100_000), "cannot be read as a scene"),
    "GLTF list": (written("s.gltf", "[1]"), "cannot be read as a scene"),
    "missing corner": (written("s.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"), "s.obj: "),
}


@pytest.mark.parametrize("name", BAD_SCENES)
def test_bad_scene_files_end_in_one_line(name: str, tmp_path: Path) -> None:
    make, message = BAD_SCENES[name]
    with pytest.raises(InputError) as raised:
        read_scene(make(tmp_path))
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_large_scans_are_refused_before_they_take_the_memory(tmp_path: Path) -> None:
    faces = np.tile(np.array([[0, 1, 2]], np.int32), (3_000_001, 1))
    np.savez(tmp_path / "scan.npz", vertices_m=EYE, faces=faces)
    with pytest.raises(InputError, match="want a scene of at most 3,000,000 faces, got 3,000,001; simplify"):
        read_scene(tmp_path / "scan.npz")


def skinned(path: Path) -> Path:
    """A table, and a person of a box with a skin in the middle of the room."""
    scene = trimesh.Scene()
    table = trimesh.creation.box((0.8, 0.7, 0.6), trimesh.transformations.translation_matrix((1.0, 0.35, 1.0)))
    scene.add_geometry(table, node_name="table")
    scene.add_geometry(trimesh.creation.box((0.5, 1.7, 0.3)), node_name="person_body")
    data = scene.export(file_type="glb")
    assert isinstance(data, bytes)
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    person = next(node for node in document["nodes"] if node.get("name") == "person_body")
    person["skin"] = 0
    document["skins"] = [{"joints": [0]}]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest)
    return path


def test_people_in_a_scene_are_no_solids(tmp_path: Path) -> None:
    found = read_scene(skinned(tmp_path / "scene.glb"))
    assert len(found.parts) == 1
    np.testing.assert_allclose(found.parts[0].vertices_m.mean(0), [1.0, 0.35, 1.0], atol=1e-6)
    words = ("--keyframes", good_npz(tmp_path / "k.npz"), "--out", tmp_path / "m.npz", "--weights", "interpolation")
    done = scenemi("sample", *words, "--scene", tmp_path / "scene.glb")
    assert done.code == 0, done.err
    assert "skinned meshes (people) of the scene are left out: person_body" in done.err


@pytest.mark.parametrize("command", ["evaluate", "train", "data"])
@pytest.mark.parametrize("spoiled", ["clip_frames", "clip_fps", "skel_parent", "skel_joint", "format_version", "rot"])
def test_archives_with_tables_of_other_kinds_end_in_one_line(command: str, spoiled: str, tmp_path: Path) -> None:
    path = walk_archive(tmp_path / "clips.npz", 121)
    with np.load(path, allow_pickle=False) as file:
        tables = {name: file[name] for name in file.files}
    for bad in (np.array("text"), np.full(tables[spoiled].shape, 1e300), np.zeros((2, 2, 2))):
        np.savez(path, **{**tables, spoiled: bad})
        named = {"evaluate": ("--clips", path, "--weights", "interpolation"), "data": (path,)}
        words = named.get(
            command, ("--motion", path, "--out", tmp_path / "run", "--config", "tiny", "--minutes", "0.01")
        )
        done = scenemi(command, *words)
        assert (done.code, len(done.err.splitlines())) == (3, 1), (done.err, bad)


def test_damaged_weights_checkpoints_and_errors_end_in_one_line(tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    path = tmp_path / "w.safetensors"
    for format_name, load in (("scenemi-weights-2", load_weights), ("scenemi-checkpoint-2", load_checkpoint)):
        for header in (
            {},
            {"config": "{", "card": "{}", "step": "1", "groups": "[]", "seconds": "0"},
            {"config": '{"width": "wide"}', "card": "{}", "step": "one", "groups": "{", "seconds": "x"},
            {"config": '{"layers": 1000000}', "card": "{}", "step": "1", "groups": "[]", "seconds": "0"},
        ):
            save_file({"model.x": np.zeros(3, np.float32)}, path, {"format": format_name, **header})
            with pytest.raises(InputError, match=r"w\.safetensors|training config"):
                load(path)
    np.savez(tmp_path / "e.npz", turn_rad=np.zeros((4, 22, 3), np.float16), shift_m=np.zeros((4, 3)), start=[0, 9])
    with pytest.raises(InputError, match="contradict"):
        PipelineErrors.read(tmp_path / "e.npz")


def test_offsets_that_are_no_numbers_are_one_line(tmp_path: Path) -> None:
    """`max` of NaN and a number may be the number."""
    path = tmp_path / "odd.bvh"
    hierarchy = "HIERARCHY ROOT hips { OFFSET 0 nan 0 CHANNELS 3 Xposition Yposition Zposition }"
    path.write_text(f"{hierarchy} MOTION Frames: 1 Frame Time: 0.03\n0 0 0\n")
    with pytest.raises(InputError, match="want numbers up to"):
        parse_bvh(path)


def test_an_unknown_setting_is_named_in_one_line() -> None:
    for values in ({"\n": 1}, {"model": {"\n": 0}}):
        with pytest.raises(InputError, match=r"unknown \\n") as caught:
            TrainConfig.from_json(values)
        assert "\n" not in str(caught.value)
