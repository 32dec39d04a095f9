"""Training of the lifter: samples with their truth, losses, resuming, and what leaves as ONNX."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic import planted_walk

from video2anim.artifacts.codec import write_value
from video2anim.errors import ModelMissingError
from video2anim.fitting.landmarks import KEYPOINT_INDEX
from video2anim.fitting.lifter_input import CONTACT_INDEX, FEATURES, OUTPUTS
from video2anim.lifting import samples
from video2anim.lifting.motions import LiftingMotions, gather
from video2anim.lifting.network import LifterNetwork, export_onnx
from video2anim.lifting.residuals import ResidualLibrary, true_keypoints
from video2anim.lifting.samples import LiftingSampler
from video2anim.lifting.train import LiftingConfig, losses, measures, train
from video2anim.models.lifter import WIDTHS, Lifter


@pytest.fixture(scope="module")
def motions() -> LiftingMotions:
    walk = planted_walk(120)
    contact = walk.contact[:, CONTACT_INDEX] > 0.5
    return LiftingMotions(
        walk.R_parent_joint.astype(np.float32), walk.T_world_root[:, :3, 3].astype(np.float32), contact,
        np.ones_like(contact), np.array([0, 120]),
    )  # fmt: skip


@pytest.fixture(scope="module")
def residuals() -> ResidualLibrary:
    rng = np.random.default_rng(0)
    count = 60
    return ResidualLibrary(
        rng.normal(0, 0.03, (count, 25, 2)).astype(np.float32), rng.normal(0, 0.05, (count, 25, 3)).astype(np.float32),
        rng.random((count, 25)).astype(np.float32), rng.normal(0, 0.4, (count, 25, 3)).astype(np.float32),
        np.array([0, 25, 60]),
    )  # fmt: skip


def test_samples_depend_on_seed_and_step_alone(motions: LiftingMotions, residuals: ResidualLibrary) -> None:
    one, two = (LiftingSampler(motions, residuals, seed=4) for _ in range(2))
    torch.testing.assert_close(one.batch(3, 2).features, two.batch(3, 2).features, rtol=0, atol=0)
    assert not torch.equal(one.batch(3, 2).features, one.batch(4, 2).features)
    assert one.batch(3, 2).features.shape == (2, 81, FEATURES)


def test_the_true_answer_costs_nothing(motions: LiftingMotions, residuals: ResidualLibrary) -> None:
    batch = LiftingSampler(motions, residuals, seed=1).batch(0, 4)
    logits = 40.0 * (batch.contact - 0.5)
    told = torch.full((*logits.shape[:2], 22), -4.0)
    truth = torch.cat([batch.rot6d.flatten(2), batch.log_size[..., None], batch.offset_m, logits, told, batch.up], -1)
    terms = losses(truth, batch)
    assert float(terms.pop("error")) == pytest.approx(0.2 * -4.0, abs=1e-3)
    assert float(torch.stack(list(terms.values())).sum()) < 1e-3
    found = measures(truth, batch)
    assert found["mpjpe_mm"] < 0.01
    assert found["up_deg"] < 0.1
    spoiled = truth.clone()
    spoiled[..., 132] += 0.1
    assert measures(spoiled, batch)["depth_percent"] == pytest.approx(10.0, rel=1e-3)


def test_noise_moves_what_is_seen_and_not_the_truth(motions: LiftingMotions, residuals: ResidualLibrary) -> None:
    """Without noise the pelvis seen along the ray is where the truth says, in units of the person."""
    clean = LiftingSampler(motions, residuals, seed=2, noise=False, varied=False).batch(0, 3)
    directions = clean.features[..., :50].reshape(3, 81, 25, 2)
    assert float(directions.square().sum(-1).mean(-1).sub(1.0).abs().max()) < 1e-4, "unit size"
    points_m = clean.features[..., 50:125].reshape(3, 81, 25, 3)
    assert float((points_m[..., 11:13, :].mean(2)).abs().max()) < 1e-5, "about the hips"
    noisy = LiftingSampler(motions, residuals, seed=2, varied=False).batch(0, 3)
    assert float((noisy.features - clean.features)[..., :125].abs().mean()) > 0.01


def test_a_camera_held_askew_turns_what_is_seen_and_the_truth_alike(
    motions: LiftingMotions, residuals: ResidualLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shoulder keypoints are joints, so the line between them is known from both."""
    spreads = []
    for share in (0.0, 1.0):
        monkeypatch.setattr(samples, "_ROLLED", share)
        batch = LiftingSampler(motions, residuals, seed=2, noise=False).batch(0, 16)
        points_m = batch.features[..., 50:125].reshape(16, 81, 25, 3)
        seen_m = points_m[..., KEYPOINT_INDEX["left_shoulder"], :] - points_m[..., KEYPOINT_INDEX["right_shoulder"], :]
        true_m = batch.joints_m[..., 16, :] - batch.joints_m[..., 17, :]
        torch.testing.assert_close(seen_m, true_m, atol=1e-4, rtol=0)
        spreads.append(float(batch.up[:, 40, 0].std()))
    assert spreads[1] > 1.5 * spreads[0], "up leans to the side"


def test_training_learns_and_goes_on_where_it_stopped(
    motions: LiftingMotions, residuals: ResidualLibrary, tmp_path: Path
) -> None:
    sampler = LiftingSampler(motions, residuals, seed=0, frames=30, varied=False)
    config = LiftingConfig(steps=12, batch=4, warmup=2, validate_every=6)
    lines: list[str] = []
    whole = train(sampler, sampler, config, tmp_path / "whole.safetensors", on_line=lines.append)
    assert len(lines) == 2
    train(
        sampler,
        sampler,
        LiftingConfig(steps=12, batch=4, warmup=2, validate_every=6, minutes=0.0),
        tmp_path / "a.safetensors",
    )
    again = train(sampler, sampler, config, tmp_path / "a.safetensors")
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, msg=name)
    batch = sampler.batch(500, 8)
    with torch.no_grad():
        trained = torch.stack(list(losses(whole(batch.features), batch).values())).sum()
        fresh = torch.stack(list(losses(LifterNetwork()(batch.features), batch).values())).sum()
    assert trained < 0.8 * fresh


def test_the_training_program_trains_and_exports(
    motions: LiftingMotions, residuals: ResidualLibrary, tmp_path: Path
) -> None:
    for name, value in (("train", motions), ("val", motions), ("residuals", residuals)):
        (tmp_path / name).mkdir()
        write_value(value, tmp_path / name)
    program = [sys.executable, str(Path(__file__).parents[2] / "training" / "lifter.py")]
    given = [f"--{name}={tmp_path / name}" for name in ("train", "val", "residuals", "checkpoint")]
    for words in (["train", *given, "--minutes=0"], ["export", given[-1], f"--out={tmp_path / 'lifter.onnx'}"]):
        done = subprocess.run([*program, *words], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    digest = hashlib.sha256((tmp_path / "lifter.onnx").read_bytes()).hexdigest()
    assert done.stdout.split() == [digest]


def test_onnx_answers_as_the_network(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = LifterNetwork(width=32)
    export_onnx(network, tmp_path / "lifter.onnx")
    features = np.random.default_rng(1).normal(0, 1, (77, FEATURES)).astype(np.float32)
    features[:, -1] = 1.0
    with torch.no_grad():
        wanted = network(torch.from_numpy(features)[None])[0].numpy()
    np.testing.assert_allclose(Lifter(tmp_path / "lifter.onnx")(features), wanted, atol=1e-4)


def test_a_lifter_of_other_widths_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (FEATURES, OUTPUTS) == WIDTHS
    monkeypatch.setattr("video2anim.lifting.network.OUTPUTS", OUTPUTS - 22)
    export_onnx(LifterNetwork(width=32), tmp_path / "old.onnx")
    with pytest.raises(
        ModelMissingError, match=r"old.onnx: want 154 features and 168 outputs a frame, got \(154, 146\)"
    ):
        Lifter(tmp_path / "old.onnx")


def test_acted_motion_knows_all_contacts() -> None:
    found = gather([], None, acted=2, seed=5)
    assert len(found.start) == 3
    assert found.start[-1] == len(found.translation_m)
    assert found.contact_known.all()
    seat = found.contact[found.start[1] :, 6]
    assert seat.any(), "the second act is to sit"
    assert not found.contact[: found.start[1], 6].any(), "the first is a walk"


def test_a_mirror_of_a_mirror(residuals: ResidualLibrary) -> None:
    twice = residuals.mirrored_too().mirrored_too()
    count = len(residuals.pixels)
    for name in ("pixels", "points_m", "visibility", "truth_m"):
        np.testing.assert_array_equal(getattr(twice, name)[3 * count :], getattr(residuals, name))
    assert twice.start[-1] == 4 * count


def test_keypoints_of_a_body_lie_about_its_joints() -> None:
    walk = planted_walk(5)
    points = true_keypoints(walk)
    middle = points[:, [KEYPOINT_INDEX["left_hip"], KEYPOINT_INDEX["right_hip"]]].mean(1)
    assert np.linalg.norm(middle - walk.joints_camera_m[:, 0], axis=-1).max() < 0.12
