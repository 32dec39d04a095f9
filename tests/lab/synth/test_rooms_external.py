"""External meshes of a user's folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from video2anim.errors import InputError
from video2anim.lab.synth.rooms import load_meshes


def _box(folder: Path, name: str, extents=(0.5, 0.8, 0.4), **color) -> None:
    mesh = trimesh.creation.box(extents=extents)
    mesh.apply_translation([3.0, 5.0, -2.0])
    if color:
        mesh.visual.vertex_colors = color["rgba"]
    mesh.export(folder / name)


@pytest.mark.parametrize("suffix", ["glb", "obj", "ply"])
def test_reads_each_format_onto_the_floor(tmp_path, suffix):
    _box(tmp_path, f"chair_oak.{suffix}", rgba=[200, 30, 10, 255])
    (obj,) = load_meshes(tmp_path)
    vertices, _ = obj.merged()
    assert obj.label == "chair"
    assert vertices.min(0) == pytest.approx([-0.25, 0, -0.2], abs=1e-6)
    assert vertices.max(0) == pytest.approx([0.25, 0.8, 0.2], abs=1e-6)
    assert obj.parts[0].vertex_rgb is not None
    assert np.abs(obj.parts[0].vertex_rgb.astype(int) - [200, 30, 10]).max() <= 2


def test_order_labels_and_other_files(tmp_path):
    _box(tmp_path, "b_thing.ply")
    _box(tmp_path, "Table2.glb")
    _box(tmp_path, "plant.obj")
    (tmp_path / "notes.txt").write_text("not a mesh")
    objects = load_meshes(tmp_path)
    assert [obj.note for obj in objects] == ["file Table2.glb", "file b_thing.ply", "file plant.obj"]
    assert [obj.label for obj in objects] == ["table", "mesh", "plant"]


def test_inside_out_mesh_is_turned(tmp_path):
    mesh = trimesh.creation.box(extents=(1, 1, 1))
    mesh.invert()
    mesh.export(tmp_path / "box.ply")
    (obj,) = load_meshes(tmp_path)
    assert trimesh.Trimesh(*obj.merged(), process=False).volume == pytest.approx(1.0)


def _too_large(folder: Path) -> None:
    _box(folder, "a.glb", (80.0, 60.0, 50.0))


def _flat(folder: Path) -> None:
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]], [[0, 1, 2]]).export(folder / "a.ply")


def _empty(folder: Path) -> None:
    (folder / "a.obj").write_text("# nothing\n")


def _points(folder: Path) -> None:
    trimesh.PointCloud(np.random.default_rng(0).random((9, 3))).export(folder / "a.ply")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: (folder / "a.glb").write_bytes(b"glTF rubbish"), "cannot be read"),
        (lambda folder: (folder / "a.ply").write_bytes(b""), "cannot be read"),
        (_empty, r"no triangles|cannot be read"),
        (_points, "no triangles"),
        (_too_large, "is 80 units long.*export it in meters"),
        (_flat, "is flat"),
        (lambda folder: (folder / "a.txt").write_text("x"), "found none"),
    ],
)
def test_bad_files_are_reported_in_one_line(tmp_path, make, message):
    make(tmp_path)
    with pytest.raises(InputError, match=message) as caught:
        load_meshes(tmp_path)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_missing_folder(tmp_path):
    with pytest.raises(InputError, match="check the path"):
        load_meshes(tmp_path / "absent")
