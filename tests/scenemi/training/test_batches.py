"""Batches: the same whenever drawn, mirrored truly, with the shares of the configuration."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_run import CONFIG, SHARD

from scenemi.data.augment import mirrored as mirrored_motion
from scenemi.data.retarget import RetargetedMotion
from scenemi.data.windows import MotionSet
from scenemi.features import JOINTS, ROTATIONS, encode
from scenemi.model.mirror import mirrored
from scenemi.scene.field import BoxField
from scenemi.training.batches import LOOKED_AT, Batch, PoolBatches
from scenemi.training.noise import PipelineErrors, gaussian, reported_level
from scenemi.training.pool import Shard
from video2anim.errors import InputError
from video2anim.types.skeleton import MIRROR_JOINT

WIDE = replace(CONFIG, batch=400, scene_share=1.0)


def same(a: Batch, b: Batch) -> bool:
    return all(torch.equal(getattr(a, item.name), getattr(b, item.name)) for item in fields(Batch))


def stored(shards: list[Shard]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Features, boxes and telling keyframes of the whole pool."""
    features = np.concatenate([shard.features for shard in shards]) / np.float32(8192.0)
    masks = np.concatenate([np.unpackbits(shard.mask, axis=1)[:, : features.shape[1]] for shard in shards])
    boxes = np.concatenate([shard.boxes for shard in shards])
    return torch.from_numpy(features).float(), torch.from_numpy(boxes), torch.from_numpy(masks).float()


def sources(batch: Batch, shards: list[Shard]) -> tuple[torch.Tensor, torch.Tensor]:
    """Row of the pool of each window, by its middle frame and its boxes, and whether it is mirrored."""
    features, boxes, _ = stored(shards)

    def marks(features: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
        return torch.cat([features[:, 60], boxes.abs().flatten(1)], 1)

    wanted = marks(batch.features, batch.boxes)
    apart = [torch.cdist(wanted, marks(some, boxes), p=torch.inf) for some in (features, mirrored(features))]
    straight, across = (gap.min(1) for gap in apart)
    assert (torch.minimum(straight.values, across.values) < 1e-5).all(), "every window is one of the pool's"
    turned = across.values < straight.values
    return torch.where(turned, across.indices, straight.indices), turned


@pytest.fixture(scope="module")
def errors() -> PipelineErrors:
    """Two runs: one of 200 frames, one of 20."""
    rng = np.random.default_rng(0)
    return PipelineErrors(
        rng.normal(0, 0.1, (220, 22, 3)).astype(np.float16), rng.normal(0, 0.05, (220, 3)).astype(np.float16),
        np.array([0, 200, 220]),
    )  # fmt: skip


def test_a_step_is_the_same_whenever_it_is_drawn(shards: list[Shard], data: PoolBatches) -> None:
    assert same(data[3], data[3])
    assert same(data[3], PoolBatches(shards, CONFIG)[3])
    assert not torch.equal(data[3].diffusion_noise, data[4].diffusion_noise)
    other = PoolBatches(shards, replace(CONFIG, seed=1))[3]
    assert not torch.equal(data[3].diffusion_noise, other.diffusion_noise)


@pytest.mark.parametrize("workers", [1, 3])
def test_batches_made_ahead_come_in_order(data: PoolBatches, workers: int) -> None:
    ahead = list(data.ahead(range(5, 10), workers))
    assert len(ahead) == 5
    assert all(same(batches[0], data[step]) for batches, step in zip(ahead, range(5, 10), strict=True))


def test_a_step_has_its_own_batches(shards: list[Shard]) -> None:
    data = PoolBatches(shards, replace(CONFIG, parts=3))
    assert all(same(a, b) for a, b in zip(data.of_step(4), [data[12], data[13], data[14]], strict=True))


def test_mirroring_twice_changes_nothing() -> None:
    x = torch.randn(2, 5, 201, generator=torch.Generator().manual_seed(0))
    assert torch.equal(mirrored(mirrored(x)), x)
    assert not torch.allclose(mirrored(x), x)


def test_mirrored_features_are_those_of_the_mirrored_motion(motions: MotionSet) -> None:
    window = motions.one(next(motions.fixed_windows(batch=1)), 0)
    motion = RetargetedMotion(
        window.translation_m.astype(float), window.R_parent_joint.astype(float), window.contact, window.name,
        window.kind, window.source,
    )  # fmt: skip
    across = mirrored_motion(motion)
    rest_m = motions.rest_joints_m[0].astype(float)
    rest_m = 0.5 * (rest_m + rest_m[MIRROR_JOINT] * [-1, 1, 1])  # a body whose sides are alike
    made = mirrored(torch.from_numpy(encode(motion.R_parent_joint, motion.translation_m, rest_m)).float())
    true = torch.from_numpy(encode(across.R_parent_joint, across.translation_m, rest_m)).float()
    torch.testing.assert_close(made, true, atol=1e-5, rtol=0)


def test_mirrored_boxes_keep_their_distances_to_the_joints(shards: list[Shard]) -> None:
    batch = PoolBatches(shards, replace(WIDE, batch=64))[0]
    row, turned = sources(batch, shards)
    assert 0.2 < turned.float().mean() < 0.8
    features, boxes, _ = stored(shards)
    every = torch.ones(len(row))

    def distances(values: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
        joints = values[:, ::10, JOINTS].unflatten(-1, (22, 3))
        field = BoxField.of(boxes, every)
        return field.query(joints.flatten(1, 2))[0].unflatten(1, (-1, 22))

    before, after = distances(features[row], boxes[row]), distances(batch.features, batch.boxes)
    across = after[turned][..., torch.from_numpy(MIRROR_JOINT)]
    torch.testing.assert_close(after[~turned], before[~turned], atol=1e-6, rtol=0)
    torch.testing.assert_close(across, before[turned], atol=1e-5, rtol=0)
    assert (before < 0.5).any()


def test_held_frames_are_given_and_do_not_count(shards: list[Shard]) -> None:
    short = [replace(shard, valid_frames=np.full(SHARD, 80, np.uint8)) for shard in shards]
    batch = PoolBatches(short, CONFIG)[0]
    assert batch.valid[:, :80].all()
    assert not batch.valid[:, 80:].any()
    assert batch.mask[:, 80:].all()
    assert not batch.mask[:, :80].all()


def test_the_first_and_the_last_frame_are_always_given(data: PoolBatches) -> None:
    for step in range(5):
        assert data[step].mask[:, [0, -1]].all()


def test_most_shown_scenes_come_with_the_keyframes_that_they_tell_of(shards: list[Shard]) -> None:
    batch = PoolBatches(shards, WIDE)[0]
    own = stored(shards)[2][sources(batch, shards)[0]]
    telling = (batch.mask == own).all(1)
    solid = batch.boxes[:, 0, 3] > 0
    assert telling[solid].float().mean() == pytest.approx(0.7, abs=0.1)
    assert telling[~solid].float().mean() < 0.1, "a bare floor tells nothing"
    blind = PoolBatches(shards, replace(WIDE, keyframes="paper"))[0]
    assert (blind.mask == stored(shards)[2][sources(blind, shards)[0]]).all(1).float().mean() < 0.1


def test_scenes_are_shown_as_often_as_the_configuration_says(shards: list[Shard]) -> None:
    batch = PoolBatches(shards, replace(WIDE, scene_share=0.5))[0]
    assert batch.scene_known.mean() == pytest.approx(0.5, abs=0.1)
    shown = batch.boxes[batch.scene_known > 0][:, 0, 3] > 0
    assert shown.any()
    assert not shown.all(), "some show nothing but the floor"
    assert not PoolBatches(shards, replace(WIDE, scene_share=0.0))[0].scene_known.any()


def test_the_papers_form_hides_the_global_or_the_local_part(shards: list[Shard]) -> None:
    batch = PoolBatches(shards, replace(WIDE, keyframes="paper", drop_global=0.3, drop_local=0.2))[0]
    filled = batch.boxes[:, 0, 3] > 0
    seen = torch.stack([batch.scene_known, batch.local_known], 1)[filled]
    assert (seen.sum(1) >= 1).all(), "never both"
    assert (1 - seen[:, 0]).mean() == pytest.approx(0.3, abs=0.08)
    assert (1 - seen[:, 1]).mean() == pytest.approx(0.2, abs=0.08)


def test_noise_is_as_large_as_the_model_is_told(shards: list[Shard]) -> None:
    batch = PoolBatches(shards, replace(WIDE, batch=60, noisy_share=0.5))[0]
    assert len(batch.noisy) == pytest.approx(30, abs=12)
    others = torch.ones(60, dtype=torch.bool).index_fill(0, batch.noisy, False)
    assert not batch.noise[others].any()
    told = batch.noise[batch.noisy][:, 0]
    assert (batch.noise[batch.noisy] == told[:, None]).all()
    assert ((told > 0) & (told < 1)).all()
    assert torch.equal(told[:, 0], told[:, 1]), "the paper's l is degrees and centimeters"
    degrees = batch.turn_rad.square().mean((1, 2, 3)).sqrt().rad2deg()
    torch.testing.assert_close(degrees, told[:, 0], rtol=0.06, atol=0)
    torch.testing.assert_close(100 * batch.shift_m.square().mean((1, 2)).sqrt(), told[:, 1], rtol=0.25, atol=0)
    assert len(PoolBatches(shards, replace(WIDE, noisy_share=0.0))[0].noisy) == 0
    assert len(PoolBatches(shards, replace(CONFIG, noisy_share=1.0, keyframes="paper"))[0].noisy) == CONFIG.batch


def test_steps_and_pieces_looked_at_lie_in_their_ranges(shards: list[Shard]) -> None:
    batch = PoolBatches(shards, WIDE)[0]
    assert batch.step.min() >= 1
    assert batch.step.max() <= 1000
    first = batch.step == 1000
    assert float(first.float().mean()) == pytest.approx(WIDE.first_step_share, abs=0.08)
    assert float(batch.step[~first].float().mean()) == pytest.approx(500, abs=80)
    assert not (PoolBatches(shards, replace(WIDE, first_step_share=0.0))[0].step == 1000).float().mean() > 0.05
    assert batch.looked_at.min() >= 0
    assert batch.looked_at.max() == 121 - LOOKED_AT
    flags = [float(PoolBatches(shards, CONFIG)[step].condition_on_estimate) for step in range(40)]
    assert 0.2 < np.mean(flags) < 0.8


def test_shards_that_come_later_are_drawn_from_too(shards: list[Shard]) -> None:
    data = PoolBatches(shards[:1], replace(WIDE, batch=64))
    assert (sources(data[0], shards)[0] < SHARD).all()
    data.take(shards)
    row, _ = sources(data[0], shards)
    assert (row < SHARD).any()
    assert (row >= SHARD).any()


def test_errors_of_the_pipeline_take_their_share(shards: list[Shard], errors: PipelineErrors) -> None:
    config = replace(WIDE, batch=200, pipeline_share=0.5, noisy_share=0.0)
    assert len(PoolBatches(shards, config)[0].noisy) == 0, "without errors there are none"
    batch = PoolBatches(shards, config, errors)[0]
    assert len(batch.noisy) == pytest.approx(100, abs=30)
    assert batch.turn_rad.shape[0] == len(batch.noisy)
    degrees = batch.turn_rad.square().mean((1, 2, 3)).sqrt().rad2deg()
    told = batch.noise[batch.noisy][:, 0, 0]
    ratio = (told / degrees).log()
    assert ratio.mean() == pytest.approx(0, abs=0.1)
    assert 0.1 < ratio.std() < 0.4, "an estimator does not know its own error exactly"
    assert batch.mask[batch.noisy].sum(1).float().mean() > 40, "observed windows have many keyframes"


def test_drawn_errors_are_recorded_ones_turned_about_the_vertical(errors: PipelineErrors) -> None:
    rng = np.random.default_rng(1)
    begins = set()
    for _ in range(30):
        turn_rad, shift_m = errors.draw(rng, 121)
        assert turn_rad.shape == (121, 22, 3)
        assert shift_m.shape == (121, 3)
        np.testing.assert_allclose(shift_m[0, [0, 2]], 0.0, atol=1e-6)
        recorded = errors.turn_rad.astype(np.float32)
        # One size for a window: its ratio to the recorded frame that it begins with.
        along = (recorded * turn_rad[0]).sum((1, 2)) / np.square(recorded).sum((1, 2))
        frame = int(np.abs(along[:, None, None] * recorded - turn_rad[0]).sum((1, 2)).argmin())
        begins.add(frame < 200)
        size = along[frame]
        assert 0.4 <= size <= 1.3
        np.testing.assert_allclose(turn_rad[1], size * recorded[frame + 1], atol=1e-5)
        moved = errors.shift_m.astype(np.float32)[frame + 1] - errors.shift_m.astype(np.float32)[frame]
        made = (shift_m[1] - shift_m[0]) / size
        assert np.hypot(made[0], made[2]) == pytest.approx(np.hypot(moved[0], moved[2]), rel=1e-3)
        assert made[1] == pytest.approx(moved[1], abs=1e-5)
    assert begins == {True, False}, "short runs are drawn too"


def test_a_short_run_goes_back_and_forth(errors: PipelineErrors) -> None:
    short = PipelineErrors(errors.turn_rad[200:], errors.shift_m[200:], np.array([0, 20]))
    turn_rad, shift_m = short.draw(np.random.default_rng(0), 121)
    assert np.isfinite(turn_rad).all()
    jumps = np.abs(np.diff(shift_m, axis=0)).max()
    assert jumps < 2 * np.abs(np.diff(short.shift_m.astype(float), axis=0)).max()
    alone = PipelineErrors(errors.turn_rad[:1], errors.shift_m[:1], np.array([0, 1]))
    turn_rad, _ = alone.draw(np.random.default_rng(0), 121)
    assert np.ptp(turn_rad, axis=0).max() == 0


def test_told_noise_is_about_the_true_one() -> None:
    rng = np.random.default_rng(0)
    turn_rad, shift_m = gaussian(rng, 200, 0.8)
    told = np.array([reported_level(rng, turn_rad, shift_m) for _ in range(300)])
    np.testing.assert_allclose(np.exp(np.log(told).mean(0)), 0.8, rtol=0.12)
    assert (np.log(told).std(0) > 0.15).all()


def test_errors_come_from_a_file(errors: PipelineErrors, tmp_path: Path) -> None:
    path = tmp_path / "errors.npz"
    with pytest.raises(InputError, match=r"errors\.npz"):
        PipelineErrors.read(path)
    np.savez(path, turn_rad=errors.turn_rad, shift_m=errors.shift_m, start=errors.start)
    np.testing.assert_array_equal(PipelineErrors.read(path).shift_m, errors.shift_m)
    np.savez(path, turn_rad=errors.turn_rad)
    with pytest.raises(InputError, match="not a file of pipeline errors"):
        PipelineErrors.read(path)


def test_stored_values_come_back_in_meters(shards: list[Shard], data: PoolBatches) -> None:
    batch = data[0]
    first = batch.features[:, 0]
    assert first[:, 0].abs().max() < 1e-3, "the canonical frame begins below the root"
    assert first[:, 2].abs().max() < 1e-3
    assert ((first[:, 1] > 0.3) & (first[:, 1] < 1.3)).all(), "hips of somebody who stands or sits"
    columns = batch.features[..., ROTATIONS].unflatten(-1, (22, 2, 3)).norm(dim=-1)
    torch.testing.assert_close(columns, torch.ones_like(columns), atol=1e-3, rtol=0)
