"""Measures errors of the video pipeline's bodies on known motions, as noise for the training of the prior.

    python training/pipeline_errors.py --motion ../shared/motion --part train --windows 200 --out errors.npz

Run it again when the lifter or stage `humans` has changed, then continue training. Nothing is rendered. Motions of a
split are placed in front of random cameras, landmarks with BlazePose's errors are simulated as for the training of the
lifter (`training/lifter.py` creates missing data), and stage `humans` fits bodies to them. Roots and local rotations
are compared in the true camera, without the mean shift of a window, which no prior can correct.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from lifter import CLIPS, samplers  # beside this file

from stages.humans import HumansConfig, recover_humans
from video2anim.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from video2anim.humans.landmarks import LANDMARK_ORDER
from video2anim.lab.lifter.samples import LiftingSampler, SimulatedWindow
from video2anim.networks import load_model
from video2anim.networks.fetch import cache_dir
from video2anim.pipeline.stage import StageContext
from video2anim.types import BodyMotion, CameraEstimate, Intrinsics, PersonTrack, PersonTracks, VideoClip
from video2anim.types.clip import FPS, SourceInfo
from video2anim.types.storage import PayloadFile

FRAMES = 180
"""Six seconds, longer than a window of the prior, so that windows get different errors."""
FOCAL_PX = 1000.0
FOCAL_ERROR, UP_ERROR_RAD = 0.05, 0.02
"""Standard deviations of the errors of the camera given to stage `humans`: log focal length, up direction."""


def main() -> None:
    """Simulate, run stage humans, compare, write the errors."""
    options = arguments()
    torch.set_num_threads(options.threads)
    train, held_out = samplers(options)
    source = train if options.part == "train" else held_out
    sampler = LiftingSampler(source.motions, source.library, seed=options.seed, frames=FRAMES, varied=False)
    turns, shifts = [], []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.windows):
            rng = np.random.default_rng([options.seed, number])
            simulated = sampler.simulate(rng)
            found = estimated(simulated, rng, Path(folder))
            if found is None:
                continue
            turn, shift = errors(simulated, found)
            turns.append(turn)
            shifts.append(shift)
            if number % 10 == 9:
                size = np.degrees(np.sqrt(np.square(turns[-10:]).mean())), np.sqrt(np.square(shifts[-10:]).mean())
                sys.stdout.write(f"{number + 1}: {size[0]:.1f} degrees, {100 * size[1]:.1f} cm\n")
                sys.stdout.flush()
    np.savez_compressed(
        options.out,
        turn_rad=np.concatenate(turns).astype(np.float16),
        shift_m=np.concatenate(shifts).astype(np.float16),
        start=np.concatenate([[0], np.cumsum([len(turn) for turn in turns])]),
    )


def estimated(simulated: SimulatedWindow, rng: np.random.Generator, folder: Path) -> BodyMotion | None:
    """The motion by stage `humans` for simulated landmarks; None if too little of the person is visible."""
    if simulated.valid.mean() < 0.5:
        return None
    intrinsics = Intrinsics(FOCAL_PX, FOCAL_PX, 0.0, 0.0, 1920, 1920)
    pixels = FOCAL_PX * simulated.directions
    landmarks_px, landmarks_m = np.full((FRAMES, 33, 2), np.nan), np.full((FRAMES, 33, 3), np.nan)
    visibility = np.zeros((FRAMES, 33))
    seen = simulated.valid
    landmarks_px[np.ix_(seen, LANDMARK_ORDER)] = pixels[seen]
    landmarks_m[np.ix_(seen, LANDMARK_ORDER)] = simulated.points_m[seen]
    visibility[np.ix_(seen, LANDMARK_ORDER)] = simulated.visibility[seen]
    track = PersonTrack(
        1, seen, np.where(seen, 1.0, np.nan), np.full((FRAMES, 4), np.nan), landmarks_px, landmarks_m, visibility,
        np.zeros((FRAMES, 64, 64), np.uint8), np.full((FRAMES, 2, 3), np.nan),
    )  # fmt: skip
    assumed = FOCAL_PX * float(np.exp(rng.normal(0.0, FOCAL_ERROR)))
    tilt = matrix_from_axis_angle(rng.normal(0.0, UP_ERROR_RAD, 3))
    camera = CameraEstimate(
        Intrinsics(assumed, assumed, intrinsics.cx_px, intrinsics.cy_px, 1920, 1920), "picture", FOCAL_ERROR,
        tilt @ simulated.R_camera_world[:, 1], UP_ERROR_RAD, True, np.tile(np.eye(4), (FRAMES, 1, 1)),
    )  # fmt: skip
    context = StageContext(folder, load_model=load_model)
    bodies = recover_humans(_clip(folder), PersonTracks((track,), (1,)), camera, HumansConfig(), context)
    return bodies.main


def errors(simulated: SimulatedWindow, found: BodyMotion) -> tuple[np.ndarray, np.ndarray]:
    """Axis-angle of R_true^T R_estimated (T, 22, 3) in radians, and estimated minus true pelvis (T, 3) in meters,
    without its mean (axes: x right, y up, z away from the camera)."""
    R_camera_world = np.swapaxes(found.T_world_camera[:, :3, :3], -1, -2)
    R = found.R_parent_joint.copy()
    R[:, 0] = R_camera_world @ R[:, 0]
    true = simulated.R_parent_joint.copy()
    true[:, 0] = simulated.R_camera_world @ true[:, 0]
    turn = axis_angle_from_matrix(np.swapaxes(true, -1, -2) @ R)
    up = simulated.R_camera_world[:, 1]
    away = np.array([0.0, 0.0, 1.0]) - up[2] * up
    away /= np.linalg.norm(away)
    axes = np.stack([np.cross(up, away), up, away])
    shift = (found.joints_camera_m[:, 0] - simulated.pelvis_camera_m) @ axes.T
    return turn, shift - shift.mean(0)


def _clip(folder: Path) -> VideoClip:
    """A clip without pictures, of which only the frame times are used."""
    time_s = np.arange(FRAMES) / FPS
    info = SourceInfo("none", "none", 1920, 1920, 0, 1.0, FPS, FRAMES, FRAMES, FRAMES / FPS, 0.0)
    shots = ((0.0, FRAMES / FPS),)
    return VideoClip(
        PayloadFile(folder / "none"), 1920, 1920, FPS, time_s, time_s, info, shots, 0, ()
    )  # fmt: skip


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", type=Path, required=True)
    parser.add_argument("--part", choices=("train", "val"), default="train")
    parser.add_argument("--windows", type=int, default=200)
    parser.add_argument("--seed", type=int, default=4100)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument(
        "--cache", type=Path, default=cache_dir() / "training" / "lifter", help="cache of training/lifter.py"
    )
    parser.add_argument("--clips", type=int, default=CLIPS, help="rendered clips with BlazePose's errors")
    parser.add_argument("--out", type=Path, required=True)
    return parser.parse_args()


if __name__ == "__main__":
    main()
