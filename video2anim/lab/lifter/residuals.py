"""Errors of the landmark model, measured on rendered people with known bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from video2anim.body.anny_body import anny_model
from video2anim.humans.initial import landmark_rotation, ray_rotation
from video2anim.humans.landmarks import KEYPOINT_INDEX, LANDMARK_ORDER, MIRROR_KEYPOINT
from video2anim.lab.eval.truth import Truth, read_truth
from video2anim.types import BodyMotion, PersonTrack, PersonTracks
from video2anim.types.skeleton import forward_kinematics

_HIPS = [KEYPOINT_INDEX["left_hip"], KEYPOINT_INDEX["right_hip"]]
_SAME_BODY = 0.35
"""A track matches a true person if the error of its landmarks is below this share of the person's size."""
_MIN_FRAMES = 12


@dataclass(frozen=True, slots=True, eq=False)
class ResidualLibrary:
    """Concatenated runs of consecutive frames, in the frame of the person's viewing ray."""

    pixels: Float[np.ndarray, "frames keypoints 2"]
    """Error of the image positions, relative to the true size (root mean square distance from the hips)."""
    points_m: Float[np.ndarray, "frames keypoints 3"]
    """Error of the 3D landmarks relative to the center of the hips."""
    visibility: Float[np.ndarray, "frames keypoints"]
    truth_m: Float[np.ndarray, "frames keypoints 3"]
    """True keypoints relative to the center of the hips: the pose to which the error belongs."""
    start: Int[np.ndarray, "runs+1"]
    hidden: Bool[np.ndarray, "runs"]
    """Of clips in which a part of the person is hidden (`video2anim.lab.lifter.hidden`)."""

    def mirrored_too(self) -> ResidualLibrary:
        """The library with a mirrored copy of every run."""
        flip2, flip3 = np.array([-1.0, 1.0]), np.array([-1.0, 1.0, 1.0])
        return ResidualLibrary(
            np.concatenate([self.pixels, self.pixels[:, MIRROR_KEYPOINT] * flip2]).astype(np.float32),
            np.concatenate([self.points_m, self.points_m[:, MIRROR_KEYPOINT] * flip3]).astype(np.float32),
            np.concatenate([self.visibility, self.visibility[:, MIRROR_KEYPOINT]]).astype(np.float32),
            np.concatenate([self.truth_m, self.truth_m[:, MIRROR_KEYPOINT] * flip3]).astype(np.float32),
            np.concatenate([self.start, self.start[1:] + self.start[-1]]),
            np.tile(self.hidden, 2),
        )


def collect(clips: Sequence[tuple[Path, PersonTracks, bool]]) -> ResidualLibrary:
    """Residuals of all persons that were found in clips of `video2anim synth`.

    Args:
        clips: Truth folder of each clip, the tracks found in its video (every frame), and whether a part of the person
            is hidden in that video.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    hidden: list[bool] = []
    for folder, tracks, is_hidden in clips:
        truth = read_truth(folder)
        for person in truth.people:
            true_m = true_keypoints(person)
            track = track_of(person, true_m, tracks)
            if track is not None:
                parts += _runs(track, true_m, truth)
                hidden += [is_hidden] * (len(parts) - len(hidden))
    pixels, points, visibility, true = (
        np.concatenate(column).astype(np.float32) for column in zip(*parts, strict=True)
    )
    start = np.concatenate([[0], np.cumsum([len(part[0]) for part in parts])])
    return ResidualLibrary(pixels, points, visibility, true, start, np.array(hidden))


def true_keypoints(person: BodyMotion) -> Float[np.ndarray, "frames keypoints 3"]:
    """Keypoints of a body in the camera frame, meters."""
    model = anny_model()
    rest = model.rest_skeleton({name: torch.tensor(float(value)) for name, value in person.shape.parameters.items()})
    R_camera_world = np.swapaxes(person.T_world_camera[:, :3, :3], -1, -2)
    _, R_world_joint = forward_kinematics(person.R_parent_joint, person.joints_world_m[:, 0], person.rest_joints_m)
    with torch.no_grad():
        world = rest.keypoints_m(
            torch.from_numpy(person.joints_world_m).float(), torch.from_numpy(R_world_joint).float()
        )
    return np.einsum("tab,tkb->tka", R_camera_world, world.numpy() - person.T_world_camera[:, None, :3, 3])


def _projected(true_m: np.ndarray, person: BodyMotion) -> np.ndarray:
    k = person.intrinsics
    z = np.maximum(true_m[..., 2], 0.1)
    return np.stack([k.fx_px * true_m[..., 0] / z + k.cx_px, k.fy_px * true_m[..., 1] / z + k.cy_px], -1)


def track_of(person: BodyMotion, true_m: np.ndarray, tracks: PersonTracks) -> PersonTrack | None:
    """The track with the smallest error for this person; None if none matches."""
    true_px = _projected(true_m, person)
    size = np.linalg.norm(np.ptp(true_px, axis=1), axis=-1)
    best: tuple[float, PersonTrack | None] = (_SAME_BODY, None)
    for track in (track.whole(len(true_m)) for track in tracks.people):
        off = np.linalg.norm(track.landmarks_px[:, LANDMARK_ORDER] - true_px, axis=-1).mean(1) / size
        miss = float(np.nanmedian(off[track.valid])) if track.valid.any() else np.inf
        if miss < best[0]:
            best = (miss, track)
    return best[1]


def _runs(track: PersonTrack, true_m: np.ndarray, truth: Truth) -> list[tuple[np.ndarray, ...]]:
    """Residuals of each run of frames in which the track matches the person."""
    person = truth.main
    seen_px, k = track.landmarks_px[:, LANDMARK_ORDER], person.intrinsics
    ok = track.valid & (true_m[..., 2].min(1) > 0.2)
    center_px = np.where(ok[:, None], _projected(true_m, person)[:, _HIPS].mean(1), k.cx_px)
    R = ray_rotation(center_px, k)
    true_ray = true_m @ R
    ones = np.ones(seen_px.shape[:2])
    seen_ray = np.stack([(seen_px[..., 0] - k.cx_px) / k.fx_px, (seen_px[..., 1] - k.cy_px) / k.fy_px, ones], -1) @ R
    true_xy, seen_xy = true_ray[..., :2] / true_ray[..., 2:], seen_ray[..., :2] / seen_ray[..., 2:]
    spread = true_xy - true_xy[:, _HIPS].mean(1, keepdims=True)
    size = np.sqrt((spread**2).sum(-1).mean(1))
    pixels = (seen_xy - true_xy) / size[:, None, None]
    relative = true_ray - true_ray[:, _HIPS].mean(1, keepdims=True)
    R_ray_landmarks = np.swapaxes(R, -1, -2) @ landmark_rotation(center_px, k, person.T_world_camera[:, 1, :3])
    points = np.einsum("tab,tkb->tka", R_ray_landmarks, track.landmarks_m[:, LANDMARK_ORDER])
    points = points - points[:, _HIPS].mean(1, keepdims=True) - relative
    ok &= np.nan_to_num(np.linalg.norm(pixels, axis=-1).mean(1), nan=9.0) < 2 * _SAME_BODY
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ok.astype(int), [0]])))
    return [
        (pixels[a:b], points[a:b], track.visibility[a:b][:, LANDMARK_ORDER], relative[a:b])
        for a, b in edges.reshape(-1, 2)
        if b - a >= _MIN_FRAMES
    ]
