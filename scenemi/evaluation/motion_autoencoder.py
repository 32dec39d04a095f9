"""Motion features for the FID: the code of a small convolutional autoencoder over whole windows.

It sees the 201 canonical features and the joints' steps from frame to frame, so that how a motion moves counts and not
its postures alone. Distances are comparable only between motions measured with the same weights.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from scenemi.features import FEATURE_COUNT, JOINTS, MIN_STD, WIDTHS, encode
from scenemi.prior import WindowMotion
from scenemi.windows import WINDOW_FRAMES
from video2anim.errors import InputError

FORMAT = "scenemi-fid-1"
CHANNELS = FEATURE_COUNT + WIDTHS[-1]
_BATCH = 64
"""Windows at once (not measured)."""
_MIN_STEP_M = 0.005
"""Steps of joints that hardly move in the training windows are not blown up."""


@dataclass(frozen=True, slots=True)
class AutoencoderConfig:
    """Sizes."""

    width: int = 64
    """Channels of the first layer."""
    kernel: int = 5
    """Frames."""
    code: int = 32
    """Number of features. The covariance of fewer windows than this is singular, so it is small."""
    frames: int = WINDOW_FRAMES


class MotionAutoencoder(nn.Module):
    """Window (B, 267, frames) to a code (B, code) and back. Three halvings in time each way."""

    mean: Tensor
    std: Tensor

    def __init__(self, config: AutoencoderConfig) -> None:
        super().__init__()
        self.config = config
        pad = config.kernel // 2
        self.short = config.frames
        layers: list[nn.Module] = []
        channels = CHANNELS
        for _ in range(3):
            layers += [nn.Conv1d(channels, config.width, config.kernel, stride=2, padding=pad), nn.SiLU()]
            channels = config.width
            self.short = (self.short + 1) // 2
        self.encoder = nn.Sequential(*layers, nn.Flatten(), nn.Linear(self.short * config.width, config.code))
        back: list[nn.Module] = []
        for number in range(3):
            out = CHANNELS if number == 2 else config.width
            back += [nn.Upsample(scale_factor=2), nn.Conv1d(config.width, out, config.kernel, padding=pad)]
            if number < 2:
                back.append(nn.SiLU())
        self.widen = nn.Linear(config.code, self.short * config.width)
        self.decoder = nn.Sequential(*back)
        self.register_buffer("mean", torch.zeros(CHANNELS, 1))
        self.register_buffer("std", torch.ones(CHANNELS, 1))

    def encode(self, windows: Float[Tensor, "batch channels frames"]) -> Float[Tensor, "batch code"]:
        """Codes of windows as `motion_channels` gives them."""
        return self.encoder((windows - self.mean) / self.std)

    def loss(self, windows: Float[Tensor, "batch channels frames"]) -> Tensor:
        """Mean square error in standard deviations."""
        target = (windows - self.mean) / self.std
        short = self.widen(self.encoder(target)).reshape(len(windows), self.config.width, self.short)
        return ((self.decoder(short)[..., : self.config.frames] - target) ** 2).mean()

    def standardize(self, windows: Float[Tensor, "batch channels frames"]) -> None:
        """Take mean and standard deviation of each channel from training windows."""
        flat = windows.transpose(1, 2).reshape(-1, CHANNELS)
        self.mean.copy_(flat.mean(0)[:, None])
        least = np.concatenate([MIN_STD, np.full(CHANNELS - len(MIN_STD), _MIN_STEP_M)])
        self.std.copy_(flat.std(0).maximum(torch.from_numpy(least).float())[:, None])


def motion_channels(
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"],
    translation_m: Float[np.ndarray, "frames 3"],
    rest_joints_m: Float[np.ndarray, "22 3"],
) -> Float[np.ndarray, "channels frames"]:
    """What the autoencoder sees of a window: 201 features, and the joints' steps (m per frame, the first zero)."""
    features = encode(R_parent_joint, translation_m, rest_joints_m)
    joints_m = features[:, JOINTS]
    steps_m = np.diff(joints_m, axis=0, prepend=joints_m[:1])
    return np.concatenate([features, steps_m], 1).T.astype(np.float32)


class FidFeatures:
    """Features of motions on one body."""

    def __init__(self, model: MotionAutoencoder, rest_joints_m: Float[np.ndarray, "22 3"]) -> None:
        self.model, self.rest_joints_m = model.eval(), rest_joints_m

    def __call__(self, motions: Sequence[WindowMotion]) -> Float[np.ndarray, "windows code"]:
        """Codes, float64.

        Raises:
            InputError: windows of another length.
        """
        frames = self.model.config.frames
        for motion in motions:
            if len(motion.translation_world_m) != frames:
                raise InputError(
                    f"FID features: want windows of {frames} frames, got {len(motion.translation_world_m)}"
                )
        codes = []
        for start in range(0, len(motions), _BATCH):
            rows = [
                motion_channels(motion.R_parent_joint, motion.translation_world_m, self.rest_joints_m)
                for motion in motions[start : start + _BATCH]
            ]
            with torch.no_grad():
                codes.append(self.model.encode(torch.from_numpy(np.stack(rows))).double().numpy())
        return np.concatenate(codes)


def to_tensors(model: MotionAutoencoder, card: dict[str, object]) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The encoder for a file: arrays (fp16, statistics fp32) and text. The decoder is not needed for features."""
    kept = {name: value for name, value in model.state_dict().items() if not name.startswith(("decoder", "widen"))}
    arrays = {
        name: value.numpy().astype(np.float32 if name in ("mean", "std") else np.float16)
        for name, value in kept.items()
    }
    return arrays, {"format": FORMAT, "config": json.dumps(asdict(model.config)), "card": json.dumps(card)}


def from_tensors(arrays: dict[str, np.ndarray], text: dict[str, str]) -> MotionAutoencoder:
    """Inverse of `to_tensors`; the decoder is left as made.

    Raises:
        InputError: arrays of something else.
    """
    if text.get("format") != FORMAT:
        raise InputError(f"FID weights: want format {FORMAT}, got {text.get('format')}")
    model = MotionAutoencoder(AutoencoderConfig(**json.loads(text["config"])))
    state = {name: torch.from_numpy(value.astype(np.float32)) for name, value in arrays.items()}
    try:
        missing, unexpected = model.load_state_dict(state, strict=False)
    except RuntimeError as error:
        raise InputError(f"FID weights do not fit their own configuration: {error}") from error
    if unexpected or any(not name.startswith(("decoder", "widen")) for name in missing):
        raise InputError("FID weights do not fit their own configuration")
    return model
