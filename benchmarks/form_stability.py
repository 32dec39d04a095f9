"""How often an object of a scene folder gets another class of form if other pixels of it are looked at.

    python benchmarks/form_stability.py SCENE_DIR... [--draws 8] [--out stability.json]

Reads the outputs of the stages before `reconstruct` and fits every object's form anew, with other random numbers in
each draw. For each object: the classes, how often the most frequent one was chosen, the lead of the best form in log
evidence, and the share of joints of people that are inside it by 5 cm or more. Writes JSON.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from stages.reconstruct import ReconstructConfig
from video2anim.artifacts.codec import read_value
from video2anim.geometry.heading import EdgeHeadings
from video2anim.geometry.masks import never_seen
from video2anim.objects.evidence import ObjectViews, PeopleEvidence, SeenObject
from video2anim.objects.form_fit import FormFit
from video2anim.objects.observed import DepthErrors
from video2anim.objects.recognize import rested_on_one
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.scene.supports import rested_and_inner_m
from video2anim.types import BackgroundImage, CompletedObjects, InstanceMasks, MetricDepth

INSIDE_M = 0.05


def main() -> None:
    """Fit, count, write the report."""
    options = arguments()
    rows = [row for scene in options.scenes for row in of_scene(scene, options.draws)]
    report = {
        "date": datetime.date.today().isoformat(), "machine": f"{os.cpu_count()} x {platform.machine()}",
        "draws": options.draws, "seed": 0, "objects": len(rows),
        "mean share of the most frequent class": float(np.mean([row["share"] for row in rows])),
        "mean spread of the highest point, m": float(np.mean([row["height_spread_m"] for row in rows])),
        "mean share of joints inside": float(np.mean([row["inside"] for row in rows])),
        "median seconds a fit": float(np.median([row["seconds"] for row in rows])),
    }  # fmt: skip
    sys.stdout.write(json.dumps(report, indent=1) + "\n")
    if options.out:
        options.out.write_text(json.dumps({**report, "rows": rows}, indent=1) + "\n")


def of_scene(scene: Path, draws: int) -> list[dict]:
    """One row per object."""
    masks, depth, background, completed = (
        read_value(kind, stage_folder(scene, stage))
        for kind, stage in (
            (InstanceMasks, "segment"), (MetricDepth, "metric"), (BackgroundImage, "background"),
            (CompletedObjects, "complete"),
        )
    )  # fmt: skip
    height_px, width_px = background.background_rgb.shape[:2]
    people = PeopleEvidence(*rested_and_inner_m(depth.bodies))
    config = ReconstructConfig()
    views = ObjectViews(
        masks, depth, never_seen(background.seen_ratio, depth.background_depth_m.shape), people,
        DepthErrors(
            config.depth_error_ratio, config.depth_relief, config.depth_relief_sigma, config.open_bias
        ),
        EdgeHeadings(background.background_rgb, depth.bodies.main_view.resized(width_px, height_px)),
    )  # fmt: skip
    rows, names = [], {found.object_id: found.label for found in completed.objects}
    drawn = [
        rested_on_one({
            found.object_id: one for found in completed.objects
            if (one := views.object(found, np.random.default_rng([draw, found.object_id]))) is not None
            and len(one.points_m) >= config.min_points
        }, names)
        for draw in range(draws)
    ]  # fmt: skip
    for found in completed.objects:
        fits, labels, began = [], Counter(), time.process_time()
        for one in [each[found.object_id] for each in drawn if found.object_id in each]:
            ranked, label = one.fits()
            labels[label] += 1
            fits.append((one.seen, ranked))
        if not fits:
            continue
        seconds = (time.process_time() - began) / draws
        row = {"scene": scene.name, "object": found.object_id, "label": found.label, "seconds": round(seconds, 2)}
        rows.append(row | of_object(fits))
        sys.stderr.write(json.dumps(rows[-1]) + "\n")
    return rows


def of_object(fits: list[tuple[SeenObject, list[FormFit]]]) -> dict:
    """How much the fits of one object differ."""
    classes = Counter(ranked[0].form.name for _, ranked in fits)
    tops_m = [highest_m(ranked[0]) for _, ranked in fits]
    leads = [ranked[0].log_evidence - ranked[1].log_evidence for _, ranked in fits if len(ranked) > 1]
    return {
        "classes": dict(sorted(classes.items(), key=lambda one: -one[1])),
        "share": max(classes.values()) / len(fits),
        "height_spread_m": round(float(np.std(tops_m)), 3),
        "lead": round(float(np.median(leads)), 1) if leads else None,
        "inside": round(float(np.mean([inside(seen, ranked[0]) for seen, ranked in fits])), 3),
        "chamfer_m": round(float(np.mean([ranked[0].chamfer_m for _, ranked in fits])), 3),
    }


def highest_m(fit: FormFit) -> float:
    """Height of the form's highest point."""
    _, solids = fit.solids()
    return float(fit.T_world_object[1, 3] + (solids.center_m + solids.half_m)[0, :, 1].max())


def inside(seen: SeenObject, fit: FormFit) -> float:
    """Share of the near joints of people that are inside by `INSIDE_M` or more."""
    if not len(seen.evidence.body_m):
        return 0.0
    T = np.linalg.inv(fit.T_world_object)
    own_m = seen.evidence.body_m @ T[:3, :3].T + T[:3, 3]
    _, solids = fit.solids()
    return float((solids.distance_m(own_m[None]).min(1) < -INSIDE_M).mean())


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE_DIR")
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--out", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    main()
