"""Errors of the fit of stage metric against truth, with each kind of evidence left out in turn.

    video2anim synth --preset bench --count 5 --seed 9001 --motion cmu.npz --out dev_work/truth
    python benchmarks/calibration.py --truth dev_work/truth --work dev_work/scenes [--sigma support_m=0.05]

Each clip is run to stage metric (cached stages stay); then the fit is repeated with one kind of evidence left out.
Columns: relative error of the background depth (median and mean over reliable pixels), height of the camera above the
floor, Chamfer distance of the person. `--sigma NAME=VALUE` changes a standard deviation. Writes Markdown and JSON.
Choose constants on seeds from 9001 on; V2A-Bench (seed 0) is for reporting.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from video2anim.calibration.evidence import Evidence, PixelEvidence
from video2anim.calibration.fit import Calibration, Sigmas, calibrate
from video2anim.calibration.gather import picture_evidence, with_objects
from video2anim.calibration.line import metric_depth
from video2anim.geometry.masks import shrunk
from video2anim.lab.eval.results import SceneResult
from video2anim.types import BackgroundImage, BodyTracks, DepthClip, InstanceMasks

NONE = PixelEvidence(np.zeros((0, 3)), np.zeros(0))


def objects_without(kind: str) -> Callable[[Evidence], Evidence]:
    """Evidence without one kind of that of objects."""
    return lambda e: replace(e, objects=tuple(replace(one, **{kind: None}) for one in e.objects))


WITHOUT: dict[str, Callable[[Evidence], Evidence]] = {
    "nothing": lambda e: e,
    "floor pixels": lambda e: replace(e, floor=NONE),
    "skin": lambda e: replace(e, skin=()),
    "every other frame of skin": lambda e: replace(e, skin=e.skin[::2]),
    "lower ends of objects": objects_without("foot"),
    "usual heights of furniture": objects_without("top"),
    "objects under feet": objects_without("under_feet"),
    "the usual offset": lambda e: replace(e, usual_offset_sigma=100.0),
}


def main() -> None:
    """Run, fit, compare, write."""
    options = arguments()
    sigmas = replace(Sigmas(), **{name: float(value) for name, value in (one.split("=") for one in options.sigma)})
    rows = []
    for truth in sorted(path.parent for path in options.truth.glob("*/meta.json")):
        scene = options.work / truth.name
        video = next(truth.glob("*.mp4"))
        command = [sys.executable, "-m", "video2anim.cli.main", "run", str(video), "--out", str(scene)]
        subprocess.run([*command, "--until", "metric"], check=True, stdout=subprocess.DEVNULL)
        rows += compared(scene, truth, sigmas)
    print(table(rows))
    found = {
        "date": datetime.date.today().isoformat(), "machine": f"{platform.machine()}, {platform.python_version()}",
        "sigmas": options.sigma, "rows": rows,
    }  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / f"calibration-{found['date']}.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def compared(scene: Path, truth: Path, sigmas: Sigmas) -> list[dict[str, float | str]]:
    """One row for each kind of evidence that is left out."""
    result = SceneResult(scene)
    depth, background, bodies = result.get(DepthClip), result.get(BackgroundImage), result.get(BodyTracks)
    masks = result.get(InstanceMasks)
    assert depth is not None
    assert background is not None
    assert bodies is not None
    assert masks is not None
    floor = shrunk(masks.floor_mask, depth.background_value.shape)
    whole = picture_evidence(depth, background, bodies, floor, result.clip.fps, np.random.default_rng(0))
    whole = with_objects(whole, depth, bodies.main, masks)
    meta, arrays = json.loads((truth / "meta.json").read_text()), np.load(truth / "truth.npz")
    rows = []
    for name, changed in WITHOUT.items():
        start = time.process_time()
        found = calibrate(changed(whole), sigmas)
        seconds = time.process_time() - start
        rows.append(
            {"clip": scene.name, "without": name, "seconds": seconds} | errors(found, depth, masks, meta, arrays)
        )
    return rows


def errors(
    found: Calibration, depth: DepthClip, masks: InstanceMasks, meta: dict, arrays: np.lib.npyio.NpzFile
) -> dict[str, float]:
    """Errors of one fit."""
    shape = depth.background_value.shape
    true_m = cv2.resize(arrays["background_depth_mm"][0] / 1000.0, shape[::-1], interpolation=cv2.INTER_NEAREST)
    factor = np.ones(shape)
    for instance, log in zip(masks.instances, found.object_depth_log, strict=True):
        factor[shrunk(instance.mask, shape)] = np.exp(log)
    estimated_m = factor * metric_depth(depth.kind, depth.background_value, found.scale, found.offset)
    known = depth.background_valid & (true_m > 0) & np.isfinite(estimated_m)
    off = np.abs(estimated_m / true_m - 1)[known]
    return {
        "height": found.camera_height_m / meta["camera"]["height_m"] - 1,
        "depth_median": float(np.median(off)),
        "depth_mean": float(np.mean(off)),
        "chamfer_m": found.chamfer_after_m,
    }


def table(rows: list[dict[str, float | str]]) -> str:
    """Means of absolute errors over the clips, Markdown."""
    keys = ("height", "depth_median", "depth_mean", "chamfer_m", "seconds")
    lines = [
        "| without | camera height | depth, median | depth, mean | chamfer, m | CPU, s |",
        "|---" * 6 + "|",
    ]
    for name in WITHOUT:
        own = [row for row in rows if row["without"] == name]
        means = [float(np.nanmean([abs(float(row[key])) for row in own])) for key in keys]
        lines.append(f"| {name} | " + " | ".join(f"{value:.3f}" for value in means) + " |")
    return "\n".join(lines)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truth", type=Path, required=True, help="folder of synthetic clips")
    parser.add_argument("--work", type=Path, required=True, help="folder of scene folders")
    parser.add_argument("--sigma", nargs="*", default=[], help="NAME=VALUE of video2anim.calibration.fit.Sigmas")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    return parser.parse_args()


if __name__ == "__main__":
    main()
