"""What each part of the model, of its data and of its training is worth: models trained alike, side by side.

    python benchmarks/scenemi/ablations.py --motion cmu.npz deepmimic.npz more.npz acted.npz --split split.json \
        --runs runs [--steps 3000] [--rows "as shipped" "no scene channels"]

All rows have the same size, steps, batch and seed: they compare with each other, not with the package's weights. A run
that is in `--runs` already goes on to `--steps`. Writes `ablations.json` and `.md`: validation clips at 15, 30 and 60
frames, and collisions in scenes that tell, before anything is cleared after sampling.
"""

from __future__ import annotations

import argparse
import datetime
import platform
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from scenemi.data.split import Split
from scenemi.files import write_json
from scenemi.model.build import build_denoiser
from scenemi.training.checkpoint import CHECKPOINT, Checkpoint, load_checkpoint
from scenemi.training.config import TrainConfig
from scenemi.training.loop import cool, train
from scenemi.training.runs import RunFiles, motions_for
from scenemi.training.validate import Validation, Validator

FREE = ("cmu_asfamc", "cmu_cc60", "cmu_daz", "cmu_expmap38", "cmu_humanoid44", "deepmimic", "accad", "synthetic")


@dataclass(frozen=True)
class Variant:
    """One row: what differs from the first."""

    name: str
    model: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)


VARIANTS = (
    Variant("as shipped"),
    Variant("no scene channels", model={"scene": False}, training={"inside_weight": 0.0}),
    Variant("no inside loss", training={"inside_weight": 0.0}),
    Variant("paper's form, narrow", model={"size": "paper-narrow"}, training={"relative": False, "keyframes": "paper"}),
    Variant("paper's loss", training={"relative": False}),
    Variant("paper's keyframes", training={"keyframes": "paper"}),
    Variant("speeds and accelerations count more", training={"velocity_weight": 0.2, "acceleration_weight": 0.05}),
    Variant("all steps alike", training={"first_step_share": 0.0}),
    Variant("no bent paths", training={"bends": 0}),
    Variant("no mixed arms, no reversal", training={"mix": 0.0, "reverse": 0.0}),
    Variant("no acted clips", training={"sources": [s for s in FREE if s != "synthetic"]}),
    Variant("no ACCAD", training={"sources": [s for s in FREE if s != "accad"]}),
    Variant("four frames a token", model={"fold": 4}),
    Variant("wider, fewer layers", model={"width": 384, "heads": 12, "layers": 4}),
)


def main() -> None:
    """Train what is missing, measure, write."""
    options = arguments()
    rows = []
    for variant in VARIANTS:
        if options.rows is None or variant.name in options.rows:
            rows.append({"row": variant.name, **measured(variant, options)})
            sys.stderr.write(f"{rows[-1]}\n")
    report = {
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads, Python {platform.python_version()}",
        "date": datetime.date.today().isoformat(), "seed": 0, "steps": options.steps, "cool": options.cool,
        "clips": [path.name for path in options.motion], "rows": rows,
    }  # fmt: skip
    write_json(options.out / "ablations.json", report)
    (options.out / "ablations.md").write_text(markdown(report))


def measured(variant: Variant, options: argparse.Namespace) -> dict[str, Any]:
    """Numbers of one variant."""
    shape = {"size": "small", **variant.model}
    config = TrainConfig.from_json({"model": shape, "pool_windows": options.pool, **variant.training})
    files = RunFiles(config, tuple(options.motion), Split.read(options.split), options.runs / "motion")
    motions, watched = motions_for(files)
    assert watched is not None
    out = options.runs / variant.name.replace(" ", "_").replace(",", "").replace("'", "")
    out.mkdir(parents=True, exist_ok=True)
    held = load_checkpoint(out / CHECKPOINT).step if (out / CHECKPOINT).is_file() else 0
    if held < options.steps:
        train(replace(config, save_every=500), motions, out, stop_at=options.steps)
    state = cool(out, motions, options.cool)
    return {
        "hours": round(state.seconds / 3600, 2), "minutes": round(motions.minutes, 1),
        "validation": [asdict(row) for row in validated(state, Validator(watched, state.statistics))],
    }  # fmt: skip


def validated(state: Checkpoint, check: Validator) -> tuple[Validation, ...]:
    """Numbers of the averaged weights."""
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
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--cool", type=int, default=600)
    parser.add_argument("--pool", type=int, default=8192)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/scenemi/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
