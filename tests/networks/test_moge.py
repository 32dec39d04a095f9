"""MoGe-2's adapter against tiny graphs: the focal length and shift of a known camera are recovered."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper
from tiny_graphs import constant_graph, save

from video2anim import networks
from video2anim.errors import ModelMissingError
from video2anim.networks.moge import Moge, focal_and_shift, input_size

HEIGHT, WIDTH = 48, 64
FOCAL_PX = 55.0
IMAGE = np.zeros((HEIGHT, WIDTH, 3), np.uint8)


def slope_m() -> np.ndarray:
    """A room: floor-like depths from 2 to 5 m."""
    return np.broadcast_to(np.linspace(5.0, 2.0, HEIGHT)[:, None], (HEIGHT, WIDTH)).copy()


def point_map(depth: np.ndarray, focal_px: float = FOCAL_PX) -> np.ndarray:
    """Points whose pixels are exact for a pinhole with its principal point in the middle of the picture."""
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width) - 0.5 * (width - 1), np.arange(height) - 0.5 * (height - 1))
    return np.stack([u * depth / focal_px, v * depth / focal_px, depth], axis=-1)


def outputs(*, unit: float = 2.5, shift: float = 0.7, scale_name: str = "scale", **changed: np.ndarray) -> dict:
    """What the network says of the room: in its own unit, moved along z by minus the shift."""
    points = point_map(slope_m()) / unit
    points[..., 2] -= shift
    normal = np.broadcast_to([0.0, 0.6, -0.8], points.shape)
    found = {"points": points[None], "normal": normal[None], "mask": np.ones((1, HEIGHT, WIDTH))}
    return found | {scale_name: np.array([unit])} | changed


def net(path: Path, inputs: dict | None = None, **changed: Any) -> Moge:
    shapes = inputs or {"image": [1, 3, HEIGHT, WIDTH]}
    return Moge(constant_graph(path / "tiny.onnx", inputs=shapes, outputs=outputs(**changed)))


@pytest.mark.parametrize("scale", ["scale", "metric_scale"])
def test_metric_depth_focal_length_and_normals(tmp_path: Path, scale: str) -> None:
    found = net(tmp_path, scale_name=scale).infer_all(IMAGE)
    assert found.focal_px == pytest.approx(FOCAL_PX, rel=1e-4)
    np.testing.assert_allclose(found.depth_m, slope_m(), rtol=1e-3)
    assert found.depth_m.dtype == np.float32
    assert found.valid.all()
    assert found.normal_camera is not None
    np.testing.assert_allclose(found.normal_camera[10, 20], [0.0, 0.6, -0.8], atol=1e-5)


def test_slot_depth_and_slot_camera(tmp_path: Path) -> None:
    model = net(tmp_path)
    assert (model.kind, model.name) == ("metric", "moge-2-small")
    np.testing.assert_allclose(model.infer(IMAGE), slope_m(), rtol=1e-3)
    assert model.focal_px(IMAGE) == pytest.approx(FOCAL_PX, rel=1e-4)


def test_a_larger_picture_has_a_longer_focal_length(tmp_path: Path) -> None:
    found = net(tmp_path).infer_all(np.zeros((3 * HEIGHT, 3 * WIDTH, 3), np.uint8))
    assert found.focal_px == pytest.approx(3 * FOCAL_PX, rel=1e-4)
    assert found.depth_m.shape == found.valid.shape == (3 * HEIGHT, 3 * WIDTH)
    # Centres of the small pixels: row 1 of the map is row 4 of the picture.
    np.testing.assert_allclose(found.depth_m[4::3, 0], slope_m()[1:, 0], rtol=2e-3)


def test_pixels_without_geometry_are_nan(tmp_path: Path) -> None:
    mask = np.ones((1, HEIGHT, WIDTH))
    mask[:, :, 40:] = 0.2
    points = outputs()["points"].copy()
    points[:, 5, 3] = np.inf
    points[:, :, 40:] = 1e3  # senseless where there is no geometry: must not move the solution nor bleed over
    found = net(tmp_path, mask=mask, points=points).infer_all(IMAGE)
    assert found.focal_px == pytest.approx(FOCAL_PX, rel=1e-4)
    assert not found.valid[:, 40:].any()
    assert not found.valid[5, 3]
    assert found.valid.sum() == HEIGHT * 40 - 1
    np.testing.assert_array_equal(np.isnan(found.depth_m), ~found.valid)
    np.testing.assert_allclose(found.depth_m[found.valid], slope_m()[found.valid], rtol=1e-3)
    assert found.normal_camera is not None
    assert np.isnan(found.normal_camera[0, 50]).all()


@pytest.mark.parametrize("focal_px", [20.0, 55.0, 400.0])
@pytest.mark.parametrize("shift", [-1.5, 0.0, 4.0])
def test_focal_length_and_shift_of_any_lens(focal_px: float, shift: float) -> None:
    rng = np.random.default_rng(0)
    depth = slope_m() + rng.uniform(0, 0.5, (HEIGHT, WIDTH))
    points = point_map(depth, focal_px)
    points[..., 2] -= shift
    found = focal_and_shift(points, np.ones(depth.shape, bool))
    np.testing.assert_allclose(found, [focal_px, shift], rtol=1e-5, atol=1e-5)


def test_noise_is_averaged_out_in_the_picture() -> None:
    """The error that is made small lies in pixels: noise across the rays of a centimeter costs little focal length."""
    points = point_map(slope_m()) + np.random.default_rng(1).normal(0, 0.01, (HEIGHT, WIDTH, 3))
    focal_px, shift = focal_and_shift(points, np.ones((HEIGHT, WIDTH), bool))
    assert focal_px == pytest.approx(FOCAL_PX, rel=0.02)
    assert shift == pytest.approx(0.0, abs=0.1)


def test_far_points_count_by_their_pixels_not_by_their_metres() -> None:
    """Half of the picture is 60 times as far away and off by 5 % of its distance, which is few pixels."""
    rng = np.random.default_rng(3)
    depth = slope_m()
    depth[:, ::2] *= 60.0
    points = point_map(depth)
    points[..., 0] += 0.05 * depth * rng.normal(0, 1, depth.shape) * (depth > 20)
    focal_px, shift = focal_and_shift(points, np.ones(depth.shape, bool))
    assert focal_px == pytest.approx(FOCAL_PX, rel=0.02)
    assert shift == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(
    "points",
    [point_map(np.full((HEIGHT, WIDTH), 3.0)), np.zeros((HEIGHT, WIDTH, 3)), point_map(-slope_m())],
    ids=["a wall seen straight on", "nothing", "behind the camera"],
)
def test_what_no_lens_explains_is_unknown(tmp_path: Path, points: np.ndarray) -> None:
    assert np.isnan(focal_and_shift(points, np.ones((HEIGHT, WIDTH), bool))).all()
    found = net(tmp_path, points=points[None]).infer_all(IMAGE)
    assert math.isnan(found.focal_px)
    assert not found.valid.any()
    assert np.isnan(found.depth_m).all()


def test_too_few_points_are_no_lens() -> None:
    valid = np.zeros((HEIGHT, WIDTH), bool)
    valid[3, 4:6] = True
    assert np.isnan(focal_and_shift(point_map(slope_m()), valid)).all()


def echo_graph(path: Path) -> Path:
    """A network of any size: points are the picture's own values (red as x ..), mask 1, scale the tokens."""
    nodes = [
        helper.make_node("Transpose", ["image"], ["points"], perm=[0, 2, 3, 1]),
        helper.make_node("ReduceMax", ["image"], ["peak"], axes=[1], keepdims=0),
        helper.make_node("Mul", ["peak", "zero"], ["none"]),
        helper.make_node("Add", ["none", "one"], ["mask"]),
        helper.make_node("Cast", ["num_tokens"], ["tokens"], to=TensorProto.FLOAT),
        helper.make_node("Unsqueeze", ["tokens", "axis"], ["scale"]),
    ]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "h", "w"])
    tokens = helper.make_tensor_value_info("num_tokens", TensorProto.INT64, [])
    made = {"points": [1, "h", "w", 3], "mask": [1, "h", "w"], "scale": [1]}
    results = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in made.items()]
    constants = [
        helper.make_tensor("zero", TensorProto.FLOAT, [], [0.0]),
        helper.make_tensor("one", TensorProto.FLOAT, [], [1.0]),
        helper.make_tensor("axis", TensorProto.INT64, [1], [0]),
    ]
    graph = helper.make_graph(nodes, "echo", [image, tokens], results, constants)
    return save(graph, path)


def test_the_network_is_shown_plain_rgb_and_its_tokens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
    model = Moge(echo_graph(tmp_path / "echo.onnx"), tokens=1200)
    said: list[dict[str, np.ndarray]] = []
    run = model._network.run
    monkeypatch.setattr(model._network, "run", lambda *what: said.append(run(*what)) or said[-1])
    model.infer_all(image)
    np.testing.assert_allclose(said[0]["points"][0], image / 255, rtol=1e-6)
    assert said[0]["scale"] == 1200


@pytest.mark.parametrize(
    ("size", "wanted"),
    [((40, 60), (40, 60)), ((1080, 1920), (445, 792)), ((1920, 1080), (792, 445)), ((594, 594), (594, 594))],
)
def test_input_size_keeps_the_ratio_and_the_tokens(size: tuple[int, int], wanted: tuple[int, int]) -> None:
    assert input_size(*size) == wanted
    assert wanted[0] * wanted[1] <= 1.01 * 1800 * 14**2


def test_the_first_moge_has_no_metres(tmp_path: Path) -> None:
    found = {name: value for name, value in outputs().items() if name != "scale"}
    path = constant_graph(tmp_path / "old.onnx", inputs={"image": [1, 3, HEIGHT, WIDTH]}, outputs=found)
    with pytest.raises(ModelMissingError, match="want an output scale or metric_scale") as caught:
        Moge(path)
    assert "\n" not in str(caught.value)


def test_an_export_without_normals(tmp_path: Path) -> None:
    found = {name: value for name, value in outputs().items() if name != "normal"}
    path = constant_graph(tmp_path / "plain.onnx", inputs={"image": [1, 3, HEIGHT, WIDTH]}, outputs=found)
    assert Moge(path).infer_all(IMAGE).normal_camera is None


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"points": np.zeros((1, 3, HEIGHT, WIDTH))}, r"want points \(1, 48, 64, 3\), got \(1, 3, 48, 64\)"),
        ({"mask": np.ones((1, 1, HEIGHT, WIDTH))}, r"want mask \(1, 48, 64\), got"),
        ({"scale": np.ones(2)}, r"want scale \(1\), got \(2,\)"),
        ({"normal": np.ones((1, 3, HEIGHT, WIDTH))}, r"want normal \(1, 48, 64, 3\), got"),
    ],
)
def test_other_outputs_are_refused(tmp_path: Path, changed: dict, told: str) -> None:
    with pytest.raises(ModelMissingError, match=told) as caught:
        net(tmp_path, **changed).infer(IMAGE)
    assert "\n" not in str(caught.value)


def test_other_tensors_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelMissingError, match=r"want tensors \('image',\).* got \('pixels',\)"):
        net(tmp_path, inputs={"pixels": [1, 3, HEIGHT, WIDTH]})
    with pytest.raises(ModelMissingError, match=r"got \('image', 'depth_prior'\)"):
        net(tmp_path, inputs={"image": [1, 3, HEIGHT, WIDTH], "depth_prior": [1]})


def test_table_loads_the_users_file(tmp_path: Path) -> None:
    path = constant_graph(tmp_path / "m.onnx", inputs={"image": [1, 3, HEIGHT, WIDTH]}, outputs=outputs())
    found = networks.load_model(f"moge-2-small@{path}").infer(IMAGE)
    np.testing.assert_array_equal(found, Moge(path).infer(IMAGE))
