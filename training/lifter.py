"""Trains the temporal lifter of `video2anim/networks/weights` in one run that can be continued at any time.

    python training/lifter.py run --motion ../shared/motion --minutes 30
    python training/lifter.py progress
    python training/lifter.py export --motion ../shared/motion --cooldown 1500 --out lifter.onnx

The first run creates missing data in the cache: clips of `video2anim synth` and BlazePose's errors on them, whole and
with a part of the person hidden (about an hour on one core), and the training motions (some minutes). Then it trains
from the last checkpoint for the given time or until it is interrupted; it may be killed at any time. Without a
checkpoint it starts from the shipped weights if they have the same architecture. `export` writes the averaged network,
with `--cooldown` after that many steps with a falling rate, and prints the digest for `video2anim/networks/table.py`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from video2anim.artifacts.codec import read_value
from video2anim.lab.eval.truth import read_truth
from video2anim.lab.lifter.hidden import KINDS, hide
from video2anim.lab.lifter.motions import cached_motions
from video2anim.lab.lifter.network import LifterNetwork, export_onnx, read_onnx
from video2anim.lab.lifter.residuals import ResidualLibrary, collect
from video2anim.lab.lifter.samples import LiftingSampler
from video2anim.lab.lifter.store import has_arrays, read_arrays, write_arrays
from video2anim.lab.lifter.train import LiftingConfig, annealed, describe, read_average, read_progress, train
from video2anim.networks.fetch import cache_dir
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.types import PersonTracks

ARCHIVES = ("cmu.npz", "deepmimic.npz", "more.npz")
"""Archives free for commercial use, except for one source in `deepmimic.npz`, which is left out."""
PROCEDURAL, VALIDATION_PROCEDURAL = 210, 14
VALIDATION_SEED = 900
CLIPS = 32
CLIP_WORDS = ("--preset", "random", "--seed", "7201", "--size", "480x848", "--longest", "1.6")
"""People are 0.28 to 0.85 of the picture's height, 240 to 720 px; the model's crop has 256 px."""
CLIP_MOTION = ("cmu.npz", "deepmimic.npz")
HELD_OUT = 6
"""The errors of every sixth clip are used for validation."""
SHIPPED = Path(__file__).parents[1] / "video2anim" / "networks" / "weights" / "lifter.onnx"


def main() -> None:
    """Run one of the three commands."""
    options = arguments()
    torch.set_num_threads(options.threads)
    if options.command == "progress":
        say(json.dumps({"line": describe(read_progress(options.cache))}))
    elif options.command == "export":
        network = read_average(options.cache)
        if options.cooldown:
            network = annealed(samplers(options)[0], LiftingConfig(), options.cache, steps=options.cooldown)
        export_onnx(network, options.out)
        say(hashlib.sha256(options.out.read_bytes()).hexdigest())
    else:
        sampler, held_out = samplers(options)
        try:
            train(
                sampler, held_out, LiftingConfig(), options.cache, minutes=options.minutes, start=shipped(), on_line=say
            )
        except KeyboardInterrupt:
            say(describe(read_progress(options.cache)))


def say(text: str) -> None:
    """Print a line without buffering."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def shipped() -> LifterNetwork | None:
    """The shipped weights, if they have the current architecture."""
    return read_onnx(SHIPPED) if SHIPPED.is_file() else None


def samplers(options: argparse.Namespace) -> tuple[LiftingSampler, LiftingSampler]:
    """Training and validation samplers, which share neither motion nor rendered clips. Missing data is created."""
    cache, archives = options.cache, [options.motion / name for name in ARCHIVES]
    split = options.motion / "split.json"
    libraries = residuals(cache, options.motion, options.clips)
    motions = cached_motions(cache / "motions", archives, split, "train", procedural=PROCEDURAL, seed=0)
    unseen = cached_motions(
        cache / "held_out_motions", archives, split, "val", procedural=VALIDATION_PROCEDURAL, seed=VALIDATION_SEED
    )
    return (
        LiftingSampler(motions, libraries[0].mirrored_too(), seed=0),
        LiftingSampler(unseen, libraries[1].mirrored_too(), seed=VALIDATION_SEED, varied=False),
    )


def residuals(cache: Path, motion: Path, count: int) -> tuple[ResidualLibrary, ResidualLibrary]:
    """BlazePose's errors on rendered clips, for training and for validation."""
    key = {"words": list(CLIP_WORDS), "clips": count, "hidden": list(KINDS)}
    folders = cache / "residuals", cache / "held_out_residuals"
    if not all(has_arrays(folder, key) for folder in folders):
        clips = rendered(cache / "clips", motion, count)
        tracked = [seen_in(clip, cache, number) for number, clip in enumerate(clips)]
        for folder, wanted in zip(folders, (False, True), strict=True):
            found = [
                (clip, seen, hidden)
                for number, (clip, videos) in enumerate(zip(clips, tracked, strict=True))
                for seen, hidden in videos
                if (number % HELD_OUT == HELD_OUT - 1) == wanted
            ]
            write_arrays(collect(found), folder, key)
    train_library, held_out = (read_arrays(ResidualLibrary, folder) for folder in folders)
    return train_library, held_out


def rendered(folder: Path, motion: Path, count: int) -> list[Path]:
    """Make the clips with truth; existing ones are kept."""
    words = [word for name in CLIP_MOTION for word in ("--motion", str(motion / name))]
    program([*("synth", *CLIP_WORDS, "--count", str(count), "--out", str(folder)), *words])
    return sorted(path.parent for path in folder.glob("[!.]*/meta.json"))


def seen_in(clip: Path, cache: Path, number: int) -> list[tuple[PersonTracks, bool]]:
    """Tracks in a clip, and in the same with a part of the main person hidden in each way."""
    box_px = read_truth(clip).person_box_px[0]
    videos = [clip / "video.mp4"]
    for kind_number, kind in enumerate(KINDS):
        videos.append(cache / "hidden" / f"{clip.name}_{kind}.mp4")
        if not videos[-1].is_file():
            videos[-1].parent.mkdir(exist_ok=True)
            hide(videos[0], videos[-1], box_px, kind, np.random.default_rng([number, kind_number]))
    scenes = [clip.name, *(video.stem for video in videos[1:])]
    found = [tracks(video, cache / "scenes" / scene) for video, scene in zip(videos, scenes, strict=True)]
    return [(seen, place > 0) for place, seen in enumerate(found) if seen is not None]


def tracks(video: Path, scene: Path) -> PersonTracks | None:
    """Tracks of all people in a video; None if the pipeline finds nobody."""
    if not stage_folder(scene, "track").is_dir():
        words = ["run", str(video), "--out", str(scene), "--until", "track", "--person", "all"]
        program(words, expected=(0, 5))
    stage = stage_folder(scene, "track")
    return read_value(PersonTracks, stage) if stage.is_dir() else None


def program(words: Sequence[str], expected: tuple[int, ...] = (0,)) -> None:
    """Run `video2anim`; on failure exit with its error output."""
    done = subprocess.run(
        [sys.executable, "-m", "video2anim.cli.main", *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        text=True, check=False,
    )  # fmt: skip
    if done.returncode not in expected:
        sys.exit(f"video2anim {' '.join(words)} ended with {done.returncode}:\n{done.stderr}")


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    of = {name: commands.add_parser(name) for name in ("run", "progress", "export")}
    for command in of.values():
        command.add_argument("--cache", type=Path, default=cache_dir() / "training" / "lifter")
        command.add_argument("--threads", type=int, default=1)
    for name in ("run", "export"):
        of[name].add_argument("--motion", type=Path, default=Path("../shared/motion"), help="folder of the archives")
        of[name].add_argument("--clips", type=int, default=CLIPS, help="rendered clips with BlazePose's errors")
    of["run"].add_argument("--minutes", type=float, help="stop after this time (default: when interrupted)")
    of["export"].add_argument("--cooldown", type=int, default=0, help="steps with a falling rate before the export")
    of["export"].add_argument("--out", type=Path, required=True)
    return parser.parse_args()


if __name__ == "__main__":
    main()
