"""Networks of a few nodes that stand for TripoSR and for a completer; tests of adapters and of stages share them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

CENTER = (0.2, -0.1, 0.05)
"""Of the ball, in TripoSR's frame: nearer to the viewer than the middle, to the left, and higher."""
STEEPNESS = 40.0
RADIUS_OF_RED = 0.4
"""The ball's radius over the mean red of the picture that the encoder is shown."""


def save(path: Path, nodes: list, inputs: dict, outputs: dict, constants: dict[str, np.ndarray]) -> Path:
    """Write a network of float32 tensors, but for constants of whole numbers."""

    def infos(shapes: dict) -> list[onnx.ValueInfoProto]:
        return [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()]

    stored = [
        numpy_helper.from_array(np.asarray(v, np.int64 if np.asarray(v).dtype.kind == "i" else np.float32), name)
        for name, v in constants.items()
    ]
    graph = helper.make_graph(nodes, "tiny", infos(inputs), infos(outputs), stored)
    path.parent.mkdir(exist_ok=True)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), str(path))
    return path


def triposr_folder(
    folder: Path,
    *,
    radius: float | None = None,
    density_gain: float = 1.0,
    color_gain: float = 1.0,
    codes: tuple[int, ...] = (1, 3, 40, 64, 64),
) -> Path:
    """A TripoSR whose object is a ball around `CENTER`, as large as the picture is red or of the radius given.

    The scene codes are the picture's mean colors, a plane each. Density is 25 on the ball's surface, times the gain;
    color is 0.5 + 0.5 (x, y, z) in TripoSR's frame, times its gain.
    """
    save(
        folder / "encoder.onnx",
        [
            helper.make_node("GlobalAveragePool", ["image"], ["mean"]),
            helper.make_node("Reshape", ["mean", "planes"], ["plane"]),
            helper.make_node("Expand", ["plane", "shape"], ["scene_codes"]),
        ],
        {"image": [1, 3, 512, 512]},
        {"scene_codes": list(codes)},
        {"planes": np.array([1, 3, 1, 1, 1]), "shape": np.array(codes)},
    )
    save(
        folder / "field.onnx",
        [
            helper.make_node("Gather", ["scene_codes", "red"], ["red_plane"], axis=1),
            helper.make_node("ReduceMean", ["red_plane"], ["redness"], keepdims=0),
            helper.make_node("Mul", ["redness", "radius_of_red"], ["red_radius"]),
            helper.make_node("Add", ["red_radius", "given_radius"], ["radius"]),
            helper.make_node("Sub", ["points", "center"], ["offset"]),
            helper.make_node("Mul", ["offset", "offset"], ["squares"]),
            helper.make_node("ReduceSum", ["squares", "last"], ["square"], keepdims=1),
            helper.make_node("Sqrt", ["square"], ["distance"]),
            helper.make_node("Sub", ["radius", "distance"], ["depth"]),
            helper.make_node("Mul", ["depth", "steepness"], ["raw"]),
            helper.make_node("Exp", ["raw"], ["ratio"]),
            helper.make_node("Mul", ["ratio", "density_scale"], ["density"]),
            helper.make_node("Mul", ["points", "half"], ["half_points"]),
            helper.make_node("Add", ["half_points", "half"], ["unit"]),
            helper.make_node("Mul", ["unit", "color_gain"], ["color"]),
        ],
        {"scene_codes": list(codes), "points": [1, "n", 3]},
        {"density": [1, "n", 1], "color": [1, "n", 3]},
        {
            "red": np.array([0]),
            "last": np.array([-1]),
            "radius_of_red": np.array(RADIUS_OF_RED if radius is None else 0.0),
            "given_radius": np.array(radius or 0.0),
            "center": np.array([[CENTER]]),
            "steepness": np.array(STEEPNESS),
            "density_scale": np.array(25.0 * density_gain),
            "half": np.array(0.5),
            "color_gain": np.array(color_gain),
        },
    )
    return folder


def completer_file(path: Path, logits: np.ndarray, color: np.ndarray) -> Path:
    """A completer that says the same whatever it is shown.

    Args:
        path: Of the file.
        logits: (256, 256) or what stands for it.
        color: (256, 256, 3) in [0, 1] or what stands for it.
    """
    said = {"amodal": logits[None, None], "color": color.transpose(2, 0, 1)[None]}
    nodes = [
        helper.make_node("Constant", [], [name], value=numpy_helper.from_array(value.astype(np.float32)))
        for name, value in said.items()
    ]
    inputs = {"picture": [1, 3, 256, 256], "visible": [1, 1, 256, 256], "hidden": [1, 1, 256, 256]}
    return save(path, nodes, inputs, {name: list(value.shape) for name, value in said.items()}, {})
