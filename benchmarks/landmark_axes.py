"""Measures how 3D landmarks are rotated against the camera.

    python benchmarks/landmark_axes.py --clips clips --scenes scenes

Clips are those of `video2anim synth`; scenes are scene folders, run until `track`, of the same names or of these with a
suffix, as `training/lifter.py` leaves them in its cache. In every 15th frame the rotation from the 3D landmarks to the
true joints is explained by linear regression: its yaw by the yaw of the viewing ray, its pitch by the pitch of the ray
and that of the camera. For the ray, slope 1 means that landmarks are in the axes of the ray and 0 in those of the
camera; for the camera, slope 1 means that they are in the axes of a level camera. The 90 % intervals are over clips.
The result is used in `video2anim.humans.initial`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from real_clips import LANDMARKS, LIMBS

from video2anim.artifacts.codec import read_value
from video2anim.geometry.rotations import axis_angle_from_matrix, nearest_rotation
from video2anim.humans.initial import landmark_turns
from video2anim.lab.eval.truth import read_truth
from video2anim.lab.lifter.residuals import track_of, true_keypoints
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.types import BodyMotion, PersonTrack, PersonTracks

EVERY = 15
FARTHEST_DEG = 25.0
"""Larger rotations are errors of the landmarks and are left out."""
HIPS, LEGS = [23, 24], [25, 26, 27, 28]
SEEN = 0.5
"""Mean visibility of knees and ankles from which legs count as seen."""
DRAWS, SEED = 1000, 0


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """Frames of one person in one video, degrees about the axes of the image."""

    clip: str
    legs_seen: np.ndarray
    """(frames,), boolean."""
    needed: np.ndarray
    """(frames, 3): from the landmarks to the true joints."""
    ray_yaw: np.ndarray
    ray_pitch: np.ndarray
    camera_pitch: np.ndarray
    """`landmark_turns`, (frames, 3) each."""


def main() -> None:
    """Collect rotations, fit the slopes, print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=Path, required=True)
    parser.add_argument("--scenes", type=Path, required=True)
    options = parser.parse_args()
    found = [turns(*one) for one in found_people(options.clips, options.scenes)]
    for name, legs in (("legs seen", [True]), ("legs hidden", [False]), ("all", [True, False])):
        sys.stdout.write(f"{name}: {described(found, legs)}\n")


def described(found: list[Turns], legs: list[bool]) -> str:
    """Slopes with their intervals over clips."""
    rng, names = np.random.default_rng(SEED), sorted({one.clip for one in found})
    by_clip = {name: rows_of([one for one in found if one.clip == name], legs) for name in names}
    by_clip = {name: rows for name, rows in by_clip.items() if len(rows)}
    names = list(by_clip)
    drawn = [slopes(np.concatenate([by_clip[name] for name in rng.choice(names, len(names))])) for _ in range(DRAWS)]
    low, high = np.percentile(drawn, [5, 95], axis=0)
    rows = np.concatenate(list(by_clip.values()))
    parts = [
        f"{name} {value:.2f} [{a:.2f}, {b:.2f}]"
        for name, value, a, b in zip(
            ("ray's yaw", "ray's pitch", "camera's pitch", "constant, deg"), slopes(rows), low, high, strict=True
        )
    ]
    return ", ".join(parts) + f"; {len(rows)} frames of {len(names)} clips"


def rows_of(found: list[Turns], legs: list[bool]) -> np.ndarray:
    """Needed yaw, ray's yaw, needed pitch, ray's pitch, camera's pitch of the usual frames, (frames, 5), degrees."""
    parts = [np.zeros((0, 5))]
    for one in found:
        usual = (np.abs(one.needed).max(1) < FARTHEST_DEG) & np.isin(one.legs_seen, legs)
        columns = [
            one.needed[:, 1], one.ray_yaw[:, 1], one.needed[:, 0], one.ray_pitch[:, 0], one.camera_pitch[:, 0]
        ]  # fmt: skip
        parts.append(np.stack(columns, 1)[usual])
    return np.concatenate(parts)


def slopes(rows: np.ndarray) -> np.ndarray:
    """Of the ray's yaw, of the ray's and the camera's pitch, and the constant of the pitch in degrees."""
    one = np.ones(len(rows))
    yaw = np.linalg.lstsq(np.stack([rows[:, 1], one], 1), rows[:, 0], rcond=None)[0]
    pitch = np.linalg.lstsq(np.stack([rows[:, 3], rows[:, 4], one], 1), rows[:, 2], rcond=None)[0]
    return np.array([yaw[0], *pitch])


def turns(clip: str, person: BodyMotion, true_m: np.ndarray, track: PersonTrack) -> Turns:
    """Every 15th valid frame of a person."""
    frames = np.flatnonzero(track.valid)[::EVERY]
    pairs = zip(track.landmarks_m[frames][:, LANDMARKS], person.joints_camera_m[frames][:, LIMBS], strict=True)
    center_px, up_camera = track.landmarks_px[frames][:, HIPS].mean(1), person.T_world_camera[frames, 1, :3]
    known = landmark_turns(center_px, person.intrinsics, up_camera)
    return Turns(
        clip, track.visibility[frames][:, LEGS].mean(1) >= SEEN, np.degrees([turn(a, b) for a, b in pairs]),
        *(np.degrees(one) for one in known),
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
