from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from scenemi.features import LEVEL_X, LEVEL_Z, Statistics
from scenemi.model.base import join_keyframes
from scenemi.model.config import SIZES, ModelConfig
from scenemi.model.denoiser import SCALES, Conditions, Denoiser, distance_to_keyframes, gap, impute
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.heading import from_heading, headings, to_heading, view
from scenemi.model.kinematics import joints_of, matrices, posed_joints
from scenemi.model.weights import load_weights, save_weights
from video2anim.body.skeleton import forward_kinematics
from video2anim.errors import InputError, ModelMissingError


def conditions(config: ModelConfig, batch: int, seed: int = 0) -> Conditions:
    g = torch.Generator().manual_seed(seed)
    frames = config.window_frames
    mask = torch.zeros(batch, frames)
    mask[:, ::15] = 1
    return Conditions(
        mask=mask,
        imputed=mask,
        base=torch.randn(batch, frames, 201, generator=g),
        local=torch.randn(batch, frames, config.bps_anchors, 3, generator=g),
        body=torch.randn(batch, 7, generator=g),
        noise_level=torch.rand(batch, generator=g),
        scene=torch.randn(batch, config.embedding, generator=g),
        scene_known=torch.ones(batch),
        local_known=torch.ones(batch),
    )


def scales(denoiser: Denoiser, residual_std: torch.Tensor) -> dict[str, torch.Tensor]:
    """Measured scales with other sizes of the correction."""
    kept = {name: denoiser.get_buffer(name).clone() for name in SCALES}
    return kept | {"residual_std": residual_std, "keyframe_std": torch.full((201,), 0.3)}


def awake(config: ModelConfig, seed: int = 0) -> Denoiser:
    """A denoiser whose zero-initialized layers are not zero."""
    torch.manual_seed(seed)
    denoiser = Denoiser(config)
    with torch.no_grad():
        for parameter in denoiser.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return denoiser.eval()


def test_an_untrained_denoiser_answers_with_the_joined_keyframes() -> None:
    config = SIZES["tiny"]
    given = conditions(config, 2)
    x = torch.randn(2, 121, 201)
    assert torch.equal(Denoiser(config)(x, torch.tensor([5, 900]), given), given.base)


def test_answers_differ_from_the_interpolation_by_the_scales() -> None:
    """Exact keyframes are kept, noisy ones change within their noise, other frames within their distance's size."""
    config = SIZES["tiny"]
    denoiser = awake(config)
    size = torch.linspace(0, 1.2, 61)[:, None].expand(61, 201)
    denoiser.set_scales(scales(denoiser, size))
    x, t = torch.randn(2, 121, 201), torch.tensor([500, 500])
    given = conditions(config, 2)
    given = replace(given, noise_level=torch.tensor([0.0, 1.0]))
    change = (denoiser(x, t, given) - given.base).abs()
    assert torch.equal(change[0, ::15], torch.zeros(9, 201))
    assert (change[1, ::15] > 0).any()
    doubled = awake(config)
    doubled.set_scales(scales(doubled, 2 * size))
    same_input = replace(given, imputed=torch.ones_like(given.mask))
    noise = torch.tensor([1000, 1000])  # so much that it tells nothing, whatever the size
    a, b = (model(x, noise, same_input)[0] - given.base[0] for model in (denoiser, doubled))
    torch.testing.assert_close(b, 2 * a, atol=1e-4, rtol=1e-3)


def test_the_noisy_window_is_not_seen_where_it_holds_the_keyframe() -> None:
    config = SIZES["tiny"]
    denoiser, given = awake(config), conditions(config, 1)
    x, t = torch.randn(1, 121, 201), torch.tensor([300])
    other = x.clone()
    other[:, 15] += 1.0
    noisy = replace(given, noise_level=torch.ones(1))
    assert not torch.allclose(denoiser(x, t, noisy), denoiser(other, t, noisy)), "what was taken out of it is seen"
    given = replace(given, noise_level=torch.zeros(1))
    assert torch.equal(denoiser(x, t, given), denoiser(other, t, given))
    free = replace(given, imputed=torch.zeros_like(given.mask))
    assert not torch.allclose(denoiser(x, t, free), denoiser(other, t, free))


def test_distances_to_keyframes() -> None:
    mask = torch.zeros(1, 8)
    mask[0, [1, 6]] = 1
    assert distance_to_keyframes(mask)[0].tolist() == [1, 0, 1, 2, 2, 1, 0, 1]


def test_without_residual_the_answer_is_free_of_the_interpolation() -> None:
    config = replace(SIZES["tiny"], residual=False)
    given, other = conditions(config, 2), conditions(config, 2, seed=1)
    x, t = torch.randn(2, 121, 201), torch.tensor([100, 600])
    denoiser = awake(config)
    assert torch.equal(denoiser(x, t, given), denoiser(x, t, replace(given, base=other.base)))


@pytest.mark.parametrize("condition", ["token", "adagn", "both"])
@pytest.mark.parametrize("fold", [1, 4])
@pytest.mark.parametrize("frames", [121, 122, 40])
def test_any_length_keeps_its_shape(condition: Any, fold: int, frames: int) -> None:
    config = replace(SIZES["tiny"], condition=condition, fold=fold, window_frames=frames)
    assert awake(config)(torch.randn(2, frames, 201), torch.tensor([1, 1000]), conditions(config, 2)).shape == (
        2,
        frames,
        201,
    )


def test_every_condition_counts_where_it_is_used() -> None:
    config = SIZES["tiny"]
    denoiser, given = awake(config), conditions(config, 2)
    x, t = torch.randn(2, 121, 201), torch.tensor([100, 600])
    before = denoiser(x, t, given)
    other = conditions(config, 2, seed=1)
    for name in ("base", "local", "body", "noise_level", "scene"):
        assert not torch.allclose(denoiser(x, t, replace(given, **{name: getattr(other, name)})), before), name
    assert not torch.allclose(denoiser(x, t - 50, given), before)
    between = given.local.clone()
    between[:, 1:14] += 1.0
    assert torch.equal(denoiser(x, t, replace(given, local=between)), before), "local scene is read at keyframes only"


def test_a_dropped_scene_does_not_show() -> None:
    config = SIZES["tiny"]
    denoiser, a, b = awake(config), conditions(config, 2), conditions(config, 2, seed=1)
    x, t = torch.randn(2, 121, 201), torch.tensor([100, 600])
    dropped = a.without_global_scene()
    assert torch.equal(denoiser(x, t, dropped), denoiser(x, t, replace(dropped, scene=b.scene)))
    assert not torch.allclose(denoiser(x, t, dropped), denoiser(x, t, a))


def test_ablated_models_do_not_look() -> None:
    config = replace(SIZES["tiny"], use_body=False, use_global=False, use_local=False)
    denoiser, a, b = awake(config), conditions(config, 2), conditions(config, 2, seed=1)
    x, t = torch.randn(2, 121, 201), torch.tensor([100, 600])
    blind = replace(a, local=b.local, body=b.body, scene=b.scene, scene_known=torch.zeros(2))
    assert torch.equal(denoiser(x, t, blind), denoiser(x, t, a))


def test_the_scene_encoder_tells_rooms_apart() -> None:
    denoiser = awake(SIZES["tiny"])
    empty, floor, wall = torch.zeros(3, 48, 24, 48).unbind()
    floor, wall = floor.clone(), wall.clone()
    floor[:, 0], wall[40] = 1, 1
    codes = denoiser.encode_scene(torch.stack([empty, floor, wall]))
    assert codes.shape == (3, 64)
    assert torch.cdist(codes, codes)[~torch.eye(3, dtype=torch.bool)].min() > 1e-3


def test_windows_of_a_batch_do_not_mix() -> None:
    config = SIZES["tiny"]
    denoiser, given = awake(config), conditions(config, 3)
    x, t = torch.randn(3, 121, 201), torch.tensor([10, 500, 990])
    together = denoiser(x, t, given)
    alone = denoiser(x[1:2], t[1:2], given.chosen(slice(1, 2)))
    torch.testing.assert_close(together[1:2], alone, atol=1e-5, rtol=1e-5)


def test_the_papers_size() -> None:
    count = sum(p.numel() for p in Denoiser(SIZES["paper"]).parameters())
    assert 100e6 < count < 125e6


def test_imputation_puts_keyframes_in_place() -> None:
    x, keys, mask = torch.zeros(1, 3, 201), torch.ones(1, 3, 201), torch.tensor([[1.0, 0.0, 1.0]])
    assert impute(x, keys, mask)[0, :, 0].tolist() == [1.0, 0.0, 1.0]


def test_the_schedule_is_the_cosine() -> None:
    schedule = CosineSchedule()
    assert schedule.alpha_bar[0] == 1.0
    assert schedule.alpha_bar[-1] < 1e-6
    assert (np.diff(schedule.alpha_bar) < 0).all()
    expected = (np.cos((0.5 + 0.008) / 1.008 * np.pi / 2) / np.cos(0.008 / 1.008 * np.pi / 2)) ** 2
    assert schedule.alpha_bar[500] == pytest.approx(expected, rel=1e-9)


def test_noise_has_the_schedules_size() -> None:
    schedule, x0 = CosineSchedule(), torch.full((4, 200, 201), 2.0)
    noise = torch.randn(x0.shape, generator=torch.Generator().manual_seed(0))
    x = schedule.add_noise(x0, torch.tensor([1, 300, 700, 1000]), noise)
    for row, t in zip(x, (1, 300, 700, 1000), strict=True):
        assert float(row.mean()) == pytest.approx(2 * np.sqrt(schedule.alpha_bar[t]), abs=0.03)
        assert float(row.std()) == pytest.approx(np.sqrt(1 - schedule.alpha_bar[t]), abs=0.03)


def test_fast_kinematics_are_the_skeletons() -> None:
    g = torch.Generator().manual_seed(0)
    x, rest = torch.randn(3, 5, 201, generator=g), torch.randn(3, 22, 3, generator=g)
    R = matrices(x[..., 3:135].unflatten(-1, (22, 6)))
    torch.testing.assert_close(R @ R.transpose(-1, -2), torch.eye(3).expand_as(R), atol=1e-5, rtol=0)
    expected, _ = forward_kinematics(R.double(), x[..., :3].double(), rest[:, None].double())
    torch.testing.assert_close(joints_of(x, rest).double(), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(posed_joints(R, x[..., :3], rest).double(), expected, atol=1e-5, rtol=0)


def test_kinematics_of_zeros_are_finite() -> None:
    x = torch.zeros(1, 2, 201, requires_grad=True)
    joints_of(x, torch.ones(1, 22, 3)).sum().backward()
    assert x.grad is not None
    assert torch.isfinite(x.grad).all()


@pytest.mark.parametrize("frames", [[0, 120], [0, 3, 10, 15, 40, 41, 77, 120], [5, 60], [7], list(range(121))])
def test_joined_keyframes_are_exact_and_straight_lines_stay_straight(frames: list[int]) -> None:
    mask = torch.zeros(1, 121)
    mask[0, frames] = 1
    line = torch.linspace(-1, 2, 121)[None, :, None].repeat(1, 1, 4)
    joined = join_keyframes(line, mask)
    torch.testing.assert_close(joined[:, frames], line[:, frames], atol=1e-5, rtol=0)
    inside = slice(min(frames), max(frames) + 1)
    torch.testing.assert_close(joined[:, inside], line[:, inside], atol=1e-4, rtol=0)
    assert torch.allclose(joined[0, : min(frames)], line[0, min(frames)])
    assert torch.allclose(joined[0, max(frames) :], line[0, max(frames)], atol=1e-5)


def test_joined_keyframes_follow_a_parabola_between_inner_keyframes() -> None:
    mask = torch.zeros(1, 121)
    mask[0, [0, 20, 50, 60, 120]] = 1
    curve = (torch.linspace(0, 1, 121) ** 2)[None, :, None]
    joined = join_keyframes(curve, mask)
    torch.testing.assert_close(joined[:, 20:61], curve[:, 20:61], atol=1e-5, rtol=0)
    assert (joined - curve).abs().max() < 0.1


def test_weights_come_back_as_they_were(tmp_path: Any) -> None:
    denoiser = awake(SIZES["tiny"])
    statistics = Statistics(*(np.arange(n, dtype=np.float32) + 1 for n in (201, 201, 7, 7)))
    save_weights(tmp_path / "w.safetensors", denoiser, statistics, {"licence": "x"})
    loaded = load_weights(tmp_path / "w.safetensors")
    assert loaded.config == SIZES["tiny"]
    assert loaded.card == {"licence": "x"}
    np.testing.assert_array_equal(loaded.statistics.std, statistics.std)
    for name, value in loaded.denoiser.state_dict().items():
        torch.testing.assert_close(value, denoiser.state_dict()[name], atol=2e-3, rtol=1e-3)


def test_missing_and_broken_weights_say_so(tmp_path: Any) -> None:
    with pytest.raises(ModelMissingError, match=r"found no nothing\.safetensors"):
        load_weights("nothing")
    (tmp_path / "bad.safetensors").write_bytes(b"no")
    with pytest.raises(InputError, match="want a safetensors file"):
        load_weights(tmp_path / "bad.safetensors")


def turned(x: torch.Tensor, yaw: float, shift: tuple[float, float]) -> torch.Tensor:
    """Features of the same motion elsewhere and facing elsewhere."""
    c, s = np.cos(yaw), np.sin(yaw)
    out = x.clone()
    out[..., LEVEL_X] = c * x[..., LEVEL_X] + s * x[..., LEVEL_Z]
    out[..., LEVEL_Z] = -s * x[..., LEVEL_X] + c * x[..., LEVEL_Z]
    for columns, by in ((LEVEL_X, shift[0]), (LEVEL_Z, shift[1])):
        out[..., [columns[0], *columns[3:]]] += by
    return out


def test_the_view_is_the_same_wherever_the_body_is() -> None:
    x = torch.randn(2, 20, 201, generator=torch.Generator().manual_seed(0))
    there = turned(x, 1.1, (3.0, -2.0))
    a, b = view(x, headings(x)), view(there, headings(there))
    torch.testing.assert_close(a[..., :-4], b[..., :-4], atol=1e-4, rtol=1e-4)
    assert not torch.allclose(a[..., -4:], b[..., -4:], atol=0.1)


def test_headings_are_the_way_the_root_faces_and_turn_back() -> None:
    x = torch.randn(1, 5, 201)
    x[..., 3:9] = torch.tensor([1.0, 0, 0, 0, 1, 0])
    torch.testing.assert_close(
        headings(turned(x, 0.7, (0, 0))), torch.tensor([np.sin(0.7), np.cos(0.7)]).float().expand(1, 5, 2)
    )
    heading = headings(torch.randn(1, 5, 201))
    torch.testing.assert_close(from_heading(to_heading(x, heading), heading), x)


def test_gaps_count_from_keyframe_to_keyframe() -> None:
    mask = torch.zeros(1, 6)
    mask[0, [0, 4, 5]] = 1
    assert (60 * gap(mask))[0].round().tolist() == [[0, 0], [1, 3], [2, 2], [3, 1], [0, 0], [0, 0]]
