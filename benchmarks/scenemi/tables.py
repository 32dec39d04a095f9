"""The paper's tables on the test split of the CMU clips.

    python benchmarks/scenemi/tables.py 1 2 --motion cmu.npz --split split.json
    python benchmarks/scenemi/tables.py 1 2 --weights small FILE ...

Tables: 1 (clean keyframes every 60 frames, scene ablations), 2 (the same, frames close to the scene), 3 (noisy
keyframes every 3 frames, T*), 6 (keyframe selection), 7 (time), 8 (one row for each weights file given with
`--variant NAME=FILE`), 9 (20 seeds). Writes JSON and Markdown. Tables of one command share common evaluations.

`at sampling` marks rows in which a trained model is sampled without a condition; rows of `--variant` are other models.
Every number is the mean over windows. FID uses this package's own features, so it is not comparable with other papers.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenemi.data.container import MotionArchive, read_split
from scenemi.data.files import write_json
from scenemi.evaluation.ablation import AblatedPrior
from scenemi.evaluation.fid import FID_DIGEST, shipped_features
from scenemi.evaluation.protocol import Evaluation, evaluate
from scenemi.evaluation.scenes import SCENE_SEED, Obstacles, with_synthetic_scenes
from scenemi.evaluation.scores import over_seeds
from scenemi.evaluation.windows import EvaluationWindow, KeyframeProtocol, cut_windows
from scenemi.model.choice import INTERPOLATION, load_prior_by_name
from scenemi.prior import InbetweeningPrior
from video2anim.digest import file_digest

TABLES = ("1", "2", "3", "6", "7", "8", "9")
CLEAN = KeyframeProtocol(60)
NOISY = KeyframeProtocol(3, noise=1.0)
ABLATIONS: dict[str, dict[str, bool]] = {
    "w/o scene (at sampling)": {"use_scene": False},
}
QUALITY = ("fid", "skating_gmd", "jerk_m_s3", "mjpe_key_m", "mjpe_all_m", "collision_frame_ratio", "penetration_max_m")
CLOSE = ("close_collision_frame_ratio", "close_collision_frame_ratio_1cm", "close_collision_vertex_ratio",
         "close_penetration_max_m")  # fmt: skip
SELECTIONS = {
    "uniform r = 1": KeyframeProtocol(1, noise=1.0),
    "uniform r = 3": NOISY,
    "uniform r = 15": KeyframeProtocol(15, noise=1.0),
    "uniform r = 60": KeyframeProtocol(60, noise=1.0),
    "random p = 0.2": KeyframeProtocol(None, 0.2, noise=1.0),
    "random p = 0.5": KeyframeProtocol(None, 0.5, noise=1.0),
}


@dataclass
class Table:
    """A table with its rows so far."""

    title: str
    columns: tuple[str, ...]
    rows: list[dict[str, Any]] = field(default_factory=list)

    def add(self, name: str, found: Evaluation, **more: Any) -> None:
        """Add a row with all numbers and intervals of an evaluation."""
        self.rows.append({"row": name, **found.details(), **more})
        sys.stderr.write(f"{self.title}: {name} done\n")


def label(weights: str) -> str:
    """Short name of weights: the stem of the file."""
    return Path(weights).stem if weights.endswith(".safetensors") else weights


class Bench:
    """Windows, features and evaluations that all tables share."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        names = read_split(options.split)[options.part] if options.split else None
        windows = with_synthetic_scenes(cut_windows([MotionArchive.read(path) for path in options.motion], names))
        self.windows: tuple[EvaluationWindow, ...] = windows[:: options.every]
        self.features = None if options.no_fid else shipped_features()
        self._found: dict[tuple[object, ...], Evaluation] = {}

    def prior(self, weights: str, **sampler: Any) -> InbetweeningPrior:
        """A prior by its weights, with the steps of the command line unless `sampler` sets others."""
        return load_prior_by_name(weights, device=self.options.device, **{"steps": self.options.steps} | sampler)

    def run(
        self,
        weights: str,
        protocol: KeyframeProtocol,
        *,
        seed: int | None = None,
        without: dict[str, bool] | None = None,
        **sampler: Any,
    ) -> Evaluation:
        """The evaluation on all windows, cached by arguments; `without`: arguments of `AblatedPrior`."""
        sampling_seed: int = self.options.seed if seed is None else seed
        key = (weights, protocol, sampling_seed, *sorted((without or {}).items()), *sorted(sampler.items()))
        if key not in self._found:
            prior = self.prior(weights, **sampler)
            if without:
                prior = AblatedPrior(prior, **without)  # type: ignore[arg-type]
            self._found[key] = evaluate(self.windows, prior, protocol, seed=sampling_seed, features=self.features)
        return self._found[key]

    def trained(self) -> list[str]:
        """Weights other than the baseline."""
        return [name for name in self.options.weights if name != INTERPOLATION]


def ablations(bench: Bench, title: str, columns: tuple[str, ...]) -> Table:
    """Tables 1 and 2: the full model, without the scene at sampling, models trained without it, interpolation."""
    table = Table(title, columns)
    for weights in bench.trained():
        table.add(label(weights), bench.run(weights, CLEAN))
        for name, parts in ABLATIONS.items():
            table.add(f"{label(weights)} {name}", bench.run(weights, CLEAN, without=parts))
    for name, path in bench.options.variant:
        table.add(f"{name} (trained so)", bench.run(path, CLEAN))
    table.add(INTERPOLATION, bench.run(INTERPOLATION, CLEAN))
    return table


def table_1(bench: Bench) -> Table:
    """Clean keyframes every 60 frames."""
    return ablations(bench, "Table 1: exact keyframes, r = 60", QUALITY)


def table_2(bench: Bench) -> Table:
    """The frames of Table 1 in which the true body is within 8 cm of the scene."""
    return ablations(bench, "Table 2: frames close to the scene, r = 60", CLOSE)


def table_3(bench: Bench) -> Table:
    """Noisy keyframes every 3 frames, for several imputation end steps T*."""
    table = Table("Table 3: noisy keyframes, r = 3, l = 1", QUALITY)
    for weights in bench.trained():
        for stop_step in (0, 10, 20, 40, 60):
            table.add(f"{label(weights)} T* = {stop_step}", bench.run(weights, NOISY, stop_step=stop_step))
        for name, parts in ABLATIONS.items():
            table.add(f"{label(weights)} {name}", bench.run(weights, NOISY, without=parts))
    table.add(INTERPOLATION, bench.run(INTERPOLATION, NOISY))
    return table


def table_6(bench: Bench) -> Table:
    """Selection of keyframes: uniform and random."""
    table = Table("Table 6: keyframe selection, l = 1", ("fid", "jerk_m_s3", "mjpe_all_m"))
    for weights in (*bench.trained(), INTERPOLATION):
        for name, protocol in SELECTIONS.items():
            table.add(f"{label(weights)} {name}", bench.run(weights, protocol))
    return table


def table_7(bench: Bench) -> Table:
    """Seconds for a single window (median of five, with scene encoding), and quality of the same sampler."""
    table = Table("Table 7: time for one window", ("median_s", "mjpe_all_m", "jerk_m_s3"))
    from scenemi.evaluation.windows import give_keyframes

    one = give_keyframes(bench.windows[0], CLEAN).keyframes
    for weights in bench.trained():
        for steps in bench.options.time_steps:
            prior = bench.prior(weights, steps=steps)
            prior.fill(one)
            times = []
            for _ in range(5 if steps < 200 else 1):
                start = time.perf_counter()
                prior.fill(one)
                times.append(time.perf_counter() - start)
            found = bench.run(weights, CLEAN, steps=steps)
            table.add(f"{label(weights)} {steps} steps", found, median_s=float(np.median(times)))
    return table


def table_8(bench: Bench) -> Table:
    """Models with other sizes of the conditions."""
    table = Table("Table 8: configurations, r = 60", QUALITY)
    for weights in bench.trained():
        table.add(label(weights), bench.run(weights, CLEAN))
        bare = bench.run(weights, CLEAN, without={"use_body": False})
        table.add(f"{label(weights)} w/o body shape (at sampling)", bare)
    for name, path in bench.options.variant:
        table.add(f"{name} (trained so)", bench.run(path, CLEAN))
    return table


def table_9(bench: Bench) -> Table:
    """Repetitions with other sampling seeds: mean and 95 % interval of the mean."""
    names = ("fid", "jerk_m_s3", "mjpe_all_m", "collision_frame_ratio")
    table = Table("Table 9: over seeds", names)
    for weights in bench.trained():
        for title, protocol in (("Table 1", CLEAN), ("Table 3", NOISY)):
            runs = [bench.run(weights, protocol, seed=seed) for seed in range(bench.options.seeds)]
            table.add(f"{label(weights)} {title}, seed 0", runs[0])
            spread = {name: over_seeds([_value(run.details(), name) for run in runs]) for name in names}
            row: dict[str, Any] = {"row": f"{label(weights)} {title}, {len(runs)} seeds"}
            row["prior"] = {name: found.mean for name, found in spread.items()}
            row["fid"] = spread["fid"].mean
            row["half_width_95"] = {name: 0.5 * (found.high - found.low) for name, found in spread.items()}
            table.rows.append(row)
    return table


MAKERS: dict[str, Callable[[Bench], Table]] = {
    "1": table_1, "2": table_2, "3": table_3, "6": table_6, "7": table_7, "8": table_8, "9": table_9,
}  # fmt: skip


def main() -> None:
    """Make the tables."""
    options = arguments()
    torch.manual_seed(options.seed)
    bench = Bench(options)
    for number in options.tables:
        write_table(bench, number)


def write_table(bench: Bench, number: str) -> None:
    """Make one table and its two files."""
    options = bench.options
    start = time.perf_counter()
    table = MAKERS[number](bench)
    report = {
        "title": table.title, "columns": list(table.columns), "rows": table.rows,
        "wall_s": round(time.perf_counter() - start, 1), **provenance(bench),
    }  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / f"table_{number}"
    write_json(stem.with_suffix(".json"), report)
    text = markdown(report)
    stem.with_suffix(".md").write_text(text)
    sys.stdout.write(f"{text}\n{stem.with_suffix('.json')}\n")


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="+", choices=TABLES)
    parser.add_argument("--motion", type=Path, nargs="+", required=True)
    parser.add_argument("--split", type=Path, help="without it, all clips are used")
    parser.add_argument("--part", default="test")
    parser.add_argument("--weights", nargs="+", default=["small"], help="small or files")
    parser.add_argument("--variant", action="append", default=[], type=named, help="NAME=FILE of a retrained model")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--time-steps", type=int, nargs="+", default=[10, 20, 50, 1000])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--every", type=int, default=1, help="use every so manyth window")
    parser.add_argument("--no-fid", action="store_true")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/scenemi/results"))
    return parser.parse_args()


def named(text: str) -> tuple[str, str]:
    name, _, path = text.partition("=")
    if not path:
        raise argparse.ArgumentTypeError(f"want NAME=FILE, got {text!r}")
    return name, path


def provenance(bench: Bench) -> dict[str, Any]:
    """Everything the numbers depend on."""
    options = bench.options
    files = {name: path for name, path in options.variant}
    digests = {name: file_digest(Path(path)) for name, path in files.items()}
    for name in bench.trained():
        digests[label(name)] = file_digest(bench.prior(name).model.path)  # type: ignore[attr-defined]
    scenes = hashlib.sha256()
    for window in bench.windows:
        assert isinstance(window.obstacles, Obstacles)
        scenes.update(np.round(window.obstacles.boxes.center_m, 6).tobytes())
    return {
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads, Python {platform.python_version()}",
        "device": options.device,
        "date": datetime.date.today().isoformat(),
        "seed": options.seed,
        "steps": options.steps,
        "weights_sha256": digests,
        "fid_sha256": FID_DIGEST,
        "windows": len(bench.windows),
        "clips": [path.name for path in options.motion],
        "clips_sha256": {path.name: file_digest(path) for path in options.motion},
        "part": options.part if options.split else "all",
        "scene_seed": SCENE_SEED,
        "scenes_sha256": scenes.hexdigest(),
    }


def markdown(report: dict[str, Any]) -> str:
    """The report as text."""
    columns: Sequence[str] = report["columns"]
    lines = [f"# {report['title']}", ""]
    lines.append(
        f"{report['windows']} windows of {', '.join(report['clips'])} ({report['part']}), {report['steps']} steps "
        f"unless said otherwise, seed {report['seed']}; {report['machine']}, {report['device']}, {report['date']}. "
        "Means, with 95 % intervals over clips where they are known."
    )
    weights = ", ".join(f"{name} {digest[:12]}" for name, digest in report["weights_sha256"].items())
    lines += ["", f"Weights: {weights or 'none'}.", ""]
    lines += ["| | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for row in report["rows"]:
        lines.append(f"| {row['row']} | " + " | ".join(_cell(row, name) for name in columns) + " |")
    truth = next((row["truth"] for row in report["rows"] if "truth" in row), {})
    lines.append("| truth | " + " | ".join(_text(truth.get(name)) for name in columns) + " |")
    noisy = next((row["noisy_input"] for row in report["rows"] if "noisy_input" in row), {})
    if noisy and noisy != truth:
        lines.append("| noisy input, all frames | " + " | ".join(_text(noisy.get(name)) for name in columns) + " |")
    return "\n".join(lines) + "\n"


def _value(row: dict[str, Any], name: str) -> Any:
    return row[name] if name in row else row.get("prior", {}).get(name)


def _cell(row: dict[str, Any], name: str) -> str:
    value = _text(_value(row, name))
    half = row.get("half_width_95", {}).get(name)
    if half is not None:
        return f"{value} ± {_text(half)}"
    low_high = row.get("prior_95", {}).get(name)
    return f"{value} [{_text(low_high[0])}, {_text(low_high[1])}]" if low_high and name not in row else value


def _text(value: Any) -> str:
    return "" if value is None or not np.isfinite(value) else f"{value:.4g}"


if __name__ == "__main__":
    main()
