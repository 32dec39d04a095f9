"""Speed of the scene inputs (voxels, basis points, synthetic scenes), compared with scipy's KD-tree and Open3D.

    python benchmarks/scene_input_speed.py --out benchmarks/results

The scene is a mesh of boxes, balls and a floor, with 48 x 24 x 48 voxels around its center and 121 frames of 64 anchors
of a walking body. `scipy_kdtree` uses surface samples (as dense as ours), `open3d` the triangles; `wrong` and `error_m`
are differences to Open3D. Building the search structure is timed separately. Open3D is skipped if not installed.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import KDTree

from scenemi.scene.basis_points import anchor_vertices, bps
from scenemi.scene.body_spheres import fit_spheres
from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.pseudo import SyntheticScenes
from scenemi.scene.voxels import DEFAULT_GRID, occupancy
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.geometry.sampling import surface_samples
from video2anim.lab.synth.acting import act
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import forward_kinematics

SEED = 0
FRAMES = 121
SAMPLE_STEP_M = 0.08


def main() -> None:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--scenes", type=int, default=100)
    options = parser.parse_args()
    window = walking_window()
    mesh = room_mesh()
    centers_m = DEFAULT_GRID.centers_m().reshape(-1, 3)
    anchors_m = window["anchors_m"].astype(np.float64)
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "seed": SEED,
        "mesh_faces": len(mesh.faces),
        "methods": methods(mesh, centers_m, anchors_m, options.repeats),
        "synthetic_scenes": synthetic_scenes(window, options.scenes),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"scene_input_speed-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(table(report) + f"\n{target}\n")


def room_mesh() -> trimesh.Trimesh:
    """Sixteen boxes, four balls (1,280 triangles each) and a floor."""
    rng = np.random.default_rng(SEED)
    parts = []
    for _ in range(16):
        box = trimesh.creation.box(rng.uniform(0.2, 1.2, 3))
        parts.append(box.apply_translation(rng.uniform([-2.4, 0.2, -2.4], [2.4, 1.2, 2.4])))
    for _ in range(4):
        ball = trimesh.creation.icosphere(3, rng.uniform(0.1, 0.4))
        parts.append(ball.apply_translation(rng.uniform([-2.4, 0.2, -2.4], [2.4, 1.2, 2.4])))
    corners = [[-3, 0, -3], [-3, 0, 3], [3, 0, 3], [3, 0, -3]]
    return trimesh.util.concatenate([*parts, trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]])])


def walking_window() -> dict[str, Any]:
    """A procedural walk of 121 frames, its anchors and its body."""
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    motion = act("walk", body, np.random.default_rng(SEED))
    joints_m, R_world = forward_kinematics(
        motion.R_parent_joint[:FRAMES], motion.translation_m[:FRAMES], body.rest_joints_m
    )
    anchors_m = body.vertices(R_world, joints_m, anchor_vertices(body))
    return {"body": body, "joints_m": joints_m, "R_world_joint": R_world, "anchors_m": anchors_m}


def methods(mesh: trimesh.Trimesh, centers_m: np.ndarray, anchors_m: np.ndarray, repeats: int) -> dict[str, Any]:
    """Times for building, voxels and offsets of each method, and its differences to Open3D."""
    vertices_m, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    scene = SceneGeometry.from_mesh(vertices_m, faces)
    voxels, offsets_m = occupancy(scene, np.eye(4)), bps(scene, anchors_m, np.eye(3))
    samples_m, _ = surface_samples(vertices_m[faces], SAMPLE_STEP_M)
    tree, flat_m = KDTree(samples_m), anchors_m.reshape(-1, 3)
    near_m, _ = tree.query(centers_m)
    gap_m, _ = tree.query(flat_m)
    found: dict[str, Any] = {
        "own": {
            "build_s": median(lambda: SceneGeometry.from_mesh(vertices_m, faces), repeats),
            "voxels_s": median(lambda: occupancy(scene, np.eye(4)), repeats),
            "bps_s": median(lambda: bps(scene, anchors_m, np.eye(3)), repeats),
        },
        "scipy_kdtree": {
            "build_s": median(lambda: KDTree(surface_samples(vertices_m[faces], SAMPLE_STEP_M)[0]), repeats),
            "voxels_s": median(lambda: tree.query(centers_m, distance_upper_bound=0.0501), repeats),
            "bps_s": median(lambda: tree.query(flat_m), repeats),
        },
    }
    exact = open3d_rows(vertices_m, faces, centers_m, flat_m, repeats)
    if exact is None:
        return found
    found["open3d"], exact_near_m, exact_gap_m = exact
    solid, reach = exact_near_m <= DEFAULT_GRID.within_m, exact_gap_m < 1.0
    own_gap_m = np.linalg.norm(offsets_m, axis=-1).ravel()
    found["own"]["voxels_wrong"] = int((voxels.ravel() != solid).sum())
    found["own"]["bps_error_m"] = float(np.abs(own_gap_m - exact_gap_m)[reach].max())
    found["scipy_kdtree"]["voxels_wrong"] = int(((near_m <= DEFAULT_GRID.within_m) != solid).sum())
    found["scipy_kdtree"]["bps_error_m"] = float(np.abs(gap_m - exact_gap_m)[reach].max())
    return found


def open3d_rows(
    vertices_m: np.ndarray, faces: np.ndarray, centers_m: np.ndarray, points_m: np.ndarray, repeats: int
) -> tuple[dict[str, float], np.ndarray, np.ndarray] | None:
    """Times and distances of Open3D's ray-casting scene; None if it is not installed."""
    try:
        import open3d
    except (ImportError, OSError):
        return None

    def build() -> Any:
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(vertices_m.astype(np.float32), faces.astype(np.uint32))
        scene.compute_distance(np.zeros((1, 3), np.float32))
        return scene

    scene = build()
    centers32, points32 = centers_m.astype(np.float32), points_m.astype(np.float32)
    times = {
        "build_s": median(build, repeats),
        "voxels_s": median(lambda: scene.compute_distance(centers32), repeats),
        "bps_s": median(lambda: scene.compute_closest_points(points32), repeats),
    }
    return times, scene.compute_distance(centers32).numpy(), scene.compute_distance(points32).numpy()


def synthetic_scenes(window: dict[str, Any], count: int) -> dict[str, float]:
    """Synthetic scenes per second in one process."""
    scenes, spheres, times = SyntheticScenes(), fit_spheres(window["body"]), []
    for number in range(count):
        rng = np.random.default_rng([SEED, number])
        start = time.perf_counter()
        scenes.solids(rng, window["joints_m"], window["R_world_joint"], None, spheres=spheres)
        times.append(time.perf_counter() - start)
    return {"median_s": round(statistics.median(times), 5), "windows_per_s": round(count / sum(times), 1)}


def median(action: Callable[[], object], count: int) -> float:
    """Median wall time of an action, after one run to warm up."""
    action()
    times = []
    for _ in range(count):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return round(statistics.median(times), 5)


def table(report: dict[str, Any]) -> str:
    """The report as text."""
    lines = [f"{report['mesh_faces']} triangles, {report['machine']}"]
    for name, row in report["methods"].items():
        wrong = (
            f", {row['voxels_wrong']} voxels wrong, offsets {row['bps_error_m']:.4f} m" if "voxels_wrong" in row else ""
        )
        times = ", ".join(
            f"{key.removesuffix('_s')} {1000 * row[key]:.1f} ms" for key in ("build_s", "voxels_s", "bps_s")
        )
        lines.append(f"{name}: {times}{wrong}")
    pseudo = report["synthetic_scenes"]
    lines.append(
        f"synthetic scenes: {1000 * pseudo['median_s']:.1f} ms each, {pseudo['windows_per_s']:.0f} in a second"
    )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
