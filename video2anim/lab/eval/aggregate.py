"""Statistics over many clips: mean, median and confidence interval of every number, and the clips that failed."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from video2anim.errors import InputError, Video2AnimError
from video2anim.lab.eval.evaluate import evaluate
from video2anim.lab.eval.model import Evaluation, SetEvaluation, SetGroup, SetRow, Statistic

RESAMPLES = 2000
"""Number of bootstrap samples of the confidence interval."""
_CONFIDENCE = 95
NO_RESULT = "no result"


def paired_folders(results_dir: Path, truth_dir: Path) -> tuple[list[tuple[Path, Path]], list[str]]:
    """The (scene folder, truth folder) of every clip of the truth, paired by name, and names of results without truth.

    Raises:
        InputError: one of the two is not a folder, or `truth_dir` holds no truth folder.
    """
    for path in (results_dir, truth_dir):
        if not os.path.isdir(path):  # Path.is_dir raises where a name is too long
            raise InputError(f"eval-set: want a folder with one folder per clip, found none at {path}")
    names = sorted(path.parent.name for path in truth_dir.glob("*/meta.json"))
    if not names:
        raise InputError(f"--truth: want truth folders with a meta.json inside, found none in {truth_dir}")
    results = {path.parent.name for path in results_dir.glob("*/run.json")}
    return [(results_dir / name, truth_dir / name) for name in names], sorted(results - set(names))


def evaluate_set(
    pairs: Sequence[tuple[Path, Path]],
    *,
    seed: int = 0,
    workers: int = 1,
    on_clip: Callable[[int, int], None] = lambda done, total: None,
) -> SetEvaluation:
    """Evaluate many clips. A clip that cannot be evaluated is counted as a failure and raises no error.

    Args:
        pairs: (scene folder, truth folder) of each clip; the name of the truth folder is the clip's name.
        seed: Seed of the bootstrap.
        workers: Number of processes.
        on_clip: Called with the number of finished clips and the number of all clips.
    """
    evaluated: list[tuple[str, Evaluation]] = []
    failures: list[tuple[str, str]] = []
    for done, (name, outcome) in enumerate(_outcomes(pairs, workers)):
        on_clip(done + 1, len(pairs))
        if isinstance(outcome, str):
            failures.append((name, outcome))
        else:
            evaluated.append((name, outcome))
    return summarize(evaluated, failures, seed=seed)


def _outcomes(pairs: Sequence[tuple[Path, Path]], workers: int) -> Iterator[tuple[str, Evaluation | str]]:
    """Name, and evaluation or the reason of the failure, in the order of the pairs."""
    if workers <= 1 or len(pairs) <= 1:
        yield from map(_outcome, pairs)
        return
    with ProcessPoolExecutor(min(workers, len(pairs)), mp_context=get_context("spawn")) as pool:
        yield from pool.map(_outcome, pairs)


def _outcome(pair: tuple[Path, Path]) -> tuple[str, Evaluation | str]:
    scene_dir, truth_dir = map(Path, pair)
    try:
        if not (scene_dir / "run.json").is_file():
            raise InputError(f"{NO_RESULT}: {scene_dir} is not a scene folder")
        return truth_dir.name, evaluate(scene_dir, truth_dir)
    except Video2AnimError as error:
        return truth_dir.name, str(error)


def summarize(
    evaluated: Sequence[tuple[str, Evaluation]], failures: Sequence[tuple[str, str]], *, seed: int = 0
) -> SetEvaluation:
    """Statistics over named evaluations; failures are (clip name, reason)."""
    groups = []
    for i, first in enumerate(evaluated[0][1].groups if evaluated else ()):
        rows = []
        for j, row in enumerate(first.rows):
            same = [evaluation.groups[i].rows[j] for _, evaluation in evaluated]
            values = tuple(tuple(item.values[column] for item in same) for column in range(len(first.columns)))
            true = [item.truth for item in same]
            statistics = tuple(statistic(column, seed=seed) for column in values)
            rows.append(
                SetRow(
                    tuple(
                        replace(quality, value=math.nan if found is None else found.mean)
                        for quality, found in zip(row.qualities, statistics, strict=True)
                    ),
                    statistics,
                    _mean(true),
                    values,
                )
            )
        groups.append(SetGroup(first.key, first.title, first.columns, tuple(rows)))
    return SetEvaluation(
        clips=tuple(name for name, _ in evaluated),
        failures=tuple(failures),
        notes=tuple((name, note) for name, evaluation in evaluated for note in evaluation.notes),
        facts=tuple(evaluation.facts for _, evaluation in evaluated),
        groups=tuple(groups),
    )


def statistic(values: Sequence[float | None], *, seed: int = 0) -> Statistic | None:
    """Mean with its percentile-bootstrap interval, and median, over the clips that have the number; None if none
    has."""
    present = np.array([value for value in values if value is not None], dtype=np.float64)
    if not len(present):
        return None
    drawn = np.random.default_rng(seed).integers(0, len(present), (RESAMPLES, len(present)))
    tail = (100 - _CONFIDENCE) / 2
    low, high = np.percentile(present[drawn].mean(1), [tail, 100 - tail])
    return Statistic(len(present), float(present.mean()), float(np.median(present)), float(low), float(high))


def _mean(values: Sequence[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if present else None
