"""Signed distances and Chamfer distances on the CPU: time and error of this project, Open3D, scipy and torch.

    python benchmarks/scene_queries.py --truth bench_work/truth/00_walk [--out FILE.json]

The project builds a grid once per scene and interpolates it; Open3D computes every distance exactly. Times are medians
of three; Chamfer distances have the sizes that stage place uses. Writes JSON.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree

from video2anim.geometry.sdf import build_sdf_grid
from video2anim.lab.eval.true_scene import connected_parts, world_mesh
from video2anim.lab.eval.truth import read_truth
from video2anim.types import Mesh

QUERIES = 1_000_000
SPACING_M = 0.06
"""Grid spacing of the pipeline's field."""


def main() -> None:
    """Measure and write the report."""
    options = arguments()
    truth = read_truth(options.truth)
    solids = [part for item in truth.furniture(0) for part in connected_parts(world_mesh(item))]
    report = {
        "date": datetime.date.today().isoformat(), "machine": platform.machine(), "seed": 0, "clip": truth.name,
        "faces": int(sum(len(solid.faces) for solid in solids)),
        "signed distance": signed_distances(solids), "chamfer": chamfers(),
    }  # fmt: skip
    text = json.dumps(report, indent=1)
    sys.stdout.write(text + "\n")
    if options.out:
        options.out.write_text(text + "\n")


def signed_distances(solids: list[Mesh]) -> dict[str, Any]:
    """Signed distances of a million points near the furniture, from the grid and from Open3D."""
    import open3d as o3d

    rng = np.random.default_rng(0)
    corners = np.concatenate([solid.vertices_m for solid in solids])
    bounds_m = np.stack([corners.min(0) - 0.3, corners.max(0) + 0.3])
    points_m = rng.uniform(bounds_m[0], bounds_m[1], (QUERIES, 3))
    build_s, grid = timed(lambda: build_sdf_grid(solids, bounds_m, SPACING_M, floor_y_m=None), 1)
    read_s, read_m = timed(lambda: grid.sample(points_m), 3)
    scenes = []
    for solid in solids:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor(solid.vertices_m.astype(np.float32)), o3d.core.Tensor(solid.faces.astype(np.uint32))
        )
        scenes.append(scene)
    query = o3d.core.Tensor(points_m.astype(np.float32))

    def exact() -> np.ndarray:
        # Parts overlap: the distance to the union is the smallest of theirs.
        return np.min([scene.compute_signed_distance(query).numpy() for scene in scenes], axis=0)

    exact_s, exact_m = timed(exact, 1)
    off_m = np.abs(read_m - exact_m)
    near = np.abs(exact_m) < 0.2
    return {
        "queries": QUERIES, "grid nodes": int(grid.sdf_m.size), "grid built, s": build_s, "grid read, s": read_s,
        "open3d, s": exact_s, "open3d over grid read": exact_s / read_s,
        "open3d over grid built and read": exact_s / (build_s + read_s),
        "error within 20 cm of a surface, median m": float(np.median(off_m[near])),
        "error within 20 cm of a surface, 99th percentile m": float(np.percentile(off_m[near], 99)),
        "wrong sign deeper than 1 cm, share": float(((read_m < 0) != (exact_m < 0))[np.abs(exact_m) > 0.01].mean()),
    }  # fmt: skip


def chamfers() -> list[dict[str, float]]:
    """Chamfer distances (both directions) between two sets of equal size."""
    import open3d as o3d

    rows = []
    for count in (300, 1000, 4000):
        rng = np.random.default_rng(count)
        a, b = rng.standard_normal((2, count, 3))
        clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (a, b)]
        one, other = torch.tensor(a), torch.tensor(b)

        def by_torch(one: torch.Tensor = one, other: torch.Tensor = other) -> float:
            far = torch.cdist(one, other)
            return float(0.5 * (far.min(1).values.mean() + far.min(0).values.mean()))

        def by_open3d(clouds: list = clouds) -> float:
            forth, back = (
                clouds[0].compute_point_cloud_distance(clouds[1]),
                clouds[1].compute_point_cloud_distance(clouds[0]),
            )
            return float(0.5 * (np.mean(forth) + np.mean(back)))

        def by_scipy(a: np.ndarray = a, b: np.ndarray = b) -> float:
            return float(0.5 * (KDTree(b).query(a)[0].mean() + KDTree(a).query(b)[0].mean()))

        found = {name: timed(call, 9) for name, call in
                 (("scipy", by_scipy), ("open3d", by_open3d), ("torch", by_torch))}  # fmt: skip
        values = [value for _, value in found.values()]
        rows.append({"points": count, "spread of answers": max(values) - min(values),
                     **{f"{name}, ms": 1e3 * seconds for name, (seconds, _) in found.items()}})  # fmt: skip
    return rows


def timed(call: Callable[[], Any], times: int) -> tuple[float, Any]:
    """Median time in seconds, and the result."""
    seconds, answer = [], None
    for _ in range(times):
        start = time.perf_counter()
        answer = call()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds)), answer


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truth", type=Path, required=True, help="truth folder of a synthetic clip")
    parser.add_argument("--out", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    main()
