"""Errors of the room network on held-out renderings and on photographs with known depth or camera, and its time.

    video2anim synth --frames-only --count 256 --size 256x192 --seed 900 --motion cmu.npz \
        --motion deepmimic.npz --out shards/900
    python benchmarks/room_net.py --held-out shards/900 --media ../shared/media [--model FILE.onnx]

Depth is compared after a least-squares fit of one scale and offset in inverse depth, for the network and for
a baseline, a plane (inverse depth linear in the pixel). Writes JSON.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from video2anim.artifacts.images import read_picture
from video2anim.depth.hue_jitter import jittered_disparity
from video2anim.geometry.line_segments import camera_with_edges, detect_line_segments
from video2anim.geometry.perspective_field import FieldCamera, fit_camera
from video2anim.lab.scene_network.samples import CLASS_TABLE
from video2anim.networks import find_model, model_path
from video2anim.networks.room_net import RoomCamera, RoomDepth, RoomSegment, SceneNetwork
from video2anim.networks.segmentation import CLASSES, MIN_INSTANCE_RATIO

NEAREST_INVERSE = 1 / 50
"""Lower limit of inverse depths in 1/m, that is, 50 m."""
HUE_SHIFTS_RAD = (-0.6, -0.3, 0.3, 0.6)
FIRST_SIGMA = 0.04
"""Of log depth within an instance: beyond it pixels count less, since masks hold other things."""
MIN_AREA_RATIO = 0.01
"""Minimum area of instances that count, as a share of the picture."""
JITTERED = 48
TIMED = 12


def main() -> None:
    """Measure the network and write the report."""
    options = arguments()
    path = options.model or model_path(find_model("room-depth"))
    report: dict[str, Any] = {
        "date": datetime.date.today().isoformat(), "machine": f"{platform.machine()}, {platform.processor() or 'CPU'}",
        "weights": path.name,
    }  # fmt: skip
    if options.held_out:
        report["renders"] = renders(path, options.held_out)
    if options.media:
        report["photographs with depth"] = rgbd(path, options.media / "rgbd_livingroom")
        report["Pose2Sim"] = pose2sim(path, options.media)
        report["seconds per 384-px picture"] = seconds(path, options.media / "rgbd_livingroom")
    text = json.dumps(report, indent=1)
    sys.stdout.write(text + "\n")
    if options.out:
        options.out.write_text(text + "\n")


def renders(path: Path, folders: list[Path]) -> dict[str, float]:
    """Means and medians over held-out renderings."""
    net, segment, depth = SceneNetwork(path), RoomSegment(path), RoomDepth(path)
    rows: list[dict[str, float]] = []
    matched, floor = np.zeros(3), np.zeros(2)
    kept_dropped, pieces, relief = [], [], []
    for folder in folders:
        for meta in sorted(folder.glob("shard_*/meta.json")):
            maps = {p.stem: np.load(p, mmap_mode="r") for p in meta.parent.glob("*.npy")}
            for row in range(len(maps["rgb"])):
                rgb = np.array(maps["rgb"][row])
                truth = inverse_depth(maps["depth_mm"][row])
                disparity = depth.infer(rgb).astype(np.float64)
                rows.append(compared(disparity, truth) | plane_numbers(truth))
                by_fields, both = cameras_of(net, [rgb])
                rows[-1] |= camera_numbers(both, maps, row)
                rows[-1] |= {f"{n} of fields alone": v for n, v in camera_numbers(by_fields, maps, row).items()}
                found = segment.segment(rgb)
                label = CLASS_TABLE[maps["label"][row]]
                rows[-1] |= class_numbers(found.semantic, label)
                estimated, true_part = found.semantic == CLASSES.index("floor"), label == CLASSES.index("floor")
                floor += (estimated & true_part).sum(), (estimated | true_part).sum()
                masks = [i.mask for i in found.instances if i.kind == "furniture"]
                true = true_pieces(np.asarray(maps["instance"][row]), label)
                matched += matches(masks, true)
                pieces += pieces_off(disparity, truth, true)
                relief += reliefs(disparity, truth, true)
                if len(rows) <= JITTERED:
                    kept_dropped.append(kept_and_dropped(depth, rgb, truth))
    means = {name: float(np.nanmean([r[name] for r in rows])) for name in rows[0]}
    named = ("fov_y_deg", "gravity_deg", "fov_y_deg of fields alone", "gravity_deg of fields alone", "absrel")
    medians = {f"median {n}": float(np.median([r[n] for r in rows])) for n in named}
    kept, dropped = np.nanmean(kept_dropped, axis=0)[:2]
    ratios = [abs(r["focal_log"]) / r["focal_log_sigma"] for r in rows]
    return {
        "pictures": len(rows), **means, **medians,
        "IoU floor over all pixels": float(floor[0] / floor[1]),
        "furniture F1 at IoU 0.5": float(2 * matched[0] / max(matched[1] + matched[2], 1)),
        "absrel of pixels kept by hue jitter": float(kept), "absrel of pixels dropped": float(dropped),
        "pieces of furniture, log depth off: mean": float(np.mean(pieces)),
        "pieces of furniture, log depth off: median of sizes": float(np.median(np.abs(pieces))),
        "median focal error over its sigma": float(np.median(ratios)),
        **relief_numbers(relief),
    }  # fmt: skip


def inverse_depth(depth_mm: np.ndarray) -> np.ndarray:
    """Inverse depth in 1/m; NaN where there is no measurement."""
    depth_m = depth_mm.astype(np.float64) / 1000
    return np.where(depth_m > 0, 1 / np.maximum(depth_m, 1e-3), np.nan)


def compared(disparity: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """AbsRel and delta1 of depth after a fit of scale and offset in inverse depth."""
    known = np.isfinite(truth)
    fitted = nearest_line(disparity[known], truth[known])
    return scores(fitted, truth[known])


def nearest_line(value: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Values after a least-squares fit of scale and offset to the truth."""
    design = np.stack([value, np.ones(len(value))], 1)
    return design @ np.linalg.lstsq(design, truth, rcond=None)[0]


def scores(inverse: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """AbsRel, and share of pixels with a ratio below 1.25 (delta1)."""
    depth, true_depth = 1 / np.maximum(inverse, NEAREST_INVERSE), 1 / truth
    ratio = np.maximum(depth / true_depth, true_depth / depth)
    return {"absrel": float(np.mean(np.abs(depth / true_depth - 1))), "delta1": float((ratio < 1.25).mean())}


def plane_numbers(truth: np.ndarray) -> dict[str, float]:
    """The same scores for the best plane."""
    known = np.isfinite(truth)
    y, x = np.nonzero(known)
    design = np.stack([x, y, np.ones(len(x))], 1).astype(np.float64)
    fitted = design @ np.linalg.lstsq(design, truth[known], rcond=None)[0]
    return {f"{name} of plane": value for name, value in scores(fitted, truth[known]).items()}


def cameras_of(net: SceneNetwork, pictures: list[np.ndarray]) -> tuple[FieldCamera, FieldCamera]:
    """Camera from images of one view by the network's fields alone, and with line segments."""
    height, width = pictures[0].shape[:2]
    camera = fit_camera([net.predict(picture).field for picture in pictures], width / height)
    return camera, camera_with_edges(camera, [detect_line_segments(picture) for picture in pictures])


def camera_numbers(camera: FieldCamera, maps: dict[str, np.ndarray], row: int) -> dict[str, float]:
    """Errors of field of view and gravity, and the predicted error of the focal length."""
    height = maps["rgb"].shape[1]
    focal_ratio = float(maps["intrinsics"][row][1]) / height
    true_fov = 2 * np.arctan(0.5 / focal_ratio)
    up = maps["up_camera"][row].astype(np.float64)
    return {
        "fov_y_deg": float(np.degrees(abs(camera.fov_y_rad - true_fov))),
        "gravity_deg": float(np.degrees(np.arccos(np.clip(camera.up_camera @ up / np.linalg.norm(up), -1, 1)))),
        "focal_log": float(np.log(camera.focal_ratio / focal_ratio)),
        "focal_log_sigma": camera.focal_log_sigma,
        "up_sigma_deg": float(np.degrees(camera.up_sigma_rad)),
    }


def class_numbers(semantic: np.ndarray, label: np.ndarray) -> dict[str, float]:
    """IoU of each class in the image."""
    found = {}
    for number, name in enumerate(CLASSES):
        estimated, true_part = semantic == number, label == number
        seen = true_part.mean() > 0.005 or estimated.mean() > 0.005
        found[f"IoU {name}"] = (
            float((estimated & true_part).sum() / (estimated | true_part).sum()) if seen else float("nan")
        )
    return found


def true_pieces(instance: np.ndarray, label: np.ndarray) -> list[np.ndarray]:
    """Masks of the true furniture instances."""
    furniture = label == CLASSES.index("furniture")
    true = [furniture & (instance == number) for number in np.unique(instance[furniture])]
    return [mask for mask in true if mask.mean() >= MIN_INSTANCE_RATIO]


def pieces_off(disparity: np.ndarray, truth: np.ndarray, true: list[np.ndarray]) -> list[float]:
    """Error of the mean log depth of each instance above `MIN_AREA_RATIO`, after alignment; positive = too far."""
    known = np.isfinite(truth)
    off = np.full(truth.shape, np.nan)
    fitted = nearest_line(disparity[known], truth[known])
    off[known] = np.log(truth[known] / np.maximum(fitted, NEAREST_INVERSE))
    return [float(np.nanmean(off[mask])) for mask in true if mask.mean() >= MIN_AREA_RATIO]


def reliefs(disparity: np.ndarray, truth: np.ndarray, masks: list[np.ndarray]) -> list[tuple[float, float]]:
    """For each instance above `MIN_AREA_RATIO`, after alignment: which share of the estimated variation of log depth
    within it is true (slope of a robust line), and the robust standard deviation of what is left."""
    known = np.isfinite(truth)
    log_depth = np.zeros(truth.shape)
    log_depth[known] = -np.log(np.maximum(nearest_line(disparity[known], truth[known]), NEAREST_INVERSE))
    found = []
    for mask in masks:
        inner = (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & known
        if mask.mean() < MIN_AREA_RATIO or not inner.any():
            continue
        own, true = log_depth[inner] - np.median(log_depth[inner]), -np.log(truth[inner])
        true -= np.median(true)
        line = least_squares(lambda x, a=own, b=true: (x[0] * a + x[1] - b) / FIRST_SIGMA, [0.5, 0.0], loss="cauchy")
        left = true - line.x[0] * own - line.x[1]
        found.append((float(line.x[0]), 1.48 * float(np.median(np.abs(left)))))
    return found


def relief_numbers(found: list[tuple[float, float]]) -> dict[str, float]:
    """Of all instances."""
    slope, left = np.array(found).T
    return {
        "relief, true over estimated: median": float(np.median(slope)),
        "relief, true over estimated: median deviation": 1.48 * float(np.median(np.abs(slope - np.median(slope)))),
        "log depth within pieces besides relief, median deviation": float(np.median(left)),
    }


def matches(masks: list[np.ndarray], true: list[np.ndarray]) -> np.ndarray:
    """Numbers of matched (IoU 0.5), predicted and true furniture instances above `MIN_AREA_RATIO`."""
    large = [mask for mask in true if mask.mean() >= MIN_AREA_RATIO]
    hits, claimed = 0, 0
    for mask in masks:
        ious = [(mask & other).sum() / (mask | other).sum() for other in true]
        best = int(np.argmax(ious)) if ious else -1
        if best >= 0 and ious[best] >= 0.5:
            if true[best].mean() >= MIN_AREA_RATIO:
                hits, claimed = hits + 1, claimed + 1
        elif mask.mean() >= MIN_AREA_RATIO:
            claimed += 1
    return np.array([hits, claimed, len(large)])


def kept_and_dropped(depth: RoomDepth, rgb: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """AbsRel of the 80 % of the pixels with the smallest hue jitter, and of the others."""
    value, sigma = jittered_disparity(depth.infer, rgb, HUE_SHIFTS_RAD)
    known = np.isfinite(truth)
    fitted = nearest_line(value[known], truth[known])
    miss = np.abs(truth[known] / np.maximum(fitted, NEAREST_INVERSE) - 1)
    unsure = sigma[known] > np.quantile(sigma[known], 0.8)
    return float(miss[~unsure].mean()), float(miss[unsure].mean())


def rgbd(path: Path, folder: Path) -> dict[str, float]:
    """Errors on renderings of a living room by others, with known depth and focal length."""
    net, depth, segment = SceneNetwork(path), RoomDepth(path), RoomSegment(path)
    lens = json.loads((folder / "intrinsics_and_poses.json").read_text())
    rows, cameras, relief = [], [], []
    for picture in sorted(folder.glob("color_*.jpg")):
        rgb = read_picture(picture)
        depth_mm = cv2.imread(str(picture.with_name(picture.name.replace("color", "depth")).with_suffix(".png")), -1)
        truth = inverse_depth(depth_mm)
        rows.append(compared(net.disparity(rgb).astype(np.float64), truth) | plane_numbers(truth))
        cameras.append(cameras_of(net, [rgb]))
        masks = [one.mask for one in segment.segment(rgb).instances if one.kind == "furniture"]
        relief += reliefs(depth.infer(rgb).astype(np.float64), truth, masks)
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    focal_px = 480 * np.array([[camera.focal_ratio for camera in both] for both in cameras])
    by_fields, both = np.median(100 * np.abs(focal_px / float(lens["fy"]) - 1), axis=0)
    return {
        "pictures": len(rows), **means, "over plane": means["absrel"] / means["absrel of plane"],
        "median over plane": float(np.median([row["absrel"] / row["absrel of plane"] for row in rows])),
        "median focal error percent": float(both), "median focal error percent of fields alone": float(by_fields),
        **relief_numbers(relief),
    }  # fmt: skip


def pose2sim(path: Path, media: Path) -> dict[str, dict[str, float]]:
    """Errors of focal length and gravity of calibrated cameras from three frames each, without using people."""
    net, found = SceneNetwork(path), {}
    for name in ("pose2sim_single_cam01", "pose2sim_single_cam02"):
        truth = json.loads((media / "reference" / f"{name}.json").read_text())
        video = cv2.VideoCapture(str(media / "videos" / f"{name}.mp4"))
        chosen = [picture_of(video, share) for share in (0.0, 0.5, 0.95)]
        height = chosen[0].shape[0]
        up = np.asarray(truth["R_camera_world"], float)[:, 2]
        found[name] = {}
        for camera, of in zip(cameras_of(net, chosen), (" of fields alone", ""), strict=True):
            found[name] |= {
                f"{key}{of}": value for key, value in camera_errors(camera, height, truth["fy"], up).items()
            }
    return found


def camera_errors(camera: FieldCamera, height_px: int, true_fy_px: float, true_up: np.ndarray) -> dict[str, float]:
    """Errors of a camera against a calibration."""
    focal_ratio = camera.focal_ratio * height_px / true_fy_px
    return {
        "focal error percent": float(100 * abs(focal_ratio - 1)),
        "focal over truth": float(focal_ratio),
        "focal sigma percent": 100 * camera.focal_log_sigma,
        "gravity error deg": float(np.degrees(np.arccos(np.clip(camera.up_camera @ true_up, -1, 1)))),
        "gravity sigma deg": float(np.degrees(camera.up_sigma_rad)),
    }


def picture_of(video: cv2.VideoCapture, share: float) -> np.ndarray:
    """The frame at a share of a video's length."""
    video.set(cv2.CAP_PROP_POS_FRAMES, int(share * video.get(cv2.CAP_PROP_FRAME_COUNT)))
    return cv2.cvtColor(video.read()[1], cv2.COLOR_BGR2RGB)


def seconds(path: Path, folder: Path) -> dict[str, float]:
    """Median time in seconds of one image of 384 px in each slot, with all views that the slot uses."""
    depth, camera, segment = RoomDepth(path), RoomCamera(path), RoomSegment(path)
    rgb = cv2.resize(read_picture(sorted(folder.glob("color_*.jpg"))[0]), (384, 288), interpolation=cv2.INTER_AREA)
    found = {}
    for name, look in (("depth", depth.infer), ("camera", camera.field), ("segment", segment.segment)):
        times = []
        for _ in range(TIMED):
            start = time.perf_counter()
            look(rgb)
            times.append(time.perf_counter() - start)
        found[name] = float(np.median(times))
    return found


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--held-out", type=Path, nargs="*", help="folders of shards not used for training")
    parser.add_argument("--media", type=Path, help="test media")
    parser.add_argument("--model", type=Path, help="another file of the same contract")
    parser.add_argument("--out", type=Path, help="JSON to write")
    return parser.parse_args()


if __name__ == "__main__":
    main()
