"""Errors of shapes and places of furniture with true depth, masks and camera: the stages complete to place alone.

    video2anim synth --preset bench --seed 0 --motion cmu.npz --motion deepmimic.npz --out bench_work/truth
    python benchmarks/object_shapes.py --truth bench_work/truth [--clips 24] [--pictures DIR]
    python benchmarks/object_shapes.py --truth dev_work/truth --sigma looks=15

Furniture counts if at least 2,000 of its pixels are visible. Chamfer distance: mean of both directions over 4,000
points of each surface; center: of the box in the object's axes; class: whether that of the form is right. `--sigma
NAME=VALUE` changes a standard deviation of the fit (`FitSigmas`) or `depth`, that of depth within an object (1 % here,
since depth is true); choose them on seeds from 9001 on. Writes JSON; `--pictures` writes images of the meshes over the
picture.
"""

from __future__ import annotations

import argparse
import datetime
import functools
import json
import platform
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.complete import CompleteConfig, complete_objects
from stages.place import PlaceConfig, place_objects
from stages.reconstruct import ReconstructConfig, reconstruct_objects
from video2anim.geometry.projection import transform_points
from video2anim.lab.eval.boxes import box_iou_3d, box_of, chamfer_m, rest_height_m, surface_points
from video2anim.lab.eval.object_rows import MIN_VISIBLE_PX
from video2anim.lab.eval.true_scene import read_glb, world_mesh
from video2anim.lab.eval.truth import Truth, read_truth
from video2anim.objects import recognize
from video2anim.objects.form_fit import FitSigmas
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    BackgroundImage,
    BodyTracks,
    InstanceMasks,
    Mesh,
    MetricDepth,
    ObjectInstance,
    ObjectMeshes,
    PlacedObjects,
)  # fmt: skip

MEDIANS = ("chamfer_m", "chamfer_first_m", "center_m", "height_m")


def main() -> None:
    """Run the stages, compare, write the report."""
    options = arguments()
    rows, depth_sigma = [], 0.01
    if options.sigma:
        name, _, value = options.sigma.partition("=")
        if name == "depth":
            depth_sigma = float(value)
        else:
            recognize.FitSigmas = functools.partial(FitSigmas, **{name: float(value)})
    for folder in sorted(path.parent for path in options.truth.glob("*/meta.json"))[: options.clips]:
        truth = read_truth(folder)
        found = of_clip(truth, options.pictures, depth_sigma, named=options.named)
        rows += found
        for row in found:
            sys.stderr.write(json.dumps(row) + "\n")
    shaped = [row for row in rows if row["chamfer_m"] is not None]
    numbers = {
        "furniture": len(rows),
        "reconstructed": len(shaped) / max(len(rows), 1),
        **{f"median {key}": float(np.median([row[key] for row in shaped])) for key in MEDIANS},
        "class right": float(np.mean([row["class"] == row["label"] for row in shaped])),
        "mean box IoU": float(np.mean([row["box_iou"] for row in shaped])),
        "median seconds per object": float(np.median([row["seconds"] for row in rows])),
        "slowest object, seconds": float(max(row["seconds"] for row in rows)),
    }
    report = {
        "date": datetime.date.today().isoformat(), "machine": platform.machine(), "seed": 0,
        "clips": len({row["clip"] for row in rows}), **numbers, "rows": rows,
    }  # fmt: skip
    text = json.dumps(report, indent=1)
    sys.stdout.write(json.dumps(numbers, indent=1) + "\n")
    if options.out:
        options.out.write_text(text + "\n")


def of_clip(truth: Truth, pictures: Path | None, depth_sigma: float, *, named: bool) -> list[dict]:
    """One row per piece of furniture that counts."""
    furniture = truth.furniture(MIN_VISIBLE_PX)
    masks, background, depth = true_inputs(truth, named=named)
    ctx = StageContext(Path())
    started = time.perf_counter()
    completed = complete_objects(background, masks, depth, CompleteConfig(), ctx)
    config = ReconstructConfig(
        depth_error_ratio=depth_sigma, depth_relief=1.0, depth_relief_sigma=2 * depth_sigma, open_bias=0.0
    )
    meshes = reconstruct_objects(completed, masks, depth, background, config, ctx)
    placed = place_objects(meshes, masks, depth, PlaceConfig(), ctx)
    seconds = (time.perf_counter() - started) / max(len(masks.instances), 1)
    if pictures:
        picture(truth, placed, pictures / f"{truth.name}.png")
    first = {item.object_id: item for item in meshes.objects}
    last = {item.object_id: item for item in placed.objects}
    rows = []
    for item in furniture:
        row = {"clip": truth.name, "label": item.label, "pixels": item.visible_px, "seconds": seconds}
        row |= dict.fromkeys(("method", "chamfer_m", "center_m", "chamfer_first_m", "box_iou", "height_m"))
        if item.object_id in last:
            mesh, box = in_world(last[item.object_id])
            before, _ = in_world(first[item.object_id])
            true_m = surface_points(world_mesh(item), np.random.default_rng(0))
            true_box = box_of(read_glb(item.file).vertices_m, item.T_world_object)
            row |= {
                "method": first[item.object_id].method,
                "class": first[item.object_id].method.removeprefix("form: ").split()[0].replace("steps", "step"),
                "chamfer_m": chamfer_m(surface_points(mesh, np.random.default_rng(0)), true_m),
                "chamfer_first_m": chamfer_m(surface_points(before, np.random.default_rng(0)), true_m),
                "center_m": float(np.linalg.norm(box.center_m - true_box.center_m)),
                "box_iou": box_iou_3d(box, true_box),
                "height_m": abs(rest_height_m(mesh) - rest_height_m(world_mesh(item))),
                "size_m": (2 * box.half_m).round(2).tolist(),
                "true_size_m": (2 * true_box.half_m).round(2).tolist(),
            }
        rows.append(row)
    return rows


def in_world(item: ObjectMeshes | PlacedObjects):
    """Mesh of an object in the world, and the box around it."""
    own_m = getattr(item, "scale", 1.0) * item.mesh.vertices_m.astype(np.float64)
    world = Mesh(transform_points(item.T_world_object, own_m), item.mesh.faces, item.mesh.vertex_rgb)
    return world, box_of(own_m, item.T_world_object)


def true_inputs(truth: Truth, *, named: bool) -> tuple[InstanceMasks, BackgroundImage, MetricDepth]:
    """The inputs of stage complete without errors, from the truth."""
    height, width = truth.background_depth_m.shape
    instances = []
    for item in truth.furniture(MIN_VISIBLE_PX):
        mask = truth.mask(item.object_id)
        rows, columns = np.nonzero(mask)
        box = np.array([columns.min(), rows.min(), columns.max(), rows.max()], np.float64)
        instances.append(ObjectInstance(item.object_id, item.label if named else "object", 1.0, box, mask))
    masks = InstanceMasks("truth", tuple(instances), truth.floor_mask)
    none = np.zeros((0, height, width), bool)
    body = replace(truth.main, intrinsics=truth.intrinsics.resized(width, height))
    background = BackgroundImage(
        truth.background_rgb, np.ones((height, width), np.float32), np.zeros(0, np.int64), none, none
    )
    depth = MetricDepth(
        1.0, 0.0, 0.0, 0.0, None, None, True, "truth", np.zeros(0, np.int64), none.astype(np.float32), none,
        truth.background_depth_m, truth.background_depth_m > 0,
        {str(item.object_id): 0.0 for item in instances}, BodyTracks((body,)),
    )  # fmt: skip
    return masks, background, depth


def picture(truth: Truth, placed: PlacedObjects, path: Path) -> None:
    """Write the background image and renderings of the meshes from its camera and from the side."""
    import cv2
    import trimesh

    meshes = [in_world(item)[0] for item in placed.objects]
    whole = trimesh.util.concatenate([
        trimesh.Trimesh(m.vertices_m, m.faces, vertex_colors=m.vertex_rgb, process=False) for m in meshes
    ])  # fmt: skip
    camera = truth.main.view().T_world_camera
    center = whole.vertices.mean(0)
    beside = camera.copy()
    turn = trimesh.transformations.rotation_matrix(np.deg2rad(70), [0, 1, 0], center)
    beside = turn @ beside
    views = [
        truth.background_rgb,
        *(seen_by(whole, T, truth.intrinsics, truth.background_rgb.shape) for T in (camera, beside)),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.concatenate(views, 1)[..., ::-1])


def seen_by(mesh, T_world_camera: np.ndarray, lens, shape: tuple[int, ...]) -> np.ndarray:
    """Shaded rendering of a mesh."""
    from video2anim.geometry.projection import pixel_rays

    rays = pixel_rays(lens.resized(shape[1], shape[0])).reshape(-1, 3) @ T_world_camera[:3, :3].T
    start = np.tile(T_world_camera[:3, 3], (len(rays), 1))
    face, ray = mesh.ray.intersects_id(start, rays, multiple_hits=False)
    out = np.full((len(rays), 3), 235, np.uint8)
    light = 0.55 + 0.45 * np.abs(mesh.face_normals[face] @ np.array([0.3, 0.8, 0.52]))
    out[ray] = np.clip(mesh.visual.face_colors[face, :3] * light[:, None], 0, 255)
    return out.reshape(shape)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--clips", type=int)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--named", action="store_true", help="give the fit the true class of each object")
    parser.add_argument("--sigma", metavar="NAME=VALUE", help="change one standard deviation")
    return parser.parse_args()


if __name__ == "__main__":
    main()
