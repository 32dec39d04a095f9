"""The objective: zero for a perfect answer, in meters and centimeters where it says so, blind to held frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_run import CONFIG, consistent, exact, loss_of

from scenemi.data.windows import MotionSet
from scenemi.features import JOINTS, Statistics
from scenemi.model.denoiser import body_points
from scenemi.scene.boxes import Boxes
from scenemi.scene.field import BoxField
from scenemi.training.batches import LOOKED_AT, Batch, PoolBatches
from scenemi.training.losses import Losses, TrainingLoss, per_window, robust
from scenemi.training.pool import Shard

WALL = torch.tensor([[[6.0, 5.0, 0.0, 5.0, 5.0, 50.0, 0.0]]])
"""A solid that fills x > 1."""


@pytest.fixture(scope="module")
def loss(motions: MotionSet, statistics: Statistics) -> TrainingLoss:
    return loss_of(motions, statistics)


@pytest.fixture(scope="module")
def batch(motions: MotionSet, data: PoolBatches) -> Batch:
    """Four windows with every frame valid and no noise."""
    return consistent(exact(data[1]), motions)


def clean(loss: TrainingLoss, batch: Batch) -> torch.Tensor:
    return (batch.features - loss.mean) / loss.std


def shifted(loss: TrainingLoss, batch: Batch, by_m: float, axis: int = 0) -> torch.Tensor:
    """The truth, moved as a whole."""
    x0 = clean(loss, batch)
    columns = [axis, *range(JOINTS.start + axis, JOINTS.stop, 3)]
    x0[..., columns] += by_m / loss.std[columns]
    return x0


def values(losses: Losses) -> dict[str, float]:
    return {name: float(getattr(losses, name)) for name in Losses.__slots__}


def test_a_perfect_answer_costs_nothing(loss: TrainingLoss, batch: Batch) -> None:
    x0, field = clean(loss, batch), BoxField.of(batch.boxes, torch.ones(4))
    for prepared in (None, prepared_of(loss, batch)):
        found = values(loss.compared(x0, x0, batch, field, prepared))
        assert max(found.values()) < 1e-5, found


def prepared_of(loss: TrainingLoss, batch: Batch):
    return loss.denoiser.prepare(loss._conditions(batch, clean(loss, batch)))


@torch.no_grad()
def test_an_untrained_model_that_is_given_every_frame_is_perfect(loss: TrainingLoss, batch: Batch) -> None:
    found = values(loss(replace(batch, mask=torch.ones_like(batch.mask))))
    assert max(found.values()) < 1e-5, found


@torch.no_grad()
def test_half_precision_of_the_network_does_not_blur_keyframes_and_joints(
    motions: MotionSet, statistics: Statistics, batch: Batch
) -> None:
    loss = loss_of(motions, statistics)
    loss.denoiser.half_precision = True
    found = values(loss(replace(batch, mask=torch.ones_like(batch.mask))))
    assert max(found.values()) < 1e-5, found


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_shifted_joints_count_in_meters(loss: TrainingLoss, batch: Batch, axis: int) -> None:
    found = loss.compared(shifted(loss, batch, 0.1, axis), clean(loss, batch), batch)
    assert float(found.joints) == pytest.approx(22 * 0.1**2, rel=1e-3)
    assert float(found.velocity) == pytest.approx(0.0, abs=1e-6)
    assert float(found.simple) > 0
    total = found.simple + CONFIG.joints_weight * found.joints + CONFIG.velocity_weight * found.velocity
    torch.testing.assert_close(found.total, total)


def test_velocity_counts_steps_from_frame_to_frame(loss: TrainingLoss, batch: Batch) -> None:
    """Joints that jump by a centimeter every other frame move by a centimeter a frame."""
    made = clean(loss, batch)
    made[:, ::2, 0] += 0.01 / loss.std[0]
    found = loss.compared(made, clean(loss, batch), batch)
    assert float(found.velocity) == pytest.approx(22 * 0.01**2, rel=0.01)


def test_joints_are_compared_in_the_piece_that_is_looked_at(loss: TrainingLoss, batch: Batch) -> None:
    here = replace(batch, looked_at=torch.full_like(batch.looked_at, 40))
    made, x0 = clean(loss, batch), clean(loss, batch)
    made[:, :40, 0] += 1.0
    made[:, 40 + LOOKED_AT :, 0] += 1.0
    assert float(loss.compared(made, x0, here).joints) < 1e-6
    made[:, 40, 0] += 1.0
    assert float(loss.compared(made, x0, here).joints) > 1e-3


def test_held_frames_do_not_count(loss: TrainingLoss, batch: Batch) -> None:
    valid = batch.valid.clone()
    valid[:, 80:] = 0
    late = replace(batch, valid=valid, looked_at=torch.full_like(batch.looked_at, 70))
    for prepared in (None, prepared_of(loss, batch)):
        wrong, x0 = clean(loss, batch), clean(loss, batch)
        wrong[:, 80:] += 1.0
        assert float(loss.compared(wrong, x0, late, None, prepared).total) < 1e-6
        wrong[:, 75:80] += 1.0
        assert float(loss.compared(wrong, x0, late, None, prepared).total) > 0.01


def test_a_body_pushed_into_a_solid_costs_and_one_that_keeps_off_does_not(loss: TrainingLoss, batch: Batch) -> None:
    field = BoxField.of(WALL.expand(4, -1, -1), torch.ones(4))
    x0 = clean(loss, batch)
    reach_m = float(body_points(batch.features[..., JOINTS].unflatten(-1, (22, 3)))[..., 0].amax())
    assert float(loss.compared(x0, x0, batch, field).inside) < 1e-5
    away = shifted(loss, batch, -(reach_m + 1.0))
    assert float(loss.compared(away, x0, batch, field).inside) < 1e-5, (
        "farther from solids than the truth costs nothing"
    )
    into = shifted(loss, batch, 3.0)
    assert float(loss.compared(into, x0, batch, field).inside) > 0.1
    assert float(loss.compared(into, x0, batch, None).inside) == 0, "no scene, no solid"


def test_nearer_than_the_truth_counts_in_centimeters_up_to_the_skin(loss: TrainingLoss, batch: Batch) -> None:
    """By numpy, in windows with a scene only."""
    known = torch.tensor([1.0, 0.0, 1.0, 1.0])
    field = BoxField.of(WALL.expand(4, -1, -1), known)
    made = shifted(loss, batch, 0.6)
    found = float(loss.compared(made, clean(loss, batch), batch, field).inside)
    wall = Boxes(np.array([[6.0, 0.0, 0.0]]), np.array([[5.0, 50.0, 50.0]]), np.zeros(1))
    expected = []
    for i in (0, 2, 3):
        piece = slice(int(batch.looked_at[i]), int(batch.looked_at[i]) + LOOKED_AT)
        true_m = body_points(batch.features[i, piece, JOINTS].unflatten(-1, (22, 3))).numpy().astype(float)
        gaps = [np.minimum(wall.signed_distance(at), at[..., 1]) for at in (true_m, true_m + np.array([0.6, 0, 0]))]
        expected.append(100 * np.maximum(np.minimum(gaps[0], 0.12) - gaps[1], 0).mean())
    assert found == pytest.approx(np.mean(expected), rel=1e-3)
    assert found > 0.1


def test_noise_moves_the_keyframes_and_only_those_of_noisy_windows(
    motions: MotionSet, statistics: Statistics, shards: list[Shard]
) -> None:
    config = replace(CONFIG, noisy_share=0.5, batch=8)
    loss, batch = loss_of(motions, statistics, config), consistent(PoolBatches(shards, config)[0], motions)
    assert 0 < len(batch.noisy) < 8
    x0 = clean(loss, batch)
    keys = loss._keyframes(batch, x0)
    moved = (keys - x0).abs().amax((1, 2)) > 1e-4
    assert moved.nonzero()[:, 0].tolist() == batch.noisy.tolist()
    shift_m = ((keys - x0) * loss.std)[batch.noisy][..., :3]
    torch.testing.assert_close(shift_m, batch.shift_m, atol=1e-5, rtol=0)


def test_noisy_keyframes_are_imputed_above_the_stop_step_only(loss: TrainingLoss, batch: Batch) -> None:
    noisy = replace(
        batch, noisy=torch.tensor([0, 1]), step=torch.tensor([20, 21, 5, 900]),
        turn_rad=torch.zeros(2, 121, 22, 3), shift_m=torch.zeros(2, 121, 3),
    )  # fmt: skip
    given = loss._conditions(noisy, clean(loss, batch))
    assert not given.imputed[0].any(), "the step itself is below"
    for i in (1, 2, 3):
        assert torch.equal(given.imputed[i], batch.mask[i])


def test_robust_errors_are_squares_when_small_and_straight_when_large() -> None:
    small, large = torch.tensor(1e-4), torch.tensor(1e6)
    assert float(robust(small)) == pytest.approx(1e-4, rel=1e-2)
    assert float(robust(large)) == pytest.approx(2 * 1e3, rel=1e-2)
    assert float(robust(torch.tensor(0.0))) == 0


def test_every_window_counts_alike_however_many_frames_are_valid() -> None:
    error, valid = torch.tensor([[1.0, 1.0, 1.0], [4.0, 9.0, 9.0]]), torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
    assert float(per_window(error, valid)) == pytest.approx(2.5)
    assert float(per_window(error, torch.zeros_like(valid))) == 0, "and none with no valid frame"


def test_relative_errors_weigh_what_keyframes_tell_most(loss: TrainingLoss, batch: Batch) -> None:
    """The same error costs more next to a keyframe than far from any."""
    mask = torch.zeros_like(batch.mask)
    mask[:, [0, 60, 120]] = 1
    sparse = replace(batch, mask=mask, looked_at=torch.full_like(batch.looked_at, 45))
    size = torch.linspace(0, 1, 61)[:, None].expand(-1, 201)
    loss.denoiser.get_buffer("residual_std").copy_(size)
    prepared, x0 = prepared_of(loss, sparse), clean(loss, sparse)

    def cost(frame: int) -> float:
        made = x0.clone()
        made[:, frame] += 0.2
        return float(loss.compared(made, x0, sparse, None, prepared).total)

    assert cost(61) > 3 * cost(90)
