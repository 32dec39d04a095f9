"""Sizes and choices of the denoisers."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from scenemi.scene.basis_points import BPS_ANCHORS
from scenemi.scene.voxels import GRID_SHAPE, VOXEL_M
from scenemi.windows import WINDOW_FRAMES

Width = Annotated[int, Field(ge=1, le=8192)]
Layers = Annotated[int, Field(ge=1, le=64)]
Voxels = Annotated[int, Field(ge=1, le=256)]
Frames = Annotated[int, Field(ge=2, le=1024)]
"""Limits of what a file's header may ask for: several times the largest published motion models. More is damage."""


@dataclass(frozen=True, slots=True)
class ModelConfig:
    """The shipped denoiser (`scenemi.model.denoiser`)."""

    width: Width = 320
    """Channels of a token."""
    layers: Layers = 6
    """Of the transformer."""
    heads: Layers = 10
    """Of its attention."""
    fold: Layers = 8
    """Frames of a token: 8 frames are a quarter of a second, which the keyframes' curve tells well already."""
    embedding: Width = 256
    """Channels that carry diffusion step and body shape."""
    scene: bool = True
    """Signed distance and the way out at the joints of the current estimate are inputs of every frame."""
    window_frames: Frames = WINDOW_FRAMES

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise ValueError(f"ModelConfig: want width in {self.heads} heads, got {self.width}")

    @property
    def tokens(self) -> int:
        return -(-self.window_frames // self.fold)

    def to_json(self) -> dict[str, Any]:
        """Plain values for a file's metadata."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class PaperConfig:
    """The paper's denoiser (`scenemi.model.paper`, Table 5)."""

    width: Width = 256
    """Base channels of the U-Net."""
    multipliers: Annotated[tuple[Layers, ...], Field(min_length=1, max_length=8)] = (2, 2, 2, 2)
    """Channels of each level in units of `width`; each level below the first halves the frame rate."""
    kernel: Layers = 5
    """Frames of a convolution."""
    groups: Layers = 8
    """Of the normalization."""
    embedding: Width = 512
    """Channels that carry diffusion step, body and scene."""
    bps_anchors: Width = BPS_ANCHORS
    local_channels: Width = 256
    """Channels of the embedded local scene."""
    grid: tuple[Voxels, Voxels, Voxels] = GRID_SHAPE
    voxel_m: Annotated[float, Field(gt=0, le=1)] = VOXEL_M
    patch: tuple[Voxels, Voxels, Voxels] = (8, 8, 8)
    """Voxels of a token of the scene encoder."""
    scene_width: Width = 512
    scene_layers: Layers = 12
    """Of the scene's encoder."""
    scene_heads: Layers = 8
    """Of its attention."""
    use_body: bool = True
    use_global: bool = True
    use_local: bool = True
    window_frames: Frames = WINDOW_FRAMES

    def __post_init__(self) -> None:
        if any(size % patch for size, patch in zip(self.grid, self.patch, strict=True)):
            raise ValueError(f"PaperConfig: want a grid of whole patches, got {self.grid} and {self.patch}")
        if (self.width * min(self.multipliers)) % self.groups:
            raise ValueError(f"PaperConfig: want channels in {self.groups} groups, got width {self.width}")

    def to_json(self) -> dict[str, Any]:
        """Plain values for a file's metadata."""
        return {"form": "paper", **asdict(self)}


Method = Literal["mdm", "stablemofusion", "scenediffuser", "wang2021", "omnicontrol", "condmdi"]


@dataclass(frozen=True, slots=True, kw_only=True)
class BaselineConfig(PaperConfig):
    """A method that the paper compares with (`scenemi.model.baselines`). All see the scene through the paper's encoder
    of the global scene, none the local scene at keyframes."""

    method: Method
    channels: Width
    """Of a frame in transformers and recurrent networks; U-Nets have `width`."""
    layers: Layers
    heads: Layers

    @classmethod
    def like(cls, method: Method, size: ModelConfig) -> BaselineConfig:
        """About as many parameters as the shipped denoiser of this size."""
        encoder = SIZES["paper-narrow"]
        assert isinstance(encoder, PaperConfig)
        return cls(
            method=method, channels=size.width, layers=size.layers, heads=size.heads, embedding=size.embedding,
            width=size.width // 4, local_channels=1, use_local=False, scene_width=encoder.scene_width,
            scene_layers=encoder.scene_layers, scene_heads=encoder.scene_heads, window_frames=size.window_frames,
        )  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """Plain values for a file's metadata."""
        return {"form": "baseline", **asdict(self)}


AnyConfig = ModelConfig | PaperConfig


def config_from_json(values: dict[str, Any]) -> AnyConfig:
    """Inverse of `to_json`.

    Raises:
        ValueError: unknown keys or impossible values.
    """
    rest = dict(values)
    kind = {"paper": PaperConfig, "baseline": BaselineConfig}.get(str(rest.pop("form", None)), ModelConfig)
    unknown = set(rest) - {item.name for item in fields(kind)}
    if unknown:
        raise ValueError(f"{kind.__name__}: unknown {', '.join(sorted(repr(str(name))[1:-1] for name in unknown))}")
    try:
        return _CHECKED[kind].validate_python(rest)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"{kind.__name__}: {where} {first['msg']}, got {repr(first['input'])[:80]}") from error


_CHECKED: dict[type, TypeAdapter[Any]] = {
    kind: TypeAdapter(kind) for kind in (ModelConfig, PaperConfig, BaselineConfig)
}


SIZES: dict[str, AnyConfig] = {
    "small": ModelConfig(),
    "tiny": ModelConfig(width=64, layers=2, heads=2, embedding=64),
    "paper": PaperConfig(),
    "paper-narrow": PaperConfig(
        width=64, multipliers=(2, 2, 2), kernel=3, embedding=256, local_channels=64, scene_width=64, scene_layers=2,
        scene_heads=4,
    ),
}  # fmt: skip
"""`small` is what ships, `paper` follows the paper's Table 5, `paper-narrow` is the same at a width that two CPU cores
train; `tiny` is for tests."""
