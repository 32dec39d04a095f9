"""What a batch of windows is made from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from scenemi.scene.field import SceneField

KeyframeInput = Literal["imputed", "given", "hidden"]
"""How a denoiser learns of keyframes: they replace rows of the noisy window; as conditions alone; not at all."""


@dataclass(frozen=True, slots=True, eq=False)
class Descriptors:
    """The paper's two views of the scene (3.1), for models that use them."""

    occupancy: Float[Tensor, "batch x y z"]
    local_m: Float[Tensor, "batch frames anchors 3"]
    """Offsets from anchors on the skin to the nearest solid; read at keyframes."""
    global_known: Float[Tensor, "batch"]
    """0 where a window has no occupancy, or where training hides it."""
    local_known: Float[Tensor, "batch"]


@dataclass(frozen=True, slots=True, eq=False)
class Conditions:
    """Features are normalized, in the canonical frame of each window."""

    mask: Float[Tensor, "batch frames"]
    """1 at keyframes."""
    imputed: Float[Tensor, "batch frames"]
    """1 where the noisy window holds the keyframe itself: `mask` while t > T*, nowhere below (paper 3.2.1)."""
    base: Float[Tensor, "batch frames 201"]
    """The keyframes joined by cubic curves."""
    noise: Float[Tensor, "batch frames 2"]
    """Noise of each keyframe: degrees of every joint, centimeters of the translation; paper's l is both alike."""
    body: Float[Tensor, "batch 7"]
    """Body lengths, normalized."""
    field: SceneField | None = None
    """Solids near the body; None = no window has a scene."""
    descriptors: Descriptors | None = None

    def without_scene(self) -> Conditions:
        """The same for classifier-free guidance."""
        hidden = self.descriptors
        if hidden is not None:
            hidden = replace(hidden, global_known=torch.zeros_like(hidden.global_known))
        return replace(self, field=None, descriptors=hidden)

    def with_keyframes(self, way: KeyframeInput) -> Conditions:
        """The same for a denoiser that learns of keyframes in this way."""
        if way == "imputed":
            return self
        none = torch.zeros_like(self.mask)
        if way == "given":
            return replace(self, imputed=none)
        return replace(self, mask=none, imputed=none, base=torch.zeros_like(self.base))

    @property
    def has_scene(self) -> bool:
        return self.field is not None or (
            self.descriptors is not None and bool((self.descriptors.global_known > 0).any())
        )


def since_and_until(mask: Float[Tensor, "batch frames"]) -> Int[Tensor, "batch frames 2"]:
    """Frames since the last keyframe and until the next; the number of frames where there is none."""
    frames = mask.shape[1]
    index = torch.arange(frames, device=mask.device).expand_as(mask)
    last = torch.where(mask > 0, index, -frames).cummax(1).values
    following = torch.where(mask > 0, index, 2 * frames).flip(1).cummin(1).values.flip(1)
    return torch.stack([index - last, following - index], -1).clamp(max=frames)


def impute(
    x: Float[Tensor, "batch frames 201"], keys: Float[Tensor, "batch frames 201"], mask: Float[Tensor, "batch frames"]
) -> Float[Tensor, "batch frames 201"]:
    """Keyframe values in place of the noisy ones (paper 3.2: x' = m * s + (1 - m) * x)."""
    return torch.where(mask[..., None] > 0, keys, x)
