"""The paper's denoiser: a U-Net that looks at everything it is given, and at nothing it is not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scenemi.model.build import build_denoiser
from scenemi.model.conditions import Conditions, Descriptors
from scenemi.model.config import SIZES, PaperConfig
from scenemi.model.denoiser import Denoiser
from scenemi.model.paper import PaperDenoiser

NARROW = SIZES["paper-narrow"]
assert isinstance(NARROW, PaperConfig)
T = torch.tensor([100, 600])


def conditions(batch: int = 2, seed: int = 0, config: PaperConfig = NARROW) -> Conditions:
    g = torch.Generator().manual_seed(seed)
    frames = config.window_frames
    mask = torch.zeros(batch, frames)
    mask[:, ::15] = mask[:, -1] = 1
    scene = Descriptors(
        occupancy=(torch.rand(batch, *config.grid, generator=g) < 0.2).float(),
        local_m=torch.randn(batch, frames, config.bps_anchors, 3, generator=g),
        global_known=torch.ones(batch),
        local_known=torch.ones(batch),
    )
    return Conditions(
        mask=mask, imputed=mask, base=torch.randn(batch, frames, 201, generator=g), noise=torch.zeros(batch, frames, 2),
        body=torch.randn(batch, 7, generator=g), descriptors=scene,
    )  # fmt: skip


def window(batch: int = 2, frames: int = 121) -> torch.Tensor:
    return torch.randn(batch, frames, 201, generator=torch.Generator().manual_seed(100))


def awake(config: PaperConfig = NARROW) -> PaperDenoiser:
    """Without layers of zeros."""
    torch.manual_seed(0)
    denoiser = PaperDenoiser(config)
    with torch.no_grad():
        for parameter in denoiser.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return denoiser.eval()


def told(given: Conditions, **changes: torch.Tensor) -> Conditions:
    """With other descriptors."""
    assert given.descriptors is not None
    return replace(given, descriptors=replace(given.descriptors, **changes))


@torch.no_grad()
def test_every_condition_counts() -> None:
    denoiser, given, x = awake(), conditions(), window()
    before, other = denoiser(x, T, given), conditions(seed=1)
    assert other.descriptors is not None
    assert not torch.allclose(denoiser(x, T, replace(given, body=other.body)), before)
    for name in ("occupancy", "local_m"):
        changed = told(given, **{name: getattr(other.descriptors, name)})
        assert not torch.allclose(denoiser(x, T, changed), before), name
    fewer = given.mask.clone()
    fewer[:, 30] = 0
    assert not torch.allclose(denoiser(x, T, replace(given, mask=fewer)), before)
    assert not torch.allclose(denoiser(x, T - 50, given), before)
    assert not torch.allclose(denoiser(x + 0.1, T, given), before)


@torch.no_grad()
def test_the_local_scene_is_read_at_keyframes_only() -> None:
    denoiser, given, x = awake(), conditions(), window()
    assert given.descriptors is not None
    between = given.descriptors.local_m.clone()
    between[:, 1:14] += 1.0
    assert torch.equal(denoiser(x, T, told(given, local_m=between)), denoiser(x, T, given))


@torch.no_grad()
def test_a_hidden_part_does_not_show() -> None:
    denoiser, given, x = awake(), conditions(), window()
    other = conditions(seed=1).descriptors
    assert other is not None
    none = torch.zeros(2)
    for known, part in (("global_known", "occupancy"), ("local_known", "local_m")):
        hidden = told(given, **{known: none})
        assert torch.equal(denoiser(x, T, told(hidden, **{part: getattr(other, part)})), denoiser(x, T, hidden)), part
        assert not torch.allclose(denoiser(x, T, hidden), denoiser(x, T, given)), part
    hidden = told(given, global_known=none, local_known=none)
    torch.testing.assert_close(denoiser(x, T, hidden), denoiser(x, T, replace(given, descriptors=None)))


@torch.no_grad()
def test_guidance_leaves_out_the_global_part_alone() -> None:
    denoiser, given, x = awake(), conditions(), window()
    assert given.has_scene
    blind = given.without_scene()
    assert not blind.has_scene
    torch.testing.assert_close(denoiser(x, T, blind), denoiser(x, T, told(given, global_known=torch.zeros(2))))


@torch.no_grad()
def test_each_window_has_its_own_scene_or_none() -> None:
    denoiser, given, x = awake(), conditions(3), window(3)
    t = torch.tensor([10, 500, 990])
    given = told(given, global_known=torch.tensor([1.0, 0.0, 1.0]), local_known=torch.tensor([1.0, 1.0, 0.0]))
    together = denoiser(x, t, given)
    assert given.descriptors is not None
    for i in range(3):
        one = slice(i, i + 1)
        parts = {name: getattr(given, name)[one] for name in ("mask", "imputed", "base", "noise", "body")}
        scene = Descriptors(*(getattr(given.descriptors, name)[one] for name in Descriptors.__slots__))
        alone = denoiser(x[one], t[one], Conditions(**parts, descriptors=scene))
        torch.testing.assert_close(together[one], alone, atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_ablated_models_do_not_look() -> None:
    denoiser = awake(replace(NARROW, use_body=False, use_global=False, use_local=False))
    a, b, x = conditions(), conditions(seed=1), window()
    assert torch.equal(denoiser(x, T, replace(a, body=b.body, descriptors=b.descriptors)), denoiser(x, T, a))
    assert torch.equal(denoiser(x, T, replace(a, descriptors=None)), denoiser(x, T, a))


@torch.no_grad()
def test_the_scene_is_encoded_once_for_all_steps_and_tells_rooms_apart() -> None:
    denoiser, given, x = awake(), conditions(3), window(3)
    empty, floor, wall = torch.zeros(3, *NARROW.grid).unbind()
    floor[:, 0], wall[40] = 1, 1
    given = told(given, occupancy=torch.stack([empty, floor, wall]))
    codes = denoiser.prepare(given)
    assert torch.cdist(codes, codes)[~torch.eye(3, dtype=torch.bool)].min() > 1e-3
    t = torch.tensor([10, 500, 990])
    assert torch.equal(denoiser(x, t, given, None, codes), denoiser(x, t, given))


@torch.no_grad()
@pytest.mark.parametrize("frames", [121, 122, 40])
def test_any_length_keeps_its_shape(frames: int) -> None:
    config = replace(NARROW, window_frames=frames)
    assert awake(config)(window(frames=frames), T, conditions(config=config)).shape == (2, frames, 201)


def test_the_papers_size() -> None:
    with torch.device("meta"):
        count = sum(p.numel() for p in PaperDenoiser(PaperConfig()).parameters())
    assert 100e6 < count < 125e6


def test_a_configuration_makes_its_own_denoiser() -> None:
    assert isinstance(build_denoiser(NARROW), PaperDenoiser)
    assert isinstance(build_denoiser(SIZES["tiny"]), Denoiser)
