"""The adapter against a tiny graph of the same contract, and its numbers against hand computation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from video2anim import networks
from video2anim.errors import ModelMissingError
from video2anim.networks.depth_anything import DepthAnything, DepthAnythingMetric, input_size, to_pixel_values

RED_MEAN, RED_STD = 0.485, 0.229


def _red_channel_graph(path: Path, *, output: str = "predicted_depth") -> Path:
    """A network whose 'disparity' is the normalized red channel."""
    pixels = helper.make_tensor_value_info("pixel_values", TensorProto.FLOAT, [1, 3, "h", "w"])
    depth = helper.make_tensor_value_info(output, TensorProto.FLOAT, [1, "h", "w"])
    index = helper.make_tensor("zero", TensorProto.INT64, [], [0])
    graph = helper.make_graph(
        [helper.make_node("Gather", ["pixel_values", "zero"], [output], axis=1)],
        "tiny",
        [pixels],
        [depth],
        [index],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize(
    ("height", "width", "wanted"),
    [
        (518, 518, (518, 518)),
        (1080, 1920, (518, 924)),
        (1920, 1080, (924, 518)),
        (240, 320, (518, 686)),
    ],
)
def test_input_size_keeps_ratio_in_patches(height: int, width: int, wanted: tuple[int, int]) -> None:
    assert input_size(height, width) == wanted
    assert all(side % 14 == 0 for side in input_size(height, width))


def test_pixel_values_by_hand() -> None:
    image = np.zeros((28, 28, 3), np.uint8)
    image[...] = (255, 0, 127)
    values = to_pixel_values(image, 14, 14)
    assert values.shape == (1, 3, 14, 14)
    assert values.dtype == np.float32
    expected = [(1.0 - 0.485) / 0.229, (0.0 - 0.456) / 0.224, (127 / 255 - 0.406) / 0.225]
    np.testing.assert_allclose(values[0, :, 3, 5], expected, rtol=1e-5)


def test_infer_returns_the_networks_values_at_picture_size(tmp_path: Path) -> None:
    net = DepthAnything(_red_channel_graph(tmp_path / "tiny.onnx"), short_side_px=28)
    image = np.zeros((40, 60, 3), np.uint8)
    image[:, 30:, 0] = 204
    disparity = net.infer(image)
    assert disparity.shape == (40, 60)
    assert disparity.dtype == np.float32
    np.testing.assert_allclose(disparity[:, :20], (0.0 - RED_MEAN) / RED_STD, atol=1e-5)
    np.testing.assert_allclose(disparity[:, 40:], (0.8 - RED_MEAN) / RED_STD, atol=1e-5)


def test_another_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelMissingError, match=r"want tensors .*predicted_depth.* got .*depth_map"):
        DepthAnything(_red_channel_graph(tmp_path / "other.onnx", output="depth_map"))


@pytest.mark.parametrize("fault", ["nothing", "text", "no room"])
def test_what_gives_no_numbers_is_refused(tmp_path: Path, fault: str) -> None:
    given = np.array([[["a", "b"]]], object) if fault == "text" else np.zeros((1, 0, 5), np.float32)
    kind = TensorProto.STRING if fault == "text" else TensorProto.FLOAT
    graph = helper.make_graph(
        [helper.make_node("Constant", [], ["predicted_depth"], value=onnx.numpy_helper.from_array(given))],
        "odd",
        [
            helper.make_tensor_value_info(
                "pixel_values", TensorProto.FLOAT, [1, 3, *([0, 14] if fault == "no room" else "HW")]
            )
        ],
        [helper.make_tensor_value_info("predicted_depth", kind, given.shape)],
    )
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), tmp_path / "odd.onnx"
    )
    with pytest.raises(ModelMissingError, match=r"odd\.onnx: want (numbers in predicted_depth|a network that takes)"):
        DepthAnything(tmp_path / "odd.onnx").infer(np.zeros((20, 30, 3), np.uint8))


def test_garbage_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "garbage.onnx"
    path.write_bytes(b"not a network")
    with pytest.raises(ModelMissingError, match="cannot load") as caught:
        DepthAnything(path)
    assert "\n" not in str(caught.value)


def test_metric_values_are_metres_and_nothing_else_is(tmp_path: Path) -> None:
    """The same tensors; a normalized red of 0.8 is 1.4 m here, of 0 a negative number, which is no depth."""
    net = DepthAnythingMetric(_red_channel_graph(tmp_path / "tiny.onnx"), short_side_px=28)
    assert (net.kind, net.name) == ("metric", "depth-anything-v2-metric-indoor-small")
    assert DepthAnything.kind == "disparity"
    image = np.zeros((40, 60, 3), np.uint8)
    image[:, 30:, 0] = 204
    depth_m = net.infer(image)
    assert depth_m.dtype == np.float32
    assert np.isnan(depth_m[:, :20]).all()
    np.testing.assert_allclose(depth_m[:, 40:], (0.8 - RED_MEAN) / RED_STD, atol=1e-5)


def test_table_loads_the_metric_variant_of_the_users_own(tmp_path: Path) -> None:
    path = _red_channel_graph(tmp_path / "mine.onnx")
    assert isinstance(networks.load_model(f"depth-anything-v2-metric-indoor-small@{path}"), DepthAnythingMetric)
    assert type(networks.load_model(f"depth-anything-v2-small@{path}")) is DepthAnything
