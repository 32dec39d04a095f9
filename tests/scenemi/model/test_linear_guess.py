from __future__ import annotations

import numpy as np
import pytest
import torch

from scenemi.model.linear_guess import GROUPS, correlation, fitted_length, linear_guess, matern

FRAMES = 40


def processes(count: int, channels: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Correlation (N, N) and samples (B, N, C) of unit size."""
    C = correlation(torch.full((1, FRAMES), 15), torch.full((121,), 5.0))[0]
    root = torch.linalg.cholesky(C + 1e-5 * torch.eye(FRAMES))
    noise = torch.randn(count, FRAMES, channels, generator=torch.Generator().manual_seed(seed))
    return C, root @ noise


def test_it_is_the_conditional_mean_of_the_gaussian() -> None:
    """Against the textbook formula with dense matrices in double precision."""
    C, r = processes(3, 16)
    size = torch.linspace(0.2, 2.0, FRAMES)[None, :, None].expand(3, -1, 16) * torch.linspace(0.5, 3.0, 16)
    a = torch.tensor([0.9, 0.3, 0.01])
    off = a.sqrt()[:, None, None] * size * r + (1 - a).sqrt()[:, None, None] * torch.randn(3, FRAMES, 16)
    # As many groups as pairs of equal channels, so that every channel is filtered with its own size.
    size = size[..., ::2].repeat_interleave(2, -1)
    made = linear_guess(off, size, a, C.expand(3, -1, -1), torch.arange(16))
    assert GROUPS == 8
    for window in range(3):
        for channel in range(16):
            s = size[window, :, channel].double().numpy()
            S = s[:, None] * C.double().numpy() * s
            share = float(a[window])
            seen = share * S + (1 - share) * np.eye(FRAMES)
            wanted = np.sqrt(share) * S @ np.linalg.solve(seen, off[window, :, channel].double().numpy())
            np.testing.assert_allclose(made[window, :, channel], wanted, atol=2e-3)


def test_it_is_nearer_than_a_guess_frame_by_frame() -> None:
    C, r = processes(50, 8)
    a, size = torch.full((50,), 0.5), torch.ones(50, FRAMES, 8)
    y = 0.5**0.5 * (r + torch.randn(50, FRAMES, 8, generator=torch.Generator().manual_seed(1)))
    over_time = linear_guess(y, size, a, C.expand(50, -1, -1), torch.arange(8))
    alone = 0.5**0.5 * y
    assert (over_time - r).square().mean() < 0.45 * (alone - r).square().mean()
    third = [torch.diff(v, n=3, dim=1).square().mean() for v in (over_time, r)]
    assert third[0] < third[1]


def test_nothing_is_guessed_where_nothing_is_missing() -> None:
    C, _ = processes(1, 8)
    size = torch.ones(1, FRAMES, 8)
    size[:, 10] = 0
    off = torch.randn(1, FRAMES, 8)
    off[:, 10] = 0
    made = linear_guess(off, size, torch.tensor([0.99]), C[None], torch.arange(8))
    assert float(made[:, 10].abs().max()) == 0
    assert float(made[:, 9].abs().min()) > 0
    none = linear_guess(off, size, torch.tensor([1e-9]), C[None], torch.arange(8))
    assert float(none.abs().max()) < 1e-3


@pytest.mark.parametrize("length", [1.0, 4.0, 12.0])
def test_lengths_are_found_again(length: float) -> None:
    assert fitted_length(matern(torch.arange(1, 9) / length)) == pytest.approx(length, rel=0.03)


def test_time_passes_faster_between_near_keyframes() -> None:
    """A valid correlation matrix whose lengths follow the spans."""
    span = torch.cat([torch.full((20,), 4), torch.full((20,), 60)])[None]
    lengths = torch.linspace(1.0, 12.0, 121)
    C = correlation(span, lengths)[0]
    assert torch.allclose(C.diagonal(), torch.ones(FRAMES))
    assert float(torch.linalg.eigvalsh(C.double()).min()) > -1e-6
    assert C[5, 8] < 0.5 * C[30, 33]
