"""A training may begin with the file that an earlier one ended with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import helper, numpy_helper
from torch import Tensor

from tests.lab.scene_network.test_export import picture, settled
from video2anim.errors import InputError
from video2anim.lab.scene_network.export import export_onnx
from video2anim.lab.scene_network.network import RoomNetwork
from video2anim.lab.scene_network.restart import averaged, calibrate_normalization, read_exported


@pytest.fixture(scope="module")
def known() -> RoomNetwork:
    """A network whose weights half precision holds exactly."""
    network = settled()
    for weight in network.parameters():
        weight.data.copy_(weight.data.half().float())
    return network


@pytest.fixture(scope="module")
def file(known: RoomNetwork, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("restart") / "room.onnx"
    export_onnx(known, path)
    return path


def pictures() -> Tensor:
    return torch.cat([picture(96, 128, seed) for seed in range(6)])


@torch.no_grad()
def furthest(one: RoomNetwork, other: RoomNetwork) -> float:
    """Largest difference of two networks' answers beside the largest answer, over all outputs."""
    pairs = zip(one(pictures()), other(pictures()), strict=True)
    return max(float((a - b).abs().max() / b.abs().max()) for a, b in pairs)


def test_the_network_of_the_file_answers_as_it_did(known: RoomNetwork, file: Path) -> None:
    """Folding batch normalization rounds to half precision: 1e-2 of an untrained network's largest answer."""
    assert furthest(read_exported(file), known) < 1e-2


def test_calibrated_normalization_keeps_all_outputs(file: Path) -> None:
    network = read_exported(file)
    calibrate_normalization(network, pictures())
    assert furthest(network, read_exported(file)) < 1e-4


def test_training_goes_on_where_it_was(file: Path) -> None:
    """With statistics of the batch, as training uses them: settled, answers stay; not settled, they jump."""
    settled_network, raw = read_exported(file), read_exported(file)
    calibrate_normalization(settled_network, pictures())
    settled_network.train()
    raw.train()
    assert furthest(settled_network, read_exported(file)) < 1e-3
    assert furthest(raw, read_exported(file)) > 0.1


def test_every_weight_is_taken(file: Path) -> None:
    """Nothing stays at what a new network begins with."""
    before = dict(RoomNetwork().named_parameters())
    for name, weight in read_exported(file).named_parameters():
        if weight.ndim > 1:
            assert not torch.equal(weight, before[name]), name


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.onnx"
    graph = helper.make_graph([], "nothing", [], [], [numpy_helper.from_array(np.zeros(3, np.float32), "weight")])
    onnx.save(helper.make_model(graph), str(path))
    with pytest.raises(InputError, match=r"other\.onnx: no weights of the room network") as caught:
        read_exported(path)
    assert "\n" not in str(caught.value)


def test_a_mean_lies_between_its_networks(file: Path) -> None:
    first, second = read_exported(file), read_exported(file)
    for weight in second.parameters():
        weight.data *= 1.25
    center = averaged(first, second, 0.4)
    for mean, one in zip(center.parameters(), first.parameters(), strict=True):
        torch.testing.assert_close(mean, 1.1 * one)
    assert furthest(averaged(first, second, 0.0), first) == 0
    assert furthest(averaged(first, second, 1.0), second) == 0
    with pytest.raises(ValueError, match="share"):
        averaged(first, second, 1.5)
