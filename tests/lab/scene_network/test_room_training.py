"""Losses of the room network against answers whose worth is known, and training that can be broken off."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from test_samples import write_shards

from video2anim.lab.scene_network import train as training
from video2anim.lab.scene_network.network import RoomAnswer, RoomNetwork
from video2anim.lab.scene_network.objective import (
    aligned,
    disparity_loss,
    distance_loss,
    losses,
    measures,
    overlap_loss,
    relative_loss,
)
from video2anim.lab.scene_network.samples import PictureBatch, PictureShards
from video2anim.lab.scene_network.train import PerceptionConfig, read_average, train

HEADS = ("disparity", "normal", "classes", "middle", "offset", "boundary", "up", "latitude")


class FewShards(PictureShards):
    """Two small pictures, however many are asked for."""

    def plain(self, numbers: object, size: tuple[int, int]) -> PictureBatch:
        return super().plain([0, 1], (64, 96))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_shards(tmp_path / "set")


@pytest.fixture
def batch(folder: Path) -> PictureBatch:
    return PictureShards([folder]).plain([0, 1], (64, 96))


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Training sizes that take no time."""
    monkeypatch.setattr(training, "SMALL_SIZES", ((32, 64), (64, 32), (64, 64)))
    monkeypatch.setattr(training, "LARGE_SIZES", ((64, 96),))


def truth(batch: PictureBatch) -> RoomAnswer:
    """What a perfect and very sure network answers."""
    disparity = batch.disparity
    median = disparity.flatten(1).median(1).values[:, None, None]
    spread = (disparity - median).abs().mean((1, 2), keepdim=True)
    classes = torch.nn.functional.one_hot(batch.classes, 6).permute(0, 3, 1, 2).float()
    instance = torch.cat([torch.logit(batch.heat, 1e-6)[:, None], batch.offset, 40 * batch.boundary[:, None] - 20], 1)
    camera = torch.cat([batch.up, batch.latitude[:, None], torch.full_like(batch.up, -4.0)], 1)
    return RoomAnswer(((disparity - median) / spread)[:, None], batch.normal, 40 * classes, instance, camera)


def other_way(answer: RoomAnswer, head: str) -> RoomAnswer:
    """The same answer with one head wrong."""
    instance, camera = answer.instance.clone(), answer.camera.clone()
    match head:
        case "disparity":
            return answer._replace(disparity=-answer.disparity)
        case "normal":
            return answer._replace(normal=answer.normal.roll(1, dims=1))
        case "classes":
            return answer._replace(classes=answer.classes.roll(1, dims=1))
        case "middle":
            instance[:, 0] = instance[:, 0].roll(12, dims=-1)
        case "offset":
            instance[:, 1:3] *= -1
        case "boundary":
            instance[:, 3] *= -1
        case "up":
            camera[:, :2] = camera[:, :2].flip(1)
        case "latitude":
            camera[:, 2] += 0.2
    return answer._replace(instance=instance, camera=camera)


def test_losses_of_the_true_output_are_almost_zero(batch: PictureBatch) -> None:
    terms = losses(truth(batch), batch)
    assert tuple(terms) == HEADS
    floor = float(torch.nn.functional.binary_cross_entropy(batch.heat, batch.heat, weight=1 + 8 * batch.heat))
    for name, value in terms.items():
        assert value.ndim == 0
        # Between 0 and 1 a blob keeps its entropy; sure directions win the Laplace likelihood's log.
        wanted = {"middle": 3 * floor, "up": 0.15 * -4.0, "latitude": 0.15 * -4.0}.get(name, 0.0)
        assert float(value) == pytest.approx(wanted, abs=0.01), name


@pytest.mark.parametrize("head", HEADS)
def test_a_wrong_output_raises_only_its_own_loss(batch: PictureBatch, head: str) -> None:
    right, wrong = losses(truth(batch), batch), losses(other_way(truth(batch), head), batch)
    for name in HEADS:
        if name == head:
            assert float(wrong[name]) > float(right[name]) + 0.1
        else:
            assert float(wrong[name]) == pytest.approx(float(right[name]), abs=1e-6)


def test_losses_of_an_untrained_network_are_about_one(batch: PictureBatch) -> None:
    """Finite, with gradients that are finite and reach every weight."""
    torch.manual_seed(0)
    network = RoomNetwork()
    terms = losses(network(batch.picture), batch)
    for name, value in terms.items():
        assert 0.1 < float(value.detach()) < 8.0, name
    torch.stack(list(terms.values())).sum().backward()
    for name, weight in network.named_parameters():
        assert weight.grad is not None, name
        assert torch.isfinite(weight.grad).all(), name
        assert weight.grad.abs().max() > 0, name


def test_extreme_outputs_have_finite_losses(batch: PictureBatch) -> None:
    """Zero everywhere, and a thousand everywhere, in a picture that is sky alone."""
    sky = replace(batch, disparity=0 * batch.disparity, normal=0 * batch.normal, has_offset=0 * batch.has_offset)
    for shown, value in itertools.product((batch, sky), (0.0, 1e3, -1e3)):
        flat = RoomAnswer(*(torch.full_like(part, value).requires_grad_() for part in truth(batch)))
        total = torch.stack(list(losses(flat, shown).values())).sum()
        assert torch.isfinite(total)
        total.backward()
        assert all(part.grad is not None and torch.isfinite(part.grad).all() for part in flat)


def test_a_small_predicted_error_pays_only_for_small_errors(batch: PictureBatch) -> None:
    """Expected error of the camera head: the best one is about the error made."""
    for off_rad in (0.02, 0.2):
        costs = []
        for log_sigma in (-4.5, np.log(off_rad), -0.5):
            camera = truth(batch).camera.clone()
            camera[:, 2] += off_rad
            camera[:, 3:5] = log_sigma
            costs.append(float(losses(truth(batch)._replace(camera=camera), batch)["latitude"]))
        assert costs[1] < costs[0]
        assert costs[1] < costs[2]


@pytest.mark.parametrize(("scale", "offset"), [(3.0, 0.0), (1.0, 0.7), (0.2, 5.0)])
def test_disparity_loss_forgives_scale_and_offset_of_the_truth(
    batch: PictureBatch, scale: float, offset: float
) -> None:
    rng = torch.Generator().manual_seed(0)
    answer = torch.randn(batch.disparity.shape, generator=rng)
    plain = disparity_loss(answer, batch.disparity)
    moved = batch.disparity * torch.tensor([scale, 1.0])[:, None, None] + torch.tensor([offset, 0.0])[:, None, None]
    torch.testing.assert_close(disparity_loss(answer, moved), plain, rtol=1e-4, atol=1e-5)
    assert float(disparity_loss(-answer, batch.disparity)) != pytest.approx(float(plain), rel=1e-3)


def test_disparity_loss_by_hand() -> None:
    """Truth of 0, 1, 2, 3 in equal shares: median 1 (the lower), mean deviation 1, so one less is right: no cost."""
    truth = torch.arange(4.0).repeat(4).expand(1, 16, 16)
    assert float(disparity_loss(truth - 1, truth)) == pytest.approx(0.0, abs=1e-6)
    # A shift: half of the mean error for the first term, none for the forgiving one, no gradients.
    assert float(disparity_loss(truth - 0.6, truth)) == pytest.approx(0.5 * 0.4, abs=1e-5)
    # Zero everywhere: errors 1, 0, 1, 2; the forgiving term knows the mean only: errors 1.5, 0.5, 0.5, 1.5.
    # Gradients at every pixel, every 2nd, 4th and 8th; rows differ by nothing.
    steps = [np.abs(np.diff(np.tile(np.arange(4.0), 4)[:: 2**level])).mean() for level in range(4)]
    wanted = 0.5 * 1.0 + 0.5 * 1.0 + 0.25 * sum(steps)
    assert float(disparity_loss(torch.zeros(1, 16, 16), truth)) == pytest.approx(wanted, rel=1e-5)


def test_aligned_by_least_squares() -> None:
    rng = np.random.default_rng(0)
    answer, goal = rng.normal(size=(2, 5, 7)), rng.normal(size=(2, 5, 7))
    goal[1] = 3 * answer[1] + 2
    found = aligned(torch.tensor(answer), torch.tensor(goal)).numpy()
    line = np.polyfit(answer[0].ravel(), goal[0].ravel(), 1)
    np.testing.assert_allclose(found[0], np.polyval(line, answer[0]), atol=1e-9)
    np.testing.assert_allclose(found[1], goal[1], atol=1e-9)


def test_measures_of_the_truth_and_of_known_errors(batch: PictureBatch) -> None:
    perfect = measures(truth(batch), batch)
    # Disparities below 0.02 count as 50 m, in the answer and in the truth.
    assert perfect["absrel"] < 1e-3
    assert perfect["delta1"] == 1.0
    for name in ("up_deg", "latitude_deg"):
        assert perfect[name] < 0.1
    for name in ("iou_floor", "iou_furniture", "iou_person"):
        assert perfect[name] == 1.0
    answer = truth(batch)
    camera, classes = answer.camera.clone(), answer.classes.clone()
    camera[:, 2] += np.deg2rad(3.0)
    cos, sin = np.cos(np.deg2rad(5.0)), np.sin(np.deg2rad(5.0))
    camera[:, 0] = cos * batch.up[:, 0] - sin * batch.up[:, 1]
    camera[:, 1] = sin * batch.up[:, 0] + cos * batch.up[:, 1]
    people = batch.classes == 5
    half = people & (torch.arange(people.shape[1])[None, :, None] % 2 == 0)
    classes[:, 5][half] = -1.0
    found = measures(answer._replace(camera=camera, classes=classes), batch)
    assert found["latitude_deg"] == pytest.approx(3.0, abs=0.01)
    assert found["up_deg"] == pytest.approx(5.0, abs=0.05)
    assert found["iou_person"] == pytest.approx(1 - float(half.sum() / people.sum()), abs=1e-5)


def test_true_normals_are_measured_as_true(batch: PictureBatch) -> None:
    """Normals stored in steps of 1/127 turn by a third of a degree at most; a tilt by 10 degrees is one of 10."""
    answer = truth(batch)
    assert measures(answer, batch)["normal_deg"] < 0.4
    unit = torch.nn.functional.normalize(batch.normal, dim=1)
    aside = torch.linalg.cross(unit, torch.tensor([0.3, 0.5, 0.8])[None, :, None, None].expand_as(unit), dim=1)
    aside = torch.nn.functional.normalize(aside, dim=1)
    tilted = np.cos(np.deg2rad(10)) * unit + np.sin(np.deg2rad(10)) * aside
    assert measures(answer._replace(normal=7 * tilted), batch)["normal_deg"] == pytest.approx(10.0, abs=0.4)


def test_training_goes_on_where_it_was_broken_off(folder: Path, tmp_path: Path, small: None) -> None:
    """Three steps, an interruption, three more: the same network, average and running statistics as six in one go."""
    config = PerceptionConfig(steps=6, batch=2, warmup=2, large_share=0.34, save_every=3)
    shards = FewShards([folder])
    lines: list[str] = []
    whole = train(shards, shards, config, tmp_path / "whole.ckpt", on_line=lines.append)
    assert [line.split()[1] for line in lines] == ["3", "6"]

    def stop(line: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(shards, shards, config, tmp_path / "parts.ckpt", on_line=stop)
    half = load_file(tmp_path / "parts.ckpt")
    again = train(FewShards([folder]), shards, config, tmp_path / "parts.ckpt")
    one, two = load_file(tmp_path / "whole.ckpt"), load_file(tmp_path / "parts.ckpt")
    assert set(one) == set(two) == set(half)
    assert any("running_mean" in name for name in one)
    moved = 0.0
    for name, value in one.items():
        torch.testing.assert_close(two[name], value, rtol=2e-3, atol=2e-4, msg=name)
        moved = max(moved, float((half[name].float() - value.float()).abs().max()))
    assert moved > 0.01, "the last three steps did something"
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=2e-3, atol=2e-4, msg=name)
    finished = train(shards, shards, config, tmp_path / "whole.ckpt")
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(finished.state_dict()[name], value, rtol=0, atol=0, msg=name)


def test_the_average_follows_weights_and_running_statistics(folder: Path, tmp_path: Path, small: None) -> None:
    """After the first step it keeps 2/11 of the beginning, by the early share (step + 1) / (step + 10)."""
    shards = FewShards([folder])
    config = PerceptionConfig(steps=1, batch=2, warmup=0, seed=5)
    average = train(shards, shards, config, tmp_path / "a.ckpt")
    torch.manual_seed(5)
    start = RoomNetwork().state_dict()
    stored = load_file(tmp_path / "a.ckpt")
    moved = []
    for name, value in start.items():
        if not value.dtype.is_floating_point:
            continue
        network = stored[f"network.{name}"]
        torch.testing.assert_close(stored[f"average.{name}"], network + 2 / 11 * (value - network), msg=name)
        torch.testing.assert_close(average.state_dict()[name], stored[f"average.{name}"], msg=name)
        if not torch.equal(network, value):
            moved.append(name)
    assert any("running_mean" in name for name in moved)
    assert len(moved) > 20
    kept = read_average(tmp_path / "a.ckpt")
    assert not kept.training
    for name, value in average.state_dict().items():
        torch.testing.assert_close(kept.state_dict()[name], value, rtol=0, atol=0)


def test_published_stages_stay_as_they_were(folder: Path, tmp_path: Path, small: None) -> None:
    """Stem and first stages are frozen, batch statistics of the whole encoder too; later stages learn."""
    shards = FewShards([folder])
    torch.manual_seed(0)
    before = RoomNetwork().encoder.state_dict()
    config = PerceptionConfig(steps=2, batch=2, warmup=0, frozen_stages=3)
    train(shards, shards, config, tmp_path / "a.ckpt")
    stored = load_file(tmp_path / "a.ckpt")
    learned = set()
    for name, value in before.items():
        if not torch.equal(stored[f"network.encoder.{name}"], value):
            learned.add(".".join(name.split(".")[:2]))
            assert "running" not in name
    assert learned == {f"stages.{number}" for number in (3, 4, 5, 6)}


def test_time_out_leaves_a_checkpoint(folder: Path, tmp_path: Path, small: None) -> None:
    shards, lines = FewShards([folder]), []
    config = PerceptionConfig(steps=50, batch=2, minutes=0.0)
    train(shards, shards, config, tmp_path / "deep" / "a.ckpt", on_line=lines.append)
    assert len(lines) == 1
    assert lines[0].startswith("step 1 ")
    train(shards, shards, config, tmp_path / "deep" / "a.ckpt", on_line=lines.append)
    assert lines[1].startswith("step 2 ")
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.ckpt"]


def test_training_learns(folder: Path, tmp_path: Path, small: None) -> None:
    """Twelve steps on two pictures: better than an untrained network on most of what is asked."""
    shards = FewShards([folder])
    config = PerceptionConfig(steps=12, batch=4, warmup=2, large_share=1.0)
    train(shards, shards, config, tmp_path / "a.ckpt")
    batch = shards.plain((), (64, 96))
    torch.manual_seed(config.seed)
    fresh, trained = RoomNetwork().eval(), read_average(tmp_path / "a.ckpt")
    with torch.no_grad():
        before, after = (losses(network(batch.picture), batch) for network in (fresh, trained))
    assert sum(map(float, after.values())) < 0.8 * sum(map(float, before.values()))


def test_the_returned_average_is_ready_to_use(folder: Path, tmp_path: Path, small: None) -> None:
    """Asked twice, of other pictures in between, it says the same: its running statistics stand still."""
    shards = FewShards([folder])
    average = train(shards, shards, PerceptionConfig(steps=1, batch=2), tmp_path / "a.ckpt")
    picture = torch.full((1, 3, 32, 32), 100.0)
    with torch.no_grad():
        first = average(picture).disparity
        average(shards.plain((), (64, 96)).picture)
        torch.testing.assert_close(average(picture).disparity, first)


def test_far_depth_counts_by_its_relative_error() -> None:
    """A far quarter seen at half its distance costs, though its disparity is off by a twentieth only."""
    truth = torch.full((1, 40, 40), 1.0)
    truth[:, :10], truth[:, 10:20], truth[:, 20:30] = 0.05, 0.1, 0.5
    far = truth.clone()
    far[:, :10] *= 2
    assert float(relative_loss(truth, truth)) == pytest.approx(0.0, abs=1e-6)
    assert float(relative_loss(far, truth)) > 0.05


def test_each_piece_counts_by_how_far_off_it_is_on_the_mean() -> None:
    """Two pieces of furniture before a wall with a step: one twice as far as it is, one with errors that cancel."""
    truth = torch.full((1, 20, 40), 0.2)
    truth[:, :, 20:] = 0.5
    instance = torch.zeros(1, 20, 40, dtype=torch.long)
    instance[:, 4:8, 4:8], instance[:, 10:12, 10:14] = 1, 2
    seen = truth.clone()
    assert float(distance_loss(seen, truth, instance)) == pytest.approx(0.0, abs=1e-6)
    seen[:, 10:12, 10:12], seen[:, 10:12, 12:14] = 0.21, 0.2**2 / 0.21
    assert float(distance_loss(seen, truth, instance)) < 0.005
    seen[:, 4:8, 4:8] = 0.1
    # The alignment takes up little of it.
    assert float(distance_loss(seen, truth, instance)) == pytest.approx(0.5 * np.log(2), rel=0.1)
    assert float(distance_loss(seen, truth, 0 * instance)) == 0.0


def test_a_small_area_costs_as_much_as_a_large_one() -> None:
    classes = torch.zeros(1, 40, 40, dtype=torch.long)
    classes[:, :2, :2] = 1
    sure = 40 * torch.nn.functional.one_hot(classes, 6).permute(0, 3, 1, 2).float()
    missed = 40 * torch.nn.functional.one_hot(0 * classes, 6).permute(0, 3, 1, 2).float()
    assert float(overlap_loss(sure, classes)) == pytest.approx(0.0, abs=1e-5)
    assert float(overlap_loss(missed, classes)) == pytest.approx(0.5, abs=0.01), "one of two classes is missed"
