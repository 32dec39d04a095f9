"""The room network as an ONNX file with weights in half precision."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from video2anim.lab.onnx_export import write_onnx
from video2anim.lab.scene_network.network import RoomNetwork, normalized_convolutions
from video2anim.networks.room_net import INPUT, OUTPUTS

_MIN_VALUES = 256
"""Smaller tensors stay in single precision."""


def export_onnx(network: RoomNetwork, path: Path) -> None:
    """Write the network with dynamic image size. Weights are stored in half precision; computation is in single."""
    network = _folded(copy.deepcopy(network).cpu().eval())
    free = {name: {2: f"{name}_rows", 3: f"{name}_columns"} for name in (INPUT, *OUTPUTS)}
    write_onnx(network, torch.zeros(1, 3, 96, 128), path, names=(INPUT, tuple(OUTPUTS)), free=free)
    onnx.save(halved(onnx.load(str(path))), str(path))


def halved(model: onnx.ModelProto) -> onnx.ModelProto:
    """The network with large weights stored as float16 and cast to float32 before use."""
    graph, casts = model.graph, []
    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < _MIN_VALUES:
            continue
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
        casts.append(helper.make_node("Cast", [f"{name}.half"], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    return model


def _folded(network: RoomNetwork) -> RoomNetwork:
    """A copy with batch normalization folded into the preceding convolutions."""
    for _, sequence, number in normalized_convolutions(network):
        convolution, norm = sequence[number], sequence[number + 1]
        assert isinstance(convolution, nn.Conv2d)
        assert isinstance(norm, nn.BatchNorm2d)
        sequence[number] = nn.utils.fuse_conv_bn_eval(convolution, norm)
        sequence[number + 1] = nn.Identity()
    return network
