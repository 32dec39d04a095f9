"""Weights that a network keeps in files beside it: they are part of it, wherever its exporter put them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from video2anim import networks
from video2anim.errors import ModelMissingError
from video2anim.networks.external_data import data_files
from video2anim.networks.network import Network
from video2anim.networks.onnx import open_session


def graph_with(path: Path, locations: list[str], *, output: str = "out") -> Path:
    """out = x + the weights of each location, four numbers."""
    tensors = []
    for number, location in enumerate(locations):
        tensor = numpy_helper.from_array(np.zeros(4, np.float32), f"w{number}")
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        for key, value in (("location", location), ("offset", "0"), ("length", "16")):
            entry = tensor.external_data.add()
            entry.key, entry.value = key, value
        tensors.append(tensor)
    names = ["x", *(tensor.name for tensor in tensors)]
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [4]) for name in ("x", output)]
    graph = helper.make_graph([helper.make_node("Sum", names, [output])], "g", values[:1], values[1:], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path.write_bytes(model.SerializeToString())
    return path


def weights(path: Path, value: float) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(np.full(4, value, np.float32).tobytes())
    return path


LONG = "/".join(["a folder of some length"] * 8) + "/w\u00e9ights"


@pytest.mark.parametrize("location", ["w.bin", "model.onnx_data", "sub/weights", LONG, "./w.bin"])
def test_weights_of_any_name_belong_to_the_digest(tmp_path: Path, location: str) -> None:
    """Those of the exporters' usual tails only were looked at: with others a result of other weights was kept."""
    data = weights(tmp_path / location, 1.0)
    path = graph_with(tmp_path / "model.onnx", [location])
    network = Network(path, inputs=("x",), outputs=("out",))
    np.testing.assert_array_equal(network.run({"x": np.zeros(4, np.float32)}, ["out"])["out"], np.ones(4))
    assert data_files(path) == (data,)
    before = networks.weight_digests(f"lifter@{path}")
    weights(data, 2.0)
    assert networks.weight_digests(f"lifter@{path}") != before


def test_a_file_that_no_graph_names_does_not_count(tmp_path: Path) -> None:
    weights(tmp_path / "w.bin", 1.0)
    path = graph_with(tmp_path / "model.onnx", ["w.bin"])
    before = networks.weight_digests(f"lifter@{path}")
    weights(tmp_path / "other.bin", 1.0)
    assert networks.weight_digests(f"lifter@{path}") == before


@pytest.mark.parametrize(
    "location", ["../out.bin", "sub/../../out.bin", "ABSOLUTE", "link.bin", "none.bin", "/dev/zero"]
)
def test_files_out_of_the_folder_are_neither_read_nor_looked_at(tmp_path: Path, location: str) -> None:
    outside = weights(tmp_path / "out.bin", 1.0)
    folder = tmp_path / "net"
    (folder / "sub").mkdir(parents=True)
    (folder / "link.bin").symlink_to(outside)
    path = graph_with(folder / "model.onnx", [location.replace("ABSOLUTE", str(outside))])
    with pytest.raises(ModelMissingError, match=r"cannot load it: .*xternal data") as caught:
        Network(path, inputs=("x",), outputs=("out",))
    assert str(caught.value).isprintable()
    if location != "link.bin":
        assert data_files(path) == ()
    assert set(networks.weight_digests(f"lifter@{path}")) == {"lifter"}


@pytest.mark.parametrize("name", [b"\0" * 8, b"w" * 3000, b"\xff\xfe.bin", b"a/" * 60 + b"w"])
def test_forged_names_are_no_files(tmp_path: Path, name: bytes) -> None:
    path = graph_with(tmp_path / "model.onnx", ["q" * len(name)])
    path.write_bytes(path.read_bytes().replace(b"q" * len(name), name))
    assert data_files(path) == ()
    with pytest.raises(ModelMissingError):
        Network(path, inputs=("x",), outputs=("out",))


@pytest.mark.parametrize("content", [b"", b"\x0a\x08location\x12", b"\x0a\x08location\x12\x7fshort", b"\x80" * 100])
def test_rubbish_names_none(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "model.onnx").write_bytes(content)
    assert data_files(tmp_path / "model.onnx") == ()


@pytest.mark.parametrize("output", [b"o\xff\xfe\xfd", b"\x1b[2Jo", b"o" * 100_000])
def test_forged_tensor_names_are_one_short_line(
    tmp_path: Path, output: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    """No text, a terminal's commands, and a flood; the runtime's own lines stay off the terminal."""
    weights(tmp_path / "w.bin", 1.0)
    path = graph_with(tmp_path / "model.onnx", ["w.bin"], output="Q" * len(output))
    path.write_bytes(path.read_bytes().replace(b"Q" * len(output), output))
    with pytest.raises(ModelMissingError, match=str(path)) as caught:
        Network(path, inputs=("x",), outputs=("out",))
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000
    assert capfd.readouterr() == ("", "")


def test_damaged_graphs_are_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Bytes changed, left out and put in."""
    rng = np.random.default_rng(0)
    weights(tmp_path / "w.bin", 1.0)
    whole = graph_with(tmp_path / "whole.onnx", ["w.bin"]).read_bytes()
    path, told = tmp_path / "model.onnx", []
    for _ in range(200):
        damaged, at = bytearray(whole), int(rng.integers(len(whole)))
        match rng.integers(3):
            case 0:
                damaged[at] = int(rng.integers(256))
            case 1:
                del damaged[at : at + int(rng.integers(1, 8))]
            case _:
                damaged[at:at] = rng.bytes(4)
        path.write_bytes(damaged)
        try:
            Network(path, inputs=("x",), outputs=("out",)).run({"x": np.zeros(4, np.float32)}, ["out"])
        except ModelMissingError as error:
            told.append(str(error))
    assert len(told) > 100
    assert not [text for text in told if "\n" in text or len(text) > 1000]
    assert capfd.readouterr() == ("", "")


def test_a_network_that_refuses_its_input_is_one_line(tmp_path: Path) -> None:
    """Its names fit, its sizes do not."""
    weights(tmp_path / "w.bin", 1.0)
    session = open_session(graph_with(tmp_path / "model.onnx", ["w.bin"]), inputs=("x",), outputs=("out",))
    with pytest.raises(ModelMissingError, match=r"model\.onnx: want a network of x \(5,\), it refuses: "):
        session.run(["out"], {"x": np.zeros(5, np.float32)})


def test_the_tests_graph_is_one(tmp_path: Path) -> None:
    weights(tmp_path / "w.bin", 1.0)
    onnx.checker.check_model(str(graph_with(tmp_path / "model.onnx", ["w.bin"])))
    assert onnxruntime.InferenceSession(str(tmp_path / "model.onnx"), providers=["CPUExecutionProvider"]).get_inputs()
