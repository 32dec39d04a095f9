"""The temporal lifter: a residual network of dilated convolutions over time (after Pavllo et al. 2019).

It works on groups of 4 frames. Motion changes little between neighbors, so the coarser time step costs a fraction and
has a larger receptive field.
"""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from video2anim.humans.lifter_input import FEATURES, OUTPUTS
from video2anim.lab.onnx_export import write_onnx

FOLD = 4
"""Number of frames that form one time step of the network."""
DILATIONS = (1, 3, 9, 1, 3)
"""Dilation of each convolution over 3 time steps."""
WIDTH = 384


class _Block(nn.Module):
    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.across = nn.Conv1d(width, width, 3, padding=dilation, dilation=dilation)
        self.within = nn.Conv1d(width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.within(nn.functional.gelu(self.across(x)))


class LifterNetwork(nn.Module):
    """Features of frames to rotations, position, contacts and up direction (`video2anim.humans.lifter_input`)."""

    mean: Tensor
    deviation: Tensor
    base: Tensor

    def __init__(self, width: int = WIDTH) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("deviation", torch.ones(FEATURES))
        self.register_buffer("base", torch.zeros(OUTPUTS))
        self.enter = nn.Conv1d(FOLD * FEATURES, width, 1)
        self.blocks = nn.ModuleList(_Block(width, dilation) for dilation in DILATIONS)
        self.leave = nn.Conv1d(width, FOLD * OUTPUTS, 1)
        nn.init.zeros_(self.leave.bias)  # type: ignore[arg-type]

    def forward(self, features: Float[Tensor, "batch frames features"]) -> Float[Tensor, "batch frames outputs"]:
        """Outputs of each frame; the mean output of the training data (`base`) is added."""
        batch, frames = features.shape[:2]
        valid = features[..., -1:]
        x = ((features - self.mean) / self.deviation).clamp(-6.0, 6.0) * valid
        x = torch.cat([x[..., :-1], valid], -1)
        # Padding at the end looks like frames without a measurement.
        x = nn.functional.pad(x, (0, 0, 0, (FOLD - frames % FOLD) % FOLD))
        x = self.enter(x.reshape(batch, -1, FOLD * FEATURES).transpose(1, 2))
        for block in self.blocks:
            x = block(x)
        x = self.leave(x).transpose(1, 2).reshape(batch, -1, OUTPUTS)
        return self.base + x[:, :frames]


def export_onnx(network: LifterNetwork, path: Path) -> None:
    """Write the network as ONNX with dynamic numbers of clips and frames."""
    names = ("features", ("body",))
    free = {name: {0: "batch", 1: "frames"} for name in ("features", "body")}
    write_onnx(network.eval(), torch.zeros(1, 60, FEATURES), path, names=names, free=free)


def read_onnx(path: Path) -> LifterNetwork | None:
    """The network of an exported file, to continue training; None if its architecture differs."""
    import onnx
    from onnx import numpy_helper

    network = LifterNetwork()
    wanted = network.state_dict()
    there = {weight.name: weight for weight in onnx.load(str(path)).graph.initializer}
    if any(name not in there or list(value.shape) != list(there[name].dims) for name, value in wanted.items()):
        return None
    network.load_state_dict({name: torch.from_numpy(numpy_helper.to_array(there[name]).copy()) for name in wanted})
    return network
