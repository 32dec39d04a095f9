"""Train the temporal lifter that ships in `video2anim/models/weights`.

    video2anim synth --preset random --count 38 --seed 7101 --size 640x480 --longest 2.5 --motion cmu.npz \
        --motion deepmimic.npz --out clips
    python training/lifter.py residuals --clips clips --out residuals
    python training/lifter.py motions --motion cmu.npz deepmimic.npz --split split.json --part train --out train
    python training/lifter.py motions --motion cmu.npz deepmimic.npz --split split.json --part val --acted 14 \
        --seed 900 --out val
    python training/lifter.py train --train train --val val --residuals residuals --checkpoint lifter.ckpt
    python training/lifter.py export --checkpoint lifter.ckpt --out video2anim/models/weights/lifter.onnx

Training goes on from the checkpoint where it was broken off. After an export the digest in `video2anim/models/table.py`
has to follow; the command prints it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
from pathlib import Path

import torch

from video2anim.artifacts.codec import read_value, write_value
from video2anim.lifting.motions import LiftingMotions, gather
from video2anim.lifting.network import export_onnx
from video2anim.lifting.residuals import ResidualLibrary, collect
from video2anim.lifting.samples import LiftingSampler
from video2anim.lifting.train import LiftingConfig, read_average, train
from video2anim.types import PersonTracks

VALIDATION_SEED = 77


def main() -> None:
    """One step of the four."""
    options = arguments()
    match options.step:
        case "residuals":
            residuals(options)
        case "motions":
            names = json.loads(options.split.read_text())[options.part] if options.split else None
            write_value(gather(options.motion, names, acted=options.acted, seed=options.seed), made(options.out))
        case "train":
            train_network(options)
        case _:
            export_onnx(read_average(options.checkpoint), options.out)
            sys.stdout.write(f"{hashlib.sha256(options.out.read_bytes()).hexdigest()}\n")


def made(folder: Path) -> Path:
    """The folder, there."""
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def residuals(options: argparse.Namespace) -> None:
    """Track everybody in the clips, compare with the truth."""
    found = []
    for folder in sorted(path for path in options.clips.iterdir() if (path / "meta.json").is_file()):
        scene = options.clips / ".scenes" / folder.name
        command = [sys.executable, "-m", "video2anim.cli.main", "run", str(folder / "video.mp4"), "--out", str(scene)]
        done = subprocess.run([*command, "--until", "track", "--person", "all"], capture_output=True, check=False)
        if done.returncode == 0:
            found.append((folder, read_value(PersonTracks, scene / "stages" / "02_track")))
    library = collect(found)
    write_value(library, made(options.out))
    sys.stdout.write(f"{len(found)} clips, {len(library.pixels)} frames, {len(library.start) - 1} runs\n")


def train_network(options: argparse.Namespace) -> None:
    """Train to the last step, or for the given time."""
    torch.set_num_threads(options.threads)
    library = read_value(ResidualLibrary, options.residuals).mirrored_too()
    sampler = LiftingSampler(read_value(LiftingMotions, options.train), library, seed=options.seed)
    held_out = LiftingSampler(read_value(LiftingMotions, options.val), library, seed=VALIDATION_SEED, varied=False)
    config = LiftingConfig(steps=options.steps, seed=options.seed, minutes=options.minutes)
    train(sampler, held_out, config, options.checkpoint, on_line=lambda text: print(text, flush=True))


def arguments() -> argparse.Namespace:
    """Options of the four steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    steps = parser.add_subparsers(dest="step", required=True)
    of = {name: steps.add_parser(name) for name in ("residuals", "motions", "train", "export")}
    of["residuals"].add_argument("--clips", type=Path, required=True)
    of["motions"].add_argument("--motion", type=Path, nargs="+", required=True)
    of["motions"].add_argument("--split", type=Path)
    of["motions"].add_argument("--part", default="train")
    of["motions"].add_argument("--acted", type=int, default=210)
    of["train"].add_argument("--train", type=Path, required=True)
    of["train"].add_argument("--val", type=Path, required=True)
    of["train"].add_argument("--residuals", type=Path, required=True)
    of["train"].add_argument("--steps", type=int, default=LiftingConfig().steps)
    of["train"].add_argument("--minutes", type=float)
    of["train"].add_argument("--threads", type=int, default=1)
    for name in ("motions", "train"):
        of[name].add_argument("--seed", type=int, default=0)
    for name in ("train", "export"):
        of[name].add_argument("--checkpoint", type=Path, required=True)
    for name in ("residuals", "motions", "export"):
        of[name].add_argument("--out", type=Path, required=True)
    return parser.parse_args()


if __name__ == "__main__":
    main()
