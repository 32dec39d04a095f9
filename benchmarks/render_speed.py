"""Speed and memory of the renderer of synthetic clips on clips of V2A-Bench (with walks of the gait model).

    python benchmarks/render_speed.py --out benchmarks/results

One process per core renders the same frames at the same time, like `synth --workers`; `frames/s` is their sum.
`ray casts` compares first hits of one 640 x 480 picture by trimesh's ray interface and by the renderer's own layer over
Embree. `frames` are medians over consecutive frames with shadows, occlusion, labels and anti-aliased edges.
"""

from __future__ import annotations

import argparse
import datetime
import json
import multiprocessing
import os
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from video2anim.lab.synth.compose import compose
from video2anim.lab.synth.generate import SynthConfig, compose_options, start_worker
from video2anim.lab.synth.presets import clip_specs
from video2anim.lab.synth.render import Renderer
from video2anim.lab.synth.render.surfaces import surfaces_of_objects
from video2anim.lab.synth.render.view import Eye
from video2anim.lab.synth.world import Shot

SEED = 0
CASES = (
    ("01_sit", 640, 480, False),
    ("11_walk_and_walk", 640, 480, False),
    ("01_sit", 320, 240, False),
    ("01_sit", 320, 240, True),
    ("01_sit", 640, 480, True),
)
"""Clip of the benchmark, width and height in pixels, whether the camera is handheld."""


def main() -> None:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--frames", type=int, default=9)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "seed": SEED,
        "ray_casts_s": ray_casts(),
        "processes": options.processes,
        "frames": [together(case, options.frames, options.processes) for case in CASES],
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"render_speed-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(table(report) + f"\n{target}\n")


def ray_casts() -> dict[str, float]:
    """Seconds for the first hits of a 640 x 480 picture, including the hit points."""
    shot = bench_shot("01_sit", 640, 480)
    surfaces = surfaces_of_objects(shot.room.objects)
    eye = Eye(shot.intrinsics, shot.T_world_camera[0])
    directions = eye.directions(np.arange(640 * 480))
    origins = np.tile(eye.origin_m, (len(directions), 1))
    caster, mesh = surfaces.caster(), trimesh.Trimesh(surfaces.vertices_m, surfaces.faces, process=False)
    return {
        "trimesh_intersects_id": median(
            lambda: mesh.ray.intersects_id(origins, directions, multiple_hits=False, return_locations=True)
        ),
        "trimesh_intersects_first": median(lambda: mesh.ray.intersects_first(origins, directions)),
        "own_first_hits": median(lambda: caster.first_hits(origins, directions)),
        "own_blocked": median(lambda: caster.blocked(origins, directions, 1.0)),
    }


def median(action: Callable[[], object], count: int = 7) -> float:
    """Median wall time of an action, after one run to warm up."""
    action()
    times = []
    for _ in range(count):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return round(statistics.median(times), 4)


def bench_shot(name: str, width_px: int, height_px: int, handheld: bool = False) -> Shot:
    """A clip of the benchmark, composed but not rendered."""
    spec = next(spec for spec in clip_specs("bench", None, SEED) if spec.name == name)
    options = compose_options(SynthConfig(width_px=width_px, height_px=height_px, seed=SEED))
    return compose(replace(spec, handheld=handheld), options)


def together(case: tuple[str, int, int, bool], frames: int, processes: int) -> dict[str, Any]:
    """The same measurement in several processes at once: medians, and total frames per second."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context, initializer=start_worker) as pool:
        rows = [job.result() for job in [pool.submit(measure, *case, frames) for _ in range(processes)]]
    return {
        **rows[0],
        "frame_s": round(statistics.median(row["frame_s"] for row in rows), 4),
        "frames_per_s": round(sum(1 / row["frame_s"] for row in rows), 2),
    }


def measure(name: str, width_px: int, height_px: int, handheld: bool, frames: int) -> dict[str, Any]:
    """One kind of shot: time of the first picture of the room, and the median over frames."""
    shot = bench_shot(name, width_px, height_px, handheld)
    renderer = Renderer(shot)
    start = time.perf_counter()
    renderer.background()
    background_s, times, busy = time.perf_counter() - start, [], []
    renderer.frame(0)
    for t in range(1, frames + 1):
        start, cpu = time.perf_counter(), time.process_time()
        renderer.frame(t)
        times.append(time.perf_counter() - start)
        busy.append(time.process_time() - cpu)
    frame_s = statistics.median(times)
    return {
        "name": name,
        "camera": "moving" if handheld else "still",
        "people": len(shot.actors),
        "shutter_blur": shot.sensor.blur_s > 0,
        "size_px": [width_px, height_px],
        "background_s": round(background_s, 3),
        "frame_s": round(frame_s, 4),
        "frame_cpu_s": round(statistics.median(busy), 4),
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }


def table(report: dict) -> str:
    """The report as text."""
    lines = [f"{name}: {1000 * value:.0f} ms" for name, value in report["ray_casts_s"].items()]
    for row in report["frames"]:
        size = "x".join(str(n) for n in row["size_px"])
        lines.append(
            f"{row['camera']} camera, {row['people']} person(s), {size}: room {row['background_s']:.2f} s, "
            f"frame {1000 * row['frame_s']:.0f} ms (CPU {1000 * row['frame_cpu_s']:.0f} ms), "
            f"{row['frames_per_s']:.1f} frames/s in {report['processes']} processes of {row['peak_memory_mib']} MiB"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
