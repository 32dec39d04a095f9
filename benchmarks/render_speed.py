"""Speed and memory of the synthetic renderer in the tests' room, one process.

    python benchmarks/render_speed.py --out benchmarks/results

`ray casts` compares first hits of one 640 x 480 picture by trimesh's ray interface and by the renderer's own layer over
embree. `frames` are medians over consecutive frames, with shadows, occlusion, labels and anti-aliased edges.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "synth"))

from render_room import make_room, make_shot

from video2anim.synth.render import Renderer
from video2anim.synth.render.surfaces import of_objects
from video2anim.synth.render.view import Eye

CASES = (
    ("still camera, one person", 640, 480, 1, False),
    ("still camera, two people", 640, 480, 2, False),
    ("still camera, one person", 320, 240, 1, False),
    ("moving camera, one person", 320, 240, 1, True),
    ("moving camera, one person", 640, 480, 1, True),
)


def main() -> None:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--frames", type=int, default=9)
    options = parser.parse_args()
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "ray_casts_s": ray_casts(),
        "frames": [measure(*case, options.frames) for case in CASES],
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"render_speed-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(table(report) + f"\n{target}\n")


def ray_casts() -> dict[str, float]:
    """Seconds for the first hits of a 640 x 480 picture with the points hit."""
    shot, surfaces = make_shot(640, 480, people=0), of_objects(make_room().objects)
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


def measure(name: str, width_px: int, height_px: int, people: int, handheld: bool, frames: int) -> dict[str, object]:
    """One kind of shot: time of the first picture of the room, and the median over frames."""
    shot = make_shot(width_px, height_px, frames=frames + 1, people=people, handheld=handheld)
    renderer = Renderer(shot)
    start = time.perf_counter()
    renderer.plate()
    plate_s, times, busy = time.perf_counter() - start, [], []
    renderer.frame(0)
    for t in range(1, frames + 1):
        start, cpu = time.perf_counter(), time.process_time()
        renderer.frame(t)
        times.append(time.perf_counter() - start)
        busy.append(time.process_time() - cpu)
    frame_s = statistics.median(times)
    return {
        "name": name,
        "size_px": [width_px, height_px],
        "plate_s": round(plate_s, 3),
        "frame_s": round(frame_s, 4),
        "frame_cpu_s": round(statistics.median(busy), 4),
        "frames_per_s": round(1 / frame_s, 2),
    }


def table(report: dict) -> str:
    """The report as text."""
    lines = [f"{name}: {1000 * value:.0f} ms" for name, value in report["ray_casts_s"].items()]
    for row in report["frames"]:
        size = "x".join(str(n) for n in row["size_px"])
        lines.append(
            f"{row['name']}, {size}: room {row['plate_s']:.2f} s, frame {1000 * row['frame_s']:.0f} ms "
            f"= {row['frames_per_s']:.1f} frames/s (CPU {1000 * row['frame_cpu_s']:.0f} ms)"
        )
    return "\n".join([*lines, f"peak memory {report['peak_memory_mib']} MiB"])


if __name__ == "__main__":
    main()
