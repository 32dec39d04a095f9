"""Splits the errors of objects into the clip's scale, each object's own distance, and the rest.

    python benchmarks/object_errors.py --work bench_work

Reads the output of `benchmarks/v2a_bench.py`: `truth/CLIP` and `results/CLIP`. The scale of a clip is the ratio of
estimated to true camera height above the floor; the distance of an object is the ratio of estimated to true median
depth of its pixels, relative to that scale. Objects are then corrected along the line of sight for the distance, and
for both, and compared again. Writes JSON.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from video2anim.geometry.masks import shrunk
from video2anim.geometry.projection import pixel_rays
from video2anim.lab.eval.alignment import match_frames, resample_nearest, truth_from_estimate
from video2anim.lab.eval.object_rows import MIN_VISIBLE_PX, compared_objects, match_masks, pairs_by_mask
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.truth import Truth, read_truth
from video2anim.objects.backproject import ObjectBackprojector
from video2anim.types import (
    DepthClip,
    InstanceMasks,
    MetricDepth,
    PlacedObject,
    RefinedMotion,
)  # fmt: skip

FAR_OFF = 0.12
"""Relative error of distance above which an object counts as too far."""
MIN_PIXELS = 5


@dataclass(frozen=True, slots=True)
class Clip:
    """One clip's results and truth."""

    name: str
    result: SceneResult
    truth: Truth

    def get(self, kind: type) -> Any:
        """A value that must exist."""
        found = self.result.get(kind)
        if found is None:
            sys.exit(f"{self.name}: {self.result.why(kind)}; run benchmarks/v2a_bench.py first")
        return found


def main() -> None:
    """Measure all clips and write the report."""
    options = arguments()
    clips, pieces = [], []
    for folder in sorted((options.work / "results").iterdir()):
        if not (options.work / "truth" / folder.name / "meta.json").is_file():
            continue
        clip = Clip(folder.name, SceneResult(folder), read_truth(options.work / "truth" / folder.name))
        clips.append(of_clip(clip))
        pieces += of_pieces(clip, clips[-1]["scale_log"])
        sys.stderr.write(json.dumps(clips[-1]) + "\n")
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "summary": summary(clips, pieces), "clips": clips, "pieces": pieces,
    }  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"object_errors-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(json.dumps(report["summary"], indent=1) + f"\n{target}\n")


def of_clip(clip: Clip) -> dict[str, Any]:
    """Logarithms of scale and body height over their true values, and AbsRel of the background depth."""
    body, true = clip.get(MetricDepth).bodies.main, clip.truth.main
    depth, value = clip.get(MetricDepth).background_depth_m, clip.get(DepthClip).background_value
    true_m = resample_nearest(clip.truth.background_depth_m, depth.shape)
    known = true_m > 0
    off = np.log(depth[known] / true_m[known])
    design = np.stack([value[known], np.ones(int(known.sum()))], 1)
    fitted = design @ np.linalg.lstsq(design, 1 / true_m[known], rcond=None)[0]
    return {
        "clip": clip.name,
        "scale_log": float(np.log(body.view().T_world_camera[1, 3] / true.view().T_world_camera[1, 3])),
        "stature_log": float(np.log(np.ptp(body.rest_joints_m[:, 1]) / np.ptp(true.rest_joints_m[:, 1]))),
        "absrel": float(np.abs(np.expm1(off)).mean()),
        "absrel_one_scale": float(np.abs(np.expm1(off - np.median(off))).mean()),
        "absrel_best_scale_and_offset": float(np.abs(1 / np.maximum(fitted, 0.02) / true_m[known] - 1).mean()),
        "floor_log": floor_log(clip),
    }


def floor_log(clip: Clip) -> float:
    """Median logarithm of the depth of the calibrated floor over its true depth, where the floor is seen, beyond the
    scale of the clip."""
    body, true = clip.get(MetricDepth).bodies.main, clip.truth.main
    true_m = clip.truth.background_depth_m
    planes = []
    for motion in (body, true):
        small = motion.view().resized(true_m.shape[1], true_m.shape[0])
        down = -(pixel_rays(small.intrinsics) @ small.T_world_camera[:3, :3].T)[..., 1]
        planes.append(small.T_world_camera[1, 3] / np.where(down > 1e-3, down, np.nan))
    floor = np.abs(planes[1] / np.maximum(true_m, 1e-3) - 1) < 0.01
    scale = body.view().T_world_camera[1, 3] / true.view().T_world_camera[1, 3]
    return float(np.nanmedian(np.log(planes[0][floor] / true_m[floor] / scale)))


def of_pieces(clip: Clip, scale_log: float) -> list[dict[str, Any]]:
    """A row for each matched piece of furniture."""
    depth, masks = clip.get(MetricDepth), clip.get(InstanceMasks)
    body, lifter = depth.bodies.main, ObjectBackprojector(masks, depth)
    furniture = clip.truth.furniture(MIN_VISIBLE_PX)
    pairs = pairs_by_mask(match_masks(masks, furniture, clip.truth))
    T = truth_from_estimate(body.T_world_camera, clip.truth, match_frames(clip.result.clip, clip.truth))
    objects = clip.get(RefinedMotion).scene.objects
    off: dict[int, float] = {}
    rows: dict[int, dict[str, Any]] = {}
    for number, j in pairs.items():
        measured = distances_m(lifter, number, furniture[j].object_id, clip.truth)
        if measured is None:
            continue
        own = lifter.own(number)
        cut = bool(own[-1].any() or own[:, 0].any() or own[:, -1].any())
        seen = next(item.mask for item in masks.instances if item.object_id == number)
        true = shrunk(clip.truth.mask(furniture[j].object_id), seen.shape)
        off[number] = float(np.log(measured[0] / measured[1])) - scale_log
        rows[furniture[j].object_id] = {
            "clip": clip.name, "label": furniture[j].label, "distance_log": off[number], "cut": cut,
            "by_scale_m": abs(float(np.expm1(scale_log))) * measured[1],
            "lowest_rows": lowest_row(own) - lowest_row(shrunk(clip.truth.mask(furniture[j].object_id), own.shape)),
            "rows": len(own), "mask_iou": float((seen & true).sum() / (seen | true).sum()),
        }  # fmt: skip
    camera_m = body.view().T_world_camera[:3, 3]
    moved = {
        "as it is": objects,
        "true scale": [nearer(item, scale_log, camera_m) for item in objects],
        "true scale and distance": [nearer(o, scale_log + off.get(o.object_id, 0.0), camera_m) for o in objects],
    }
    for name, some in moved.items():
        for row in compared_objects(some, furniture, pairs, T):
            if row[0].object_id in rows:
                value = {quality.key: quality.value for quality in row}
                rows[row[0].object_id][name] = [value["chamfer"], value["center_error"]]
    return [row for row in rows.values() if "as it is" in row]


def distances_m(lifter: ObjectBackprojector, number: int, true_number: int, truth: Truth) -> tuple[float, float] | None:
    """Median estimated and true depth of an object where its masks overlap; None for fewer than `MIN_PIXELS` pixels."""
    obj = lifter.lift(number)
    true_m = resample_nearest(truth.background_depth_m, obj.shows.shape)
    both = obj.shows & shrunk(truth.mask(true_number), obj.shows.shape) & (true_m > 0)
    if both.sum() <= MIN_PIXELS:
        return None
    center_m = float(np.median(true_m[both]))
    return float(np.median(obj.depth_m[both] / true_m[both])) * center_m, center_m


def lowest_row(mask: np.ndarray) -> int:
    """Number of the lowest row that the mask has."""
    return int(np.flatnonzero(mask.any(1)).max(initial=-1))


def nearer(item: PlacedObject, by_log: float, camera_m: np.ndarray) -> PlacedObject:
    """The object with the same image, but with its distance to the camera smaller by a factor exp(by_log)."""
    factor = float(np.exp(-by_log))
    T = item.T_world_object.copy()
    T[:3, 3] = camera_m + factor * (T[:3, 3] - camera_m)
    return replace(item, T_world_object=T, scale=factor * item.scale)


def summary(clips: Sequence[dict[str, Any]], pieces: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Medians over clips and objects, of absolute values for signed numbers."""
    distance = np.array([piece["distance_log"] for piece in pieces])
    far = [piece for piece in pieces if piece["distance_log"] > np.log1p(FAR_OFF)]
    found: dict[str, Any] = {
        "pieces": len(pieces),
        "scale off (median)": float(np.median([abs(np.expm1(clip["scale_log"])) for clip in clips])),
        "body height off (root of mean square)": float(np.sqrt(np.mean([clip["stature_log"] ** 2 for clip in clips]))),
        "scale off without body height (median)": float(
            np.median([abs(clip["scale_log"] - clip["stature_log"]) for clip in clips])
        ),
        "an object's own distance off (median)": float(np.median(np.abs(np.expm1(distance)))),
        "what the scale alone moves an object by (median), m": float(
            np.median([piece["by_scale_m"] for piece in pieces])
        ),
        "objects more than 12 % too far": len(far),
        "of them cut by the border": sum(piece["cut"] for piece in far),
        "of them chairs and tables": sum(piece["label"] in ("chair", "table") for piece in far),
    }
    labels = sorted({piece["label"] for piece in pieces})
    found["pieces, logarithm of depth over its true value (mean) by class"] = {
        label: [len(own), round(float(np.mean(own)), 3)]
        for label in labels
        if (own := [piece["distance_log"] for piece in pieces if piece["label"] == label])
    }
    found["depth of the floor beyond the scale, clips within 1.2 %"] = sum(abs(c["floor_log"]) < 0.012 for c in clips)
    ious = [piece["mask_iou"] for piece in pieces]
    found["IoU of masks (median, mean)"] = [round(float(np.median(ious)), 3), round(float(np.mean(ious)), 3)]
    whole = [100 * piece["lowest_rows"] / piece["rows"] for piece in pieces if not piece["cut"]]
    found["lowest row of masks that the border does not cut, below the true one (median), % of the image"] = float(
        np.median(whole)
    )
    for key in ("absrel", "absrel_one_scale", "absrel_best_scale_and_offset"):
        found[key] = float(np.mean([clip[key] for clip in clips]))
    for name in ("as it is", "true scale", "true scale and distance"):
        chamfer, center = np.median([piece[name] for piece in pieces if name in piece], axis=0)
        found[f"Chamfer and middle, m, {name}"] = [round(float(chamfer), 4), round(float(center), 4)]
    return found


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("bench_work"))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    return parser.parse_args()


if __name__ == "__main__":
    main()
