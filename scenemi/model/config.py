"""Sizes and choices of the denoiser."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from scenemi.features import BODY_LENGTHS, FEATURE_COUNT


@dataclass(frozen=True, slots=True)
class ModelConfig:
    """Architecture (paper Table 5). Everything here decides the shape of the weights or what they mean."""

    width: int = 96
    """Base channels of the U-Net."""
    multipliers: tuple[int, ...] = (2, 2, 2)
    """Channels of each level in units of `width`; each level below the first halves the frame rate."""
    fold: int = 4
    """Frames that are one for the U-Net: 4 cost a third with the same channels."""
    kernel: int = 3
    groups: int = 8
    """Groups of the group normalization."""
    embedding: int = 512
    """Channels of the embedding of the diffusion step, and of the scene (paper: 512)."""
    window_frames: int = 121
    condition: Literal["token", "adagn", "both"] = "both"
    """How body shape and global scene enter: as two more frames in time (paper: "concatenated along the temporal
    dimension"), added to the embedding that scales and shifts the normalizations, or both."""
    residual: bool = True
    """Predict the difference to the interpolated keyframes (the idea of Oreshkin et al. 2023), which are also an
    input; in units of the size that difference has at each distance from the keyframes."""
    noise_channel: bool = True
    """The noise level of the keyframes is an input, so that exact keyframes are not mistrusted."""
    joiners: int = 3
    """Networks of the learned interpolation, each trained without one part of the clips; 0 = interpolation alone."""
    joiner_width: int = 512
    smooth_keyframes: bool = True
    """Noisy keyframes are smoothed before they are joined (`scenemi.model.keyframe_smoothing`). With `residual`."""
    smooth_output: bool = True
    """The answer passes a fixed low-pass in time, so that noise which is white in time does not come through."""
    bps_anchors: int = 64
    local_channels: int = 64
    """Channels of the embedded local scene."""
    grid: tuple[int, int, int] = (48, 24, 48)
    voxel_m: float = 0.1
    """Edge of a voxel; the paper's finer grid is (96, 48, 96) at 0.05 (Table 8)."""
    patch: tuple[int, int, int] = (8, 8, 8)
    """Voxels of a token of the scene encoder."""
    scene_width: int = 64
    scene_layers: int = 2
    scene_heads: int = 4
    dropout: float = 0.0
    use_body: bool = True
    use_global: bool = True
    use_local: bool = True

    def __post_init__(self) -> None:
        if any(size % patch for size, patch in zip(self.grid, self.patch, strict=True)):
            raise ValueError(f"ModelConfig: want a grid of whole patches, got {self.grid} and {self.patch}")
        if (self.width * min(self.multipliers)) % self.groups:
            raise ValueError(f"ModelConfig: want channels in {self.groups} groups, got width {self.width}")

    @property
    def members(self) -> int:
        """Networks of the learned interpolation that there are: what it makes is the base of `residual`."""
        return self.joiners if self.residual else 0

    @property
    def smooths(self) -> bool:
        """Whether noisy keyframes are smoothed."""
        return self.residual and self.smooth_keyframes

    @property
    def feature_count(self) -> int:
        return FEATURE_COUNT

    @property
    def body_lengths(self) -> int:
        return BODY_LENGTHS

    def to_json(self) -> dict[str, Any]:
        """Plain values for a file's metadata."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> ModelConfig:
        """Inverse of `to_json`.

        Raises:
            ValueError: unknown or missing keys.
        """
        try:
            lists: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
            return cls(**lists)
        except TypeError as error:
            raise ValueError(f"ModelConfig: {error}") from error


SIZES: dict[str, ModelConfig] = {
    "tiny": ModelConfig(
        width=16, embedding=64, scene_width=32, scene_layers=1, scene_heads=2, local_channels=16,
        joiners=1, joiner_width=64,
    ),
    "small": ModelConfig(),
    "paper": ModelConfig(
        width=256, multipliers=(2, 2, 2, 2), fold=1, kernel=5, condition="token", residual=False, noise_channel=False,
        smooth_output=False, scene_width=512, scene_layers=12, scene_heads=8, local_channels=256,
    ),
}  # fmt: skip
"""`paper` follows the paper's Table 5; `small` is what ships; `tiny` is for tests."""
