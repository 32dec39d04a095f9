"""The temporal lifter: a residual network of dilated convolutions over time (Pavllo et al. 2019 lift 2D poses so)."""

from __future__ import annotations

import warnings
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from video2anim.fitting.lifter_input import FEATURES, OUTPUTS

DILATIONS = (1, 3, 9, 1, 3, 9)
"""Each of a convolution over 3 frames: 26 frames are seen before and after."""
WIDTH = 256
ONNX_OPSET = 17


class _Block(nn.Module):
    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.across = nn.Conv1d(width, width, 3, padding=dilation, dilation=dilation)
        self.within = nn.Conv1d(width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.within(nn.functional.gelu(self.across(x)))


class LifterNetwork(nn.Module):
    """Features of frames -> rotations, place, contacts and up of each (`video2anim.fitting.lifter_input`)."""

    mean: Tensor
    deviation: Tensor
    base: Tensor

    def __init__(self, width: int = WIDTH) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("deviation", torch.ones(FEATURES))
        self.register_buffer("base", torch.zeros(OUTPUTS))
        self.enter = nn.Conv1d(FEATURES, width, 1)
        self.blocks = nn.ModuleList(_Block(width, dilation) for dilation in DILATIONS)
        self.leave = nn.Conv1d(width, OUTPUTS, 1)
        nn.init.zeros_(self.leave.bias)  # type: ignore[arg-type]

    def forward(self, features: Float[Tensor, "batch frames features"]) -> Float[Tensor, "batch frames outputs"]:
        """Answers around the middle one of the training data."""
        valid = features[..., -1:]
        x = ((features - self.mean) / self.deviation).clamp(-6.0, 6.0) * valid
        x = torch.cat([x[..., :-1], valid], -1)
        x = self.enter(x.transpose(1, 2))
        for block in self.blocks:
            x = block(x)
        return self.base + self.leave(x).transpose(1, 2)


def export_onnx(network: LifterNetwork, path: Path) -> None:
    """Write the network with free numbers of clips and frames."""
    network = network.eval()
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        # The exporter over TorchScript is deprecated, but its successor needs packages that nothing else here does.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network, (torch.zeros(1, 60, FEATURES),), str(path), input_names=["features"], output_names=["body"],
            dynamic_axes={"features": {0: "batch", 1: "frames"}, "body": {0: "batch", 1: "frames"}},
            opset_version=ONNX_OPSET, dynamo=False,
        )  # fmt: skip
