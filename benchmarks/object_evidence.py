"""What each kind of evidence is worth to the forms of objects: stage reconstruct repeated without it.

    python benchmarks/v2a_bench.py --motion cmu.npz deepmimic.npz --work bench_work
    python benchmarks/object_evidence.py --work bench_work

Reads the output of `v2a_bench.py` and repeats the stages reconstruct and place, with one kind left out at a time.
Objects are compared at the true scale of the clip, since the error of that, which no object can help, hides the rest:
they are moved along the lines of sight by the ratio of true to estimated camera height. Writes JSON: medians over the
furniture that is found, and differences without minus with of the means of clips, with 95 % intervals over the clips.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from object_errors import Clip, nearer

from stages.place import PlaceConfig, place_objects
from stages.reconstruct import ReconstructConfig, reconstruct_objects
from video2anim.lab.eval.aggregate import statistic
from video2anim.lab.eval.alignment import match_frames, truth_from_estimate
from video2anim.lab.eval.object_rows import MIN_VISIBLE_PX, compared_objects, match_masks, pairs_by_mask
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.truth import read_truth
from video2anim.objects.evidence import ObjectViews, SeenObject
from video2anim.objects.observed import ObjectEvidence
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    BackgroundImage,
    CompletedObjects,
    InstanceMasks,
    MetricDepth,
)  # fmt: skip

MEASURES = ("chamfer", "center_error", "height_error", "box_iou")
NONE_M = np.zeros((0, 3))
WITHOUT: dict[str, Callable[[ObjectEvidence], ObjectEvidence]] = {
    "nothing": lambda seen: seen,
    "what rested": lambda seen: seen.rested_at(()),
    "bodies": partial(replace, body_m=NONE_M),
    "points of others": partial(replace, others_m=NONE_M),
    "headings": partial(replace, sides=None, walls=None),
}
"""Evidence less one kind."""
SETTINGS = {
    "the bias of open objects": ReconstructConfig(open_bias=0.0),
    "a free relief": ReconstructConfig(depth_relief_sigma=1e-3),
}
"""Settings of stage reconstruct that leave one kind out."""
Row = dict[str, float]


def main() -> None:
    """Repeat the stage for every kind and write the report."""
    options = arguments()
    clips = sorted(path.name for path in (options.work / "results").iterdir() if path.is_dir())
    kinds = options.kinds or [*WITHOUT, *SETTINGS]
    report: dict[str, Any] = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "clips": clips, "seed": 0, "without": {},
    }  # fmt: skip
    whole: dict[tuple[str, int], Row] = {}
    for kind in dict.fromkeys(["nothing", *kinds]):
        with ProcessPoolExecutor(options.workers, max_tasks_per_child=1) as pool:
            done = list(pool.map(partial(of_clip, options.work, kind), clips))
        rows = {key: row for found, _ in done for key, row in found.items()}
        whole = whole or rows
        report["without"][kind] = compared(whole, rows) | {"cpu_s": sum(seconds for _, seconds in done)}
        sys.stdout.write(f"{kind}: {json.dumps(report['without'][kind])}\n")
        sys.stdout.flush()
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"object_evidence-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(f"{target}\n")


def of_clip(work: Path, kind: str, clip: str) -> tuple[dict[tuple[str, int], Row], float]:
    """Errors of each piece of furniture, by clip and true ID, and the processor's time of the stage."""
    one_clip = Clip(clip, SceneResult(work / "results" / clip), read_truth(work / "truth" / clip))
    truth, masks, depth = one_clip.truth, one_clip.get(InstanceMasks), one_clip.get(MetricDepth)
    completed, background = one_clip.get(CompletedObjects), one_clip.get(BackgroundImage)
    config, ctx = SETTINGS.get(kind, ReconstructConfig()), StageContext(Path())
    whole, left_out = ObjectViews.object, WITHOUT.get(kind, WITHOUT["nothing"])

    def seen(views: ObjectViews, *found: Any) -> SeenObject | None:
        one = whole(views, *found)
        return None if one is None else replace(one, evidence=left_out(one.evidence))

    started = time.process_time()
    with patch.object(ObjectViews, "object", seen):
        meshes = reconstruct_objects(completed, masks, depth, background, config, ctx)
    seconds = time.process_time() - started
    body = depth.bodies.main
    camera = body.view().T_world_camera
    scale_log = float(np.log(camera[1, 3] / truth.main.view().T_world_camera[1, 3]))
    placed, furniture = place_objects(meshes, masks, depth, PlaceConfig(), ctx).objects, truth.furniture(MIN_VISIBLE_PX)
    rows = compared_objects(
        [nearer(one, scale_log, camera[:3, 3]) for one in placed], furniture,
        pairs_by_mask(match_masks(masks, furniture, truth)),
        truth_from_estimate(body.T_world_camera, truth, match_frames(one_clip.result.clip, truth)),
    )  # fmt: skip
    return {
        (clip, int(row[0].object_id or 0)): {q.key: q.value for q in row if q.key in MEASURES} for row in rows
    }, seconds


def compared(whole: dict[tuple[str, int], Row], rows: dict[tuple[str, int], Row]) -> dict[str, Any]:
    """Medians of the rows, and differences from the whole on the pieces that both have, means over clips of means."""
    common = sorted(whole.keys() & rows.keys())
    found: dict[str, Any] = {"pieces": len(rows)}
    for measure in MEASURES:
        of_clips: dict[str, list[float]] = defaultdict(list)
        for key in common:
            of_clips[key[0]].append(rows[key][measure] - whole[key][measure])
        difference = statistic([float(np.mean(off)) for off in of_clips.values()])
        found[measure] = {
            "median": float(np.median([row[measure] for row in rows.values()])),
            "difference": difference and asdict(difference),
        }
    return found


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder of benchmarks/v2a_bench.py")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--kinds", nargs="*", choices=[*WITHOUT, *SETTINGS], help="only these")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="clips in parallel")
    return parser.parse_args()


if __name__ == "__main__":
    main()
