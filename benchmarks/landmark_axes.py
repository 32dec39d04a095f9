"""Measures how 3D landmarks are rotated against the viewing ray.

    python benchmarks/landmark_axes.py --clips clips --scenes scenes

Clips are those of `video2anim synth`; scenes are scene folders, run until `track`, of the same names or of these with a
suffix, as `training/lifter.py` leaves them in its cache. In every 15th frame the rotation from the 3D landmarks to the
true joints, in the axes of the viewing ray, is explained by linear regression: its pitch by that of the ray against the
horizon (slope 0: landmarks are in the axes of the ray, 1: in those of a level camera), its yaw by the yaw of the ray in
the image (0: axes of the ray, -1: of the camera). The last line is of the lifter: the error of the root's pitch over
how far the lifter's own up direction is off in pitch, medians of each video, by a line through the origin. The 90 %
intervals are over clips. The results are used in `video2anim.humans.initial` and `video2anim.humans.lifting`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from real_clips import LANDMARKS, LIMBS

from video2anim.artifacts.codec import read_value
from video2anim.geometry.rotations import axis_angle_from_matrix, nearest_rotation
from video2anim.humans.initial import ray_pitch, ray_rotation
from video2anim.humans.lifter_input import lifted_body, lifter_input
from video2anim.humans.lifting import Network
from video2anim.humans.observe import observations
from video2anim.lab.eval.truth import read_truth
from video2anim.lab.lifter.residuals import track_of, true_keypoints
from video2anim.networks import load_model
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.types import BodyMotion, PersonTrack, PersonTracks

EVERY = 15
FARTHEST_DEG = 25.0
"""Larger rotations are errors of the landmarks and are left out."""
HIPS, LEGS = [23, 24], [25, 26, 27, 28]
SEEN = 0.5
"""Mean visibility of knees and ankles from which legs count as seen."""
DRAWS, SEED = 1000, 0
NAMES = "slope of the pitch", "its constant in degrees", "slope of the yaw"


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """Frames of one person in one video, degrees."""

    clip: str
    legs_seen: np.ndarray
    """(frames,), boolean."""
    needed: np.ndarray
    """(frames, 3): rotation vectors from the landmarks to the true joints, in the axes of the ray."""
    pitch: np.ndarray
    """(frames,): of a level camera against the ray."""
    yaw: np.ndarray
    """(frames,): of the ray in the image."""
    lifted: tuple[float, float]
    """Error of the lifter's root and of its up direction in pitch, medians of the video."""


def main() -> None:
    """Collect rotations, fit the slopes, print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=Path, required=True)
    parser.add_argument("--scenes", type=Path, required=True)
    options = parser.parse_args()
    network = load_model("lifter")
    found = [turns(*one, network) for one in found_people(options.clips, options.scenes)]
    for name, legs in (("legs seen", [True]), ("legs hidden", [False]), ("all", [True, False])):
        parts = [rows_of(of_clip, legs) for of_clip in by_clip(found)]
        sys.stdout.write(f"{name}: {described([rows for rows in parts if len(rows)], slopes, NAMES)}\n")
    videos = [np.array([one.lifted for one in of_clip]) for of_clip in by_clip(found)]
    sys.stdout.write(f"lifter: {described(videos, slope_of_pitch, ('slope of the pitch',))}\n")


def by_clip(found: list[Turns]) -> list[list[Turns]]:
    """Videos of the same clip together."""
    return [[one for one in found if one.clip == clip] for clip in sorted({one.clip for one in found})]


def described(parts: list[np.ndarray], fit: Callable[[np.ndarray], np.ndarray], names: Sequence[str]) -> str:
    """Result of a fit to the rows of all clips, with its intervals over clips."""
    rng, rows = np.random.default_rng(SEED), np.concatenate(parts)
    drawn = [
        fit(np.concatenate([parts[clip] for clip in rng.integers(len(parts), size=len(parts))])) for _ in range(DRAWS)
    ]
    columns = zip(names, fit(rows), *np.percentile(drawn, [5, 95], axis=0), strict=True)
    numbers = ", ".join(f"{name} {value:.2f} [{low:.2f}, {high:.2f}]" for name, value, low, high in columns)
    return f"{numbers}; {len(rows)} rows of {len(parts)} clips"


def rows_of(found: list[Turns], legs: list[bool]) -> np.ndarray:
    """Needed pitch, pitch, needed yaw, yaw of the usual frames, (frames, 4), degrees."""
    parts = [np.zeros((0, 4))]
    for one in found:
        usual = (np.abs(one.needed).max(1) < FARTHEST_DEG) & np.isin(one.legs_seen, legs)
        parts.append(np.stack([one.needed[:, 0], one.pitch, one.needed[:, 1], one.yaw], 1)[usual])
    return np.concatenate(parts)


def slopes(rows: np.ndarray) -> np.ndarray:
    """Slope of the pitch, its constant in degrees, slope of the yaw."""
    one = np.ones(len(rows))
    pitch = np.linalg.lstsq(np.stack([rows[:, 1], one], 1), rows[:, 0], rcond=None)[0]
    yaw = np.linalg.lstsq(np.stack([rows[:, 3], one], 1), rows[:, 2], rcond=None)[0]
    return np.array([*pitch, yaw[0]])


def slope_of_pitch(videos: np.ndarray) -> np.ndarray:
    """Error of the root's pitch over that of the up direction."""
    return np.array([(videos[:, 0] @ videos[:, 1]) / (videos[:, 1] @ videos[:, 1])])


def lifted_pitch(person: BodyMotion, track: PersonTrack, network: Network) -> tuple[float, float]:
    """Error of the lifter's root in pitch, and what its up direction is off in pitch, medians in degrees."""
    up_camera = person.T_world_camera[:, 1, :3]
    given = lifter_input(observations(track, person.frame_time_s, person.intrinsics, up_camera))
    body = lifted_body(network(given.features), given)
    pitch_rad, across = ray_pitch(up_camera, given.R_camera_ray)
    R_true = np.swapaxes(person.T_world_camera[:, :3, :3], -1, -2) @ person.R_parent_joint[:, 0]
    error = axis_angle_from_matrix(R_true @ np.swapaxes(body.R_parent_joint[:, 0], -1, -2))
    error_rad = np.einsum("ta,tab,tb->t", error, given.R_camera_ray, across)
    off_rad = pitch_rad - ray_pitch(body.up_camera, given.R_camera_ray)[0]
    valid = track.valid
    return float(np.degrees(np.median(error_rad[valid]))), float(np.degrees(np.median(off_rad[valid])))


def turns(clip: str, person: BodyMotion, true_m: np.ndarray, track: PersonTrack, network: Network) -> Turns:
    """Every 15th valid frame of a person."""
    frames = np.flatnonzero(track.valid)[::EVERY]
    center_px, k = track.landmarks_px[frames][:, HIPS].mean(1), person.intrinsics
    R_camera_ray = ray_rotation(center_px, k)
    pitch_rad, across = ray_pitch(person.T_world_camera[frames, 1, :3], R_camera_ray)
    true_ray_m = person.joints_camera_m[frames][:, LIMBS] @ R_camera_ray
    pairs = zip(track.landmarks_m[frames][:, LANDMARKS], true_ray_m, strict=True)
    return Turns(
        clip, track.visibility[frames][:, LEGS].mean(1) >= SEEN, np.degrees([turn(a, b) for a, b in pairs]),
        np.degrees(pitch_rad * across[:, 0]),
        np.degrees(np.arctan((center_px[:, 0] - k.cx_px) / k.fx_px)),
        lifted_pitch(person, track, network),
    )  # fmt: skip


def found_people(clips: Path, scenes: Path) -> Iterator[tuple[str, BodyMotion, np.ndarray, PersonTrack]]:
    """Clips, people of `video2anim synth`, their keypoints (frames, keypoints, 3) in the camera, and their tracks."""
    for folder in sorted(path.parent for path in clips.glob("[!.]*/meta.json")):
        for scene in sorted(scenes.glob(f"{folder.name}*")):
            payload = stage_folder(scene, "track")
            if not payload.is_dir():
                continue
            tracks = read_value(PersonTracks, payload)
            for person in read_truth(folder).people:
                true_m = true_keypoints(person)
                track = track_of(person, true_m, tracks)
                if track is not None:
                    yield folder.name, person, true_m, track.whole(len(true_m))


def turn(points_m: np.ndarray, goal_m: np.ndarray) -> np.ndarray:
    """Rotation vector of the best rotation from points to others, both relative to their centroids."""
    a, b = points_m - points_m.mean(0), goal_m - goal_m.mean(0)
    return axis_angle_from_matrix(nearest_rotation((b.T @ a)[None]))[0]


if __name__ == "__main__":
    main()
