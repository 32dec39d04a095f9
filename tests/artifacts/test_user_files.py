"""Meshes that users bring: read whole and in color, refused in one line, told apart by their content."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.exchange.gltf import export_gltf
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from video2anim import mesh_file
from video2anim.artifacts.user_files import content_digest, mesh_files, read_mesh_file
from video2anim.errors import InputError
from video2anim.mesh_file import MESH_SUFFIXES

RED, GREEN, ORANGE = (200, 30, 40), (10, 200, 30), (255, 128, 0)
GRAY = 160


def red_box() -> trimesh.Trimesh:
    """1 x 2 x 3; the vertex of the lowest corner is green."""
    box = trimesh.creation.box((1, 2, 3))
    colors = np.tile(np.array([*RED, 255], np.uint8), (8, 1))
    colors[np.asarray(box.vertices).sum(1).argmin()] = (*GREEN, 255)
    box.visual = ColorVisuals(box, vertex_colors=colors)
    return box


def export(shape: trimesh.Trimesh | trimesh.Scene, path: Path) -> Path:
    """Write a mesh file with all that belongs to it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".gltf":  # trimesh leaves the file open
        files = export_gltf(trimesh.Scene(shape) if isinstance(shape, trimesh.Trimesh) else shape)
        for name, data in files.items():
            (path if name == "model.gltf" else path.parent / name).write_bytes(data)
    else:
        shape.export(path)
    return path


@pytest.mark.parametrize("suffix", [*MESH_SUFFIXES, ".GLB", ".Ply"])
def test_every_kind_of_file_is_read(tmp_path: Path, suffix: str) -> None:
    """STL has no colors: it is gray."""
    path = export(red_box(), tmp_path / f"box{suffix.lower()}")
    path = path.rename(tmp_path / f"again{suffix}")
    mesh = read_mesh_file(path)
    assert (mesh.vertices_m.dtype, mesh.faces.dtype, mesh.vertex_rgb.dtype) == (np.float64, np.int64, np.uint8)
    assert (mesh.vertices_m.shape, mesh.faces.shape, mesh.vertex_rgb.shape) == ((8, 3), (12, 3), (8, 3))
    np.testing.assert_allclose([mesh.vertices_m.min(0), mesh.vertices_m.max(0)], [[-0.5, -1, -1.5], [0.5, 1, 1.5]])
    assert trimesh.Trimesh(mesh.vertices_m, mesh.faces).volume == pytest.approx(6.0), "triangles keep facing outward"
    if suffix == ".stl":
        assert (mesh.vertex_rgb == GRAY).all()
    else:
        lowest = mesh.vertices_m.sum(1).argmin()
        np.testing.assert_array_equal(mesh.vertex_rgb[lowest], GREEN)
        np.testing.assert_array_equal(np.delete(mesh.vertex_rgb, lowest, axis=0), np.tile(RED, (7, 1)))


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".obj"])
def test_texture_becomes_the_color_of_vertices(tmp_path: Path, suffix: str) -> None:
    """A square with a picture of four colors: blue and white below, red and green above."""
    colors = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    picture = Image.fromarray(colors.repeat(8, 0).repeat(8, 1))
    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    square.visual = TextureVisuals(uv=np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]]), image=picture)
    mesh = read_mesh_file(export(square, tmp_path / f"square{suffix}"))
    for place, color in (
        ((0, 0), colors[1, 0]),
        ((1, 0), colors[1, 1]),
        ((0, 1), colors[0, 0]),
        ((1, 1), colors[0, 1]),
    ):
        at = np.flatnonzero((mesh.vertices_m[:, :2] == place).all(1))
        np.testing.assert_array_equal(mesh.vertex_rgb[at], [color] * len(at))
        assert len(at)


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_all_parts_come_in_their_places(tmp_path: Path, suffix: str) -> None:
    """The second part is 5 m to the right and turned, by a node of the file."""
    scene = trimesh.Scene()
    scene.add_geometry(red_box())
    turned = np.asarray(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    turned[0, 3] = 5.0
    scene.add_geometry(red_box(), transform=turned)
    mesh = read_mesh_file(export(scene, tmp_path / f"two{suffix}"))
    assert len(mesh.faces) == 24
    np.testing.assert_allclose([mesh.vertices_m.min(0), mesh.vertices_m.max(0)], [[-0.5, -1, -1.5], [6.5, 1, 1.5]])
    assert (mesh.vertex_rgb == RED).all(1).sum() == 14


def plain_material() -> trimesh.Trimesh:
    box = trimesh.creation.box((1, 1, 1))
    box.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[*ORANGE, 255]))
    return box


def colored_faces() -> trimesh.Trimesh:
    box = trimesh.creation.box((1, 1, 1))
    box.visual = ColorVisuals(box, face_colors=np.tile(np.array([*ORANGE, 255], np.uint8), (12, 1)))
    return box


@pytest.mark.parametrize(("shape", "suffix"), [(plain_material(), ".glb"), (colored_faces(), ".ply")])
def test_colors_of_materials_and_faces_are_kept(tmp_path: Path, shape: trimesh.Trimesh, suffix: str) -> None:
    assert (read_mesh_file(export(shape, tmp_path / f"box{suffix}")).vertex_rgb == ORANGE).all()


def refused(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_mesh_file(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
@pytest.mark.parametrize("content", [b"", b"junk\nand \x00\xff more\n", None])
def test_damaged_files_are_refused_in_one_line(tmp_path: Path, suffix: str, content: bytes | None) -> None:
    """Empty, no mesh at all, and a mesh that ends after 300 bytes."""
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(export(red_box(), tmp_path / f"good{suffix}").read_bytes()[:300] if content is None else content)
    assert "cannot be read as a mesh" in refused(path) or "want a mesh with triangles" in refused(path)


def test_what_is_no_mesh_file_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("v 0 0 0\n")
    (tmp_path / "folder.glb").mkdir()
    assert "want a mesh file (.glb, .gltf, .obj, .ply, .stl)" in refused(tmp_path / "notes.txt")
    assert "no such mesh file" in refused(tmp_path / "missing.glb")
    assert "no such mesh file (not a plain file)" in refused(tmp_path / "folder.glb")


def test_points_without_triangles_and_places_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    (tmp_path / "nan.obj").write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "beyond.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    data = export(red_box(), tmp_path / "endless.glb").read_bytes()
    (tmp_path / "endless.glb").write_bytes(data.replace(struct.pack("<f", 1.5), struct.pack("<f", np.inf)))
    assert "finite" in refused(tmp_path / "endless.glb")
    assert "triangles" in refused(tmp_path / "points.ply")
    assert "triangles" in refused(tmp_path / "nan.obj")
    refused(tmp_path / "beyond.obj")


@pytest.mark.parametrize(
    ("places", "corners", "said"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 0 30000\n", "1 2 3", "farther than 10 km"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\n", "1 2 3", "with an area"),
    ],
)
def test_what_no_room_has_is_refused(tmp_path: Path, places: str, corners: str, said: str) -> None:
    (tmp_path / "odd.obj").write_text(f"{places}f {corners}\n")
    assert said in refused(tmp_path / "odd.obj")


def test_too_many_faces_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_file, "MAX_FACES", 11)
    assert "want a mesh of at most 11 faces, got 12" in refused(export(red_box(), tmp_path / "box.ply"))


def test_meshes_of_a_folder_by_number(tmp_path: Path) -> None:
    """Other names and other kinds of files are no objects."""
    for name in ("3.glb", "12.OBJ", "007.ply", "chair.glb", "4.txt", "3.png", "-1.glb"):
        (tmp_path / name).touch()
    found = mesh_files(tmp_path)
    assert found == {3: tmp_path / "3.glb", 12: tmp_path / "12.OBJ", 7: tmp_path / "007.ply"}


def test_a_folder_without_a_clear_answer_is_refused(tmp_path: Path) -> None:
    (tmp_path / "3.glb").touch()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "chair.glb").touch()
    for folder in (tmp_path / "none", tmp_path / "3.glb", tmp_path / "other"):
        with pytest.raises(InputError, match="want a folder of meshes") as caught:
            mesh_files(folder)
        assert str(folder) in str(caught.value)
    (tmp_path / "03.obj").touch()
    with pytest.raises(InputError, match=r"one mesh per object, got 03\.obj and 3\.glb"):
        mesh_files(tmp_path)


def test_digest_follows_the_content_of_a_file_and_not_its_place(tmp_path: Path) -> None:
    one, other = tmp_path / "a.glb", tmp_path / "deep" / "b.ply"
    other.parent.mkdir()
    one.write_bytes(b"abc")
    other.write_bytes(b"abc")
    # The published digest of these three bytes.
    assert content_digest(one) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert content_digest(other) == content_digest(one)
    other.write_bytes(b"abd")
    assert content_digest(other) != content_digest(one)


def test_digest_follows_names_and_content_of_a_folder_and_not_its_place(tmp_path: Path) -> None:
    first = tmp_path / "first"
    first.mkdir()
    (first / "1.glb").write_bytes(b"one")
    (first / "2.glb").write_bytes(b"two")
    second = Path(shutil.copytree(first, tmp_path / "elsewhere" / "second"))
    before = content_digest(first)
    assert content_digest(second) == before
    (second / "2.glb").write_bytes(b"too")
    assert content_digest(second) != before, "other bytes"
    (second / "2.glb").write_bytes(b"two")
    assert content_digest(second) == before
    (second / "2.glb").rename(second / "3.glb")
    assert content_digest(second) != before, "another name"
    (second / "3.glb").unlink()
    assert content_digest(second) != before, "a file less"


def test_nothing_has_no_digest(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found nothing at") as caught:
        content_digest(tmp_path / "none.glb")
    assert str(tmp_path / "none.glb") in str(caught.value)
    assert "\n" not in str(caught.value)


def textured_square(path: Path) -> Path:
    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    square.visual = TextureVisuals(uv=0.1 + 0.8 * square.vertices[:, :2], image=Image.fromarray(noise))
    return export(square, path)


def test_a_picture_cut_off_inside_a_mesh_is_refused(tmp_path: Path) -> None:
    path = textured_square(tmp_path / "square.glb")
    read_mesh_file(path)
    data = path.read_bytes()
    start = data.index(b"IDAT") + 2000
    path.write_bytes(data[:start] + bytes(4000) + data[start + 4000 :])
    assert "cannot be read as a mesh" in refused(path)


def test_colors_that_do_not_fit_the_vertices_are_no_gray_mesh(tmp_path: Path) -> None:
    """The file places three of four vertices in its texture."""
    path = textured_square(tmp_path / "square.gltf")
    document = json.loads(path.read_text())
    places = document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
    document["accessors"][places]["count"] = 3
    path.write_text(json.dumps(document))
    assert "want a color for each of 4 vertices, got 3" in refused(path)
