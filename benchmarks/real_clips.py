"""Real clips after each motion stage: numbers without truth, and errors against marker-based or triangulated truth.

    python benchmarks/real_clips.py --media ../shared/media --work real_work [--clips ocv_sts ocv_walk]

Each clip is run into `--work` (cached stages stay). Its main person is measured after the stages humans, keyframes and
refine, and after the solve of refine without the prior. Columns of each row:

- displacement: image distance of the joints from those of stage humans, in % of the standing body's height in the
  picture, median and 95th percentile over the valid frames;
- reprojection: image distance of the 12 limb joints from their BlazePose landmarks (visibility over 0.5), relative to
  that of stage humans, median over the frames;
- tilt: angle of pelvis to neck against up in frames with a foot in contact and straight legs, median;
- contacts of stage humans (parts with a probability over 0.5, the same in every row): share within 3 cm of observed
  surfaces of the scene (objects, floor), share on inferred supports, and share that is no contact with the scene (parts
  that move fast, hands on the own body);
- inside: share of frames with skin more than 1 cm inside the scene; skating (`gmd`); jerk;
- with truth: PA-MPJPE and root-relative MPJPE (12 limb joints), root path after rigid alignment over the whole clip,
  acceleration error, knee and hip flexion (the `ocv` clips by `eval_mocap.py` of the media).

Per clip: share of frames that the prior changed; seconds of refine per window of 121 frames; order: share of the pixels
showing the person in front of an object at which the object's depth is larger than the person's; errors of focal length
(%) and gravity (degrees) if known. Writes Markdown and JSON, and a contact sheet of previews to `--work` (`sheet.png`;
the footage may not be published).
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
from court_camera import court_camera

from scenemi import metrics
from scenemi.metrics import align_similarity
from video2anim.artifacts.images import write_png
from video2anim.artifacts.motion_io import write_motion
from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import LIKELY, NEAR_M, believed, posed_vertices, skin_of
from video2anim.geometry.masks import shrunk
from video2anim.geometry.projection import project
from video2anim.geometry.scene_mesh import world_mesh
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
from video2anim.humans.observe import at_frame_times
from video2anim.lab.eval.person_coverage import person_coverage
from video2anim.lab.eval.results import SceneResult
from video2anim.motion.observation import image_distance_ratio
from video2anim.scene.supports import SUPPORT
from video2anim.types import (
    BackgroundImage,
    BodyMotion,
    BodyTracks,
    Contact,
    InstanceMasks,
    KeyframedMotion,
    MetricDepth,
    ObjectMeshes,
    PersonTrack,
    PersonTracks,
    RefinedMotion,
    SceneModel,
)
from video2anim.types.clip import FPS
from video2anim.types.skeleton import FEET, JOINT_INDEX, TOUCHING_PARTS

CLIPS = (
    "ocv_sts", "ocv_walk", "pose2sim_single_cam01", "pose2sim_single_cam02", "bodypose3d_squat", "sports2d_demo",
    "gvhmr_tennis", "glamr_pexels_walking", "sam2_bedroom", "davis_breakdance_flare",
)  # fmt: skip
LIMBS = [JOINT_INDEX[f"{side}_{part}"] for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
         for side in ("left", "right")]  # fmt: skip
LANDMARKS = [11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28]
HIPS = slice(6, 8)
STRAIGHT_DEG = 20.0


@dataclass(frozen=True, slots=True)
class Row:
    """One stage of one clip; NaN if a number does not exist."""

    clip: str
    stage: str
    picture: float
    picture_95: float
    misses: float
    tilt: float
    contacts: float
    on_supports: float
    no_touch: float
    inside: float
    skating: float
    jerk: float
    pa_mm: float
    relative_mm: float
    root_mm: float
    acceleration: float
    knee_deg: float
    hip_deg: float


HEADS = (
    "clip", "stage", "displacement, %", "95 %", "reprojection", "tilt, deg", "contacts", "on supports", "no touch",
    "inside", "skating", "jerk, m/s3", "PA, mm",
    "root-relative, mm", "root path, mm", "acceleration, m/s2", "knee, deg", "hip, deg",
)  # fmt: skip


def main() -> None:
    """Run the clips, measure, write the report."""
    options = arguments()
    rows: list[Row] = []
    clips: dict[str, Any] = {}
    for clip in options.clips:
        folder = options.work / clip
        command = [sys.executable, "-m", "video2anim.cli.main", "run", str(options.media / "videos" / f"{clip}.mp4")]
        ended = subprocess.run([*command, "--out", str(folder)], capture_output=True, text=True, check=False)
        if ended.returncode:
            clips[clip] = ended.stderr.strip().splitlines()[-1]
            continue
        found, clips[clip] = of_clip(folder, options.media)
        rows += found
        sys.stderr.write("\n".join(map(str, found)) + "\n")
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "seed": 0, "clips": clips, "rows": [asdict(row) for row in rows],
    }  # fmt: skip
    target = options.out / f"real_clips-{report['date']}.json"
    options.out.mkdir(parents=True, exist_ok=True)
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(table(rows) + "\n")
    write_png(options.work / "sheet.png", sheet([options.work / clip / "preview.mp4" for clip in options.clips]))


def of_clip(folder: Path, media: Path) -> tuple[list[Row], dict[str, Any]]:
    """Rows of the main person, and numbers of the whole clip."""
    result = SceneResult(folder)
    bodies, keyframed = result.get(BodyTracks), result.get(KeyframedMotion)
    scene, refined = result.get(SceneModel), result.get(RefinedMotion)
    if bodies is None or keyframed is None or refined is None or scene is None:
        raise SystemExit(f"{folder}: {result.why(BodyTracks, KeyframedMotion, SceneModel, RefinedMotion)}")
    tracks, metric = result.get(PersonTracks), result.get(MetricDepth)
    masks, background = result.get(InstanceMasks), result.get(BackgroundImage)
    meshes = result.get(ObjectMeshes)
    assert meshes is not None
    assert tracks is not None
    assert metric is not None
    assert masks is not None
    assert background is not None
    track = at_frame_times(tracks.selected()[0].whole(result.clip.frame_count), result.clip)
    raw = bodies.people[0].in_world(keyframed.people[0].T_world_camera)
    made = {
        "humans": (raw, scene), "keyframes": (keyframed.people[0], scene),
        "refined": (refined.people[0], refined.scene), "without prior": (refined.without_prior[0], refined.scene),
    }  # fmt: skip
    rows = [row(folder.name, stage, motion, raw, track, where, media) for stage, (motion, where) in made.items()]
    manifest = json.loads(next(folder.glob("stages/*_refine/manifest.json")).read_text())
    windows = max(1.0, len(raw.valid) / 121)
    return rows, {
        "frames": len(raw.valid), "prior": refined.prior[0], "shaped": refined.prior_share[0],
        "refine s per window": manifest["wall_time_s"] / windows, "order": depth_order(metric, masks, background),
        "forms": dict(Counter(one.method for one in meshes.objects)),
        "trusted": sum(one.trusted for one in scene.objects) / max(len(scene.objects), 1),
        **right_class(folder.name, result.record.contacts),
        **camera_off(folder.name, metric.bodies.main, media),
    }  # fmt: skip


def right_class(clip: str, contacts: Sequence[Contact]) -> dict[str, float | None]:
    """Per body part, the share of its contact time (without the floor) on objects of the right class according to
    `real_contacts.json`; None if it touches nothing but the floor."""
    wanted = json.loads(Path(__file__).with_name("real_contacts.json").read_text()).get(clip, {})
    shares: dict[str, float | None] = {}
    for part, classes in wanted.items():
        own = [one for one in contacts if one.body_part == part and one.label != "floor"]
        total_s = sum(one.end_s - one.start_s for one in own)
        right_s = sum(one.end_s - one.start_s for one in own if one.label in classes)
        shares[f"{part} on {' or '.join(classes)}"] = right_s / total_s if total_s else None
    return shares


def depth_order(metric: MetricDepth, masks: InstanceMasks, background: BackgroundImage) -> float:
    """Share of the pixels of the person in front of an object at which the object's depth is larger than the
    person's."""
    shape = metric.background_depth_m.shape
    body = metric.bodies.main
    passed_m = person_coverage(
        body, background.frame_index, background.selected_mask, body.intrinsics.resized(*shape[::-1])
    )
    objects = np.any([shrunk(one.mask, shape) for one in masks.instances] or [np.zeros(shape, bool)], axis=0)
    asked = objects & (passed_m > 0) & metric.background_valid
    return float((metric.background_depth_m >= passed_m)[asked].mean()) if asked.any() else float("nan")


def camera_off(clip: str, body: BodyMotion, media: Path) -> dict[str, float]:
    """Errors of focal length (%) and gravity (degrees). For `ocv` the reference itself has an error of 2 degrees."""
    if clip == "gvhmr_tennis":
        court = court_camera()
        return _camera_off(body, court.focal_px, court.up_camera)
    path = media / "reference" / f"{clip}.json"
    if not path.is_file():
        return {}
    known = json.loads(path.read_text())
    camera = known.get("camera", known)
    if "R_camera_world" not in camera:
        return _camera_off(body, camera["fx"], None)
    # The world of `ocv` has y up, that of `pose2sim` z up.
    return _camera_off(body, camera["fx"], np.array(camera["R_camera_world"])[:, 2 if "up_in_camera" in known else 1])


def _camera_off(body: BodyMotion, focal_px: float, up_camera: np.ndarray | None) -> dict[str, float]:
    off = {"lens off, %": 100 * (body.intrinsics.fx_px / focal_px - 1)}
    if up_camera is None:
        return off
    angle = np.arccos(np.clip(up_camera @ body.T_world_camera[0, 1, :3], -1, 1))
    return off | {"gravity off, deg": float(np.degrees(angle))}


def misses_px(motion: BodyMotion, track: PersonTrack) -> np.ndarray:
    """Mean image distance of the limb joints from their landmarks, per frame; NaN if none is visible."""
    joints_px = project(motion.joints_camera_m[:, LIMBS], motion.intrinsics)
    off_px = np.linalg.norm(joints_px - track.landmarks_px[:, LANDMARKS], axis=-1)
    seen = (track.valid & motion.valid)[:, None] & (np.nan_to_num(track.visibility[:, LANDMARKS]) > 0.5)
    return np.where(seen, off_px, 0.0).sum(1) / np.where(seen.any(1), seen.sum(1), np.nan)


def row(
    clip: str, stage: str, motion: BodyMotion, raw: BodyMotion, track: PersonTrack, scene: SceneModel, media: Path
) -> Row:
    """The row of one stage."""
    off = 100 * image_distance_ratio(motion, raw)
    body, field = shaped_body(motion.shape), SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)
    valid = np.flatnonzero(motion.valid)
    index = np.arange(0, len(body.rest_vertices_m), 7)
    distance_m = field.sample(posed_vertices(motion, body, index, valid))
    misses = float(np.nanmedian(misses_px(motion, track)) / np.nanmedian(misses_px(raw, track)))
    measured = motion.measured_joints_m
    return Row(
        clip, stage, float(np.median(off)), float(np.percentile(off, 95)), misses, tilt_deg(motion),
        *contact_shares(motion, raw, scene), float((distance_m.min(1) < -0.01).mean()),
        metrics.foot_skating_gmd(measured, FPS), metrics.jerk_m_s3(measured, FPS), *against_truth(clip, motion, media),
    )  # fmt: skip


def contact_shares(motion: BodyMotion, raw: BodyMotion, scene: SceneModel) -> tuple[float, float, float]:
    """Shares of the contacts of stage humans: on observed surfaces, on inferred supports, and no contact in fact."""
    body, field = shaped_body(motion.shape), SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)
    supports = [world_mesh(o.mesh, o.T_world_object, o.scale) for o in scene.objects if o.label == SUPPORT]
    inferred = None
    if supports:
        corners_m = np.concatenate([one.vertices_m for one in supports]).astype(np.float64)
        bounds_m = np.stack([corners_m.min(0) - 0.2, corners_m.max(0) + 0.2])
        inferred = build_sdf_grid(supports, bounds_m, scene.sdf_spacing_m, floor_y_m=None)
    found = np.zeros((0, 3), bool)
    likely = believed(raw, body)
    for joints in TOUCHING_PARTS.values():
        frames = np.flatnonzero(raw.valid & motion.valid & (raw.contact[:, list(joints)].max(1) > LIKELY))
        skin_m = posed_vertices(motion, body, skin_of(body, joints), frames)
        if not len(frames):
            continue
        near = np.abs(field.sample(skin_m).min(1)) < NEAR_M
        held = near & (np.abs(inferred.sample(skin_m).min(1)) < NEAR_M) if inferred else np.zeros_like(near)
        none = ~near & (likely[frames][:, list(joints)].max(1) <= LIKELY)
        found = np.concatenate([found, np.stack([near & ~held, held, none], 1)])
    shares = found.mean(0) if len(found) else np.full(3, np.nan)
    return float(shares[0]), float(shares[1]), float(shares[2])


def tilt_deg(motion: BodyMotion) -> float:
    """Angle of pelvis to neck against up, median over frames with straight legs and a foot in contact."""
    touches = motion.valid & (motion.contact[:, list(FEET)].max(1) > 0.5)
    bend = [
        np.rad2deg(np.arccos(np.clip((np.trace(motion.R_parent_joint[:, JOINT_INDEX[name]], axis1=1, axis2=2) - 1) / 2,
                                     -1, 1)))
        for name in ("left_knee", "right_knee")
    ]  # fmt: skip
    rows = touches & (np.max(bend, 0) < STRAIGHT_DEG)
    if not rows.any():
        return float("nan")
    up = motion.joints_world_m[rows, JOINT_INDEX["neck"]] - motion.joints_world_m[rows, 0]
    return float(np.median(np.rad2deg(np.arccos(up[:, 1] / np.linalg.norm(up, axis=1)))))


def mocap_report(motion: Path, clip: str, media: Path) -> dict[str, Any]:
    """What `eval_mocap.py` of the media says of a motion file."""
    with tempfile.TemporaryDirectory() as folder:
        said = Path(folder) / "said.json"
        words = [sys.executable, str(media / "eval_mocap.py"), str(motion), "--clip", clip, "--json", str(said)]
        subprocess.run(words, check=True, capture_output=True)
        return json.loads(said.read_text(encoding="utf-8"))


def against_truth(clip: str, motion: BodyMotion, media: Path) -> tuple[float, ...]:
    """PA and root-relative MPJPE, root path (mm), acceleration error (m/s2), knee and hip flexion errors (deg)."""
    if clip.startswith("ocv_"):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "motion.npz"
            write_motion(path, motion)
            found = mocap_report(path, clip, media)
        names = ("pa_mpjpe_mm", "mpjpe_root_mm", "whole_root_mm", "accel_error_m_s2", "knee_flexion_error_deg",
                 "hip_flexion_error_deg")  # fmt: skip
        return tuple(found[name] for name in names)
    reference = media / "reference" / f"{clip}_joints.npz"
    if not reference.is_file():
        return (float("nan"),) * 6
    with np.load(reference) as truth:
        true_m, time_s = truth["landmarks_camera_m"][:, LANDMARKS], truth["frame_time_s"]
    pa, relative, roots = [], [], []
    for frame in np.flatnonzero(motion.valid):
        nearest = int(np.abs(time_s - motion.frame_time_s[frame]).argmin())
        known = np.isfinite(true_m[nearest]).all(1)
        if abs(time_s[nearest] - motion.frame_time_s[frame]) > 0.5 / 60 or known.sum() < 8 or not known[HIPS].all():
            continue
        estimated, true_part = motion.joints_camera_m[frame, LIMBS], true_m[nearest]
        center, their_center = estimated[HIPS].mean(0), true_part[HIPS].mean(0)
        fit = align_similarity(estimated[known], true_part[known])
        pa.append(np.linalg.norm(fit(estimated[known]) - true_part[known], axis=1).mean())
        relative.append(np.linalg.norm(estimated[known] - center - true_part[known] + their_center, axis=1).mean())
        roots.append((center, their_center))
    path_m, true_path_m = np.array(roots).transpose(1, 0, 2)
    aligned = align_similarity(path_m, true_path_m, with_scale=False)(path_m)
    bend = np.diff(path_m, n=2, axis=0) - np.diff(true_path_m, n=2, axis=0)
    return (
        1000 * float(np.mean(pa)), 1000 * float(np.mean(relative)),
        1000 * float(np.linalg.norm(aligned - true_path_m, axis=1).mean()),
        float(np.linalg.norm(bend, axis=1).mean()) * FPS**2, float("nan"), float("nan"),
    )  # fmt: skip


def table(rows: list[Row]) -> str:
    """Markdown."""
    lines = ["| " + " | ".join(HEADS) + " |", "|---" * len(HEADS) + "|"]
    for one in rows:
        cells = [value if isinstance(value, str) else cell(value) for value in asdict(one).values()]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def cell(value: float) -> str:
    """Three significant digits; empty for NaN."""
    return "" if np.isnan(value) else f"{value:.3g}"


def sheet(previews: list[Path], frames: int = 3, width_px: int = 900) -> np.ndarray:
    """Frames of each preview side by side, one row per clip."""
    import cv2

    rows = []
    for path in previews:
        if not path.is_file():
            continue
        with av.open(str(path)) as film:
            pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        chosen = [pictures[int(k)] for k in np.linspace(0.15, 0.85, frames) * (len(pictures) - 1)]
        size = (width_px // 1, round(chosen[0].shape[0] * width_px / chosen[0].shape[1]))
        rows.append(np.concatenate([cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in chosen], 1))
    return np.concatenate(rows)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--media", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="folder of the scene folders, kept")
    parser.add_argument("--clips", nargs="+", default=list(CLIPS))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
