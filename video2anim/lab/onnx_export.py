"""Networks of torch as ONNX files."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

OPSET = 17
"""Version of the operators: the lowest that has layer normalization."""


def write_onnx(
    network: nn.Module, example: Tensor, path: Path, *, names: tuple[str, Sequence[str]],
    free: Mapping[str, Mapping[int, str]],
) -> None:  # fmt: skip
    """Trace a network of one input.

    Args:
        network: in evaluation mode.
        example: an input.
        path: file to write.
        names: of the input and of the outputs.
        free: names of axes of any length, by tensor.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        # The exporter over TorchScript is deprecated, but its successor needs packages that nothing else here does.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network, (example,), str(path), input_names=[names[0]], output_names=list(names[1]),
            dynamic_axes={name: dict(axes) for name, axes in free.items()}, opset_version=OPSET, dynamo=False,
        )  # fmt: skip
