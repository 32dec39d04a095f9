"""Vision transformer over the occupancy around the first frame (paper 3.1, global scene features)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn


class SceneEncoder(nn.Module):
    """Occupancy (B, x, y, z) to one vector. Blocks of voxels are tokens; their mean is the scene."""

    def __init__(
        self, grid: tuple[int, int, int], patch: tuple[int, int, int], width: int, layers: int, heads: int, out: int
    ) -> None:
        super().__init__()
        self.patch = patch
        self.cells = tuple(size // step for size, step in zip(grid, patch, strict=True))
        tokens = self.cells[0] * self.cells[1] * self.cells[2]
        self.embed = nn.Linear(patch[0] * patch[1] * patch[2], width)
        self.position = nn.Parameter(0.02 * torch.randn(tokens, width))
        layer = nn.TransformerEncoderLayer(
            width, heads, 4 * width, dropout=0.0, activation="gelu", batch_first=True, norm_first=True
        )
        self.layers = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, out)

    def forward(self, occupancy: Float[Tensor, "batch x y z"]) -> Float[Tensor, "batch out"]:
        """The scene vector; occupancy is 0 or 1."""
        return self.out(self.tokens(occupancy).mean(1))

    def tokens(self, occupancy: Float[Tensor, "batch x y z"]) -> Float[Tensor, "batch tokens width"]:
        """One vector for each block of voxels."""
        batch = occupancy.shape[0]
        (a, b, c), (p, q, r) = self.cells, self.patch
        blocks = occupancy.reshape(batch, a, p, b, q, c, r).permute(0, 1, 3, 5, 2, 4, 6).reshape(batch, a * b * c, -1)
        return self.norm(self.layers(self.embed(blocks) + self.position))
