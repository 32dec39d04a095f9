from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_run import CONFIG

from scenemi.data.windows import MotionSet
from scenemi.features import Statistics
from scenemi.model.base import join_keyframes
from scenemi.training.batches import parts_of
from scenemi.training.joiner import JoinerBatches, holds_joiner, load_joiner, save_joiner, train_joiner
from video2anim.errors import InputError

LEARNING = replace(
    CONFIG, joiner_steps=150, joiner_batch=16, joiner_rate=3e-3, noisy_share=0.0,
    model=replace(CONFIG.model, joiners=1, joiner_width=64),
)  # fmt: skip


def test_a_trained_joiner_is_nearer_to_seen_motion_than_interpolation(
    motions: MotionSet, statistics: Statistics
) -> None:
    joiner = train_joiner(motions, statistics, LEARNING, 0)
    batch = JoinerBatches(motions, statistics, LEARNING, 0)[500]
    mask = torch.zeros_like(batch.mask)
    mask[:, ::30] = 1
    base = join_keyframes(batch.x0, mask)
    with torch.no_grad():
        made = base + joiner(batch.x0, mask, batch.body, batch.noise_level)
    assert float((made - batch.x0)[..., 135:].norm()) < 0.8 * float((base - batch.x0)[..., 135:].norm())


def test_a_step_is_drawn_alike_and_differs_between_members(motions: MotionSet, statistics: Statistics) -> None:
    config = replace(CONFIG, model=replace(CONFIG.model, joiners=2))
    data = JoinerBatches(motions, statistics, config, 0)
    assert torch.equal(data[3].x0, data[3].x0)
    assert data[3].x0.shape[1:] == (121, 201)
    assert not torch.equal(data[3].mask[:1], JoinerBatches(motions, statistics, config, 1)[3].mask[:1])


def test_each_member_leaves_its_part_of_the_clips_out(motions: MotionSet, statistics: Statistics) -> None:
    config = replace(CONFIG, model=replace(CONFIG.model, joiners=2))
    part = parts_of(motions.store.clip_name, 2)
    assert set(part.tolist()) == {0, 1}
    for k in (0, 1):
        assert np.array_equal(JoinerBatches(motions, statistics, config, k).seen, part != k)


def test_members_come_back_and_know_their_configuration(
    motions: MotionSet, statistics: Statistics, tmp_path: Path
) -> None:
    path = tmp_path / "joiner_0.safetensors"
    assert not holds_joiner(path, CONFIG)
    joiner = train_joiner(motions, statistics, CONFIG, 0)
    save_joiner(path, joiner, CONFIG)
    assert holds_joiner(path, CONFIG)
    assert not holds_joiner(path, replace(CONFIG, joiner_rate=1.0))
    for name, value in load_joiner(path).items():
        assert torch.equal(value, joiner.state_dict()[name])
    path.write_bytes(b"no")
    assert not holds_joiner(path, CONFIG)
    with pytest.raises(InputError, match="cannot read"):
        load_joiner(path)
