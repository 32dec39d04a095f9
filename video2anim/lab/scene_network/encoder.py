"""EfficientNet-Lite0 without its classifier (Tan and Le 2019; the Lite variants: ReLU6, no squeeze-and-excitation).

The room network starts from its published weights (Apache-2.0, trained on photographs), because rendered images cannot
teach the statistics of real ones to the early layers.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

MEAN_RGB, STD_RGB = 127.0, 128.0
"""Normalization of images in 0 to 255 that the published weights expect."""
STEM = 32
STAGES = (
    (1, 16, 1, 1, 3), (6, 24, 2, 2, 3), (6, 40, 2, 2, 5), (6, 80, 3, 2, 3), (6, 112, 3, 1, 5), (6, 192, 4, 2, 5),
    (6, 320, 1, 1, 3),
)  # fmt: skip
"""Expansion, channels, blocks, stride, kernel size of each stage."""
TAPS = (0, 1, 2, 4, 6)
"""Last stage at each scale: 1/2, 1/4, 1/8, 1/16 and 1/32."""
WIDTHS = tuple(STAGES[stage][1] for stage in TAPS)
_EPSILON = 1e-3


class _SameConv(nn.Conv2d):
    """Convolution with TensorFlow's padding for even sizes: with stride 2, more padding after than before."""

    def __init__(self, inputs: int, outputs: int, size: int, stride: int = 1, groups: int = 1) -> None:
        # With stride 1 the padding is symmetric.
        super().__init__(inputs, outputs, size, stride, size // 2 if stride == 1 else 0, groups=groups, bias=False)
        self._after = size - stride - (size - stride) // 2 if stride > 1 else 0
        self._before = (size - stride) // 2 if stride > 1 else 0

    def forward(self, input: Tensor) -> Tensor:
        if self._after or self._before:
            input = functional.pad(input, (self._before, self._after, self._before, self._after))
        return super().forward(input)


class _Block(nn.Module):
    """Inverted residual: expand, depthwise, project."""

    def __init__(self, inputs: int, outputs: int, expansion: int, size: int, stride: int) -> None:
        super().__init__()
        wide = inputs * expansion
        layers: list[nn.Module] = []
        if expansion > 1:
            layers += [nn.Conv2d(inputs, wide, 1, bias=False), nn.BatchNorm2d(wide, _EPSILON), nn.ReLU6()]
        layers += [_SameConv(wide, wide, size, stride, wide), nn.BatchNorm2d(wide, _EPSILON), nn.ReLU6()]
        layers += [nn.Conv2d(wide, outputs, 1, bias=False), nn.BatchNorm2d(outputs, _EPSILON)]
        self.layers = nn.Sequential(*layers)
        self.skips = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x) if self.skips else self.layers(x)


class Encoder(nn.Module):
    """Features at five scales. Batch normalization keeps the published statistics."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(_SameConv(3, STEM, 3, 2), nn.BatchNorm2d(STEM, _EPSILON), nn.ReLU6())
        stages, inputs = [], STEM
        for expansion, outputs, count, stride, size in STAGES:
            blocks = []
            for number in range(count):
                blocks.append(_Block(inputs, outputs, expansion, size, stride if number == 0 else 1))
                inputs = outputs
            stages.append(nn.Sequential(*blocks))
        self.stages = nn.ModuleList(stages)
        self.train()

    def train(self, mode: bool = True) -> Encoder:
        """Set the training mode; batch normalization always stays in evaluation mode."""
        super().train(mode)
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()
        return self

    def forward(self, x: Float[Tensor, "batch 3 height width"]) -> list[Tensor]:
        """Features with `WIDTHS` channels at scales 1/2 to 1/32; `x` is (RGB - `MEAN_RGB`) / `STD_RGB`."""
        x = self.stem(x)
        kept = []
        for number, stage in enumerate(self.stages):
            x = stage(x)
            if number in TAPS:
                kept.append(x)
        return kept

    def read_published(self, weights: Mapping[str, Tensor]) -> None:
        """Load the weights of the PyTorch conversion of EfficientNet-Lite0.

        Raises:
            ValueError: a tensor has another shape, or one is missing.
        """
        blocks = [block for stage in self.stages for block in stage]  # type: ignore[union-attr]
        pairs: list[tuple[nn.Module, str]] = [(self.stem[0], "_conv_stem"), (self.stem[1], "_bn0")]
        for number, block in enumerate(blocks):
            names = ["_depthwise_conv", "_bn1", "_project_conv", "_bn2"]
            layers = [layer for layer in block.layers if not isinstance(layer, nn.ReLU6)]
            if len(layers) > 4:
                names = ["_expand_conv", "_bn0", *names]
            pairs += [(layer, f"_blocks.{number}.{name}") for layer, name in zip(layers, names, strict=True)]
        with torch.no_grad():
            for layer, name in pairs:
                for part, mine in layer.state_dict(keep_vars=True).items():
                    theirs = weights.get(f"{name}.{part}")
                    if theirs is None or theirs.shape != mine.shape:
                        came = None if theirs is None else tuple(theirs.shape)
                        raise ValueError(f"{name}.{part}: want {tuple(mine.shape)}, got {came}")
                    mine.copy_(theirs)
