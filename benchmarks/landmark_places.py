"""Where landmarks are on the body, against the body's own keypoints.

    video2anim synth --preset random --count 16 --seed 4242 --longest 3 --motion cmu.npz --motion more.npz --out clips
    for c in clips/0*; do video2anim run $c/video.mp4 --out scenes/$(basename $c) --until track; done
    python benchmarks/landmark_places.py --clips clips --scenes scenes

For every keypoint the offset in the T-pose that explains best (least squares with Cauchy weights, both sides together,
seen landmarks more) where BlazePose's 2D landmarks of rendered people are, over the body's height; its median
absolute deviation over people; and the median distance of landmarks from keypoints before and after it. The result is
`LANDMARK_OFFSETS` of `video2anim.humans.landmarks`.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from landmark_axes import found_people

from video2anim.body.anny_body import KEYPOINT_NAMES, anny_model, shaped_body
from video2anim.humans.landmarks import LANDMARK_ORDER, MIRROR_KEYPOINT
from video2anim.types import BodyMotion, PersonTrack
from video2anim.types.skeleton import forward_kinematics

MIRROR = np.diag([-1.0, 1.0, 1.0])
OUTLIER = 0.025
"""Distance over the body's height at which a landmark counts half."""


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """Landmarks of one person, in all frames in which they were found. Lengths over the body's height."""

    slope: np.ndarray
    """(frames, keypoints, 2, 3): movement across the image for that of a keypoint in the T-pose."""
    off: np.ndarray
    """(frames, keypoints, 2): landmark minus keypoint, across the image at the keypoint's distance."""
    weight: np.ndarray
    """(frames, keypoints): visibility; every person counts the same."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=Path, required=True)
    parser.add_argument("--scenes", type=Path, required=True)
    options = parser.parse_args()
    people = [compared(*found[1:]) for found in found_people(options.clips, options.scenes)]
    sys.stdout.write(f"{len(people)} people; parts per thousand of the body's height\n")
    sys.stdout.write(
        "| keypoint | offset (left, up, front) | over people | distance before | after |\n|---|---|---|---|---|\n"
    )
    for name in (name for name in KEYPOINT_NAMES if not name.startswith("right_")):
        each = np.stack([offset(name, [person]) for person in people])
        spread = np.median(np.abs(each - np.median(each, 0)), 0)
        found = offset(name, people)
        slope, off, _ = both_sides(name, people)
        before, after = (np.median(np.linalg.norm(off - slope @ d, axis=-1)) for d in (np.zeros(3), found))
        numbers = (", ".join(f"{1000 * x:.0f}" for x in row) for row in (found, spread, [before], [after]))
        sys.stdout.write(f"| {name.removeprefix('left_')} | {' | '.join(numbers)} |\n")


def compared(person: BodyMotion, true_m: np.ndarray, track: PersonTrack) -> Person:
    """Landmarks against keypoints (frames, keypoints, 3) in the camera."""
    k, height_m = person.intrinsics, shaped_body(person.shape).height_m
    rows = np.flatnonzero(track.valid & (true_m[..., 2].min(1) > 0.3))
    x, y, z = (true_m[rows, :, axis] for axis in range(3))
    seen_px = track.landmarks_px[rows][:, LANDMARK_ORDER]
    off_m = np.stack([(seen_px[..., 0] - k.cx_px) / k.fx_px * z - x, (seen_px[..., 1] - k.cy_px) / k.fy_px * z - y], -1)
    _, R_world_joint = forward_kinematics(person.R_parent_joint, person.joints_world_m[:, 0], person.rest_joints_m)
    R_camera_joint = person.T_world_camera[rows, :3, :3].swapaxes(-1, -2)[:, None] @ R_world_joint[rows]
    turned = np.einsum("kj,tjab->tkab", anny_model().keypoint_weights.numpy(), R_camera_joint)
    zero, one = np.zeros(z.shape), np.ones(z.shape)
    across = np.stack([np.stack([one, zero, -x / z], -1), np.stack([zero, one, -y / z], -1)], 2)
    return Person(across @ turned, off_m / height_m, track.visibility[rows][:, LANDMARK_ORDER] / len(rows))


def both_sides(name: str, people: list[Person]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slopes, offsets and weights of a left keypoint and of its mirrored partner."""
    left = KEYPOINT_NAMES.index(name)
    right = MIRROR_KEYPOINT[left]
    return (
        np.concatenate([part for one in people for part in (one.slope[:, left], one.slope[:, right] @ MIRROR)]),
        np.concatenate([part for one in people for part in (one.off[:, left], one.off[:, right])]),
        np.concatenate([one.weight[:, k] for one in people for k in (left, right)]) / len(people),
    )


def offset(name: str, people: list[Person]) -> np.ndarray:
    """The offset (3,) of a left keypoint in the T-pose."""
    slope, off, weight = both_sides(name, people)
    found = np.zeros(3)
    for _ in range(20):
        robust = weight / (1 + np.square(np.linalg.norm(off - slope @ found, axis=-1) / OUTLIER))
        curvature = np.einsum("n,nia,nib->ab", robust, slope, slope) + 1e-9 * np.eye(3)
        found = np.linalg.solve(curvature, np.einsum("n,nia,ni->a", robust, slope, off))
    return found


if __name__ == "__main__":
    main()
