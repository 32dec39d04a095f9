"""Training of the lifter: samples with their truth, losses, a run that goes on, and what leaves as ONNX."""

from __future__ import annotations

import hashlib
import json
import runpy
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic import planted_walk

from video2anim.body.anny_body import KEYPOINT_NAMES
from video2anim.errors import ModelMissingError
from video2anim.geometry.rotations import matrix_from_axis_angle, matrix_from_rot6d, rot6d_from_matrix
from video2anim.humans.landmarks import KEYPOINT_INDEX, MIRROR_KEYPOINT
from video2anim.humans.lifter_input import CONTACT_INDEX, FEATURES, OUTPUTS
from video2anim.lab.lifter import landmark_errors, samples, variation
from video2anim.lab.lifter.bodies import draw_bodies
from video2anim.lab.lifter.hidden import BELOW, CUT, KINDS, hide
from video2anim.lab.lifter.kinematics import planes, planes_from_rot6d, posed
from video2anim.lab.lifter.landmark_errors import LandmarkErrors
from video2anim.lab.lifter.motions import LiftingMotions, cached_motions, gather
from video2anim.lab.lifter.network import LifterNetwork, export_onnx, read_onnx
from video2anim.lab.lifter.objective import losses, measures
from video2anim.lab.lifter.residuals import ResidualLibrary, true_keypoints
from video2anim.lab.lifter.samples import LiftingSampler
from video2anim.lab.lifter.store import has_arrays, read_arrays, write_arrays
from video2anim.lab.lifter.train import (
    CHECKPOINT,
    PROGRESS,
    LiftingConfig,
    annealed,
    read_average,
    read_progress,
    train,
)
from video2anim.lab.lifter.views import draw_views
from video2anim.networks.lifter import WIDTHS, Lifter
from video2anim.types.skeleton import forward_kinematics
from video2anim.video.container import open_video
from video2anim.video.encode import FrameWriter

ROWS = {name: KEYPOINT_INDEX[name] for name in ("left_hip", "right_hip", "left_shoulder", "right_shoulder")}


@pytest.fixture(scope="module")
def motions() -> LiftingMotions:
    walk = planted_walk(120)
    contact = walk.contact[:, CONTACT_INDEX] > 0.5
    return LiftingMotions(
        rot6d_from_matrix(walk.R_parent_joint).astype(np.float32), walk.T_world_root[:, :3, 3].astype(np.float32),
        contact, np.ones_like(contact), np.array([0, 120]),
    )  # fmt: skip


@pytest.fixture(scope="module")
def residuals() -> ResidualLibrary:
    rng = np.random.default_rng(0)
    count = 60
    return ResidualLibrary(
        rng.normal(0, 0.03, (count, 25, 2)).astype(np.float32), rng.normal(0, 0.05, (count, 25, 3)).astype(np.float32),
        rng.random((count, 25)).astype(np.float32), rng.normal(0, 0.4, (count, 25, 3)).astype(np.float32),
        np.array([0, 25, 60]), np.zeros(2, bool),
    )  # fmt: skip


def test_samples_depend_on_seed_and_step_alone(motions: LiftingMotions, residuals: ResidualLibrary) -> None:
    one, two = (LiftingSampler(motions, residuals, seed=4) for _ in range(2))
    torch.testing.assert_close(one.batch(3, 2).features, two.batch(3, 2).features, rtol=0, atol=0)
    assert not torch.equal(one.batch(3, 2).features, one.batch(4, 2).features)
    assert one.batch(3, 2).features.shape == (2, samples.WINDOW_FRAMES, FEATURES)


def test_losses_of_the_true_output_are_zero(motions: LiftingMotions, residuals: ResidualLibrary) -> None:
    batch = LiftingSampler(motions, residuals, seed=1, frames=40).batch(0, 4)
    logits = 40.0 * (batch.contact - 0.5)
    told = torch.full((*logits.shape[:2], 22), -4.0)
    place = torch.cat([batch.log_size[..., None], batch.pelvis_m[..., :2]], -1)
    truth = torch.cat([batch.rot6d.flatten(2), place, logits, told, batch.up], -1)
    terms = losses(truth, batch)
    assert float(terms.pop("error")) == pytest.approx(0.2 * -4.0, abs=1e-3)
    assert float(torch.stack(list(terms.values())).sum()) < 1e-3
    found = measures(truth, batch)
    assert found["mpjpe_mm"] < 0.01
    assert found["pa_mpjpe_mm"] < 0.01
    assert found["up_deg"] < 0.1
    spoiled = truth.clone()
    spoiled[..., 132] += 0.1
    assert measures(spoiled, batch)["depth_percent"] == pytest.approx(10.0, rel=1e-3)


def test_each_loss_rises_with_its_own_error_only(motions: LiftingMotions, residuals: ResidualLibrary) -> None:
    """A body turned about the viewing ray is wrong in the picture; one that leans along the ray hardly is."""
    batch = LiftingSampler(motions, residuals, seed=1, frames=20).batch(0, 4)
    costs = {}
    for name, axis in (("across", [0.0, 0.0, 1.0]), ("along", [1.0, 0.0, 0.0])):
        turn = torch.from_numpy(matrix_from_axis_angle(0.1 * np.array(axis))).float()
        R = matrix_from_rot6d(batch.rot6d)
        R[:, :, 0] = turn @ R[:, :, 0]
        told = torch.full((*batch.contact.shape[:2], 22), -4.0)
        place = torch.cat([batch.log_size[..., None], batch.pelvis_m[..., :2]], -1)
        answer = torch.cat([rot6d_from_matrix(R).flatten(2), place, batch.contact, told, batch.up], -1)
        costs[name] = losses(answer, batch)
    assert costs["across"]["picture"] > 2 * costs["along"]["picture"]
    assert costs["along"]["bones"] > 0.5 * costs["across"]["bones"] > 0.01


def test_alignment_takes_out_a_similarity(motions: LiftingMotions, residuals: ResidualLibrary) -> None:
    """Turned bodies have the same pose; bent ones have not."""
    batch = LiftingSampler(motions, residuals, seed=1, frames=20).batch(0, 2)
    R = matrix_from_rot6d(batch.rot6d)
    turned, bent = R.clone(), R.clone()
    turned[:, :, 0] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ R[:, :, 0]
    bent[:, :, 16] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ R[:, :, 16]
    for wrong, low, high in ((turned, 0.0, 0.01), (bent, 20.0, 300.0)):
        answer = torch.zeros(*R.shape[:2], OUTPUTS)
        answer[..., :132] = rot6d_from_matrix(wrong).flatten(2)
        found = measures(answer, batch)
        assert low <= found["pa_mpjpe_mm"] <= high
        assert found["mpjpe_mm"] > 20.0


def test_noise_moves_what_is_seen_and_not_the_truth(motions: LiftingMotions, residuals: ResidualLibrary) -> None:
    """Without noise the pelvis seen along the ray is where the truth says, in units of the person."""
    clean = LiftingSampler(motions, residuals, seed=2, frames=40, noise=False, varied=False).batch(0, 3)
    directions = clean.features[..., :50].reshape(3, 40, 25, 2)
    assert float(directions.square().sum(-1).mean(-1).sub(1.0).abs().max()) < 1e-4, "unit size"
    points_m = clean.features[..., 50:125].reshape(3, 40, 25, 3)
    assert float((points_m[..., 11:13, :].mean(2)).abs().max()) < 1e-5, "about the hips"
    noisy = LiftingSampler(motions, residuals, seed=2, frames=40, varied=False).batch(0, 3)
    assert float((noisy.features - clean.features)[..., :125].abs().mean()) > 0.01
    torch.testing.assert_close(noisy.rest_joints_m, clean.rest_joints_m)


def test_camera_roll_rotates_landmarks_and_truth(
    motions: LiftingMotions, residuals: ResidualLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shoulder keypoints are joints, so the line between them is known from both."""
    spreads = []
    for share in (0.0, 1.0):
        monkeypatch.setattr(samples, "_ASKEW", share)
        batch = LiftingSampler(motions, residuals, seed=2, frames=40, noise=False).batch(0, 16)
        points_m = batch.features[..., 50:125].reshape(16, 40, 25, 3)
        seen_m = points_m[..., ROWS["left_shoulder"], :] - points_m[..., ROWS["right_shoulder"], :]
        true_m = batch.joints_m[..., 16, :] - batch.joints_m[..., 17, :]
        torch.testing.assert_close(seen_m, true_m, atol=1e-4, rtol=0)
        spreads.append(float(batch.up[:, 20, 0].std()))
    assert spreads[1] > 1.5 * spreads[0], "up leans to the side"


def test_planes_give_what_small_matrices_give() -> None:
    """Forward kinematics and its gradient, in both layouts."""
    rot6d = torch.randn(3, 5, 22, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rest_m = torch.randn(3, 22, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    rest_m[:, 0] = 0.0
    gradients = []
    for in_planes in (True, False):
        given = rot6d.clone().requires_grad_()
        if in_planes:
            joints_m, R = posed(planes_from_rot6d(given), rest_m)
            joints_m, R = joints_m.permute(2, 3, 1, 0), R.permute(3, 4, 2, 0, 1)
        else:
            matrix = matrix_from_rot6d(given)
            joints_m, R = forward_kinematics(matrix, torch.zeros_like(matrix[..., 0, :, 0]), rest_m[:, None])
        (joints_m.square().sum() + R.sum()).backward()
        gradients.append((joints_m.detach(), R.detach(), given.grad))
    for ours, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, theirs)


def test_a_mirrored_window_is_the_window_in_a_mirror(motions: LiftingMotions, residuals: ResidualLibrary) -> None:
    """Joints of both: x changes its sign, left and right their places."""
    sampler = LiftingSampler(motions, residuals, seed=3, frames=20, varied=False)
    pairs: dict[bool, torch.Tensor] = {}
    rest = draw_bodies(np.random.default_rng(0), 1, performers=False).rest_joints_m[0]
    for mirrored in (False, True):
        fixed = _Fixed(mirrored)
        R, translation, _, _ = sampler._moved(fixed, 1)  # type: ignore[arg-type]
        pairs[mirrored] = forward_kinematics(R, translation, rest)[0]
    swapped = pairs[True][..., [0, 2, 1, 3, 5, 4], :] * torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(swapped, pairs[False][..., :6, :], atol=5e-3, rtol=0)  # Anny is not quite symmetric


class _Fixed:
    """A generator that draws the same window, mirrored (the fourth draw of chances) or not, and no turn."""

    def __init__(self, mirrored: bool) -> None:
        self.chances = [0.9, 0.9, 0.9, 0.0 if mirrored else 0.9]

    def choice(self, values: np.ndarray, size: int, p: np.ndarray) -> np.ndarray:
        return np.repeat(values[:1], size)

    def random(self, size: int) -> np.ndarray:
        return np.full(size, self.chances.pop(0))

    def uniform(self, low: float, high: float, size: int) -> np.ndarray:
        return np.zeros(size)


def test_variation_keeps_hinges_and_marks_contacts_unknown() -> None:
    """Knees stay hinges (they bend forward, hardly sideways) and contacts that a change spoils are not known."""
    rng = np.random.default_rng(1)
    still = torch.eye(3).repeat(200, 5, 22, 1, 1)
    known = torch.ones(200, 5, 8, dtype=torch.bool)
    R, left = variation.varied(rng, still, known)
    assert torch.equal(still, torch.eye(3).repeat(200, 5, 22, 1, 1)), "the input stays"
    angle = torch.arccos(((R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    assert float(angle[:, :, 4:6].max()) < 0.6
    assert float(angle[:, :, [1, 2, 16, 17]].max()) > 0.8
    moved = (R - still).abs().amax((1, 2, 3, 4)) > 1e-6
    assert not left[moved].all(2).all(1).any()
    assert 0.1 < float(left.all(2).all(1).float().mean()) < 0.6, "some windows stay as they are"


def test_cameras_see_the_person_from_where_they_stand() -> None:
    """Before the lens, at heights a hand can hold, mostly within the picture; the truth's up goes with the pitch."""
    rng = np.random.default_rng(0)
    joints_m = torch.from_numpy(rng.normal([0.0, 0.9, 0.0], [0.3, 0.4, 0.3], (400, 3, 22, 3))).float()
    views = draw_views(rng, joints_m)
    seen_m = joints_m @ views.R_camera_world[:, None].transpose(-1, -2) + views.t_camera_m[:, None, None]
    assert float(seen_m[..., 2].min()) > 0.55
    height_m = -(views.R_camera_world.transpose(-1, -2) @ views.t_camera_m[..., None])[:, 1, 0]
    assert -0.6 < float(height_m.quantile(0.02)) < float(height_m.quantile(0.98)) < 4.5
    inside = ((seen_m[..., :2] / seen_m[..., 2:]).abs() < views.half[:, None, None]).all(-1).float().mean((1, 2))
    assert 0.5 < float((inside > 0.95).float().mean()) < 0.95, "some are cut by the border"
    aspect = views.half[:, 0] / views.half[:, 1]
    assert float((aspect < 0.99).float().mean()) == pytest.approx(0.42, abs=0.1), "portraits"


def test_performers_vary_in_limb_lengths() -> None:
    """Thigh over shank varies more than in Anny's adults, both sides alike; keypoints stay at their joints."""
    plain, varied = (draw_bodies(np.random.default_rng(0), 40, performers=p) for p in (False, True))
    sizes = [[torch.linalg.norm(b.rest_joints_m[:, child] - b.rest_joints_m[:, parent], dim=-1) for parent, child in
              ((1, 4), (2, 5), (4, 7))] for b in (plain, varied)]  # fmt: skip
    torch.testing.assert_close(sizes[1][0], sizes[1][1], rtol=0.02, atol=0)
    stretch = (sizes[1][0] / sizes[0][0]).log()
    assert float(stretch.std()) == pytest.approx(0.05, abs=0.02)
    assert float(((sizes[1][2] / sizes[0][2]).log() - stretch).std()) > 0.05, "independent of the shank"
    for bodies in (plain, varied):
        joints, R = posed(planes(torch.eye(3).expand(40, 1, 22, 3, 3)), bodies.rest_joints_m)
        points = bodies.keypoints_m(torch.arange(40), joints, R)
        for name, joint, near_m in (("left_shoulder", 16, 1e-5), ("left_knee", 4, 0.12), ("right_wrist", 21, 0.12)):
            off_m = torch.linalg.norm(points[:, 0, KEYPOINT_NAMES.index(name)] - joints[:, joint, :, 0].T, dim=-1)
            assert float(off_m.max()) < near_m, name


def test_errors_outside_the_picture_are_large_and_lower_visibility(residuals: ResidualLibrary) -> None:
    rng = np.random.default_rng(0)
    true_m = torch.from_numpy(rng.normal(0, 0.4, (40, 30, 25, 3))).float()
    inside = torch.ones(40, 30, 25, dtype=torch.bool)
    inside[..., 15:17] = False
    found = LandmarkErrors(residuals)(rng, true_m[..., :2] / 4, true_m, inside)
    off = (found.directions - true_m[..., :2] / 4).norm(dim=-1)
    assert float(off[..., 15:17].mean()) > 2 * float(off[..., :15].mean())
    assert float(found.visibility[..., 15:17].max()) < 0.3
    assert 0.8 < float(found.valid.float().mean()) < 1.0
    nearly_all = torch.zeros_like(inside)
    assert not LandmarkErrors(residuals)(rng, true_m[..., :2] / 4, true_m, nearly_all).valid.any()


def test_hidden_limbs_are_guessed_from_what_is_seen(residuals: ResidualLibrary) -> None:
    """Where a run's clip hides a limb, landmarks do not follow the true limb; those that are seen do."""
    unseen = [number for number, name in enumerate(KEYPOINT_NAMES) if name.split("_")[-1] in ("knee", "ankle", "heel")]
    seen = np.setdiff1d(np.arange(len(KEYPOINT_NAMES)), unseen)
    visibility = np.ones_like(residuals.visibility)
    visibility[:, unseen] = 0
    hidden = replace(residuals, visibility=visibility, hidden=np.ones(2, bool))
    rng = np.random.default_rng(0)
    true_m = torch.from_numpy(rng.normal(0, 0.4, (6, 30, 25, 3))).float()
    other_m, size = true_m.clone(), true_m[..., :2].square().sum(-1).mean(-1).sqrt()
    # The same size in the picture, which unseen landmarks are guessed at.
    other_m[:, :, unseen] *= -1
    inside = torch.ones(6, 30, 25, dtype=torch.bool)
    first, second = (
        LandmarkErrors(hidden)(np.random.default_rng(1), part[..., :2] / 4, part, inside) for part in (true_m, other_m)
    )
    torch.testing.assert_close(first.points_m[:, :, unseen], second.points_m[:, :, unseen])
    torch.testing.assert_close(first.directions[:, :, unseen], second.directions[:, :, unseen])
    off = (first.directions - true_m[..., :2] / 4).norm(dim=-1) / (size / 4)[..., None]
    assert float(off[:, :, unseen].median()) > 4 * float(off[:, :, seen].median())
    shown = replace(hidden, hidden=np.zeros(2, bool))
    found = LandmarkErrors(shown)(np.random.default_rng(1), true_m[..., :2] / 4, true_m, inside)
    off = (found.directions - true_m[..., :2] / 4).norm(dim=-1) / (size / 4)[..., None]
    assert float(off[:, :, unseen].median()) < 1.5 * float(off[:, :, seen].median())


@pytest.mark.parametrize("kind", KINDS)
def test_a_part_of_the_person_is_hidden(kind: str, tmp_path: Path) -> None:
    with FrameWriter(tmp_path / "clip.mp4", width_px=64, height_px=96) as writer:
        for _ in range(3):
            writer.write(np.full((96, 64, 3), (10, 120, 240), np.uint8))
    box_px = np.tile([20.0, 10.0, 40.0, 90.0], (3, 1))
    box_px[1] = np.nan
    hide(tmp_path / "clip.mp4", tmp_path / "out.mp4", box_px, kind, np.random.default_rng(3))
    with open_video(tmp_path / "out.mp4") as container:
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    assert len(frames) == 3
    same = np.abs(frames[0] - (10, 120, 240)).max(-1) < 12
    if kind == CUT:
        assert 10 + 0.35 * 80 - 2 <= len(same) <= 10 + 0.85 * 80
        assert same.all()
    elif kind == BELOW:
        assert not same[-1, 18:42].any()
        assert same[:36].all()
        assert same[:, :8].all()
    else:
        hidden = ~same.any(0)
        assert 4 <= hidden.sum() <= 13
        assert same[:, ~hidden].mean() > 0.9


FAULTS = ("_FROZEN", "_SWAPPED", "_REVERSED", "_MISSING", "_LONG_MISSING")


@pytest.fixture
def only(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Sets the share of one kind of fault to 1, of the others to 0."""

    def chosen(fault: str) -> None:
        for name in FAULTS:
            monkeypatch.setattr(landmark_errors, name, float(name == fault))

    return chosen


def test_frozen_and_swapped_limbs(only: Callable[[str], None]) -> None:
    """A frozen limb is where it was; a swapped pair of limbs has left where right is."""
    only("_FROZEN")
    frame, keypoint, sign = landmark_errors._faults(np.random.default_rng(0), 50, 40)
    assert torch.equal(keypoint, torch.arange(25).expand(50, 40, 25))
    assert (sign == 1).all()
    stuck = frame != torch.arange(40)[None, :, None]
    assert stuck.any(1).sum(1).le(5).all(), "one limb of a window"
    assert stuck.any((1, 2)).float().mean() > 0.7
    only("_SWAPPED")
    frame, keypoint, _ = landmark_errors._faults(np.random.default_rng(0), 50, 40)
    changed = keypoint != torch.arange(25)
    for number in keypoint[changed].unique():
        assert KEYPOINT_NAMES[int(number)].split("_")[0] in ("left", "right")
    assert changed.any((1, 2)).all()


def test_front_taken_for_back(residuals: ResidualLibrary, only: Callable[[str], None]) -> None:
    """Left is where right is, and what is near is far, at the same place in the image, for less than a second."""
    only("")
    rng = np.random.default_rng(1)
    points = torch.from_numpy(rng.normal(0, 0.4, (20, 40, 25, 3))).float()
    errors, inside = landmark_errors.LandmarkErrors(residuals), torch.ones(20, 40, 25, dtype=torch.bool)
    right = errors(np.random.default_rng(2), points[..., :2] / 4, points, inside)
    only("_REVERSED")
    wrong = errors(np.random.default_rng(2), points[..., :2] / 4, points, inside)
    mirror = torch.from_numpy(MIRROR_KEYPOINT)
    reversed_m = right.points_m[:, :, mirror] * torch.tensor([1.0, 1.0, -1.0])
    turned = (wrong.points_m - right.points_m).abs().amax((2, 3)) > 1e-6
    torch.testing.assert_close(wrong.points_m[turned], reversed_m[turned])
    torch.testing.assert_close(wrong.directions[turned], right.directions[:, :, mirror][turned])
    torch.testing.assert_close(wrong.directions[~turned], right.directions[~turned])
    assert turned.any(1).all()
    assert (turned.sum(1) < 20).all()


LEARNT = 60
"""Steps of four windows after which losses have fallen by a tenth."""


def test_training_learns_and_goes_on(motions: LiftingMotions, residuals: ResidualLibrary, tmp_path: Path) -> None:
    sampler = LiftingSampler(motions, residuals, seed=0, frames=24, varied=False)
    config = LiftingConfig(batch=4, warmup=2, save_minutes=0.0)
    lines: list[str] = []
    train(sampler, sampler, config, tmp_path, stop_at=2, on_line=lines.append)
    assert len(lines) >= 2
    first = read_progress(tmp_path)
    assert first.steps == 2
    assert first.windows == 4 * first.steps
    assert first.hours > 0
    assert f"{first.steps} steps" in lines[-1]
    whole = train(sampler, sampler, replace(config, save_minutes=1.0), tmp_path, stop_at=LEARNT)
    second = read_progress(tmp_path)
    assert second.steps == LEARNT
    assert second.hours > first.hours
    for name, value in read_average(tmp_path).state_dict().items():
        torch.testing.assert_close(whole.state_dict()[name], value, msg=name)
    batch = sampler.batch(500, 8)
    with torch.no_grad():
        trained = torch.stack(list(losses(whole(batch.features), batch).values())).sum()
        fresh = torch.stack(list(losses(LifterNetwork()(batch.features), batch).values())).sum()
    assert trained < 0.9 * fresh
    before = (tmp_path / CHECKPOINT).read_bytes(), (tmp_path / PROGRESS).read_bytes()
    calm = annealed(sampler, config, tmp_path, steps=3)
    assert not torch.equal(calm.enter.weight, whole.enter.weight)
    assert before == ((tmp_path / CHECKPOINT).read_bytes(), (tmp_path / PROGRESS).read_bytes()), "the run stays"


def test_a_lost_checkpoint_starts_from_given_weights(
    motions: LiftingMotions, residuals: ResidualLibrary, tmp_path: Path
) -> None:
    sampler = LiftingSampler(motions, residuals, seed=0, frames=24, varied=False)
    start = LifterNetwork()
    export_onnx(start, tmp_path / "lifter.onnx")
    again = read_onnx(tmp_path / "lifter.onnx")
    assert again is not None
    config = LiftingConfig()
    begun = train(sampler, sampler, config, tmp_path / "run", minutes=-1.0, start=again)
    for name, value in start.state_dict().items():
        torch.testing.assert_close(begun.state_dict()[name], value, msg=name)
    export_onnx(LifterNetwork(width=32), tmp_path / "other.onnx")
    assert read_onnx(tmp_path / "other.onnx") is None


def test_the_training_program_goes_on_and_exports(
    motions: LiftingMotions, residuals: ResidualLibrary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a cache that holds the stores already, as after a first run."""
    source = Path(__file__).parents[3] / "training" / "lifter.py"
    program = runpy.run_path(str(source))
    monkeypatch.setitem(
        program["main"].__globals__,
        "samplers",
        lambda options: (LiftingSampler(motions, residuals, seed=0, frames=24),) * 2,
    )
    cache, out = tmp_path / "cache", tmp_path / "lifter.onnx"
    for words in (
        ["run", "--minutes=0"],
        ["run", "--minutes=0"],
        ["progress"],
        ["export", "--cooldown=1", f"--out={out}"],
    ):
        monkeypatch.setattr(sys, "argv", ["lifter.py", *words, f"--cache={cache}"])
        program["main"]()
    assert json.loads((cache / PROGRESS).read_text())["steps"] == 0
    assert Lifter(out)(np.zeros((5, FEATURES), np.float32)).shape == (5, OUTPUTS)
    helped = subprocess.run([sys.executable, str(source), "run", "--help"], capture_output=True, check=False)
    assert helped.returncode == 0
    assert len(hashlib.sha256(out.read_bytes()).hexdigest()) == 64


def test_stored_arrays_are_complete_and_memory_mapped(motions: LiftingMotions, tmp_path: Path) -> None:
    folder = tmp_path / "motions"
    assert not has_arrays(folder, {"seed": 1})
    write_arrays(motions, folder, {"seed": 1})
    assert has_arrays(folder, {"seed": 1})
    assert not has_arrays(folder, {"seed": 2})
    again = read_arrays(LiftingMotions, folder)
    assert isinstance(again.rot6d, np.memmap)
    np.testing.assert_array_equal(again.rot6d, motions.rot6d)
    assert [path.name for path in tmp_path.iterdir()] == ["motions"]


def test_motions_are_gathered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    split = tmp_path / "split.json"
    split.write_text('{"train": []}')
    made: list[int] = []
    monkeypatch.setattr(
        "video2anim.lab.lifter.motions.gather",
        lambda *given, **named: (made.append(1), gather([], None, procedural=1, seed=0))[1],
    )
    for _ in range(2):
        cached_motions(tmp_path / "store", [], split, "train", procedural=1, seed=0)
    assert len(made) == 1
    cached_motions(tmp_path / "store", [], split, "train", procedural=2, seed=0)
    assert len(made) == 2


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
    monkeypatch.setattr("video2anim.lab.lifter.network.OUTPUTS", OUTPUTS - 22)
    export_onnx(LifterNetwork(width=32), tmp_path / "old.onnx")
    with pytest.raises(
        ModelMissingError, match=r"old.onnx: want 154 features and 168 outputs a frame, got \(154, 146\)"
    ):
        Lifter(tmp_path / "old.onnx")


def test_all_contacts_of_procedural_motion_are_known() -> None:
    found = gather([], None, procedural=2, seed=5)
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
    center = points[:, [KEYPOINT_INDEX["left_hip"], KEYPOINT_INDEX["right_hip"]]].mean(1)
    assert np.linalg.norm(center - walk.joints_camera_m[:, 0], axis=-1).max() < 0.12
