"""Files that are no network, or one that gives no numbers, are refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper
from tiny_graphs import save

from video2anim.errors import ModelMissingError
from video2anim.networks.onnx import open_session


@pytest.mark.parametrize("fault", ["nothing", "text", "no room"])
def test_what_gives_no_numbers_is_refused(tmp_path: Path, fault: str) -> None:
    given = np.array([[["a", "b"]]], object) if fault == "text" else np.zeros((1, 0, 5), np.float32)
    kind = TensorProto.STRING if fault == "text" else TensorProto.FLOAT
    size = [0, 14] if fault == "no room" else ["h", "w"]
    graph = helper.make_graph(
        [helper.make_node("Constant", [], ["out"], value=numpy_helper.from_array(given))],
        "odd",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, *size])],
        [helper.make_tensor_value_info("out", kind, given.shape)],
    )
    path = save(graph, tmp_path / "odd.onnx")
    with pytest.raises(ModelMissingError, match=r"odd\.onnx: want (numbers in out|a network that takes)"):
        open_session(path, inputs=("x",), outputs=("out",)).run(["out"], {"x": np.zeros((1, 3, 14, 14), np.float32)})


def test_garbage_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "garbage.onnx"
    path.write_bytes(b"not a network")
    with pytest.raises(ModelMissingError, match="cannot load") as caught:
        open_session(path, inputs=("x",), outputs=("out",))
    assert "\n" not in str(caught.value)
