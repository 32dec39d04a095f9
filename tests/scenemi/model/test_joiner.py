from __future__ import annotations

import pytest
import torch

from scenemi.features import FEATURE_COUNT, JOINTS, LEVEL_X, LEVEL_Z
from scenemi.model.base import join_keyframes
from scenemi.model.config import SIZES
from scenemi.model.denoiser import Denoiser
from scenemi.model.heading import from_heading
from scenemi.model.joiner import LEAST_SPAN, KeyframeJoiner, find_segments


def awake(seed: int = 0) -> KeyframeJoiner:
    """A joiner whose zero-initialized answer is not zero."""
    torch.manual_seed(seed)
    joiner = KeyframeJoiner(16).eval()
    torch.nn.init.normal_(joiner.last.weight, std=0.1)
    return joiner


def mask_of(*frames: int, count: int = 121) -> torch.Tensor:
    mask = torch.zeros(count)
    mask[list(frames)] = 1
    return mask


def windows(count: int, seed: int = 0) -> torch.Tensor:
    """Upright poses somewhere, facing somewhere."""
    g = torch.Generator().manual_seed(seed)
    values = 0.3 * torch.randn(count, 121, FEATURE_COUNT, generator=g)
    values[..., 3:9] = torch.tensor([1.0, 0, 0, 0, 1, 0])
    return values


def test_segments_lie_between_neighbors_and_know_what_is_around() -> None:
    found = find_segments(torch.stack([mask_of(0, 10, 12, 30, 120), mask_of(0, 120)]))
    assert found.window.tolist() == [0, 0, 0, 1]
    assert found.keyframes.tolist() == [[0, 0, 10, 12], [10, 12, 30, 120], [12, 30, 120, 120], [0, 0, 120, 120]]
    assert found.known.tolist() == [
        [False, True, True, True], [True, True, True, True], [True, True, True, False], [False, True, True, False],
    ]  # fmt: skip
    assert found.span.tolist() == [10, 18, 90, 120]


def test_near_keyframes_are_left_to_interpolation() -> None:
    assert not len(find_segments(mask_of(*range(0, 121, LEAST_SPAN - 1))[None]).window)
    assert not len(find_segments(torch.zeros(2, 121)).window)
    zero = awake()(windows(1), torch.ones(1, 121), torch.zeros(1, 7), torch.zeros(1))
    assert torch.equal(zero, torch.zeros(1, 121, FEATURE_COUNT))


@torch.no_grad()
def test_corrections_keep_the_keyframes_and_read_nothing_else() -> None:
    keys, mask = windows(2), torch.stack([mask_of(0, 15, 40, 120), mask_of(0, 60, 61, 120)])
    joiner = awake()
    made = joiner(keys, mask, torch.zeros(2, 7), torch.zeros(2))
    assert float(made[mask > 0].abs().max()) == 0
    assert float(made[0, 1:15].abs().amin(1).min()) > 0
    other = torch.where(mask[..., None] > 0, keys, torch.nan)
    torch.testing.assert_close(joiner(other, mask, torch.zeros(2, 7), torch.zeros(2)), made)


@torch.no_grad()
def test_corrections_meet_at_keyframes_without_a_kink() -> None:
    """Slopes of sampled corrections, from one-sided differences: exact for the cubic part, to O(1 / span) for sines."""
    keys, mask = windows(1), mask_of(0, 40, 80, 82, 120)[None]
    (made,) = awake()(keys, mask, torch.zeros(1, 7), torch.zeros(1))
    before, after = made[40] - made[39], made[41] - made[40]
    bend = (made[38] - 2 * made[39] + made[40]).abs().amax() + (made[40] - 2 * made[41] + made[42]).abs().amax()
    assert float((after - before).abs().amax()) <= float(bend)
    assert float(before.abs().amax()) > 4 * float((after - before).abs().amax())
    for still in (made[80] - made[79], made[83] - made[82]):  # beside a pair without correction
        assert float(still.abs().amax()) <= float(bend)


@torch.no_grad()
def test_an_untrained_joiner_adds_nothing() -> None:
    made = KeyframeJoiner(16)(windows(1), mask_of(0, 60, 120)[None], torch.zeros(1, 7), torch.zeros(1))
    assert float(made.abs().max()) == 0


@torch.no_grad()
def test_corrections_turn_and_move_with_the_person() -> None:
    keys, mask = windows(2), torch.stack([mask_of(0, 15, 40, 120)] * 2)
    angle = torch.tensor([0.7, -2.0])
    turn = torch.stack([angle.sin(), angle.cos()], -1)[:, None].expand(-1, 121, -1)
    moved = from_heading(keys, turn)
    for columns in (LEVEL_X, LEVEL_Z):
        places = [c for c in columns if c < 3 or c >= JOINTS.start]
        moved[..., places] += 1.5
    joiner, none = awake(), (torch.zeros(2, 7), torch.zeros(2))
    torch.testing.assert_close(
        joiner(moved, mask, *none), from_heading(joiner(keys, mask, *none), turn), atol=2e-5, rtol=1e-4
    )


@torch.no_grad()
def test_windows_do_not_mix() -> None:
    keys, mask = windows(3), torch.stack([mask_of(0, 20, 120), mask_of(0, 7, 9, 120), mask_of(0, 120)])
    joiner, body, noise = awake(), torch.randn(3, 7), torch.rand(3)
    together = joiner(keys, mask, body, noise)
    for i in range(3):
        alone = joiner(keys[i : i + 1], mask[i : i + 1], body[i : i + 1], noise[i : i + 1])
        torch.testing.assert_close(alone[0], together[i])


@torch.no_grad()
def test_the_mean_of_members_is_used_unless_one_is_asked_for() -> None:
    from dataclasses import replace

    denoiser = Denoiser(replace(SIZES["tiny"], joiners=2)).eval()
    for joiner in denoiser.joiners:
        torch.nn.init.normal_(joiner.last.weight, std=0.1)  # type: ignore[union-attr, arg-type]
    keys, mask = windows(2), torch.stack([mask_of(0, 15, 40, 120)] * 2)
    given = keys, mask, torch.zeros(2, 7), torch.zeros(2)
    one, two = (denoiser.join(*given, part=torch.full((2,), k)) for k in (0, 1))
    torch.testing.assert_close(denoiser.join(*given), (one + two) / 2)
    torch.testing.assert_close(denoiser.join(*given, part=torch.tensor([1, 0]))[0], two[0])
    base = join_keyframes(keys, mask)
    assert torch.equal(one[mask > 0], base[mask > 0])
    assert float((one - two).abs().max()) > 0


def test_members_stay_as_they_were_trained() -> None:
    denoiser = Denoiser(SIZES["tiny"]).train()
    assert not denoiser.joiners.training
    assert not any(parameter.requires_grad for parameter in denoiser.joiners.parameters())
    assert denoiser.unet.training


@pytest.mark.parametrize("residual", [True, False])
def test_only_corrected_curves_are_learned(residual: bool) -> None:
    from dataclasses import replace

    assert hasattr(Denoiser(replace(SIZES["tiny"], residual=residual)), "joiners") == residual
