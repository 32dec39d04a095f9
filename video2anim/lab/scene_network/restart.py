"""A network to train on, out of the ONNX file that an earlier training ended with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import torch
from jaxtyping import Float
from onnx import numpy_helper
from torch import Tensor, nn

from video2anim.errors import InputError
from video2anim.lab.scene_network.network import RoomNetwork, normalised_convolutions


def read_exported(path: Path) -> RoomNetwork:
    """The network of a file by `export_onnx`, in evaluation mode; it answers what the file answers.

    The file has batch normalization folded into the convolutions. Here they are apart again, the normalization adding
    the bias only: call `settle` before training.

    Raises:
        InputError: the file is of another network.
    """
    graph = onnx.load(str(path)).graph
    stored = {t.name.removesuffix(".half"): numpy_helper.to_array(t).astype(np.float32) for t in graph.initializer}
    # The exporter turns a linear layer's weight about and names it by a number; the product that uses it is named.
    for node in graph.node:
        if node.op_type == "MatMul" and node.input[1] in stored:
            layer = node.output[0].removesuffix("/MatMul_output_0").rpartition("/")
            parent = layer[0].rpartition("/")[2]
            stored[f"{parent}.{layer[2]}.weight"] = stored.pop(node.input[1]).T
    network = RoomNetwork().eval()
    for name, norm in _normalisations(network):
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
    """The mean of the weights of two exported networks, `share` of the second.

    Of a training and what it began with, the mean often keeps what either is better at (Wortsman et al. 2022).

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
def settle(network: RoomNetwork, pictures: Float[Tensor, "batch 3 height width"]) -> None:
    """Give batch normalization the statistics of some pictures, and the weights that keep every answer as it is.

    Training normalizes by the statistics of its batches: with those of `read_exported` its first step would see another
    network.
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

    for _, norm in _normalisations(network):
        follow(norm)
    network(pictures)
    for handle in handles:
        handle.remove()


def _normalisations(network: nn.Module) -> list[tuple[str, nn.BatchNorm2d]]:
    """Name of a convolution, and the batch normalization after it."""
    found = []
    for name, sequence, number in normalised_convolutions(network):
        norm = sequence[number + 1]
        assert isinstance(norm, nn.BatchNorm2d)
        found.append((name, norm))
    return found
