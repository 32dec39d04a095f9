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
from scenemi.training.joiner import (
    JoinerBatches,
    JoinerPool,
    holds_joiner,
    load_joiner,
    save_joiner,
    train_joiner,
)
from video2anim.errors import InputError

LEARNING = replace(
    CONFIG, joiner_steps=150, joiner_batch=16, joiner_rate=3e-3, noisy_share=0.0,
    model=replace(CONFIG.model, joiners=1, joiner_width=64),
)  # fmt: skip


def test_a_trained_joiner_is_nearer_to_seen_motion_than_interpolation(
    motions: MotionSet, statistics: Statistics
) -> None:
    pool = JoinerPool.draw(motions, statistics, LEARNING)
    joiner = train_joiner(pool, LEARNING, 0)
    batch = JoinerBatches(pool, LEARNING, 0)[500]
    mask = torch.zeros_like(batch.mask)
    mask[:, ::30] = 1
    base = join_keyframes(batch.x0, mask)
    with torch.no_grad():
        made = base + joiner(batch.x0, mask, batch.body, batch.noise_level)
    assert float((made - batch.x0)[..., 135:].norm()) < 0.8 * float((base - batch.x0)[..., 135:].norm())


def test_a_step_is_drawn_alike_and_differs_between_members(motions: MotionSet, statistics: Statistics) -> None:
    config = replace(CONFIG, model=replace(CONFIG.model, joiners=2))
    pool = JoinerPool.draw(motions, statistics, config)
    data = JoinerBatches(pool, config, 0)
    assert torch.equal(data[3].x0, data[3].x0)
    assert data[3].x0.shape[1:] == (121, 201)
    assert not torch.equal(data[3].mask[:1], JoinerBatches(pool, config, 1)[3].mask[:1])


def test_each_member_leaves_its_part_of_the_clips_out(motions: MotionSet, statistics: Statistics) -> None:
    config = replace(CONFIG, model=replace(CONFIG.model, joiners=2))
    part = parts_of(motions.store.clip_name, 2)
    assert set(part.tolist()) == {0, 1}
    pool = JoinerPool.draw(motions, statistics, config)
    for k in (0, 1):
        assert set(pool.part[pool.seen_by(k)].tolist()) == {1 - k}
    alone = replace(pool, part=np.zeros_like(pool.part))
    assert len(alone.seen_by(0)) == len(pool.part), "one part alone is not left out"


def test_a_pool_is_drawn_alike_and_its_noise_is_of_one_degree_and_centimeter(
    motions: MotionSet, statistics: Statistics
) -> None:
    pool, again = (JoinerPool.draw(motions, statistics, CONFIG) for _ in range(2))
    assert torch.equal(pool.x0, again.x0)
    assert torch.equal(pool.noise, again.noise)
    assert pool.x0.shape == (CONFIG.joiner_windows, 121, 201)
    measured = pool.noise.float().square().mean((0, 1)).sqrt()
    torch.testing.assert_close(measured[:3], torch.full((3,), 0.01), rtol=0.1, atol=0)
    torch.testing.assert_close(measured, pool.noise_std, rtol=0.4, atol=1e-4)


def test_noisy_keyframes_are_drawn_smoothed(motions: MotionSet, statistics: Statistics) -> None:
    config = replace(CONFIG, noisy_share=1.0, joiner_batch=32)
    pool = JoinerPool.draw(motions, statistics, config)
    batch = JoinerBatches(pool, config, 0)[0]
    rough = JoinerBatches(pool, replace(config, model=replace(config.model, smooth_keyframes=False)), 0)[0]
    at = batch.mask > 0

    def error(keys: torch.Tensor) -> float:
        return float((keys - batch.x0)[at][:, 135:].square().mean())

    assert torch.equal(rough.mask, batch.mask)
    assert 0 < error(batch.keys) < 0.8 * error(rough.keys)


def test_members_come_back_and_know_their_configuration(
    motions: MotionSet, statistics: Statistics, tmp_path: Path
) -> None:
    path = tmp_path / "joiner_0.safetensors"
    assert not holds_joiner(path, CONFIG)
    joiner = train_joiner(JoinerPool.draw(motions, statistics, CONFIG), CONFIG, 0)
    save_joiner(path, joiner, CONFIG)
    assert holds_joiner(path, CONFIG)
    assert not holds_joiner(path, replace(CONFIG, joiner_rate=1.0))
    for name, value in load_joiner(path).items():
        assert torch.equal(value, joiner.state_dict()[name])
    path.write_bytes(b"no")
    assert not holds_joiner(path, CONFIG)
    with pytest.raises(InputError, match="cannot read"):
        load_joiner(path)
