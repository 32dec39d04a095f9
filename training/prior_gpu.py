"""Trains the prior on one GPU within minutes, where `training/prior.py` takes days on two CPU cores.

    python training/prior_gpu.py --from-pack PACK --work DIR --out DIR --train-s 500
    python training/prior_gpu.py --from-pack PACK --work DIR --out DIR --train-s 700 --cool-from-s 560

`PACK` is what `scenemi train --pack` writes. Processes on the other cores retarget the motion and make training windows
with scenes, which the GPU takes as they come. The second command goes on where the first ended; seconds of training
count from the first. From `--cool-from-s` on the learning rate falls to zero. `--out` gets the averaged weights and the
last ones, and a log with the loss on windows of the validation clips.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch

from scenemi.data.adults import draw_adults
from scenemi.data.container import MotionArchive
from scenemi.data.motion_store import MotionStore, build_store, load_store, save_store
from scenemi.data.split import Split
from scenemi.data.windows import MotionSet, archives_of, chosen_clips
from scenemi.model.weights import WEIGHTS_FOLDER
from scenemi.scene.body_spheres import fit_spheres
from scenemi.scene.pseudo import SyntheticScenes
from scenemi.training import pool
from scenemi.training.checkpoint import CHECKPOINT, load_checkpoint, save_checkpoint
from scenemi.training.device_batches import DeviceBatch, DeviceBatches, read_shard
from scenemi.training.loop import from_weights
from scenemi.training.loop_parts import Stopwatch
from scenemi.training.noise import PipelineErrors
from scenemi.training.packing import unpack_run
from scenemi.training.run import Run
from scenemi.training.runs import RunFiles, drawn_from, licenses_of, watched_for, write_run_weights
from scenemi.training.validate import Validator
from video2anim.body.anny_body import shaped_body

STORES, POOL = "stores", "pool"
"""Folders in `--work`: retargeted motion, and windows."""
LOOK_EVERY_S = 30.0
"""Between lines of the log."""
COMPARED_BATCHES = 4
"""Batches of the validation loss, always the same ones."""
FIRST_SHARDS = 8
"""Before the first step."""


def main() -> None:
    """Start the processes, then train."""
    options = arguments()
    begun = time.monotonic()
    options.work.mkdir(parents=True, exist_ok=True)
    options.out.mkdir(parents=True, exist_ok=True)
    pack = options.work / "pack"
    if not (pack / "run.json").is_file():
        unpack_run(options.from_pack, pack)
        (pack / "run.json").write_text("")
    files = RunFiles.of(options.config, [pack / "motion.npz"], pack / "split.json", None)
    context = multiprocessing.get_context("fork")
    there = len(list((options.work / POOL).glob("shard_????")))
    makers = [
        context.Process(target=make_windows, args=(options, files, i, there), daemon=True)
        for i in range(options.makers)
    ]
    for maker in makers:
        maker.start()
    try:
        train(options, files, begun)
    finally:
        for maker in makers:
            maker.terminate()


def make_windows(options: argparse.Namespace, files: RunFiles, number: int, there: int) -> None:
    """Retarget a share of the clips; when all have, make the shards that follow those that are there."""
    torch.set_num_threads(1)
    stores = options.work / STORES
    use = drawn_from(files)
    mine, merged = stores / f"part_{number:02d}", stores / "all"
    if not merged.is_dir() and not mine.is_dir():
        archives = [MotionArchive.read(path) for path in archives_of(files.motion)]
        split = files.split or Split()
        names = [chosen_clips(archive, split, "train", use)[number :: options.makers] for archive in archives]
        shapes = draw_adults(files.config.bodies)
        save_store(mine, build_store(list(zip(archives, names, strict=True)), shapes, use.store))
    if number == 0 and not merged.is_dir():
        parts = [stores / f"part_{i:02d}" for i in range(options.makers)]
        save_store(merged, joined([wait_for(part) for part in parts]))
    motions = MotionSet(wait_for(merged), draw_adults(files.config.bodies), use)
    scenes, spheres = SyntheticScenes(), [fit_spheres(body) for body in motions.bodies()]
    folder = options.work / POOL
    for shard in range(there + number, options.shards, options.makers):
        rng = np.random.default_rng([options.seed, shard])
        pool.write_shard(folder / f"shard_{shard:04d}", pool.made_shard(motions, scenes, spheres, rng), "gpu")


def wait_for(folder: Path) -> MotionStore:
    """A store, once it is there."""
    while not folder.is_dir():
        time.sleep(0.2)
    return load_store(folder)


def joined(stores: list[MotionStore]) -> MotionStore:
    """Stores one after the other."""
    frames = np.cumsum([0] + [len(store.translation_m) for store in stores])
    clips = np.cumsum([0] + [len(store.clip_name) for store in stores])
    columns = {
        item.name: np.concatenate([np.asarray(getattr(store, item.name)) for store in stores])
        for item in fields(MotionStore)
    }
    pieces = [len(store.piece_clip) for store in stores]
    columns["piece_start"] = columns["piece_start"] + np.repeat(frames[:-1], pieces)
    columns["piece_clip"] = columns["piece_clip"] + np.repeat(clips[:-1], pieces)
    return MotionStore(**columns)


def run_from(options: argparse.Namespace, files: RunFiles, device: torch.device) -> Run:
    """The run of the last call, or one that begins with given weights."""
    path, config = options.work / CHECKPOINT, files.config
    bodies = [shaped_body(shape) for shape in draw_adults(config.bodies)]
    if path.is_file():
        held = load_checkpoint(path)
        if held.config != config:
            raise SystemExit(f"{path}: the run was begun with another configuration; want that, or an empty --work")
        return Run(config, bodies, [], str(device), held)
    begun = from_weights(options.start, config)
    if begun is None:
        raise SystemExit(f"{options.start}: want weights of the form that {options.config} trains")
    return Run(config, bodies, [], str(device), replace(begun, config=config, step=0, seconds=0.0))


@torch.no_grad()
def compared(run: Run, batches: list[DeviceBatch]) -> list[float]:
    """Loss of the averaged weights on given batches, then of the last ones."""
    now = {name: value.detach().clone() for name, value in run.model.state_dict().items()}
    found = []
    run.model.eval()
    for weights in (run.average, now):
        run.model.load_state_dict(weights)
        found.append(float(torch.stack([run.loss(batch).total for batch in batches]).mean()))
    run.model.train()
    return found


def save(options: argparse.Namespace, run: Run, motions: MotionSet, licenses: dict[str, str]) -> None:
    """State to go on from, and both weights."""
    state = run.state()
    save_checkpoint(options.work / CHECKPOINT, state)
    for name, weights in (("average", state.ema), ("last", state.model)):
        out = options.out / f"{name}.safetensors"
        write_run_weights(out, replace(state, ema=weights), motions, licenses=licenses)


def train(options: argparse.Namespace, files: RunFiles, begun: float) -> None:
    """Train until the time is over."""
    config, device = files.config, torch.device(options.device)
    errors = None if options.errors is None else PipelineErrors.read(options.errors)
    watched = watched_for(files)
    motions = MotionSet(wait_for(options.work / STORES / "all"), draw_adults(config.bodies), drawn_from(files))
    run, licenses = run_from(options, files, device), licenses_of(files, motions)
    data = DeviceBatches(config, options.shards * pool.SHARD_WINDOWS, device, errors, options.seed + run.step)
    held_out = DeviceBatches(config, pool.SHARD_WINDOWS, device, errors, 1)
    spheres = [fit_spheres(watched.body(0))]
    held_out.add(pool.made_shard(watched, SyntheticScenes(), spheres, np.random.default_rng(1)))
    check = Validator(watched, run.statistics)
    same = [held_out.draw() for _ in range(COMPARED_BATCHES)]
    say(options, begun, f"ready; {torch.cuda.get_device_name() if device.type == 'cuda' else 'cpu'}")
    taken: set[Path] = set()
    while take(options, data, taken) or len(taken) < min(FIRST_SHARDS, options.shards):
        time.sleep(0.01)
    say(options, begun, f"{len(taken)} shards")
    run.stopwatch = Stopwatch()
    looked, losses = run.seconds, []
    while run.seconds < options.train_s:
        cooling = options.cool_from_s is not None and run.seconds > options.cool_from_s
        share = (options.train_s - run.seconds) / (options.train_s - options.cool_from_s) if cooling else 1.0
        found, _ = run.advance([data.draw()], share)
        losses.append(torch.stack([found.total, found.simple, found.joints, found.inside]))
        if run.step % 10 == 0:
            take(options, data, taken)
        if run.seconds - looked > LOOK_EVERY_S:
            mean = torch.stack(losses).mean(0).tolist()
            speed = len(losses) * config.batch / (run.seconds - looked)
            of_average, of_last = compared(run, same)
            say(
                options, begun, f"step {run.step}, {run.seconds:.0f} s, rate {share:.2f}, {speed:.0f} windows/s, "
                f"{data.windows} in pool; loss {mean[0]:.4f} (simple {mean[1]:.4f}, joints {mean[2]:.4f}, inside "
                f"{mean[3]:.4f}); validation {of_average:.4f} average, {of_last:.4f} last",
            )  # fmt: skip
            save(options, run, motions, licenses)
            looked, losses = run.seconds, []
    save(options, run, motions, licenses)
    say(options, begun, f"trained to step {run.step}")
    run.model.half_precision = False
    for name, model in (("last", run.model), ("average", run.averaged())):
        told = ", ".join(
            f"{row.interval}{'s' if row.scene else ''} {row.mjpe_ratio:.4f}/{row.inside:.4f}" for row in check(model)
        )
        say(options, begun, f"{name}: {told}")


def take(options: argparse.Namespace, data: DeviceBatches, taken: set[Path]) -> bool:
    """Take one of the new shards, if there is any."""
    for path in sorted((options.work / POOL).glob("shard_????")):
        if path not in taken:
            data.add(read_shard(path))
            taken.add(path)
            return True
    return False


def say(options: argparse.Namespace, begun: float, text: str) -> None:
    """A line for the log."""
    line = f"{time.monotonic() - begun:.0f} s: {text}\n"
    sys.stdout.write(line)
    sys.stdout.flush()
    with (options.out / "log.txt").open("a") as log:
        log.write(line)


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--from-pack", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="state and windows; kept between two calls")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--errors", type=Path, help="of training/pipeline_errors.py")
    parser.add_argument(
        "--start", type=Path, default=WEIGHTS_FOLDER / "small.safetensors", help="weights to start from"
    )
    parser.add_argument("--config", default="gpu")
    parser.add_argument("--train-s", type=float, required=True)
    parser.add_argument("--cool-from-s", type=float)
    parser.add_argument("--makers", type=int, default=max(1, multiprocessing.cpu_count() - 2))
    parser.add_argument("--shards", type=int, default=512)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--device", default="cuda")
    return parser.parse_args()


if __name__ == "__main__":
    main()
