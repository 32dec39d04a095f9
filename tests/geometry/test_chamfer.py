"""Chamfer distance against brute force, its robustness, and that it can be minimized."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from video2anim.geometry.chamfer import ChamferConfig, ChamferLoss, chamfer_m
from video2anim.geometry.robust import huber_of_square


def clouds() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.normal(size=(40, 3)), rng.normal(size=(55, 3))


@pytest.mark.parametrize("sides", ["both", "source", "target"])
def test_squared_loss_and_report_agree_with_brute_force(sides: str) -> None:
    source_m, target_m = clouds()
    all_m = np.linalg.norm(source_m[:, None] - target_m[None], axis=-1)
    by_side = {"source": all_m.min(1), "target": all_m.min(0)}
    chosen = by_side if sides == "both" else {sides: by_side[sides]}
    config = ChamferConfig(sides=sides, huber_m=float("inf"))  # type: ignore[arg-type]
    loss = ChamferLoss(target_m, config)(torch.as_tensor(source_m))
    assert float(loss) == pytest.approx(np.mean([(d**2).mean() for d in chosen.values()]))
    report = chamfer_m(source_m, target_m, sides=sides)  # type: ignore[arg-type]
    assert report == pytest.approx(np.mean([d.mean() for d in chosen.values()]))


def test_huber_is_quadratic_then_linear_and_smooth() -> None:
    distance = torch.tensor([0.0, 0.05, 0.1, 0.2, 1.0], dtype=torch.float64, requires_grad=True)
    cost = huber_of_square(distance**2, 0.1)
    np.testing.assert_allclose(cost.detach(), [0, 0.0025, 0.01, 0.03, 0.19])
    cost.sum().backward()
    np.testing.assert_allclose(distance.grad, [0, 0.1, 0.2, 0.2, 0.2])


def test_trimming_leaves_the_farthest_out() -> None:
    target_m = np.stack([np.arange(10.0), np.zeros(10), np.zeros(10)], -1)
    source_m = target_m.copy()
    source_m[9] += [0, 50.0, 0]
    assert chamfer_m(source_m, target_m, sides="source", trim_ratio=0.1) == 0.0
    assert chamfer_m(source_m, target_m, sides="source") == pytest.approx(5.0)
    trimmed = ChamferLoss(target_m, ChamferConfig(0.05, sides="source", trim_ratio=0.1))(torch.as_tensor(source_m))
    assert float(trimmed) == 0.0


def test_minimizing_finds_a_translation_in_spite_of_outliers() -> None:
    rng = np.random.default_rng(1)
    target_m = rng.uniform(-1, 1, (300, 3)) * [1.0, 0.5, 0.2]
    shift_m = np.array([0.08, -0.05, 0.06])
    source = torch.as_tensor(np.concatenate([target_m - shift_m, rng.uniform(3, 4, (20, 3))]))
    found = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    loss = ChamferLoss(target_m, ChamferConfig(huber_m=0.05, trim_ratio=0.1))
    optimizer = torch.optim.Adam([found], lr=0.01)
    for _ in range(150):
        optimizer.zero_grad()
        loss(source + found).backward()
        optimizer.step()
    np.testing.assert_allclose(found.detach(), shift_m, atol=2e-3)


@pytest.mark.parametrize("bad", [np.zeros((0, 3)), np.full((4, 3), np.nan)])
def test_points_that_are_none_are_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="chamfer target_m"):
        ChamferLoss(bad, ChamferConfig(0.05))


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="trim_ratio"):
        ChamferConfig(0.05, trim_ratio=1.0)
