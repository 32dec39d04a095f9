"""What each part of the model and each source of motion is worth: small models, trained alike, side by side.

    python benchmarks/scenemi/ablations.py --motion cmu.npz deepmimic.npz acted.npz --split split.json --runs runs

All rows share width, steps, batch and seed (`--width`, `--steps`), so they compare with each other and not with the
package's weights. Rows with the same motion share the learned interpolation, which is trained once. A run that is in
`--runs` already is not trained again. Writes `ablations.json` and `.md`.
"""

from __future__ import annotations

import argparse
import datetime
import platform
import shutil
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenemi.choice import choose_prior
from scenemi.data.balance import BalanceConfig
from scenemi.data.container import MotionArchive, read_split
from scenemi.data.split import Split
from scenemi.data.windows import MotionSet, MotionSetConfig
from scenemi.evaluation.protocol import evaluate
from scenemi.evaluation.scenes import with_pseudo_scenes
from scenemi.evaluation.scores import mean_of
from scenemi.evaluation.windows import EvaluationWindow, KeyframeProtocol, cut_windows
from scenemi.files import write_json
from scenemi.model.config import SIZES
from scenemi.model.denoiser import Denoiser
from scenemi.model.weights import save_weights
from scenemi.training.config import TrainConfig
from scenemi.training.loop import train

PROTOCOLS = {
    "r = 15": KeyframeProtocol(15),
    "r = 60": KeyframeProtocol(60),
    "r = 3, l = 1": KeyframeProtocol(3, noise=1.0),
}
_WEIGHTS = "weights.safetensors"
CMU = ("cmu_asfamc", "cmu_cc60", "cmu_daz", "cmu_expmap38", "cmu_humanoid44")


@dataclass(frozen=True)
class Variant:
    """One row: what differs from the first."""

    name: str
    model: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    sources: tuple[str, ...] | None = None
    own_joiners: bool = False
    """Trains its own learned interpolation."""


VARIANTS = (
    Variant("all"),
    Variant("no global scene", {"use_global": False}),
    Variant("no local scene", {"use_local": False}),
    Variant("no scene", {"use_global": False, "use_local": False}),
    Variant("no body shape", {"use_body": False}),
    Variant("scene 96 x 48 x 96", {"grid": (96, 48, 96), "voxel_m": 0.05, "patch": (16, 16, 16)}),
    Variant("256 basis points", {"bps_anchors": 256}),
    Variant("conditions as tokens", {"condition": "token"}),
    Variant("conditions by AdaGN", {"condition": "adagn"}),
    Variant("no residual", {"residual": False}, own_joiners=True),
    Variant("no learned interpolation", {"joiners": 0}, own_joiners=True),
    Variant("noisy keyframes not smoothed", {"smooth_keyframes": False}, own_joiners=True),
    Variant("no augmentation in time and parts", {}, {"reverse": 0.0, "mix": 0.0}, own_joiners=True),
    Variant("CMU only", sources=CMU, own_joiners=True),
    Variant("captured only", sources=(*CMU, "deepmimic"), own_joiners=True),
)


def main() -> None:
    """Train what is missing, evaluate all, write the table."""
    options = arguments()
    chosen = [variant for variant in VARIANTS if not options.only or variant.name in options.only]
    names = read_split(options.split)["test"]
    windows = with_pseudo_scenes(cut_windows([MotionArchive.read(options.motion[0])], names))
    windows = windows[:: options.every]
    rows = []
    for variant in chosen:
        folder = options.runs / variant.name.replace(" ", "_").replace(",", "")
        seconds = trained(variant, folder, options)
        rows.append({"row": variant.name, "train_s": seconds, **measured(folder / _WEIGHTS, windows, options)})
        sys.stderr.write(f"{variant.name} done\n")
    report = {
        "title": "Ablations", "rows": rows, "windows": len(windows), "width": options.width, "steps": options.steps,
        "joiner_steps": options.joiner_steps, "batch": options.batch, "seed": options.seed,
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads, Python {platform.python_version()}",
        "date": datetime.date.today().isoformat(), "motion": [path.name for path in options.motion],
    }  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "ablations.json", report)
    (options.out / "ablations.md").write_text(markdown(report))
    sys.stdout.write(markdown(report))


def trained(variant: Variant, folder: Path, options: argparse.Namespace) -> float:
    """Seconds of training (0 where it was trained before)."""
    if (folder / _WEIGHTS).is_file():
        return 0.0
    model = replace(SIZES["small"], width=options.width, joiner_width=options.joiner_width, **variant.model)
    config = TrainConfig(
        model=model, steps=options.steps, batch=options.batch, joiner_steps=options.joiner_steps, seed=options.seed,
        joiner_windows=options.joiner_windows, cooldown=0.3, warmup=100, relative=model.residual, validate_every=10**9,
        save_every=500,
    )  # fmt: skip
    config = replace(config, **variant.training)
    shared = options.runs / "all"
    folder.mkdir(parents=True, exist_ok=True)
    if not variant.own_joiners:
        for path in sorted(shared.glob("joiner_*.safetensors")):
            if path.parent != folder:
                shutil.copy(path, folder / path.name)
    use = MotionSetConfig(
        sources=variant.sources, balance=BalanceConfig(source_share={"synthetic": config.synthetic_share}),
        reverse=config.reverse, mix=config.mix,
    )  # fmt: skip
    motions = MotionSet.build(
        options.motion, Split.read(options.split), "train", config.bodies, use, cache=options.runs / "cache"
    )
    start = time.perf_counter()
    state = train(config, motions, folder)
    seconds = time.perf_counter() - start
    denoiser = Denoiser(config.model)
    denoiser.load_state_dict(state.ema)
    save_weights(folder / _WEIGHTS, denoiser, state.statistics, {"variant": variant.name})
    (folder / "checkpoint.safetensors").unlink(missing_ok=True)
    return seconds


def measured(weights: Path, windows: tuple[EvaluationWindow, ...], options: argparse.Namespace) -> dict[str, Any]:
    """Numbers of one model; bodies are not moved out of solids afterwards, so that the model itself is seen."""
    prior = choose_prior(str(weights), steps=options.sampling_steps, clear_rounds=0)
    found: dict[str, Any] = {}
    for name, protocol in PROTOCOLS.items():
        one = evaluate(windows, prior, protocol, seed=options.seed)
        found[name] = {
            "mjpe_all_m": one.mean("mjpe_all_m"),
            "mjpe_ratio": one.mean("mjpe_all_m") / mean_of(one.baseline, "mjpe_all_m"),
            "jerk_ratio": one.mean("jerk_m_s3") / mean_of(one.truth, "jerk_m_s3"),
            "skating_gmd": one.mean("skating_gmd"),
            "close_collision_1cm": one.mean("close_collision_frame_ratio_1cm"),
        }
    return found


def markdown(report: dict[str, Any]) -> str:
    """The report as text."""
    lines = [
        f"# {report['title']}",
        "",
        f"Models of width {report['width']}, {report['steps']} steps of {report['batch']} windows after "
        f"{report['joiner_steps']} steps of the learned interpolation, seed {report['seed']}; {report['windows']} CMU "
        f"test windows in random scenes; {report['machine']}, {report['date']}.",
        "",
        "| | " + " | ".join(f"{name}: MJPE cm | jerk | close" for name in PROTOCOLS) + " |",
        "|---|" + "---|---|---|" * len(PROTOCOLS),
    ]
    for row in report["rows"]:
        cells = []
        for name in PROTOCOLS:
            one = row[name]
            close = one["close_collision_1cm"]
            cells.append(f"{100 * one['mjpe_all_m']:.2f} ({one['mjpe_ratio']:.2f}) | {one['jerk_ratio']:.2f}")
            cells.append("" if not np.isfinite(close) else f"{close:.3f}")
        lines.append(f"| {row['row']} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "In brackets: over interpolation's; jerk: over the truth's; close: share of the frames near the scene in",
    ]
    lines.append("which the skin is more than 1 cm inside.")
    return "\n".join(lines) + "\n"


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", type=Path, nargs="+", required=True, help="the first one holds the test clips")
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the trained models")
    parser.add_argument("--only", nargs="+", default=[], help="names of rows")
    parser.add_argument("--width", type=int, default=48)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--joiner-steps", type=int, default=800)
    parser.add_argument("--joiner-windows", type=int, default=4000)
    parser.add_argument("--joiner-width", type=int, default=256)
    parser.add_argument("--sampling-steps", type=int, default=10)
    parser.add_argument("--every", type=int, default=2, help="use every so manyth window")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/scenemi/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
