"""The training loop: resumable to the step, with no end of its own."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

from scenemi.data.windows import MotionSet
from scenemi.model.baselines.build import build_any
from scenemi.model.config import BaselineConfig
from scenemi.model.weights import load_weights
from scenemi.training.batches import PoolBatches
from scenemi.training.checkpoint import CHECKPOINT, Checkpoint, load_checkpoint
from scenemi.training.config import FREE, TrainConfig
from scenemi.training.noise import PipelineErrors
from scenemi.training.pool import SHARD_WINDOWS, AnyShard, grow_pool, open_pool
from scenemi.training.run import Progress, Run
from scenemi.training.scene_pool import SceneMotions
from scenemi.training.validate import Validator
from scenemi.training.watch import Watch
from video2anim.errors import InputError

POOL, SCENE_POOL = "pool", "pool_captured"
_FIRST_SHARDS = 2
"""Of the pool, made before the first step; another one follows now and then."""


def train(
    config: TrainConfig,
    motions: MotionSet,
    out: Path,
    *,
    scenes: SceneMotions | None = None,
    validation: MotionSet | None = None,
    device: str = "cpu",
    errors: PipelineErrors | None = None,
    start: Path | None = None,
    stop_at: int | None = None,
    time_limit_s: float | None = None,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> Checkpoint:
    """Train, or go on training, in the folder `out`.

    Args:
        config: the run; a resumed run must have the same, save for what does not change weights.
        motions: clips on bodies, from which the pool in `out/pool` is made; in made-up scenes, or captured ones.
        out: folder of the pool, the checkpoint, `log.csv` and `progress.json`.
        scenes: clips in captured scenes on the same bodies, beside others in `motions`; half of the batches are theirs.
        validation: windows that sampled numbers are made of; baselines, which are sampled in other ways, have none.
        device: of torch.
        errors: of the video pipeline, for noisy keyframes.
        start: weights to begin from where `out` has no checkpoint or one with fewer steps, if they are of the same
            architecture.
        stop_at: end after this step; None = at the time limit, or never.
        time_limit_s: end after this time.
        on_progress: called every `config.log_every` steps, and after each validation.

    Raises:
        InputError: the checkpoint in `out` is of another configuration.
        StageError: training met no finite gradient any more.
    """
    held = _begun(out, config, start)
    pools = {POOL: motions} if scenes is None else {POOL: motions, SCENE_POOL: scenes}
    _grow(out, pools, min(config.pool_windows, _FIRST_SHARDS * SHARD_WINDOWS), config.seed)
    shards = _shards(out)
    run = Run(config, motions.bodies(), shards, device, held)
    watched = None if isinstance(config.model, BaselineConfig) else validation
    check = None if watched is None else Validator(watched, run.statistics)
    watch = Watch(run, out, check, on_progress)
    data = PoolBatches(shards, config, errors)
    try:
        for batches in data.ahead(range(run.step, stop_at if stop_at is not None else 2**62), config.workers):
            watch.took(*run.advance(batches))
            if run.stopwatch.is_over(time_limit_s) or run.step == stop_at:
                break
            if run.step % config.save_every == 0:
                watch.save()
            if run.step % config.grow_every == 0:
                _enlarge(data, pools, out, config)
    finally:  # interrupted, too
        watch.save()
    return run.state()


def _begun(out: Path, config: TrainConfig, start: Path | None) -> Checkpoint | None:
    """The state to go on from, of the folder or of given weights, whichever has more steps."""
    held = load_checkpoint(out / CHECKPOINT) if (out / CHECKPOINT).is_file() else None
    begun = from_weights(start, config)
    if begun is not None and (held is None or begun.step > held.step):
        held = begun
    if held is not None and (differing := _differing(held.config, config)):
        raise InputError(
            f"training: {out / CHECKPOINT} was trained with other {', '.join(differing)}; give another folder, or the "
            "configuration it was begun with"
        )
    return held


def cool(
    out: Path,
    motions: MotionSet,
    steps: int,
    *,
    errors: PipelineErrors | None = None,
    device: str = "cpu",
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> Checkpoint:
    """The state of a run after so many more steps in which the learning rate falls to zero; the run itself stays as it
    is. The average of weights is taken over these steps too.

    Raises:
        InputError: no checkpoint.
        StageError: training met no finite gradient any more.
    """
    held = load_checkpoint(out / CHECKPOINT)
    shards = _shards(out)
    run = Run(held.config, motions.bodies(), shards, device, held)
    data = PoolBatches(shards, held.config, errors)
    last = run.step + steps
    for batches in data.ahead(range(run.step, last), held.config.workers):
        losses, _ = run.advance(batches, (last - run.step) / steps)
        if run.step % held.config.log_every == 0:
            on_progress(run.progress(float(losses.total)))
    return run.state()


def from_weights(path: Path | None, config: TrainConfig) -> Checkpoint | None:
    """Shipped weights as the state of a run whose checkpoint is gone: the optimizer begins anew."""
    if path is None or not path.is_file():
        return None
    try:
        found = load_weights(path, build=build_any)
    except InputError:
        return None  # of an older format
    if found.config != config.model:
        return None
    state = found.denoiser.state_dict()
    hours, steps, trained = (
        float(found.card.get("hours", 0.0)),
        int(found.card.get("steps", 0)),
        found.card.get("config", {}),
    )
    windows = steps * int(trained.get("batch", config.batch)) * int(trained.get("parts", config.parts))
    return Checkpoint(windows // config.step_windows, config, found.statistics, state, state, {}, 3600 * hours)


def _grow(out: Path, pools: Mapping[str, MotionSet], windows: int, seed: int) -> None:
    for name, motions in pools.items():
        grow_pool(out / name, motions, windows, seed=seed)


def _shards(out: Path) -> list[AnyShard]:
    """Of the pool, and of that in captured scenes where there is one."""
    captured = open_pool(out / SCENE_POOL) if (out / SCENE_POOL).is_dir() else []
    return [*open_pool(out / POOL), *captured]


def _enlarge(data: PoolBatches, pools: Mapping[str, MotionSet], out: Path, config: TrainConfig) -> None:
    """One more shard, until each pool has all its windows. Batches drawn ahead are of the smaller pool."""
    there = sum(map(len, data.shards)) // len(pools)
    wanted = min(config.pool_windows, there + SHARD_WINDOWS)
    if wanted > there:
        _grow(out, pools, wanted, config.seed)
        data.take(_shards(out))


def _differing(held: TrainConfig, wanted: TrainConfig) -> list[str]:
    a, b = (json.loads(json.dumps(config.to_json())) for config in (held, wanted))
    return [key for key in a if key not in FREE and a[key] != b[key]]
