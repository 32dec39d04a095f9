"""The shipped weights on captured motion: long motion has no seams, keyframes no pops, few steps are enough."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scenemi.data.container import MotionArchive, read_split
from scenemi.data.retarget import RetargetedMotion, retarget
from scenemi.evaluation.seams import keyframe_motion, seam_jerk
from scenemi.evaluation.windows import FPS, adult_body
from scenemi.longmotion import inbetween
from scenemi.model.prior import DiffusionPrior, load_diffusion_prior
from scenemi.prior import WEIGHTS_FOLDER, InterpolationPrior, KeyframeWindow
from scenemi.windows import WINDOW_FRAMES
from video2anim.body.skeleton import forward_kinematics

REPOSITORY = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def prior() -> DiffusionPrior:
    if not (WEIGHTS_FOLDER / "small.safetensors").is_file():
        pytest.skip("no weights in scenemi/weights")
    return load_diffusion_prior(WEIGHTS_FOLDER)


@pytest.fixture(scope="module")
def long_clips() -> list[RetargetedMotion]:
    """Held-out clips of several windows."""
    folder = REPOSITORY.parent / "shared" / "motion"
    if not folder.is_dir():
        pytest.skip(f"motion data not found at {folder}")
    archive = MotionArchive.read(folder / "cmu.npz")
    test = set(read_split(folder / "split.json")["test"])
    frames = zip(archive.names, archive.frame_counts, strict=True)
    names = [name for name, count in frames if name in test and count >= 300]
    return [retarget(archive.clip(name), adult_body()) for name in names[:4]]


@pytest.mark.slow
@pytest.mark.parametrize("interval", [15, 30])
def test_there_is_no_pop_at_seams_and_keyframes(
    prior: DiffusionPrior, long_clips: list[RetargetedMotion], interval: int
) -> None:
    at_seams, at_keys = [], []
    for clip in long_clips:
        motion = keyframe_motion(clip, interval, min(len(clip.translation_m), 690))
        jerk = seam_jerk(motion, inbetween(motion, prior))
        at_seams.append(jerk.at_seams)
        at_keys.append(jerk.at_keyframes)
    assert np.median(np.concatenate(at_seams)) <= 1.2
    assert np.median(np.concatenate(at_keys)) <= 1.3


@pytest.mark.slow
def test_between_keyframes_it_is_nearer_the_truth_than_interpolation(
    prior: DiffusionPrior, long_clips: list[RetargetedMotion]
) -> None:
    errors: list[tuple[float, float]] = []
    for clip in long_clips:
        motion = keyframe_motion(clip, 30, WINDOW_FRAMES)
        window = KeyframeWindow(
            motion.R_parent_joint, motion.translation_world_m, motion.is_keyframe, motion.rest_joints_m, FPS,
            body=motion.body,
        )  # fmt: skip
        rest = motion.rest_joints_m
        truth_m, _ = forward_kinematics(window.R_parent_joint, window.translation_world_m, rest)
        row = []
        for filler in (prior, InterpolationPrior()):
            made = filler.fill(window)
            joints_m, _ = forward_kinematics(made.R_parent_joint, made.translation_world_m, rest)
            row.append(float(np.linalg.norm(joints_m - truth_m, axis=-1).mean()))
        errors.append((row[0], row[1]))
    ours, theirs = np.mean(errors, axis=0)
    assert ours < theirs
