"""What makes a network's depth metric: the person (Chamfer, paper 8.1), the floor, or both; beside geometric depth.

    video2anim synth --preset bench --seed 0 --motion cmu.npz --motion deepmimic.npz --out bench_work/truth
    python benchmarks/metric_evidence.py --truth bench_work/truth --work bench_work/evidence [--clips 8]

Each clip is brought to stage segment once per way; everything before depth is made once. Depth is compared as it is, in
metres, and after the scale and offset that fit best. Writes JSON.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import sys
from pathlib import Path

import numpy as np
from human_fit import call

WAYS = {
    "geometric": ("depth.provider=geometric", "segment.provider=geometric"),
    "body": ("metric.evidence=body",),
    "ground": ("metric.evidence=ground",),
    "both": ("metric.evidence=both",),
}
ROWS = (
    ("depth", "abs_rel", "metric"), ("depth", "delta1", "metric"), ("depth", "scale_error", "metric"),
    ("depth", "abs_rel_person", "metric"), ("depth", "abs_rel", "fitted"), ("depth", "delta1", "fitted"),
    ("camera", "fov_error", ""), ("camera", "gravity_error", ""), ("segment", "floor_iou", ""), ("segment", "f1", ""),
)  # fmt: skip


def main() -> None:
    """Run, evaluate, write."""
    options = arguments()
    clips = sorted(path.parent for path in options.truth.glob("*/meta.json"))[: options.clips]
    rows = []
    for truth in clips:
        for way, sets in WAYS.items():
            scene = options.work / truth.name
            words = ["run", str(truth / "video.mp4"), "--out", str(scene), "--until", "segment"]
            call(*words, *(word for text in sets for word in ("--set", text)))
            rows.append({"clip": truth.name, "way": way, **evaluated(scene, truth)})
            sys.stderr.write(json.dumps(rows[-1]) + "\n")
    names = [name for name in rows[0] if name not in ("clip", "way")]
    means = {way: {name: mean([row[name] for row in rows if row["way"] == way]) for name in names} for way in WAYS}
    report = {
        "date": datetime.date.today().isoformat(), "machine": platform.machine(), "clips": len(clips), "seed": 0,
        "means": means, "rows": rows,
    }  # fmt: skip
    text = json.dumps(report, indent=1)
    sys.stdout.write(text + "\n")
    if options.out:
        options.out.write_text(text + "\n")


def mean(values: list[float | str]) -> float:
    """Of those that are numbers."""
    numbers = [value for value in values if isinstance(value, float | int)]
    return float(np.mean(numbers)) if numbers else float("nan")


def evaluated(scene: Path, truth: Path) -> dict[str, float | str]:
    """Rows of `video2anim eval`, with the verdict of the metric stage."""
    out = scene / "eval.json"
    call("eval", str(scene), "--truth", str(truth), "--json", str(out))
    groups = {group["key"]: group for group in json.loads(out.read_text())["groups"]}
    found: dict[str, float | str] = {}
    for group, key, column in ROWS:
        columns = groups[group]["columns"] if group in groups else []
        row = next((row for row in groups.get(group, {"rows": []})["rows"] if row["key"] == key), None)
        at = columns.index(column) if column in columns else 0
        found[f"{group} {key} {column}".strip()] = row["values"][at] if row else float("nan")
    found["trusted"] = float("not trusted" not in groups["depth"]["note"])
    return found


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truth", type=Path, required=True, help="folder of clips with truth")
    parser.add_argument("--work", type=Path, required=True, help="folder of scenes, kept")
    parser.add_argument("--clips", type=int, default=24)
    parser.add_argument("--out", type=Path, help="JSON to write")
    return parser.parse_args()


if __name__ == "__main__":
    main()
