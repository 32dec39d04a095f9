"""Trains the room network on one GPU within minutes, where `training/room_net.py` takes hours on processor cores.

    python training/room_net_gpu.py --start video2anim/networks/weights/room_net.onnx --motion cmu.npz deepmimic.npz \
        --work DIR --out DIR --train-s 560
    python training/room_net_gpu.py ... --train-s 700 --cool-from-s 560
    python training/room_net.py export --weights DIR/average.safetensors --out room_net.onnx

Processes on the other cores render rooms, which the GPU takes as they come. The second command goes on where the first
ended; seconds of training count from the first. From `--cool-from-s` on the learning rate falls to zero.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import shutil
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import torch

from scenemi.data.files import write_tensors
from scenemi.training.loop_parts import (
    Stopwatch,
    measures_text,
    ramped_decay,
    read_networks,
    set_rate,
    update_average,
    warmup,
    write_networks,
)
from video2anim.errors import InputError
from video2anim.lab.scene_network.device_samples import DeviceSamples, Images, compact
from video2anim.lab.scene_network.network import RoomAnswer, RoomNetwork
from video2anim.lab.scene_network.objective import instance_loss, losses, measures
from video2anim.lab.scene_network.restart import calibrate_normalization, read_exported
from video2anim.lab.scene_network.samples import PictureBatch
from video2anim.lab.scene_network.train import LARGE_SIZES, SMALL_SIZES, PerceptionConfig, make_optimizer
from video2anim.lab.synth.frames import generate_frames
from video2anim.lab.synth.generate import SynthConfig

RENDERED = ((256, 192), (256, 192), (288, 160), (192, 256))
"""Width and height in pixels of successive shards."""
PER_SHARD = 16
"""Images of one room."""
SMALL_EVERY = 5
"""Every fifth step is at one of `SMALL_SIZES`."""
VALIDATION_SHARDS = 4
"""The first shards are not trained on."""
LINE_EVERY_S = 20.0


def main() -> None:
    """Start the processes that render, then train."""
    options = arguments()
    options.work.mkdir(parents=True, exist_ok=True)
    options.out.mkdir(parents=True, exist_ok=True)
    context = multiprocessing.get_context("fork")
    begun = 1 + max((int(path.stem.removeprefix("shard_")) for path in options.work.glob("shard_*.npz")), default=-1)
    renderers = [
        context.Process(target=render, args=(options, begun + i), daemon=True) for i in range(options.renderers)
    ]
    for process in renderers:
        process.start()
    try:
        train(options, renderers)
    finally:
        for process in renderers:
            process.terminate()


def render(options: argparse.Namespace, first: int) -> None:
    """Shards `first`, `first + renderers`, ... as compact files."""
    torch.set_num_threads(1)
    for number in itertools.count(first, options.renderers):
        width, height = RENDERED[number % len(RENDERED)]
        seed = 1000 * options.seed + number
        config = SynthConfig("random", PER_SHARD, seed, width, height, tuple(options.motion))
        folder = options.work / f"rendered_{number:05d}"
        try:
            generate_frames(config, folder)
        except InputError as error:  # no room can be composed with this seed
            sys.stdout.write(f"shard {number} is left out: {error}\n")
            continue
        part = options.work / f"part_{number:05d}.npz"
        np.savez(part, **compact(folder / "shard_00000")._asdict())
        part.rename(options.work / f"shard_{number:05d}.npz")
        shutil.rmtree(folder)


def read_shard(path: Path) -> Images:
    """A shard that a renderer has finished."""
    with np.load(path, allow_pickle=False) as stored:
        return Images(**{name: stored[name] for name in stored.files})


class Incoming:
    """Finished shards, read in the background."""

    def __init__(self, work: Path) -> None:
        self._work, self._pool = work, ThreadPoolExecutor(2)
        self._waiting: dict[Path, Future[Images]] = {}
        self._known: set[Path] = set()

    def taken(self, wait_for: int = 0) -> Iterator[Images]:
        """Shards that are there and read; waits until `wait_for` have come."""
        given = 0
        while True:
            for path in sorted(set(self._work.glob("shard_*.npz")) - self._known):
                self._known.add(path)
                self._waiting[path] = self._pool.submit(read_shard, path)
            for path in [path for path, future in self._waiting.items() if future.done() or given < wait_for]:
                yield self._waiting.pop(path).result()
                given += 1
            if given >= wait_for:
                return
            time.sleep(0.2)


def train(options: argparse.Namespace, renderers: list[BaseProcess]) -> None:
    """Take steps until the time is over; write weights and checkpoint."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    config = PerceptionConfig(batch=options.batch, learning_rate=options.rate, ema=options.ema)
    samples, held_out = DeviceSamples(device, options.seed), DeviceSamples(device, 0)
    incoming = Incoming(options.work)
    for number, images in enumerate(incoming.taken(options.first_shards)):
        (held_out if number < VALIDATION_SHARDS else samples).add(images)
    network, average = networks(options, samples, device)
    optimizer = make_optimizer(network, config)
    checkpoint, progress = options.work / "room.ckpt", options.work / "progress.json"
    step, before_s = 0, 0.0
    if checkpoint.is_file():
        step = read_networks(checkpoint, {"network": network, "average": average}, optimizer)
        before_s = json.loads(progress.read_text())["seconds"]
    test = held_out.plain(LARGE_SIZES[0])
    network.train()
    weights, mean = network.state_dict(), average.state_dict()
    clock, next_line = Stopwatch(), 0.0
    while (seconds := before_s + clock.seconds) < options.train_s:
        cooling = min(1.0, (options.train_s - seconds) / max(options.train_s - options.cool_from_s, 1e-9))
        set_rate(optimizer, config.learning_rate * warmup(step, config.warmup) * cooling)
        sizes = SMALL_SIZES if step % SMALL_EVERY == 0 else LARGE_SIZES
        batch, instance = samples.batch(config.batch, sizes[step // SMALL_EVERY % len(sizes)])
        answer = answered(network, batch.picture)
        terms = losses(answer, batch)
        terms["instance"] = options.instance_weight * instance_loss(answer.disparity[:, 0], batch.disparity, instance)
        optimizer.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        step += 1
        update_average(mean, weights, ramped_decay(step, config.ema))
        if step % 20 == 0:
            if dead := [process.exitcode for process in renderers if process.exitcode]:
                raise SystemExit(f"a process that renders ended with {dead[0]}; its error is above")
            for images in incoming.taken():
                samples.add(images)
        if clock.seconds >= next_line:
            next_line = clock.seconds + LINE_EVERY_S
            report(step, len(samples), measured(average, test), terms, seconds)
    write_networks(checkpoint, {"network": network, "average": average}, optimizer, step)
    progress.write_text(json.dumps({"seconds": before_s + clock.seconds}))
    report(step, len(samples), measured(average, test), terms, before_s + clock.seconds)
    for name, trained in (("average", average), ("last", network)):
        halves = {
            key: (value.half() if value.ndim > 1 else value).cpu().contiguous()
            for key, value in trained.state_dict().items()
        }
        write_tensors(options.out / f"{name}.safetensors", halves, {"steps": str(step), "images": str(len(samples))})


def networks(
    options: argparse.Namespace, samples: DeviceSamples, device: torch.device
) -> tuple[RoomNetwork, RoomNetwork]:
    """The network with the weights that it starts from, and its average."""
    network = read_exported(options.start).to(device)
    calibrate_normalization(network, samples.batch(128 if device.type == "cuda" else 16, LARGE_SIZES[0])[0].picture)
    average = RoomNetwork().to(device).eval()
    average.load_state_dict(network.state_dict())
    return network.to(memory_format=torch.channels_last), average  # pyright: ignore[reportCallIssue]


def answered(network: RoomNetwork, picture: torch.Tensor) -> RoomAnswer:
    """The network's answer; convolutions in bfloat16 on a GPU, outputs in single precision."""
    with torch.autocast(picture.device.type, torch.bfloat16, enabled=picture.is_cuda):
        answer = network(picture.contiguous(memory_format=torch.channels_last))
    return RoomAnswer(*(value.float() for value in answer))


@torch.no_grad()
def measured(average: RoomNetwork, test: PictureBatch) -> dict[str, float]:
    """Validation measures of the averaged weights."""
    return measures(average(test.picture), test)


def report(step: int, images: int, found: dict[str, float], terms: dict[str, torch.Tensor], seconds: float) -> None:
    """A line of numbers."""
    parts = measures_text({name: float(value.detach()) for name, value in terms.items()})
    sys.stdout.write(f"step {step} of {images} | {measures_text(found)} | {parts} | {seconds:.0f} s\n")
    sys.stdout.flush()


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--start", type=Path, required=True, help="ONNX file of an earlier training")
    parser.add_argument("--motion", type=Path, nargs="+", required=True, help="archives of captured motion")
    parser.add_argument("--work", type=Path, required=True, help="folder for rendered images and the checkpoint")
    parser.add_argument("--out", type=Path, required=True, help="folder for the weights")
    parser.add_argument("--train-s", type=float, required=True, help="seconds of training, earlier calls included")
    parser.add_argument("--cool-from-s", type=float, default=float("inf"))
    parser.add_argument("--renderers", type=int, default=15)
    parser.add_argument("--first-shards", type=int, default=30)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--rate", type=float, default=1.5e-3)
    parser.add_argument("--ema", type=float, default=0.999)
    parser.add_argument("--instance-weight", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=7)
    return parser.parse_args()


if __name__ == "__main__":
    main()
