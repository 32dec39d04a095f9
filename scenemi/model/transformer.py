"""A small transformer over time; diffusion step and body shape scale and shift its normalizations."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

_EXPANSION = 2
"""Width of the hidden layer of a block in units of its own."""
_PARTS = 6
"""Scale, shift and gate of attention and of the hidden layer."""


class Block(nn.Module):
    """Attention and a hidden layer, with AdaLN-single (Chen et al. 2024, PixArt-alpha): one modulation for all blocks
    and an offset of each."""

    def __init__(self, width: int, heads: int, tokens: int) -> None:
        super().__init__()
        self.heads = heads
        self.project = nn.Linear(width, 3 * width)
        self.merge = nn.Linear(width, width)
        self.widen = nn.Linear(width, _EXPANSION * width)
        self.narrow = nn.Linear(_EXPANSION * width, width)
        self.offset = nn.Parameter(torch.zeros(_PARTS, width))
        self.bias = nn.Parameter(torch.zeros(heads, 2 * tokens - 1))
        """Added to the attention by distance in time."""
        index = torch.arange(tokens)
        self.distance: Tensor
        self.register_buffer("distance", index[:, None] - index[None] + tokens - 1, persistent=False)

    def forward(
        self, x: Float[Tensor, "batch tokens width"], modulation: Float[Tensor, "batch 6 width"]
    ) -> Float[Tensor, "batch tokens width"]:
        """The block's input plus its two corrections."""
        batch, tokens, width = x.shape
        parts = (modulation + self.offset)[:, :, None].unbind(1)
        scale1, shift1, gate1, scale2, shift2, gate2 = parts
        h = functional.layer_norm(x, (width,)) * (1 + scale1) + shift1
        q, k, v = self.project(h).reshape(batch, tokens, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        bias = self.bias[:, self.distance]
        h = functional.scaled_dot_product_attention(q, k, v, attn_mask=bias[None].expand(batch, -1, -1, -1))
        x = x + gate1 * self.merge(h.transpose(1, 2).reshape(batch, tokens, width))
        h = functional.layer_norm(x, (width,)) * (1 + scale2) + shift2
        return x + gate2 * self.narrow(functional.gelu(self.widen(h)))


class Transformer(nn.Module):
    """Tokens in, tokens out."""

    def __init__(
        self, channels_in: int, channels_out: int, *, width: int, layers: int, heads: int, tokens: int, embedding: int
    ) -> None:
        super().__init__()
        self.enter = nn.Linear(channels_in, width)
        self.position = nn.Parameter(0.02 * torch.randn(tokens, width))
        self.modulation = nn.Linear(embedding, _PARTS * width)
        self.blocks = nn.ModuleList(Block(width, heads, tokens) for _ in range(layers))
        self.leave = nn.Linear(width, channels_out)
        for layer in (self.modulation, self.leave):  # a correction that begins at nothing
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(
        self, x: Float[Tensor, "batch tokens channels"], embedding: Float[Tensor, "batch embedding"]
    ) -> Float[Tensor, "batch tokens out"]:
        """As many tokens as come in."""
        modulation = self.modulation(functional.silu(embedding)).unflatten(1, (_PARTS, -1))
        x = self.enter(x) + self.position
        for block in self.blocks:
            x = block(x, modulation)
        return self.leave(functional.layer_norm(x, (x.shape[-1],)))
