"""The training loop of the room network. It can be resumed; its batches depend on seed and step alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from scenemi.training.loop_parts import (
    Stopwatch,
    mean_measures,
    measures_text,
    ramped_decay,
    read_networks,
    set_rate,
    take_step,
    update_average,
    warmup,
    write_networks,
)
from video2anim.lab.scene_network.network import RoomAnswer, RoomNetwork
from video2anim.lab.scene_network.objective import losses, measures
from video2anim.lab.scene_network.restart import calibrate_normalization, read_exported
from video2anim.lab.scene_network.samples import PictureBatch, PictureShards

SMALL_SIZES = ((128, 192), (128, 160), (160, 160), (192, 128), (96, 192))
LARGE_SIZES = ((192, 256), (160, 288), (192, 192), (256, 192), (224, 288))
"""Image sizes (height, width) from which batches are drawn, in the first and in the last phase."""
_REFRESH_EVERY = 20
"""Steps between looks for shards that are finished."""


@dataclass(frozen=True, slots=True)
class PerceptionConfig:
    """Settings of a training run."""

    steps: int = 8000
    batch: int = 8
    learning_rate: float = 1.5e-3
    encoder_rate: float = 0.25
    """Learning rate of the encoder relative to that of the other layers."""
    frozen_stages: int = 3
    """Number of encoder stages (with the stem) that keep the published weights."""
    weight_decay: float = 0.02
    warmup: int = 200
    ema: float = 0.998
    large_share: float = 0.15
    """Share of the steps, at the end, with `LARGE_SIZES`."""
    cooling_share: float = 0.2
    """Share of the steps, at the end, over which the learning rate falls to zero."""
    seed: int = 0
    save_every: int = 400
    minutes: float | None = None
    """Stop with a checkpoint after this time, for machines with a time limit."""


def train(
    shards: PictureShards,
    held_out: PictureShards,
    config: PerceptionConfig,
    checkpoint: Path,
    *,
    encoder: Mapping[str, Tensor] | None = None,
    start: Path | None = None,
    device: str = "cpu",
    on_line: Callable[[str], None] = lambda text: None,
) -> RoomNetwork:
    """Train, or continue from the checkpoint. Returns the averaged network.

    Args:
        shards: Training images, on `device`.
        held_out: Images of other rooms, on `device`; the first 64 are used for validation.
        config: Settings.
        checkpoint: File to continue from and to write.
        encoder: Published weights with which the encoder starts.
        start: File written by `export_onnx` with which the whole network starts instead.
        device: `cpu` or `cuda`.
        on_line: Called with a line of numbers at every checkpoint.
    """
    clock = Stopwatch()
    torch.manual_seed(config.seed)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    network, average = _networks(shards, config, encoder, start, device)
    optimizer = _optimizer(network, config)
    networks = {"network": network, "average": average}
    step = read_networks(checkpoint, networks, optimizer) if checkpoint.is_file() else 0
    if step == 0:
        average.load_state_dict(network.state_dict())
    network.train()
    average.eval()
    chosen = range(min(len(held_out), 64))
    tests = [held_out.plain(chosen[first : first + 32], LARGE_SIZES[0]) for first in range(0, len(chosen), 32)]
    mean, weights, late = average.state_dict(), network.state_dict(), False
    while step < config.steps and not late:
        if step % _REFRESH_EVERY == 0:
            shards.refresh()
        batch = _batch(shards, step, config)
        set_rate(optimizer, config.learning_rate * _rate(step, config))
        terms = losses(_answer(network, batch.picture), batch)
        take_step(network, optimizer, torch.stack(list(terms.values())).sum(), max_norm=5.0)
        step += 1
        update_average(mean, weights, ramped_decay(step, config.ema))
        late = config.minutes is not None and clock.is_over(60 * config.minutes)
        if step % config.save_every == 0 or step == config.steps or late:
            write_networks(checkpoint, networks, optimizer, step)
            validation = mean_measures([_measured(average, test) for test in tests])
            parts = measures_text({name: float(value.detach()) for name, value in terms.items()})
            numbers = f"{measures_text(validation)} | {parts}"
            on_line(f"step {step} of {len(shards)} | {numbers} | {clock.seconds:.0f} s")
    return average


def _answer(network: RoomNetwork, picture: Tensor) -> RoomAnswer:
    """On a GPU convolutions are computed in bfloat16."""
    with torch.autocast(picture.device.type, torch.bfloat16, enabled=picture.is_cuda):
        answer = network(picture.contiguous(memory_format=torch.channels_last))
    return RoomAnswer(*(head.float() for head in answer))


def _networks(
    shards: PictureShards, config: PerceptionConfig, encoder: Mapping[str, Tensor] | None, start: Path | None,
    device: str,
) -> tuple[RoomNetwork, RoomNetwork]:  # fmt: skip
    """The network to train, with its initial weights, and a copy for the average."""
    network, average = RoomNetwork() if start is None else read_exported(start), RoomNetwork().to(device)
    if start is not None:
        calibrate_normalization(network, shards.batch(0, 4 * config.batch, LARGE_SIZES[0]).picture.cpu())
    elif encoder is not None:
        network.encoder.read_published(encoder)
    return network.to(device, memory_format=torch.channels_last), average  # pyright: ignore[reportCallIssue]


def _batch(shards: PictureShards, step: int, config: PerceptionConfig) -> PictureBatch:
    """Training samples of a step at one of the sizes of its phase."""
    large = step >= (1 - config.large_share) * config.steps
    sizes = LARGE_SIZES if large else SMALL_SIZES
    return shards.batch(step, config.batch, sizes[step % len(sizes)])


def _optimizer(network: RoomNetwork, config: PerceptionConfig) -> torch.optim.Optimizer:
    """AdamW over the weights that are not frozen."""
    network.encoder.stem.requires_grad_(config.frozen_stages == 0)
    for number, stage in enumerate(network.encoder.stages):
        stage.requires_grad_(number >= config.frozen_stages)
    inner = [p for p in network.encoder.parameters() if p.requires_grad]
    known = {id(p) for p in network.encoder.parameters()}
    outer = [p for p in network.parameters() if id(p) not in known]
    groups = [{"params": outer, "share": 1.0}, {"params": inner, "share": config.encoder_rate}]
    return torch.optim.AdamW(groups, lr=config.learning_rate, weight_decay=config.weight_decay)


def _measured(average: RoomNetwork, test: PictureBatch) -> dict[str, float]:
    with torch.no_grad():
        return measures(average(test.picture), test)


def _rate(step: int, config: PerceptionConfig) -> float:
    """Share of the learning rate: constant between warm-up and cooling, so that training goes on from a checkpoint with
    more steps (Hagele et al. 2024)."""
    cooling = (config.steps - step) / max(1.0, config.cooling_share * config.steps)
    return min(warmup(step, config.warmup), cooling, 1.0)


def read_average(path: Path) -> RoomNetwork:
    """The averaged network of a checkpoint."""
    average = RoomNetwork()
    read_networks(path, {"average": average})
    return average.eval()
