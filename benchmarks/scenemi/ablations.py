"""Ablations: models trained without single parts of the model, the data or the training, compared with a base model.

    python benchmarks/scenemi/ablations.py --motion cmu.npz deepmimic.npz more.npz acted.npz --split split.json \
        --runs runs [--steps 400] [--rows "base" "no scene channels"]

All rows have the same size, steps, batch and seed, so they can be compared with each other, but not with the package's
weights. They learn one task only, the expected motion between exact keyframes (`ALONE`), so that short runs differ. An
existing run in `--runs` continues up to `--steps`; rows with the same data share its windows. Each finished row is
written to `runs/ROW/numbers.json`, and all finished rows to `ablations.json` and `.md`: errors on the validation clips
of the base at 15, 30 and 60 frames, and collisions in blocking scenes, without postprocessing.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import re
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from scenemi.data.files import write_json
from scenemi.data.split import Split
from scenemi.model.build import build_denoiser
from scenemi.training.checkpoint import CHECKPOINT, Checkpoint, load_checkpoint
from scenemi.training.config import TrainConfig
from scenemi.training.loop import POOL, cool, train
from scenemi.training.noise import PipelineErrors
from scenemi.training.pool import grow_pool
from scenemi.training.runs import RunFiles, motions_for
from scenemi.training.validate import Validation, Validator

ALONE = {"first_step_share": 1.0, "noisy_share": 0.0, "pipeline_share": 0.0}
"""Task of the base: every window at the first step of sampling, with exact keyframes."""
FREE = ("cmu_asfamc", "cmu_cc60", "cmu_daz", "cmu_expmap38", "cmu_humanoid44", "deepmimic", "accad", "synthetic")


NUMBERS = "numbers.json"


@dataclass(frozen=True)
class Variant:
    """One row: its differences to the base."""

    name: str
    model: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)
    """Training settings that change the windows."""

    @property
    def folder(self) -> str:
        """Name of the row's folder."""
        return re.sub(r"\W+", "_", self.name)

    @property
    def pool(self) -> str:
        """Name of the folder of its windows."""
        return "pool" if not self.data else f"pool_{self.folder}"


VARIANTS = (
    Variant("base"),
    Variant("no scene channels", model={"scene": False}, training={"inside_weight": 0.0}),
    Variant("no inside loss", training={"inside_weight": 0.0}),
    Variant("inside loss 0.5", training={"inside_weight": 0.5}),
    Variant("paper's form, narrow", model={"size": "paper-narrow"}, training={"relative": False, "keyframes": "paper"}),
    Variant("paper's loss", training={"relative": False}),
    Variant("as shipped: all tasks", training={key: getattr(TrainConfig(), key) for key in ALONE}),
    Variant("no bent paths", data={"bends": 0}),
    Variant("no mixed arms, no reversal", data={"mix": 0.0, "reverse": 0.0}),
    Variant("no acted clips", data={"sources": [s for s in FREE if s != "synthetic"]}),
    Variant("no ACCAD", data={"sources": [s for s in FREE if s != "accad"]}),
)


def main() -> None:
    """Train missing models, measure them, write the report."""
    options = arguments()
    for variant in VARIANTS:
        if options.rows is None or variant.name in options.rows:
            found = measured(variant, options)
            write_json(options.runs / variant.folder / NUMBERS, found)
            sys.stderr.write(f"{found}\n")
    paths = [options.runs / variant.folder / NUMBERS for variant in VARIANTS]
    report = {
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads, Python {platform.python_version()}",
        "date": datetime.date.today().isoformat(), "seed": 0, "steps": options.steps, "cool": options.cool,
        "clips": [path.name for path in options.motion],
        "rows": [json.loads(path.read_text()) for path in paths if path.is_file()],
    }  # fmt: skip
    write_json(options.out / "ablations.json", report)
    (options.out / "ablations.md").write_text(markdown(report))


def measured(variant: Variant, options: argparse.Namespace) -> dict[str, Any]:
    """Train and measure one variant."""
    shape = {"size": "small", **variant.model}
    chosen = {**ALONE, **variant.training, **variant.data}
    config = TrainConfig.from_json({"model": shape, "pool_windows": options.pool, **chosen})
    files = RunFiles(config, tuple(options.motion), Split.read(options.split), options.runs / "motion")
    motions, _ = motions_for(files)
    _, watched = motions_for(replace(files, config=TrainConfig()))
    assert watched is not None
    out = options.runs / variant.folder
    out.mkdir(parents=True, exist_ok=True)
    grow_pool(options.runs / variant.pool, motions, options.pool, seed=config.seed)
    if not (out / POOL).exists():
        (out / POOL).symlink_to(Path("..") / variant.pool)
    held = load_checkpoint(out / CHECKPOINT).step if (out / CHECKPOINT).is_file() else 0
    errors = None if options.errors is None else PipelineErrors.read(options.errors)
    if held < options.steps:
        train(replace(config, save_every=200), motions, out, errors=errors, stop_at=options.steps)
    state = cool(out, motions, options.cool, errors=errors)
    return {
        "row": variant.name, "steps": options.steps, "hours": round(state.seconds / 3600, 2),
        "minutes": round(motions.minutes, 1),
        "validation": [asdict(row) for row in validated(state, Validator(watched, state.statistics))],
    }  # fmt: skip


def validated(state: Checkpoint, check: Validator) -> tuple[Validation, ...]:
    """Validation of the averaged weights."""
    model = build_denoiser(state.config.model)
    model.load_state_dict(state.ema)
    return check(model)


def markdown(report: dict[str, Any]) -> str:
    """The report as a table."""
    lines = [
        f"{report['steps']} steps and {report['cool']} of falling rate, seed {report['seed']}; {report['machine']}, "
        f"{report['date']}. Validation clips; error over that of the joined keyframes, the expected motion (one step).",
        "", "| | 15 | 30 | 60 | 60, scene shown | inside, not shown | inside, shown | minutes of motion | hours |",
        "|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["rows"]:
        r15, r30, r60, shown = row["validation"]
        lines.append(
            f"| {row['row']} | {r15['mjpe_ratio']:.3f} | {r30['mjpe_ratio']:.3f} | {r60['mjpe_ratio']:.3f} | "
            f"{shown['mjpe_ratio']:.3f} | {r60['inside']:.4f} | {shown['inside']:.4f} | {row['minutes']} | "
            f"{row['hours']} |"
        )
    return "\n".join(lines) + "\n"


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", type=Path, nargs="+", required=True)
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--rows", nargs="+")
    parser.add_argument("--errors", type=Path, help="errors of the video pipeline, for the row with all tasks")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--cool", type=int, default=200)
    parser.add_argument("--pool", type=int, default=4096)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/scenemi/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
