"""SceneMI and the six methods that the paper compares it with, all trained alike: the paper's tables 1 and 3.

    python benchmarks/scenemi/baselines.py --motion cmu.npz deepmimic.npz more.npz acted.npz --split split.json \
        --test cmu.npz --runs runs [--size small] [--steps 20000] [--cool 2000] [--rows scenemi mdm]

All rows have about the same size, and the same windows, batch, steps, learning rate and seed. SceneMI has its shipped
settings; the others have the paper's objective and exact keyframes (`TrainConfig.of_method`) and the samplers of
`scenemi.model.baselines`. An existing run in `--runs` continues up to `--steps`. Every row is measured on the windows
of `--test`, each in a scene, with exact keyframes every 15, 30 and 60 frames (table 1) and noisy ones every 3 (table
3). Each row is written to `runs/ROW/numbers.json`, and all finished rows to `table_baselines.json` and `.md`. The row
`scenemi` is the output of the network, as for the other methods; `scenemi, solved` is the result of `scenemi sample`.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from scenemi.data.container import MotionArchive, read_split
from scenemi.data.files import write_json
from scenemi.data.split import Split
from scenemi.evaluation.fid import shipped_features
from scenemi.evaluation.protocol import evaluate
from scenemi.evaluation.scenes import SCENE_SEED, with_synthetic_scenes
from scenemi.evaluation.windows import EvaluationWindow, KeyframeProtocol, cut_windows
from scenemi.model.choice import INTERPOLATION, load_prior_by_name
from scenemi.postprocess.in_scene import SolvedPrior
from scenemi.training.checkpoint import CHECKPOINT, load_checkpoint
from scenemi.training.config import METHODS, TrainConfig
from scenemi.training.loop import POOL, cool, train
from scenemi.training.pool import grow_pool
from scenemi.training.runs import RunFiles, motions_for, write_run_weights
from video2anim.digest import file_digest

OURS, SOLVED = "scenemi", "scenemi, solved"
ROWS = (INTERPOLATION, *METHODS, OURS, SOLVED)
PROTOCOLS = {
    "table 1, r = 15": KeyframeProtocol(15), "table 1, r = 30": KeyframeProtocol(30),
    "table 1, r = 60": KeyframeProtocol(60), "table 3, r = 3, l = 1": KeyframeProtocol(3, noise=1.0),
}  # fmt: skip
COLUMNS = ("fid", "skating_gmd", "jerk_m_s3", "mjpe_key_m", "mjpe_all_m", "collision_frame_ratio", "penetration_max_m")


def main() -> None:
    """Train missing models, measure them, write the report."""
    options = arguments()
    names = read_split(options.split)[options.part]
    cut = cut_windows([MotionArchive.read(path) for path in options.test], names)
    windows = with_synthetic_scenes(cut)[:: options.every]
    for row in options.rows:
        folder(row, options).mkdir(parents=True, exist_ok=True)
        found = {} if row == INTERPOLATION else trained(OURS if row == SOLVED else row, options)
        found |= {"row": row, "windows": len(windows), "numbers": measured(row, windows, options)}
        write_json(folder(row, options) / "numbers.json", found)
    paths = [folder(row, options) / "numbers.json" for row in ROWS]
    report = {
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads, Python {platform.python_version()}",
        "date": datetime.date.today().isoformat(), "device": options.device, "seed": 0, "size": options.size,
        "steps": options.steps, "cool": options.cool, "scene_seed": SCENE_SEED, "part": options.part,
        "clips": [path.name for path in options.motion], "test_clips": [path.name for path in options.test],
        "rows": [json.loads(path.read_text()) for path in paths if path.is_file()],
    }  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "table_baselines.json", report)
    text = markdown(report)
    (options.out / "table_baselines.md").write_text(text)
    sys.stdout.write(text)


def folder(row: str, options: argparse.Namespace) -> Path:
    """Folder of a row's run."""
    return options.runs / row.replace(", ", "_")


def trained(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Facts about the model of a row, which is trained up to `--steps` first."""
    config = TrainConfig.from_json({"model": options.size, "pool_windows": options.pool, **options.training})
    files = RunFiles(config, tuple(options.motion), Split.read(options.split), options.runs / "motion")
    motions, _ = motions_for(files)
    config = config if name == OURS else config.of_method(name)
    out = folder(name, options)
    out.mkdir(exist_ok=True)
    grow_pool(options.runs / POOL, motions, options.pool, seed=config.seed)
    if not (out / POOL).exists():
        (out / POOL).symlink_to(Path("..") / POOL)
    held = load_checkpoint(out / CHECKPOINT).step if (out / CHECKPOINT).is_file() else 0
    if held < options.steps:
        train(replace(config, save_every=200), motions, out, device=options.device, stop_at=options.steps)
    weights = out / "weights.safetensors"
    if held < options.steps or not weights.is_file():
        state = cool(out, motions, options.cool, device=options.device)
        write_run_weights(weights, state, motions)
    prior: Any = load_prior_by_name(str(weights))
    card, parameters = prior.model.card, sum(p.numel() for p in prior.model.denoiser.parameters())
    return {
        "parameters": parameters, "steps": card["steps"], "hours": card["hours"], "minutes": card["minutes"],
        "step_windows": config.step_windows, "sha256": file_digest(weights),
    }  # fmt: skip


def measured(row: str, windows: tuple[EvaluationWindow, ...], options: argparse.Namespace) -> dict[str, Any]:
    """All numbers of a row by protocol."""
    weights = INTERPOLATION if row == INTERPOLATION else str(folder(row.split(",")[0], options) / "weights.safetensors")
    prior: Any = load_prior_by_name(weights, device=options.device)
    prior = SolvedPrior(prior) if row == SOLVED else prior
    found = {}
    for name, protocol in PROTOCOLS.items():
        found[name] = evaluate(windows, prior, protocol, features=shipped_features()).details()
        sys.stderr.write(f"{row}, {name}: {found[name]['prior']['mjpe_all_m']:.4f} m\n")
    return found


def markdown(report: dict[str, Any]) -> str:
    """The report as tables."""
    rows = report["rows"]
    lines = [
        f"Size {report['size']}, {report['steps']} steps and {report['cool']} of falling rate, seed {report['seed']}; "
        f"{rows[0]['windows']} windows of {', '.join(report['test_clips'])} ({report['part']}); {report['machine']}, "
        f"{report['device']}, {report['date']}. Means with 95 % intervals over clips.", "",
        "| | parameters | windows of training | hours | s per window |", "|---|---|---|---|---|",
    ]  # fmt: skip
    for row in rows:
        if "steps" in row:
            seconds = row["numbers"]["table 1, r = 60"]["seconds_per_window"]
            lines.append(
                f"| {row['row']} | {row['parameters']} | {row['steps'] * row['step_windows']} | {row['hours']} | "
                f"{seconds:.2f} |"
            )
    for name in PROTOCOLS:
        lines += ["", f"**{name[0].upper()}{name[1:]}**", "", "| | " + " | ".join(COLUMNS) + " |"]
        lines.append("|---|" + "---|" * len(COLUMNS))
        for row in rows:
            lines.append(f"| {row['row']} | " + " | ".join(_cell(row["numbers"][name], c) for c in COLUMNS) + " |")
        truth = rows[0]["numbers"][name]["truth"]
        lines.append("| truth | " + " | ".join(_text(truth.get(column)) for column in COLUMNS) + " |")
    return "\n".join(lines) + "\n"


def _cell(numbers: dict[str, Any], column: str) -> str:
    if column in numbers:
        return _text(numbers[column])
    low, high = numbers["prior_95"][column]
    return f"{_text(numbers['prior'][column])} [{_text(low)}, {_text(high)}]"


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", type=Path, nargs="+", required=True, help="to train on")
    parser.add_argument("--test", type=Path, nargs="+", required=True, help="to measure on")
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--part", default="test")
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS)
    parser.add_argument("--size", default="small", help="size of the network: small or tiny")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--cool", type=int, default=2000)
    parser.add_argument("--pool", type=int, default=32_768)
    parser.add_argument("--training", type=json.loads, default={}, help="further training settings, as JSON")
    parser.add_argument("--every", type=int, default=1, help="use every so manyth window")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/scenemi/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
