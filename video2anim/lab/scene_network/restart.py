"""Reads a network from the ONNX file of an earlier training, to continue training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import torch
from jaxtyping import Float
from onnx import numpy_helper
from torch import Tensor, nn

from video2anim.errors import InputError
from video2anim.lab.scene_network.network import RoomNetwork, normalized_convolutions


def read_exported(path: Path) -> RoomNetwork:
    """The network of a file written by `export_onnx`, in evaluation mode; its outputs are those of the file.

    Batch normalization is folded into the convolutions in the file. Here the layers are separate again, but the
    normalization only adds the bias: call `calibrate_normalization` before training.

    Raises:
        InputError: the file holds another network.
    """
    graph = onnx.load(str(path)).graph
    stored = {t.name.removesuffix(".half"): numpy_helper.to_array(t).astype(np.float32) for t in graph.initializer}
    # The exporter transposes the weight of a linear layer and gives it a number as name; its MatMul node has a name.
    for node in graph.node:
        if node.op_type == "MatMul" and node.input[1] in stored:
            layer = node.output[0].removesuffix("/MatMul_output_0").rpartition("/")
            parent = layer[0].rpartition("/")[2]
            stored[f"{parent}.{layer[2]}.weight"] = stored.pop(node.input[1]).T
    network = RoomNetwork().eval()
    for name, norm in _normalizations(network):
        if f"{name}.bias" not in stored:
            raise InputError(f"{path}: no weights of the room network, {name}.bias is missing; export one by training")
        bias = torch.from_numpy(stored.pop(f"{name}.bias"))
        norm.load_state_dict({
            "weight": torch.ones_like(bias), "bias": bias, "running_mean": torch.zeros_like(bias),
            "running_var": torch.full_like(bias, 1.0 - norm.eps), "num_batches_tracked": torch.tensor(0),
        })  # fmt: skip
    own = network.state_dict()
    for name, value in stored.items():
        if name not in own or own[name].shape != value.shape:
            want = tuple(own[name].shape) if name in own else "no such tensor"
            raise InputError(f"{path}: want {want} for {name}, got {value.shape}; was it exported by this version?")
        own[name].copy_(torch.from_numpy(np.ascontiguousarray(value)))
    return network


@torch.no_grad()
def averaged(first: RoomNetwork, second: RoomNetwork, share: float) -> RoomNetwork:
    """Weighted mean of the weights of two exported networks: (1 - share) of the first, share of the second.

    The mean of a fine-tuned network and its starting point often keeps the strengths of both (Wortsman et al. 2022).

    Raises:
        ValueError: a share outside 0 to 1.
    """
    if not 0 <= share <= 1:
        raise ValueError(f"averaged: want a share from 0 to 1, got {share:g}")
    network = RoomNetwork().eval()
    parts = zip(network.state_dict().values(), first.state_dict().values(), second.state_dict().values(), strict=True)
    for mean, one, other in parts:
        mean.copy_((1 - share) * one + share * other if mean.dtype.is_floating_point else other)
    return network


@torch.no_grad()
def calibrate_normalization(network: RoomNetwork, pictures: Float[Tensor, "batch 3 height width"]) -> None:
    """Set the statistics of batch normalization from some images, and its weights so that no output changes.

    Training normalizes by the statistics of its batches. Without this call the first step after `read_exported` would
    run a different network.
    """
    network.eval()
    handles = []

    def follow(norm: nn.BatchNorm2d) -> None:
        def hook(layer: nn.Module, inputs: tuple[Tensor, ...], answer: Tensor) -> None:
            variance, mean = torch.var_mean(inputs[0], (0, 2, 3), unbiased=False)
            now = norm.state_dict()
            scale = now["weight"] / torch.sqrt(now["running_var"] + norm.eps)
            offset = now["bias"] - scale * now["running_mean"]
            weight = scale * torch.sqrt(variance + norm.eps)
            settled = {"weight": weight, "bias": offset + scale * mean, "running_mean": mean, "running_var": variance}
            norm.load_state_dict(now | settled)

        handles.append(norm.register_forward_hook(hook))

    for _, norm in _normalizations(network):
        follow(norm)
    network(pictures)
    for handle in handles:
        handle.remove()


def _normalizations(network: nn.Module) -> list[tuple[str, nn.BatchNorm2d]]:
    """Name of each convolution and the batch normalization after it."""
    found = []
    for name, sequence, number in normalized_convolutions(network):
        norm = sequence[number + 1]
        assert isinstance(norm, nn.BatchNorm2d)
        found.append((name, norm))
    return found
