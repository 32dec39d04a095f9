"""The denoiser: joined keyframes and a correction of a known size, told the scene along its own estimate."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from scenemi.features import JOINTS, LEVEL_X, LEVEL_Z, Statistics
from scenemi.model.base import join_keyframes
from scenemi.model.conditions import Conditions, impute, since_and_until
from scenemi.model.config import SIZES, ModelConfig
from scenemi.model.denoiser import SCALES, Denoiser, body_points, cosines, overlapping
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.heading import VIEW, from_heading, headings, to_heading, view
from scenemi.model.kinematics import joints_of, matrices, posed_joints
from scenemi.model.weights import FORMAT, load_weights, save_weights
from scenemi.scene.field import BoxField
from video2anim.errors import InputError, ModelMissingError
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

REACH_M = 0.6
"""An arm's length, at which the field ends."""

TINY = SIZES["tiny"]
assert isinstance(TINY, ModelConfig)
HEIGHT_M = 1.2
"""Joints of these made-up bodies lie around it: far from the floor."""


CORRELATION = torch.exp(-0.25 * (torch.arange(121)[:, None] - torch.arange(121)).abs())
"""Of residual and noise over time."""


def root(matrix: torch.Tensor) -> torch.Tensor:
    """Symmetric."""
    values, vectors = torch.linalg.eigh(matrix)
    return (vectors * values.sqrt()) @ vectors.T


def conditions(batch: int, seed: int = 0, frames: int = 121) -> Conditions:
    """Keyframes every half second of random motion, joined."""
    g = torch.Generator().manual_seed(seed)
    mask = torch.zeros(batch, frames)
    mask[:, ::15] = mask[:, -1] = 1
    base = join_keyframes(torch.randn(batch, frames, 201, generator=g), mask)
    return Conditions(
        mask=mask, imputed=mask, base=base, noise=torch.rand(batch, 1, 2, generator=g).expand(-1, frames, -1),
        body=torch.randn(batch, 7, generator=g),
    )  # fmt: skip


def window(batch: int = 2, seed: int = 0) -> torch.Tensor:
    return torch.randn(batch, 121, 201, generator=torch.Generator().manual_seed(100 + seed))


def awake(config: ModelConfig = TINY, seed: int = 0) -> Denoiser:
    """A denoiser whose zero-initialized layers are not zero, for features of 0.3 m around a body at rest."""
    torch.manual_seed(seed)
    denoiser = Denoiser(config)
    with torch.no_grad():
        for parameter in denoiser.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    mean = torch.zeros(201)
    mean[[1, *range(JOINTS.start + 1, JOINTS.stop, 3)]] = HEIGHT_M
    mean[[3, 7]] = 1.0
    denoiser.set_scales({
        "residual_std": torch.linspace(0, 0.5, 61)[:, None].expand(-1, 201), "noise_std": torch.full((2, 201), 0.1),
        "correlate": root(CORRELATION),
        "view_mean": torch.zeros(VIEW), "view_std": torch.ones(VIEW), "feature_mean": mean,
        "feature_std": torch.full((201,), 0.1),
    })  # fmt: skip
    return denoiser.eval()


def joints_m(denoiser: Denoiser, x: torch.Tensor) -> torch.Tensor:
    return (x * denoiser.feature_std + denoiser.feature_mean)[..., JOINTS].unflatten(-1, (22, 3))


def box(x: float, y: float, z: float, half: float = 0.2, yaw: float = 0.0) -> torch.Tensor:
    return torch.tensor([[x, y, z, half, half, half, yaw]])


def in_scene(given: Conditions, boxes: torch.Tensor, known: list[float] | None = None) -> Conditions:
    """With boxes (B, K, 7)."""
    every = torch.ones(len(given.mask)) if known is None else torch.tensor(known)
    return replace(given, field=BoxField.of(boxes, every))


T = torch.tensor([300, 700])


def untrained() -> Denoiser:
    """With the scales of `awake`, and layers as they begin."""
    denoiser, other = Denoiser(TINY), awake()
    denoiser.set_scales({name: getattr(other, name) for name in SCALES})
    return denoiser


@torch.no_grad()
def test_an_untrained_denoiser_answers_with_the_best_linear_estimate() -> None:
    """Of a residual with the noise's covariance x_t tells sqrt(alpha_bar) (x_t - center): nothing at T, all at 0."""
    denoiser, given, generator = untrained(), conditions(64), torch.Generator().manual_seed(1)
    given = replace(given, noise=torch.zeros(64, 121, 2))
    scene = in_scene(given, box(0, HEIGHT_M, 0).expand(64, -1, -1))
    center, prepared = denoiser.center(given), denoiser.prepare(given)

    def drawn() -> torch.Tensor:
        return denoiser.noise(torch.randn(64, 121, 201, generator=generator), prepared)

    residual, between = drawn(), given.mask[0] == 0
    for t in (1, 300, 700, 1000):
        a = CosineSchedule().alpha_bar[t]
        x = center + np.sqrt(a) * residual + np.sqrt(1 - a) * drawn()
        steps = torch.full((64,), t)
        made = denoiser(x, steps, given)
        assert torch.equal(denoiser(x, steps, scene), made)
        off = ((made - center - residual) / prepared.scale)[:, between].square().mean()
        assert float(off) == pytest.approx(1 - a, rel=0.03, abs=1e-4), "of no other factor of x_t is it smaller"
        assert float((made - center)[:, ~between].abs().max()) < 1e-5


@torch.no_grad()
def test_noise_of_the_forward_process_is_correlated_over_time_and_as_large_as_the_residual() -> None:
    denoiser, given = awake(), conditions(400)
    prepared = denoiser.prepare(given)
    made = denoiser.noise(torch.randn(400, 121, 201, generator=torch.Generator().manual_seed(2)), prepared)
    unit = to_heading(made, prepared.heading) / prepared.scale
    found = torch.einsum("bif,bjf->ij", unit, unit) / (400 * 201)
    torch.testing.assert_close(found, CORRELATION, atol=0.02, rtol=0)


@torch.no_grad()
def test_answers_differ_from_the_joined_keyframes_by_the_scales() -> None:
    """Exact keyframes are kept to a hundredth, noisy ones change within their noise, others within their distance's."""
    denoiser, given = awake(), conditions(2)
    given = replace(given, noise=torch.tensor([[[0.0, 0.0]], [[3.0, 4.0]]]).expand(-1, 121, -1))
    scale = denoiser.scales(given)
    torch.testing.assert_close(scale[0, ::15], torch.full((9, 201), 0.01))
    torch.testing.assert_close(scale[1, ::15], torch.full((9, 201), float(np.hypot(0.5, 0.01))), msg="0.1 by 3 and 4")
    between = 0.5 / 60 * since_and_until(given.mask).amin(-1)
    torch.testing.assert_close(scale[0, 3], torch.hypot(between[0, 3], torch.tensor(0.01)).expand(201))
    among_noisy = torch.hypot(between[1, 3], torch.tensor(float(np.hypot(0.5, 0.01)))).expand(201)
    torch.testing.assert_close(scale[1, 3], among_noisy, msg="joined noisy keyframes are noisy between, too")
    told = torch.zeros(2, 121, 2)
    told[:, 15] = torch.tensor([3.0, 4.0])
    one = denoiser.scales(replace(given, noise=told))[0]
    assert one[0, 0] == pytest.approx(0.01)
    assert (one[1:15, 0] > torch.hypot(between[0, 1:15], torch.tensor(0.02))).all(), "on the way to a noisy one"
    change = to_heading(denoiser(given.base, T, given) - given.base, denoiser.prepare(given).heading) / scale
    assert 0.1 < change.std() < 20
    # The unit of the network's own output is the same near keyframes and far from them.
    assert change[0, ::15].std() == pytest.approx(float(change[0, 7::15].std()), rel=0.7)


def test_the_noisy_window_is_not_seen_where_it_holds_the_keyframe() -> None:
    denoiser, given, x = awake(), conditions(2), window()
    other = x.clone()
    other[:, 15] += 1.0
    assert torch.equal(denoiser(x, T, given), denoiser(other, T, given))
    free = replace(given, imputed=torch.zeros_like(given.mask))
    assert not torch.allclose(denoiser(x, T, free), denoiser(other, T, free))


@torch.no_grad()
def test_the_network_reads_frequencies_of_eight_frames_each_at_its_own_size() -> None:
    denoiser, given, x = awake(), conditions(2), window()
    torch.testing.assert_close(cosines(8) @ cosines(8).T, torch.eye(8))
    read = denoiser.inputs(x, T, given, None, denoiser.prepare(given))
    frames = (cosines(8).T @ read).flatten(1, 2)
    at = 201 + 66 + VIEW
    torch.testing.assert_close(frames[:, :121, at], given.mask)
    torch.testing.assert_close(frames[:, 121:, at], given.mask[:, -1:].expand(-1, 7), msg="the last frame goes on")
    before = denoiser(x, T, given)
    denoiser.set_input_scales(read)
    unit = (read - denoiser.token_mean) / denoiser.token_std
    assert unit.mean((0, 1)).abs().max() < 1e-3
    changing = read.std((0, 1)) > 0.03
    torch.testing.assert_close(unit.std((0, 1))[changing], torch.ones(int(changing.sum())))
    assert unit.std((0, 1)).max() < 1.001, "what hardly changes is not blown up"
    assert not torch.allclose(denoiser(x, T, given), before)


def test_answers_of_tokens_overlap_without_seams() -> None:
    """Half of the frequencies of sixteen frames, eight apart: a motion slower than that is told nearly exactly."""
    matrix = overlapping(16, 8)
    time = torch.arange(128) / 30
    slow = torch.stack([torch.sin(2 * np.pi * hz * time + hz) for hz in (0.0, 1.0, 2.5)], 1)
    fitted = matrix @ torch.linalg.lstsq(matrix, slow, driver="gelsd").solution
    assert (fitted - slow).abs().max() < 1e-4
    noise = matrix @ torch.randn(128, 200, generator=torch.Generator().manual_seed(0))
    steps = noise.diff(dim=0).square().mean(1).sqrt()
    by_phase = torch.stack([steps[8 + phase : 112 : 8].mean() for phase in range(8)])
    assert by_phase.max() < 1.3 * by_phase.mean(), "between two tokens as within one"


def test_every_condition_counts() -> None:
    denoiser, given, x = awake(), conditions(2), window()
    before, other = denoiser(x, T, given), conditions(2, seed=1)
    for name in ("base", "body", "noise"):
        assert not torch.allclose(denoiser(x, T, replace(given, **{name: getattr(other, name)})), before), name
    fewer = given.mask.clone()
    fewer[:, 30] = 0
    assert not torch.allclose(denoiser(x, T, replace(given, mask=fewer)), before)
    assert not torch.allclose(denoiser(x, T - 50, given), before)
    assert not torch.allclose(denoiser(window(seed=1), T, given), before)
    assert not torch.allclose(denoiser(x, T, given, given.base + 0.1), before), "the last estimate"
    assert torch.equal(denoiser(x, T, given, given.base), before), "at first that is the joined keyframes"


def test_noise_is_told_of_keyframes_alone_and_degrees_apart_from_centimeters() -> None:
    denoiser, given, x = awake(), conditions(2), window()
    before = denoiser(x, T, given)
    between = given.noise.clone()
    between[given.mask == 0] += 5.0
    assert torch.equal(denoiser(x, T, replace(given, noise=between)), before)
    answers = []
    for kind in (0, 1):
        louder = given.noise.clone()
        louder[..., kind] += 1.0
        answers.append(denoiser(x, T, replace(given, noise=louder)))
    assert not torch.allclose(answers[0], before)
    assert not torch.allclose(answers[0], answers[1])


def test_what_steps_have_in_common_may_be_given() -> None:
    denoiser, given, x = awake(), conditions(2), window()
    assert torch.equal(denoiser(x, T, given, None, denoiser.prepare(given)), denoiser(x, T, given))


def test_windows_of_a_batch_do_not_mix() -> None:
    denoiser, boxes = awake(), torch.stack([box(0.1 * i, HEIGHT_M, 0, 0.1 + 0.1 * i) for i in range(3)])
    x, t = window(3), torch.tensor([10, 500, 990])
    given = in_scene(conditions(3), boxes, [1.0, 1.0, 0.0])
    together = denoiser(x, t, given)
    for i, known in enumerate((1.0, 1.0, 0.0)):
        one = slice(i, i + 1)
        parts = {name: getattr(given, name)[one] for name in ("mask", "imputed", "base", "noise", "body")}
        alone = denoiser(x[one], t[one], in_scene(Conditions(**parts), boxes[one], [known]))
        torch.testing.assert_close(together[one], alone, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("frames", [121, 122, 40, 8])
@pytest.mark.parametrize("fold", [1, 4, 8])
def test_any_length_keeps_its_shape(fold: int, frames: int) -> None:
    config = replace(TINY, fold=fold, window_frames=frames)
    x = torch.randn(2, frames, 201)
    assert awake(config)(x, torch.tensor([1, 1000]), conditions(2, frames=frames)).shape == (2, frames, 201)


def test_a_solid_changes_the_answer_only_where_it_is_within_reach() -> None:
    """Of two windows one has a solid at its joints, the other one that no joint comes near."""
    denoiser, given, x = awake(), conditions(2), window()
    reach = body_points(joints_m(denoiser, given.base)).flatten(0, 2)
    assert reach[:, 1].min() > REACH_M, "the floor is out of reach too"
    far = float(reach[:, 0].max()) + REACH_M + 0.21
    boxes = torch.stack([box(0, HEIGHT_M, 0), box(far, HEIGHT_M, 0)])
    before, after = denoiser(x, T, given), denoiser(x, T, in_scene(given, boxes))
    assert not torch.allclose(after[0], before[0])
    torch.testing.assert_close(after[1], before[1], atol=1e-6, rtol=0)
    nearer = in_scene(given, torch.stack([box(0, HEIGHT_M, 0), box(far - 0.3, HEIGHT_M, 0)]))
    assert not torch.allclose(denoiser(x, T, nearer)[1], before[1], atol=1e-6)
    unseen = in_scene(given, boxes, [0.0, 1.0])
    torch.testing.assert_close(denoiser(x, T, unseen), before, atol=1e-6, rtol=0), "nor where it is not shown"


def test_the_scene_is_asked_along_the_last_estimate() -> None:
    denoiser, given, x = awake(), conditions(2), window()
    far = 30.0
    scene = in_scene(given, box(far, HEIGHT_M, 0).expand(2, -1, -1))
    there = given.base.clone()
    there[..., list(range(JOINTS.start, JOINTS.stop, 3))] += far / 0.1
    assert torch.equal(denoiser(x, T, scene, given.base), denoiser(x, T, given, given.base))
    assert not torch.allclose(denoiser(x, T, scene, there), denoiser(x, T, given, there))


def test_posts_between_joints_are_seen() -> None:
    """The middles of the limbs are asked too."""
    joints = torch.zeros(1, 22, 3)
    joints[0, JOINT_INDEX["left_knee"]] = torch.tensor([0.0, 0.5, 0.0])
    joints[0, JOINT_INDEX["left_ankle"]] = torch.tensor([0.2, 0.1, 0.0])
    found = body_points(joints)
    assert found.shape == (1, 30, 3)
    torch.testing.assert_close(found[:, :22], joints)
    assert (found[0, 22:] - torch.tensor([0.1, 0.3, 0.0])).norm(dim=-1).min() < 1e-6


def test_without_scene_channels_solids_do_not_count() -> None:
    denoiser, given, x = awake(replace(TINY, scene=False)), conditions(2), window()
    scene = in_scene(given, box(0, HEIGHT_M, 0).expand(2, -1, -1))
    assert torch.equal(denoiser(x, T, scene), denoiser(x, T, given))


def test_a_scene_left_out_does_not_show() -> None:
    denoiser, given, x = awake(), conditions(2), window()
    scene = in_scene(given, box(0, HEIGHT_M, 0).expand(2, -1, -1))
    assert scene.has_scene
    assert not scene.without_scene().has_scene
    assert torch.equal(denoiser(x, T, scene.without_scene()), denoiser(x, T, given))


@pytest.mark.parametrize("shift", [(0.0, 0.0), (2.0, -1.0)])
def test_the_answer_turns_along_with_the_window_and_its_scene(shift: tuple[float, float]) -> None:
    """But for the place and the heading in the window's own frame, which the network also reads: here it cannot."""
    denoiser, angle = awake(), 1.1
    with torch.no_grad():
        columns = denoiser.network.enter.weight.unflatten(1, (TINY.fold, -1))
        columns[:, :, 201 + 66 + VIEW - 4 : 201 + 66 + VIEW] = 0
    std, mean = denoiser.feature_std, denoiser.feature_mean
    given, x = conditions(2), window()
    estimate = given.base + 0.2 * window(seed=2)
    boxes = torch.stack([box(0.1, HEIGHT_M, 0.2, 0.15, 0.4), box(-0.2, HEIGHT_M, 0.0, 0.1, 1.0)])
    turned_boxes = boxes.clone()
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    turned_boxes[..., 0] = cos * boxes[..., 0] + sin * boxes[..., 2] + shift[0]
    turned_boxes[..., 2] = cos * boxes[..., 2] - sin * boxes[..., 0] + shift[1]
    turned_boxes[..., 6] += angle

    def there(values: torch.Tensor) -> torch.Tensor:
        return (turned(values * std + mean, angle, shift) - mean) / std

    answer = denoiser(x, T, in_scene(given, boxes), estimate)
    moved = replace(in_scene(given, turned_boxes), base=there(given.base))
    answer_there = denoiser(there(x), T, moved, there(estimate))
    assert (answer - given.base).abs().max() > 0.1, "it says something"
    torch.testing.assert_close(answer_there, there(answer), atol=5e-3, rtol=1e-3)
    assert not torch.allclose(denoiser(there(x), T, in_scene(moved, boxes), there(estimate)), answer_there, atol=5e-3)


def test_frames_since_and_until_the_next_keyframe() -> None:
    mask = torch.zeros(1, 8)
    mask[0, [1, 6]] = 1
    assert since_and_until(mask)[0].tolist() == [
        [8, 1], [0, 0], [1, 4], [2, 3], [3, 2], [4, 1], [0, 0], [1, 8],
    ]  # fmt: skip
    assert since_and_until(mask).amin(-1)[0].tolist() == [1, 0, 1, 2, 2, 1, 0, 1]


def test_the_shipped_size_is_small_enough_for_a_processor() -> None:
    count = sum(p.numel() for p in Denoiser(SIZES["small"]).parameters())  # type: ignore[arg-type]
    assert 3e6 < count < 12e6


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
    denoiser = awake()
    statistics = Statistics(*(np.arange(n, dtype=np.float32) + 1 for n in (201, 201, 7, 7)))
    save_weights(tmp_path / "w.safetensors", denoiser, statistics, {"license": "x"})
    loaded = load_weights(tmp_path / "w.safetensors")
    assert loaded.config == TINY
    assert loaded.card == {"license": "x"}
    assert not loaded.denoiser.training
    np.testing.assert_array_equal(loaded.statistics.std, statistics.std)
    for name, value in loaded.denoiser.state_dict().items():
        torch.testing.assert_close(value, denoiser.state_dict()[name], atol=2e-3, rtol=1e-3)
    assert set(SCALES) <= set(loaded.denoiser.state_dict()), "sizes measured before training are kept with them"


def test_missing_and_broken_weights_say_so(tmp_path: Any) -> None:
    from safetensors.torch import save_file

    with pytest.raises(ModelMissingError, match=r"found no nothing\.safetensors"):
        load_weights("nothing")
    path = tmp_path / "bad.safetensors"
    path.write_bytes(b"no")
    with pytest.raises(InputError, match="want a safetensors file"):
        load_weights(path)
    save_file({"x": torch.zeros(1)}, str(path), {"format": "scenemi-weights-1"})
    with pytest.raises(InputError, match=f"want format {FORMAT}"):
        load_weights(path)
    import json

    header = {"format": FORMAT, "config": json.dumps(TINY.to_json()), "card": "{}"}
    save_file({"model.x": torch.zeros(1)}, str(path), header)
    with pytest.raises(InputError, match="does not fit its own configuration"):
        load_weights(path)
    with pytest.raises(InputError, match="cannot be written"):
        save_weights(tmp_path / "none" / "w.safetensors", awake(), Statistics(*(np.ones(1, np.float32),) * 4), {})


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
