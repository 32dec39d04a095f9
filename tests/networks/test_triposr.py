"""TripoSR's adapter against tiny networks of its contract: a ball of known size, place and color."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from object_graphs import CENTER, RADIUS_OF_RED, completer_file, triposr_folder

from video2anim import networks
from video2anim.errors import ModelMissingError, StageError
from video2anim.networks import triposr
from video2anim.networks.triposr import RADIUS, TripoSR, surface, to_input
from video2anim.types import Mesh

GRAY = 127 / 255
RED = np.zeros((200, 200, 3), np.uint8)
RED[..., 0] = 255
MOST = 100_000
"""Faces: no simplification."""


def red_share(side: int = 200) -> float:
    """Mean red of a red square of that side on its gray square."""
    share = (side / int(side / 0.85)) ** 2
    return share + (1 - share) * GRAY


def radius_of(side: int = 200) -> float:
    return RADIUS_OF_RED * red_share(side)


def mesh_of(folder: Path, picture: np.ndarray = RED, **options: int) -> Mesh:
    return TripoSR(folder / "encoder.onnx").mesh(picture, **({"max_faces": 4000} | options))


def closed(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0, "faces turned outwards"
    return mesh


def failure(folder: Path, kind: type[Exception]) -> str:
    with pytest.raises(kind) as caught:
        mesh_of(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_ball_of_the_picture_is_closed_and_of_its_size(tmp_path: Path) -> None:
    """Simplified to 4000 faces it stays within a third of a sample's distance of the ball."""
    found = mesh_of(triposr_folder(tmp_path))
    mesh = closed(found.vertices_m, found.faces)
    x, y, z = CENTER
    distance = np.linalg.norm(found.vertices_m - [y, z, x], axis=1)
    np.testing.assert_allclose(distance, radius_of(), atol=0.3 * 2 * RADIUS / 95)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius_of() ** 3, rel=0.01)
    assert len(found.faces) <= 4000
    assert (found.vertices_m.dtype, found.vertex_rgb.dtype) == (np.float32, np.uint8)


def test_up_is_y_and_the_picture_shows_the_side_of_z(tmp_path: Path) -> None:
    """Red grows towards TripoSR's viewer (its +x), green to the viewer's right (+y), blue upwards (+z)."""
    found = mesh_of(triposr_folder(tmp_path))
    right, up, front = found.vertices_m.T
    np.testing.assert_allclose(found.vertex_rgb[:, 0], 255 * (0.5 + 0.5 * front), atol=0.51)
    np.testing.assert_allclose(found.vertex_rgb[:, 1], 255 * (0.5 + 0.5 * right), atol=0.51)
    np.testing.assert_allclose(found.vertex_rgb[:, 2], 255 * (0.5 + 0.5 * up), atol=0.51)


def test_the_encoder_sees_the_picture(tmp_path: Path) -> None:
    """A flat red bar leaves more gray, so the ball is smaller."""
    found = mesh_of(triposr_folder(tmp_path), RED[:40])
    share = 200 * 40 / int(200 / 0.85) ** 2
    radius = RADIUS_OF_RED * (share + (1 - share) * GRAY)
    assert np.ptp(found.vertices_m, axis=0) == pytest.approx(2 * radius, abs=0.004)


@pytest.mark.parametrize(("height", "width"), [(200, 200), (60, 200), (200, 60), (1000, 400), (3, 7)])
def test_input_by_hand(height: int, width: int) -> None:
    picture = np.full((height, width, 3), (255, 0, 51), np.uint8)
    values = to_input(picture)
    assert (values.shape, values.dtype) == ((1, 3, 512, 512), np.float32)
    assert values.flags.c_contiguous
    obj = values[0, 1] < 0.5 * GRAY
    rows, columns = np.nonzero(obj)
    scale = 512 / int(max(height, width) / 0.85)
    np.testing.assert_allclose([np.ptp(rows) + 1, np.ptp(columns) + 1], [height * scale, width * scale], atol=1.5)
    assert abs(rows.min() + rows.max() - 511) <= scale + 1
    assert abs(columns.min() + columns.max() - 511) <= scale + 1
    center = values[0, :, (rows.min() + rows.max()) // 2, (columns.min() + columns.max()) // 2]
    np.testing.assert_allclose(center, [1.0, 0.0, 0.2], atol=1e-6)
    np.testing.assert_allclose(values[0, :, 0, 0], GRAY, atol=1e-6)


def test_points_are_asked_for_in_chunks_over_the_whole_cube(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = TripoSR(triposr_folder(tmp_path) / "encoder.onnx")
    asked: list[np.ndarray] = []
    run = model._field.run
    monkeypatch.setattr(model._field, "run", lambda feeds, names: asked.append(feeds["points"]) or run(feeds, names))
    monkeypatch.setattr(triposr, "_CHUNK", 3000)
    made = model.mesh(RED, max_faces=MOST, resolution=20)
    assert max(points.shape[1] for points in asked) == 3000
    points = np.concatenate(asked, axis=1)[0]
    assert len(points) == 20**3 + len(made.vertices_m)
    axis = np.linspace(-RADIUS, RADIUS, 20)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    np.testing.assert_allclose(points[: 20**3], grid, atol=1e-6)
    monkeypatch.setattr(triposr, "_CHUNK", 10**6)
    whole = model.mesh(RED, max_faces=MOST, resolution=20)
    np.testing.assert_array_equal(made.vertices_m, whole.vertices_m)
    np.testing.assert_array_equal(made.vertex_rgb, whole.vertex_rgb)


def test_an_empty_field_is_no_mesh(tmp_path: Path) -> None:
    assert "want density of 25 somewhere, got" in failure(triposr_folder(tmp_path, density_gain=1e-9), StageError)


@pytest.mark.parametrize("broken", ["density", "color", "scene_codes"])
def test_what_is_not_finite_is_no_mesh(tmp_path: Path, broken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    gains = {"density": {"density_gain": np.inf}, "color": {"color_gain": np.nan}, "scene_codes": {}}[broken]
    folder = triposr_folder(tmp_path, **gains)
    if broken == "scene_codes":
        monkeypatch.setattr(triposr, "to_input", lambda picture: np.full((1, 3, 512, 512), np.nan, np.float32))
    assert f"triposr: want finite {broken}, got" in failure(folder, StageError)


def test_exports_before_the_activations_are_refused(tmp_path: Path) -> None:
    assert "want density after exp(x - 1), never negative, got -" in failure(
        triposr_folder(tmp_path, density_gain=-1.0), ModelMissingError
    )
    assert "want color in 0..1 (after the sigmoid), got" in failure(
        triposr_folder(tmp_path, color_gain=3.0), ModelMissingError
    )


def test_other_shapes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = triposr_folder(tmp_path / "small", codes=(1, 3, 40, 32, 32))
    assert "want scene_codes (1, 3, 40, 64, 64), got (1, 3, 40, 32, 32)" in failure(small, ModelMissingError)
    model = TripoSR(triposr_folder(tmp_path / "flat") / "encoder.onnx")
    run = model._field.run
    for name, width in (("density", 1), ("color", 3)):

        def flat(feeds: dict, names: tuple[str, ...], name: str = name) -> dict[str, np.ndarray]:
            return {key: value[0] if key == name else value for key, value in run(feeds, names).items()}

        monkeypatch.setattr(model._field, "run", flat)
        with pytest.raises(
            ModelMissingError, match=rf"field\.onnx: want {name} \(1, \d+, {width}\), got \(\d+, {width}\)"
        ):
            model.mesh(RED, max_faces=4000)


def test_other_tensors_are_refused(tmp_path: Path) -> None:
    folder = triposr_folder(tmp_path)
    other = completer_file(tmp_path / "other.onnx", np.zeros((256, 256)), np.zeros((256, 256, 3)))
    (folder / "field.onnx").write_bytes(other.read_bytes())
    with pytest.raises(ModelMissingError, match=r"field\.onnx: want tensors \('scene_codes', 'points'\)"):
        TripoSR(folder / "encoder.onnx")
    with pytest.raises(ModelMissingError, match=r"other\.onnx: want tensors \('image',\) -> \('scene_codes',\)"):
        TripoSR(other)


def test_the_table_takes_the_folder_or_the_encoder(tmp_path: Path) -> None:
    folder = triposr_folder(tmp_path / "mine")
    known = mesh_of(folder, max_faces=MOST, resolution=20)
    for name in (f"triposr@{folder}", f"triposr@{folder / 'encoder.onnx'}"):
        made = networks.load_model(name).mesh(RED, max_faces=MOST, resolution=20)
        np.testing.assert_array_equal(made.vertices_m, known.vertices_m)
        assert networks.ensure(name) == folder / "encoder.onnx"
    row = networks.find_model("object-mesh")
    assert (row.name, row.license, row.verified) == ("triposr", "MIT", "contract")


@pytest.mark.parametrize("file", ["encoder.onnx", "field.onnx"])
def test_a_missing_file_is_named(tmp_path: Path, file: str) -> None:
    folder = triposr_folder(tmp_path)
    (folder / file).unlink()
    for use in (networks.ensure, networks.weight_digests, networks.load_model):
        with pytest.raises(ModelMissingError, match="there is none; correct the path") as caught:
            use(f"triposr@{folder}")
        assert str(folder / file) in str(caught.value)


@pytest.mark.parametrize("file", ["encoder.onnx", "field.onnx", "encoder.onnx.data", "field.onnx_data"])
def test_every_file_is_part_of_the_digest(tmp_path: Path, file: str) -> None:
    folder = triposr_folder(tmp_path / "a")
    for data in ("encoder.onnx.data", "field.onnx_data"):
        (folder / data).write_bytes(b"weights")
    before = networks.weight_digests(f"triposr@{folder}")
    moved = folder.rename(tmp_path / "b")
    assert networks.weight_digests(f"triposr@{moved}") == before, "places do not count"
    (moved / file).write_bytes(b"other")
    assert list(before) == ["triposr"]
    assert networks.weight_digests(f"triposr@{moved}") != before


# The surface of a field.


def field_of(distance: np.ndarray, steepness: float = 40.0) -> np.ndarray:
    """Density of an object by the depth below its surface; 0 or more everywhere."""
    return 25.0 * np.exp(np.clip(steepness * distance, -60, 60))


def samples(count: int = 64) -> np.ndarray:
    axis = np.linspace(-RADIUS, RADIUS, count)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)


def ball(radius: float, center: tuple[float, float, float] = (0.0, 0.0, 0.0), count: int = 64) -> np.ndarray:
    """Depth below a ball's surface."""
    return radius - np.linalg.norm(samples(count) - center, axis=-1)


@pytest.mark.parametrize("steepness", [5.0, 40.0, 1000.0])
def test_the_surface_is_where_the_density_is_25(steepness: float) -> None:
    """However abruptly it falls, with no sides taken: the mean distance is off by a tenth of a sample's at most."""
    spacing = 2 * RADIUS / 63
    vertices, faces = surface(field_of(ball(0.5), steepness), MOST)
    closed(vertices, faces)
    radius = np.linalg.norm(vertices, axis=1)
    assert radius.mean() == pytest.approx(0.5, abs=0.1 * spacing)
    np.testing.assert_allclose(radius, 0.5, atol=0.02 * spacing if steepness == 5.0 else 0.6 * spacing)


def test_hollows_are_filled_and_specks_left_out() -> None:
    """A shell with a speck in it and one beside it is a ball; a second object of a tenth of its size stays."""
    shell = np.minimum(ball(0.5), -ball(0.4))
    specks = np.maximum(ball(0.04), ball(0.05, (0.7, 0.7, 0.7)))
    mesh = closed(*surface(field_of(np.maximum(shell, specks)), MOST))
    assert mesh.body_count == 1
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.5**3, rel=0.01)
    second = closed(*surface(field_of(np.maximum(shell, ball(0.25, (0.6, 0.6, 0.6)))), MOST))
    assert second.body_count == 2


def test_a_thing_that_fills_the_cube_is_closed_at_its_border() -> None:
    half = closed(*surface(field_of(-samples(32)[..., 0]), MOST))
    assert half.volume == pytest.approx(0.5 * (2 * RADIUS) ** 3, rel=0.01)
    assert np.abs(half.bounds).max() == pytest.approx(RADIUS)
    assert half.bounds[1, 0] == pytest.approx(0.0, abs=1e-6)
    whole = closed(*surface(np.full((24, 24, 24), 1e4), MOST))
    assert whole.volume == pytest.approx((2 * RADIUS) ** 3, rel=0.01)


def test_samples_on_the_surface_do_not_tear_it() -> None:
    density = np.where(np.abs(samples(32)).max(-1) < 0.4, 25.0, 0.0)
    mesh = closed(*surface(density, MOST))
    assert mesh.body_count == 1
    assert mesh.area_faces.min() > 0


@pytest.mark.parametrize("max_faces", [200, 2000])
def test_the_limit_of_faces_is_kept(max_faces: int) -> None:
    vertices, faces = surface(field_of(ball(0.5)), max_faces)
    closed(vertices, faces)
    assert 0.5 * max_faces < len(faces) <= max_faces


@pytest.mark.parametrize("seed", [0, 7])
def test_a_ragged_field_is_closed_within_the_limit_of_faces(seed: int) -> None:
    """Noise, which marching cubes leave open and no simplification brings below the limit."""
    noise = np.random.default_rng(seed).normal(size=(28, 28, 28))
    vertices, faces = surface(25.0 * np.exp(noise), 3000)
    assert len(faces) <= 3000
    closed(vertices, faces)
    assert np.abs(vertices).max() <= RADIUS
