"""Errors of headings by straight edges (`video2anim.geometry.heading`), of rooms and of single objects.

    video2anim synth --preset bench --seed 9001 --count 10 --motion cmu.npz --motion deepmimic.npz --out dev_work/truth
    python benchmarks/headings.py --truth dev_work/truth [--out headings.json]

For every piece of furniture of which at least 2,000 pixels are visible, with its true mask, lens and gravity: the angle
between its sides and the heading of its own edges, and that of the room's, modulo a right angle. Round objects have no
sides, so that a heading found for them is an error. Writes JSON.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import sys
from pathlib import Path

import cv2
import numpy as np

from video2anim.geometry.heading import EdgeHeadings, Heading
from video2anim.lab.eval.object_rows import MIN_VISIBLE_PX
from video2anim.lab.eval.truth import Truth, read_truth

ROUND = ("plant", "lamp")
NEAR_DEG = 3.0


def main() -> None:
    """Measure all clips and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--out", type=Path, help="JSON to write")
    options = parser.parse_args()
    rows = [row for meta in sorted(options.truth.glob("*/meta.json")) for row in of_clip(read_truth(meta.parent))]
    report = {"date": datetime.date.today().isoformat(), "machine": platform.machine(), **summary(rows), "rows": rows}
    sys.stdout.write(json.dumps(summary(rows), indent=1) + "\n")
    if options.out:
        options.out.write_text(json.dumps(report, indent=1) + "\n")


def of_clip(truth: Truth) -> list[dict]:
    """One row per piece of furniture; errors in degrees, None where no heading was found."""
    height, width = truth.background_rgb.shape[:2]
    edges = EdgeHeadings(truth.background_rgb, truth.main.view().resized(width, height))
    small = truth.background_depth_m.shape
    rows = []
    for item in truth.furniture(MIN_VISIBLE_PX):
        mask = cv2.resize(truth.mask(item.object_id).astype(np.uint8), small[::-1], interpolation=cv2.INTER_NEAREST) > 0
        x, _, z = item.T_world_object[:3, 2]
        rows.append({
            "clip": truth.name, "label": item.label,
            "own": off_deg(edges.within(mask), np.arctan2(z, x)), "room": off_deg(edges.of_room(), np.arctan2(z, x)),
        })  # fmt: skip
    return rows


def off_deg(found: Heading | None, true_rad: float) -> float | None:
    """Angle between a heading and the truth, modulo a right angle."""
    if found is None:
        return None
    return float(np.degrees(abs((found.angle_rad - true_rad + np.pi / 4) % (np.pi / 2) - np.pi / 4)))


def summary(rows: list[dict]) -> dict[str, float]:
    """Shares and medians."""
    straight = [row for row in rows if row["label"] not in ROUND]
    found: dict[str, float] = {"pieces": len(straight)}
    for key in ("own", "room"):
        known = np.array([row[key] for row in straight if row[key] is not None])
        found |= {
            f"{key}: share found": len(known) / len(straight),
            f"{key}: median, deg": float(np.median(known)),
            f"{key}: within {NEAR_DEG:.0f} deg": float((known < NEAR_DEG).mean()),
        }
    others = [row for row in rows if row["label"] in ROUND]
    return found | {"round pieces": len(others), "round: found": sum(row["own"] is not None for row in others)}


if __name__ == "__main__":
    main()
