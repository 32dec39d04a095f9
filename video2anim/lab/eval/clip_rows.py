"""Evaluation groups of the clip and its camera: `ingest`, `track`, `camera`."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from video2anim.lab.eval.alignment import FrameMatch
from video2anim.lab.eval.model import Group, make_group
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.truth import Truth
from video2anim.types import BodyTracks, CameraEstimate, Intrinsics, PersonTracks
from video2anim.types.quality import Quality

MATCH_IOU = 0.3
"""Minimum overlap of a track's box with the box of a person's visible pixels. It is low because the first spans joints,
also hidden ones, and the second visible skin and clothes."""


INGEST = (
    Quality("frames", math.nan, "count", "none"),
    Quality("fps", math.nan, "Hz", "none"),
    Quality("kept", math.nan, "ratio", "near_1"),
)
TRACK = (
    Quality("recall", math.nan, "ratio", "higher"),
    Quality("main_recall", math.nan, "ratio", "higher"),
    Quality("precision", math.nan, "ratio", "higher"),
    Quality("box_iou", math.nan, "ratio", "higher"),
    Quality("id_switches", math.nan, "count", "lower"),
)
CAMERA = (
    Quality("static", math.nan, "ratio", "higher"),
    Quality("focal_error", math.nan, "%", "lower"),
    Quality("fov_error", math.nan, "deg", "lower"),
    Quality("gravity_error", math.nan, "deg", "lower"),
    Quality("height_error", math.nan, "m", "lower"),
    Quality("focal_sigmas", math.nan, "ratio", "none"),
    Quality("gravity_sigmas", math.nan, "ratio", "none"),
)

_UNDEFINED = {
    **dict.fromkeys(("recall", "main_recall"), "no person is seen in the truth"),
    **dict.fromkeys(("precision", "box_iou"), "nobody was found"),
    **dict.fromkeys(("focal_sigmas", "gravity_sigmas"), "no standard deviation was predicted"),
}


def ingest_group(result: SceneResult, truth: Truth) -> Group:
    """Frames and frame rate."""
    clip = result.clip
    numbers = {
        "frames": clip.frame_count,
        "fps": clip.fps,
        "kept": clip.frame_count / clip.fps / truth.duration_s,
    }
    true = {"frames": len(truth.frame_time_s), "fps": truth.fps}
    return make_group("ingest", "Clip", INGEST, {"value": numbers}, truth=true)


def track_group(result: SceneResult, truth: Truth, frames: FrameMatch) -> Group:
    """Detection and tracking of persons, by CLEAR MOT on boxes (Bernardin and Stiefelhagen 2008)."""
    tracks = result.get(PersonTracks)
    if tracks is None:
        return make_group("track", "Tracking people", TRACK, {"value": result.why(PersonTracks)})
    size = truth.intrinsics
    scale = np.array([size.width_px / result.clip.width_px, size.height_px / result.clip.height_px])
    known = np.flatnonzero(frames.known)
    whole = [track.whole(result.clip.frame_count) for track in tracks.people]
    boxes = np.array([np.where(t.valid[:, None], t.box_px, np.nan)[known] for t in whole])
    boxes = (boxes.reshape(len(tracks.people), len(known), 4) + 0.5) * np.tile(scale, 2) - 0.5
    found = match_boxes(truth.person_box_px[:, frames.true_index[known]], boxes)
    numbers = {
        "recall": found.recall(),
        "main_recall": found.recall(0),
        "precision": found.precision(),
        "box_iou": found.mean_iou(),
        "id_switches": found.switches,
    }
    note = f"{len(tracks.people)} tracks against {len(truth.people)} persons."
    return make_group("track", "Tracking people", TRACK, {"value": numbers}, undefined=_UNDEFINED, note=note)


def camera_group(result: SceneResult, truth: Truth, frames: FrameMatch) -> Group:
    """Whether a fixed camera was recognized; focal length, gravity and height of the camera."""
    camera, bodies = result.get(CameraEstimate), result.bodies
    true_size = truth.intrinsics
    true_first, first = _first_known(frames)
    numbers: dict[str, float | str] = {measure.key: result.why(CameraEstimate) for measure in CAMERA}
    note = ""
    if camera is not None:
        lens = camera.intrinsics.resized(true_size.width_px, true_size.height_px)
        focal_px = abs(lens.fy_px - true_size.fy_px)
        sigma_px = lens.fy_px * camera.focal_sigma_ratio
        gravity_rad = angle_rad(camera.up_camera, truth.up_camera[true_first])
        numbers |= {
            "static": float(camera.is_static == truth.is_static),
            "focal_error": 100 * focal_px / true_size.fy_px,
            "fov_error": abs(_fov_y_deg(lens) - _fov_y_deg(true_size)),
            "gravity_error": math.degrees(gravity_rad),
            "focal_sigmas": focal_px / sigma_px if sigma_px > 0 else math.nan,
            "gravity_sigmas": gravity_rad / camera.up_sigma_rad if camera.up_sigma_rad > 0 else math.nan,
        }
        note = f"Focal length from {camera.focal_source}."
    numbers["height_error"] = result.why(BodyTracks) or "nobody was fitted"
    if bodies is not None and bodies.people:
        true_height_m = truth.main.T_world_camera[true_first, 1, 3]
        numbers["height_error"] = abs(float(bodies.people[0].T_world_camera[first, 1, 3] - true_height_m))
    return make_group("camera", "Camera", CAMERA, {"value": numbers}, undefined=_UNDEFINED, note=note)


class BoxMatch:
    """The assignment of tracks to true persons in every frame."""

    def __init__(self, track: Int[np.ndarray, "people frames"], iou: Float[np.ndarray, "people frames"]) -> None:
        self.track = track
        """Index of the track of each person; -1 = missed, -2 = the person is not visible."""
        self.iou = iou
        self.false_boxes = 0
        self.switches = 0

    def recall(self, person: int | None = None) -> float:
        chosen = self.track if person is None else self.track[[person]]
        seen = chosen != -2
        return float((chosen[seen] >= 0).mean()) if seen.any() else math.nan

    def precision(self) -> float:
        right = int((self.track >= 0).sum())
        return right / (right + self.false_boxes) if right + self.false_boxes else math.nan

    def mean_iou(self) -> float:
        matched = self.track >= 0
        return float(self.iou[matched].mean()) if matched.any() else math.nan


def match_boxes(
    true_px: Float[np.ndarray, "people frames 4"], found_px: Float[np.ndarray, "tracks frames 4"]
) -> BoxMatch:
    """Match boxes frame by frame; a person keeps its previous track while they overlap (Bernardin, Stiefelhagen 2008).

    Boxes are x0, y0, x1, y1 in pixels; rows of NaN are absent.
    """
    people, count = true_px.shape[:2]
    match = BoxMatch(np.full((people, count), -2), np.full((people, count), np.nan))
    last = np.full(people, -1)
    for frame in range(count):
        seen = np.flatnonzero(np.isfinite(true_px[:, frame]).all(-1))
        present = np.flatnonzero(np.isfinite(found_px[:, frame]).all(-1))
        match.track[seen, frame] = -1
        iou = box_iou(true_px[seen, frame], found_px[present, frame])
        # Keeping the previous track outweighs any better overlap.
        gain = np.where(iou >= MATCH_IOU, iou + (last[seen][:, None] == present[None]), 0.0)
        taken = 0
        for i, j in zip(*linear_sum_assignment(-gain), strict=True):
            if iou[i, j] < MATCH_IOU:
                continue
            person, track = seen[i], present[j]
            match.switches += int(last[person] not in (-1, track))
            match.track[person, frame], match.iou[person, frame], last[person] = track, iou[i, j], track
            taken += 1
        match.false_boxes += len(present) - taken
    return match


def box_iou(a: Float[np.ndarray, "rows 4"], b: Float[np.ndarray, "columns 4"]) -> Float[np.ndarray, "rows columns"]:
    """Intersection over union of boxes x0, y0, x1, y1."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    inner = np.clip(high - low, 0, None).prod(-1)
    area_a, area_b = (np.clip(x[:, 2:] - x[:, :2], 0, None).prod(-1) for x in (a, b))
    return inner / np.maximum(area_a[:, None] + area_b[None] - inner, 1e-9)


def angle_rad(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two directions in radians, exact also for tiny angles."""
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def _fov_y_deg(lens: Intrinsics) -> float:
    return math.degrees(2 * math.atan2(0.5 * lens.height_px, lens.fy_px))


def _first_known(frames: FrameMatch) -> tuple[int, int]:
    """First common frame, as its index in the truth and in the estimate."""
    known = np.flatnonzero(frames.known)
    first = int(known[0]) if len(known) else 0
    return int(frames.true_index[first]), first
