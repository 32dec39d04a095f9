"""Depth of the room network on video by moving cameras, against points triangulated from their motion.

    python -m pip install pycolmap==4.2.1
    python benchmarks/depth_from_motion.py --work motion_work --videos VIDEO... [--model FILE.onnx...]

COLMAP's incremental mapper (Schonberger and Frahm 2016) gives cameras and sparse points of what stands still, without
any network. Depth is compared at the points seen in a frame after a robust fit of one scale and offset in inverse
depth, for the network and for the best plane (inverse depth linear in the pixel). Points with triangulation angles
below 1 degree or fewer than 4 views are left out. Reconstructions are kept in --work. Prints JSON.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap  # pyright: ignore[reportMissingImports]
from jaxtyping import Float

from video2anim.networks import find_model, model_path
from video2anim.networks.room_net import RoomDepth

FRAMES = 40
"""Per video, evenly spaced, that are reconstructed."""
MIN_VIEWS, MIN_ANGLE_DEG, MAX_ERROR_PX = 4, 1.0, 1.5
MIN_POINTS = 60
"""In a frame that counts."""
ROBUST_STEPS = 10


def main() -> None:
    """Reconstruct the videos, compare every network with the points."""
    options = arguments()
    models = options.model or [model_path(find_model("room-depth"))]
    networks = [RoomDepth(path) for path in models]
    report = {}
    for video in options.videos:
        folder = options.work / video.stem
        frames = write_frames(video, folder / "frames")
        scene = reconstructed(folder)
        rows = [] if scene is None else compared(scene, frames, networks)
        if not rows:
            report[video.stem] = "not reconstructed"
            continue
        numbers = np.array(rows)
        report[video.stem] = {
            "frames": len(rows), "points per frame": float(numbers[:, 0].mean()),
            "absrel of plane": float(numbers[:, 1].mean()),
            **{f"absrel of {path.stem}": float(numbers[:, 2 + k].mean()) for k, path in enumerate(models)},
        }  # fmt: skip
    sys.stdout.write(json.dumps(report, indent=1) + "\n")


def write_frames(video: Path, folder: Path) -> dict[str, np.ndarray]:
    """RGB frames by file name, written as images for COLMAP."""
    folder.mkdir(parents=True, exist_ok=True)
    capture, found = cv2.VideoCapture(str(video)), {}
    total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    wanted = set(np.linspace(0, total - 1, min(FRAMES, total)).round().astype(int).tolist())
    for number in range(total):
        more, bgr = capture.read()
        if not more:
            break
        if number in wanted:
            name = f"{number:05d}.png"
            cv2.imwrite(str(folder / name), bgr)
            found[name] = bgr[..., ::-1].copy()
    return found


def reconstructed(folder: Path) -> pycolmap.Reconstruction | None:
    """The largest reconstruction of the frames."""
    model = folder / "model"
    if not (model / "points3D.bin").is_file():
        database = folder / "database.db"
        database.unlink(missing_ok=True)
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "SIMPLE_RADIAL"
        pycolmap.extract_features(
            database, folder / "frames", camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader
        )
        pycolmap.match_exhaustive(database)
        options = pycolmap.IncrementalPipelineOptions()
        options.mapper.init_min_tri_angle = 4.0
        maps = pycolmap.incremental_mapping(database, folder / "frames", folder, options)
        if not maps:
            return None
        best = max(maps.values(), key=lambda scene: scene.num_reg_images())
        model.mkdir(exist_ok=True)
        best.write(model)
    return pycolmap.Reconstruction(model)


def compared(
    scene: pycolmap.Reconstruction, frames: dict[str, np.ndarray], networks: list[RoomDepth]
) -> list[list[float]]:
    """For each frame: number of points, AbsRel of the best plane and of each network."""
    good = {
        number: point.xyz
        for number, point in scene.points3D.items()
        if point.track.length() >= MIN_VIEWS and point.error < MAX_ERROR_PX and angle_deg(scene, point) >= MIN_ANGLE_DEG
    }
    rows = []
    for image in scene.images.values():
        if not image.has_pose:
            continue
        seen = [(p.xy, good[p.point3D_id]) for p in image.points2D if p.has_point3D() and p.point3D_id in good]
        if len(seen) < MIN_POINTS:
            continue
        pixels, points = (np.array([pair[k] for pair in seen]) for k in (0, 1))
        pose = image.cam_from_world()
        depth = (points @ pose.rotation.matrix().T + pose.translation)[:, 2]
        rgb = frames[image.name]
        truth = np.median(depth) / depth
        plane = np.concatenate([pixels, np.ones((len(pixels), 1))], 1)
        row = [float(len(seen)), absrel(plane, truth)]
        for network in networks:
            x, y = (pixels[:, k].astype(np.float32) - 0.5 for k in (0, 1))
            at = cv2.remap(network.infer(rgb), x, y, cv2.INTER_LINEAR).reshape(-1)
            row.append(absrel(np.stack([at, np.ones(len(pixels))], 1), truth))
        rows.append(row)
    return rows


def angle_deg(scene: pycolmap.Reconstruction, point: pycolmap.Point3D) -> float:
    """Largest angle between the rays of a point."""
    centers = np.array([scene.images[e.image_id].projection_center() for e in point.track.elements])
    rays = point.xyz - centers
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1).min())))


def absrel(design: Float[np.ndarray, "points unknowns"], truth: Float[np.ndarray, "points"]) -> float:
    """Mean relative error of depth after a fit of the inverse depths by least absolute relative errors."""
    weight, value = np.ones(len(truth)), truth
    for _ in range(ROBUST_STEPS):
        root = np.sqrt(weight)[:, None] / truth[:, None]
        value = design @ np.linalg.lstsq(root * design, root[:, 0] * truth, rcond=None)[0]
        weight = 1 / np.maximum(np.abs(value / truth - 1), 0.02)
    return float(np.mean(np.abs(truth / np.maximum(value, 0.02) - 1)))


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--videos", type=Path, nargs="+", required=True)
    parser.add_argument("--model", type=Path, nargs="+", help="ONNX files to compare (default: the shipped one)")
    parser.add_argument("--work", type=Path, required=True)
    return parser.parse_args()


if __name__ == "__main__":
    main()
