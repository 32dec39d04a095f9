"""The exported room network says what the trained one says, at any size, in a small file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from video2anim.lab.scene_network.export import export_onnx, halved
from video2anim.lab.scene_network.network import RoomAnswer, RoomNetwork
from video2anim.networks.room_net import OUTPUTS, SceneNetwork

SIZES = ((64, 96), (96, 64), (128, 128), (160, 288))


def picture(height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Blotches of color."""
    rng = torch.Generator().manual_seed(seed)
    coarse = 255 * torch.rand(1, 3, height // 16, width // 16, generator=rng)
    return torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")


def settled() -> RoomNetwork:
    """An untrained network whose batch statistics are unlike those it begins with."""
    torch.manual_seed(0)
    network = RoomNetwork()
    rng = torch.Generator().manual_seed(1)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            for values, low, high in ((module.weight, 0.7, 1.3), (module.running_var, 0.5, 2.0)):
                assert values is not None
                values.data.copy_(low + (high - low) * torch.rand(values.shape, generator=rng))
            for values in (module.bias, module.running_mean):
                assert values is not None
                values.data.copy_(0.2 * torch.randn(values.shape, generator=rng))
    return network.eval()


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[tuple[int, int], RoomAnswer], int]:
    """File, the network's answers before the export, and its number of weights."""
    network = settled()
    with torch.no_grad():
        answers = {size: network(picture(*size)) for size in SIZES}
    count = sum(weight.numel() for weight in network.parameters())
    path = tmp_path_factory.mktemp("export") / "deep" / "room.onnx"
    export_onnx(network, path)
    return path, answers, count


@pytest.mark.parametrize("size", SIZES)
def test_the_file_says_what_the_network_says(
    exported: tuple[Path, dict[tuple[int, int], RoomAnswer], int], size: tuple[int, int]
) -> None:
    path, answers, _ = exported
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    found = session.run(list(OUTPUTS), {"picture": picture(*size).numpy()})
    for name, value, wanted in zip(OUTPUTS, map(np.asarray, found), answers[size], strict=True):
        assert value.shape == wanted.shape
        assert value.dtype == np.float32
        assert float(wanted.std()) > 1e-3, "the answer depends on the place, so that agreement means something"
        scale = max(1.0, float(wanted.abs().max()))
        np.testing.assert_allclose(value, wanted.numpy(), atol=1e-2 * scale, err_msg=name)


def test_the_file_is_one_of_half_precision(
    exported: tuple[Path, dict[tuple[int, int], RoomAnswer], int],
) -> None:
    path, _, count = exported
    assert 5e6 < count < 2e7
    assert path.stat().st_size < 1.1 * 2 * count
    assert [file.name for file in path.parent.iterdir()] == ["room.onnx"], "one file, nothing beside it"
    onnx.checker.check_model(str(path))


def test_the_adapter_takes_the_file(exported: tuple[Path, dict[tuple[int, int], RoomAnswer], int]) -> None:
    """Names, shapes and ranges are those of the contract; one of the two views is the network's own answer."""
    image = picture(192, 256)[0].numpy().transpose(1, 2, 0).astype(np.uint8)
    view = SceneNetwork(exported[0]).predict(image)
    assert view.disparity.shape == (96, 128)
    assert view.class_logits.shape == (96, 128, 6)
    assert view.field.latitude_rad.shape == (24, 32)
    tall = SceneNetwork(exported[0]).predict(np.ascontiguousarray(image.transpose(1, 0, 2)))
    assert tall.disparity.shape == (128, 96)
    for values in (view.disparity, view.normal_camera, view.field.up, view.instances.offset):
        assert np.isfinite(values).all()


def test_the_network_is_left_as_it_was(tmp_path: Path) -> None:
    """Training may go on after an export, and its checkpoints fit."""
    network = settled()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    export_onnx(network, tmp_path / "room.onnx")
    after = network.state_dict()
    assert set(after) == set(before)
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, rtol=0, atol=0)


def test_large_weights_alone_are_halved(tmp_path: Path) -> None:
    """A sum of a large and a small tensor: the large one is rounded to half precision, the small one is not."""
    large, small = np.linspace(0.1, 1.0, 256, dtype=np.float32), np.array([0.1], np.float32)
    graph = helper.make_graph(
        [helper.make_node("Add", ["x", "large"], ["both"]), helper.make_node("Add", ["both", "small"], ["y"])],
        "tiny",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [256])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [256])],
        [numpy_helper.from_array(large, "large"), numpy_helper.from_array(small, "small")],
    )
    model = halved(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9))
    onnx.checker.check_model(model)
    types = {tensor.name.split(".")[0]: tensor.data_type for tensor in model.graph.initializer}
    assert types == {"large": TensorProto.FLOAT16, "small": TensorProto.FLOAT}
    onnx.save(model, str(tmp_path / "t.onnx"))
    session = onnxruntime.InferenceSession(str(tmp_path / "t.onnx"), providers=["CPUExecutionProvider"])
    (found,) = session.run(["y"], {"x": np.zeros(256, np.float32)})
    np.testing.assert_allclose(np.asarray(found), large.astype(np.float16).astype(np.float32) + small, rtol=1e-6)
