"""Tests whether 3D landmarks are in camera axes or in the axes of the person's viewing ray.

    python benchmarks/landmark_axes.py --clips clips --scenes scenes

Clips are those of `video2anim synth`; scenes are scene folders of the same names, run until `track`. In every 15th
frame the rotation from the 3D landmarks to the true joints is compared with the rotation of the viewing ray by linear
regression. Slope 1 means that landmarks are in the axes of the ray, 0 in those of the camera. The result is used in
`video2anim.humans.initial`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from main_job import JOINTS, LANDMARKS

from video2anim.artifacts.codec import read_value
from video2anim.geometry.rotations import axis_angle_from_matrix, nearest_rotation
from video2anim.humans.initial import ray_rotation
from video2anim.lab.eval.truth import read_truth
from video2anim.lab.lifter.residuals import track_of, true_keypoints
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.types import BodyMotion, PersonTrack, PersonTracks

EVERY = 15
FARTHEST_DEG = 25.0
"""Larger rotations are errors of the landmarks and are left out."""
HIPS = [23, 24]


def main() -> None:
    """Collect rotations, fit the slopes, print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=Path, required=True)
    parser.add_argument("--scenes", type=Path, required=True)
    options = parser.parse_args()
    rays, turns = [], []
    for person, _, track in found_people(options.clips, options.scenes):
        frames = np.flatnonzero(track.valid)[::EVERY]
        center_px = track.landmarks_px[frames][:, HIPS].mean(1)
        rays.append(np.degrees(axis_angle_from_matrix(ray_rotation(center_px, person.intrinsics))))
        landmarks_m = track.landmarks_m[frames][:, LANDMARKS]
        turns.append(
            np.degrees(
                [turn(a, b) for a, b in zip(landmarks_m, person.joints_camera_m[frames][:, JOINTS], strict=True)]
            )
        )
    ray, needed = np.concatenate(rays), np.concatenate(turns)
    usual = np.abs(needed).max(1) < FARTHEST_DEG
    for axis, name in enumerate(("pitch (x)", "yaw (y)")):
        design = np.stack([ray[usual, axis], np.ones(usual.sum())], 1)
        fit, rest, _, _ = np.linalg.lstsq(design, needed[usual, axis], rcond=None)
        spread = float(
            np.sqrt(rest[0] / (usual.sum() - 2) / np.square(ray[usual, axis] - ray[usual, axis].mean()).sum())
        )
        sys.stdout.write(
            f"{name}: slope {fit[0]:.2f} +- {spread:.2f} over {usual.sum()} frames of {len(rays)} people\n"
        )


def found_people(clips: Path, scenes: Path) -> Iterator[tuple[BodyMotion, np.ndarray, PersonTrack]]:
    """People of `video2anim synth`, their keypoints (frames, keypoints, 3) in the camera, and their tracks."""
    for folder in sorted(clips.iterdir()):
        payload = stage_folder(scenes / folder.name, "track")
        if not (folder / "meta.json").is_file() or not payload.is_dir():
            continue
        tracks = read_value(PersonTracks, payload)
        for person in read_truth(folder).people:
            true_m = true_keypoints(person)
            track = track_of(person, true_m, tracks)
            if track is not None:
                yield person, true_m, track


def turn(points_m: np.ndarray, goal_m: np.ndarray) -> np.ndarray:
    """Rotation vector of the best rotation from points to others, both relative to their centroids."""
    a, b = points_m - points_m.mean(0), goal_m - goal_m.mean(0)
    return axis_angle_from_matrix(nearest_rotation((b.T @ a)[None]))[0]


if __name__ == "__main__":
    main()
