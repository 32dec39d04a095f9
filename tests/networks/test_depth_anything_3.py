"""Depth Anything 3's adapter against tiny graphs of its contract."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from tiny_graphs import constant_graph, save

from video2anim import networks
from video2anim.errors import ModelMissingError
from video2anim.networks.depth_anything_3 import DepthAnything3, input_size

INTRINSICS = np.array([[70.0, 0, 42], [0, 60.0, 28], [0, 0, 1]])


def outputs(**changed: np.ndarray) -> dict[str, np.ndarray]:
    found = {
        "predicted_depth": np.tile(np.linspace(1.0, 3.0, 84), (1, 1, 56, 1)),
        "confidence": np.full((1, 1, 56, 84), 7.0),
        "extrinsics": np.zeros((1, 1, 3, 4)),
        "intrinsics": INTRINSICS[None, None],
    }
    return found | changed


def net(path: Path, found: dict[str, np.ndarray]) -> DepthAnything3:
    return DepthAnything3(constant_graph(path / "t.onnx", inputs={"pixel_values": [1, 1, 3, 56, 84]}, outputs=found))


def red_graph(path: Path, views: list) -> Path:
    """A network of any size whose 'depth' is the normalized red channel plus 3."""
    channels = len(views) + 1
    nodes = [
        helper.make_node("Gather", ["pixel_values", "red"], ["plain"], axis=channels),
        helper.make_node("Add", ["plain", "three"], ["predicted_depth"]),
    ]
    picture = helper.make_tensor_value_info("pixel_values", TensorProto.FLOAT, [1, *views, 3, "h", "w"])
    depth = helper.make_tensor_value_info("predicted_depth", TensorProto.FLOAT, [1, *views, "h", "w"])
    constants = [
        helper.make_tensor("red", TensorProto.INT64, [], [0]),
        helper.make_tensor("three", TensorProto.FLOAT, [], [3.0]),
    ]
    return save(helper.make_graph(nodes, "red", [picture], [depth], constants), path)


@pytest.mark.parametrize("views", [["images"], [1], []], ids=["any views", "one view", "no axis of views"])
def test_depth_is_the_networks_at_picture_size(tmp_path: Path, views: list) -> None:
    model = DepthAnything3(red_graph(tmp_path / "red.onnx", views), long_side_px=84)
    image = np.zeros((40, 60, 3), np.uint8)
    image[:, 30:, 0] = 204
    found = model.infer_all(image)
    assert (model.kind, model.name) == ("depth", "depth-anything-3-small")
    assert found.depth.shape == (40, 60)
    assert found.depth.dtype == np.float32
    np.testing.assert_allclose(found.depth[:, :25], 3 - 0.485 / 0.229, atol=1e-4)
    np.testing.assert_allclose(found.depth[:, 35:], 3 + (0.8 - 0.485) / 0.229, atol=1e-4)
    assert found.confidence is None
    assert math.isnan(found.focal_px)
    np.testing.assert_array_equal(model.infer(image), found.depth)


def test_confidence_and_focal_length(tmp_path: Path) -> None:
    """The input is 84 x 56; the picture is 4 times as wide and 5 times as high, so the lens is in other pixels."""
    model = net(tmp_path, outputs())
    image = np.zeros((280, 336, 3), np.uint8)
    found = model.infer_all(image)
    assert found.confidence is not None
    np.testing.assert_allclose(found.confidence, 7.0)
    assert found.depth.shape == found.confidence.shape == (280, 336)
    assert found.focal_px == pytest.approx(0.5 * (70 * 4 + 60 * 5))
    assert model.focal_px(image) == found.focal_px
    # Column x of the picture is (x + 0.5) / 4 - 0.5 of the map, whose 84 columns rise by 2 / 83 each.
    np.testing.assert_allclose(found.depth[9, 101], 1 + (101.5 / 4 - 0.5) * 2 / 83, rtol=1e-5)


@pytest.mark.parametrize("lens", [np.zeros((3, 3)), np.full((3, 3), np.nan), -INTRINSICS])
def test_a_senseless_lens_is_unknown(tmp_path: Path, lens: np.ndarray) -> None:
    assert math.isnan(net(tmp_path, outputs(intrinsics=lens[None, None])).focal_px(np.zeros((56, 84, 3), np.uint8)))


def test_what_is_no_depth_is_nan(tmp_path: Path) -> None:
    depth = outputs()["predicted_depth"].copy()
    depth[..., 0, 0], depth[..., 1, 0], depth[..., 2, 0] = 0.0, np.inf, -1.0
    found = net(tmp_path, outputs(predicted_depth=depth)).infer(np.zeros((56, 84, 3), np.uint8))
    np.testing.assert_array_equal(np.isnan(found[:4, 0]), [True, True, True, False])


@pytest.mark.parametrize(
    ("size", "wanted"), [((1080, 1920), (280, 504)), ((1920, 1080), (504, 280)), ((10, 500), (14, 504))]
)
def test_input_size_brings_the_longer_side_to_504(size: tuple[int, int], wanted: tuple[int, int]) -> None:
    assert input_size(*size) == wanted


def test_other_networks_are_refused_in_one_line(tmp_path: Path) -> None:
    depth = {"depth": np.ones((1, 1, 56, 84))}
    with pytest.raises(ModelMissingError, match=r"want tensors .*predicted_depth.* got .*\('depth',\)"):
        net(tmp_path, depth)
    image = np.zeros((56, 84, 3), np.uint8)
    with pytest.raises(ModelMissingError, match=r"want predicted_depth \(1, 1, \*, \*\), got \(1, 56, 84\)") as caught:
        net(tmp_path, outputs(predicted_depth=np.ones((1, 56, 84)))).infer(image)
    assert "\n" not in str(caught.value)


def test_an_input_of_another_rank_is_refused_in_one_line(tmp_path: Path) -> None:
    """Four axes where the network says five inside: the runtime's complaint becomes one line."""
    picture = helper.make_tensor_value_info("pixel_values", TensorProto.FLOAT, [1, 3, "h", "w", 2])
    depth = helper.make_tensor_value_info("predicted_depth", TensorProto.FLOAT, [1, 3, "h", "w", 2])
    graph = helper.make_graph(
        [helper.make_node("Identity", ["pixel_values"], ["predicted_depth"])], "odd", [picture], [depth]
    )
    with pytest.raises(ModelMissingError, match=r"want a network of pixel_values .* it refuses") as caught:
        DepthAnything3(save(graph, tmp_path / "odd.onnx")).infer(np.zeros((56, 84, 3), np.uint8))
    assert "\n" not in str(caught.value)


def test_weights_beside_the_graph_are_found_and_belong_to_the_digest(tmp_path: Path) -> None:
    """The published file is such a pair."""
    whole = onnx.load(str(red_graph(tmp_path / "whole.onnx", ["images"])))
    bias = onnx.numpy_helper.from_array(np.full((1, 1, 1, 2000), 3.0, np.float32), "three")
    whole.graph.initializer[1].CopyFrom(bias)
    path = tmp_path / "model.onnx"
    onnx.save(whole, str(path), save_as_external_data=True, location="model.onnx_data", size_threshold=10)
    data = tmp_path / "model.onnx_data"
    assert data.stat().st_size >= 8000
    assert isinstance(networks.load_model(f"depth-anything-3-small@{path}"), DepthAnything3)
    before = networks.weight_digests(f"depth-anything-3-small@{path}")
    data.write_bytes(data.read_bytes()[::-1])
    assert networks.weight_digests(f"depth-anything-3-small@{path}") != before
    data.unlink()
    with pytest.raises(ModelMissingError, match="cannot load"):
        networks.load_model(f"depth-anything-3-small@{path}")
