"""Baselines train as the package's own model does, from the same pool, and learn what they are shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_run import CONFIG

from scenemi.data.windows import MotionSet
from scenemi.features import decode, encode, to_canonical
from scenemi.model.baselines.build import BASELINES
from scenemi.model.choice import load_prior_by_name
from scenemi.model.config import SIZES, BaselineConfig, Method
from scenemi.prior import KeyframeWindow
from scenemi.training.batches import PoolBatches
from scenemi.training.config import METHODS, TrainConfig
from scenemi.training.loop import train
from scenemi.training.pool import Shard
from scenemi.training.run import Run
from scenemi.training.runs import write_run_weights
from scenemi.training.validate import Validator
from video2anim.errors import UsageError
from video2anim.types.skeleton import forward_kinematics

FRAMES, INTERVAL = 31, 15
FIRST = 45
"""Of the second of each clip that is learned."""
STEPS: dict[Method, int] = {
    "mdm": 250, "stablemofusion": 150, "scenediffuser": 400, "wang2021": 100, "omnicontrol": 150, "condmdi": 150,
}  # fmt: skip
"""After which the error is about half of the bound or less, with either of two seeds (one for `wang2021`)."""


def test_a_baseline_has_the_budget_of_the_run_and_the_objective_of_the_paper() -> None:
    plain = TrainConfig()
    for method in METHODS:
        found = plain.of_method(method)
        assert isinstance(found.model, BaselineConfig)
        assert found.model.method == method
        assert TrainConfig.from_json(found.to_json()) == found
        for name in ("batch", "parts", "learning_rate", "seed", "bodies", "keyframes", "scene_share", "pool_windows"):
            assert getattr(found, name) == getattr(plain, name), name
        assert not found.relative
        assert (found.noisy_share, found.first_step_share) == (0.0, 0.0)
    with pytest.raises(UsageError, match=r"want mdm, .*, got gan"):
        plain.of_method("gan")
    with pytest.raises(UsageError, match="shipped form"):
        replace(plain, model=SIZES["paper"]).of_method("mdm")


@pytest.mark.parametrize("method", METHODS)
def test_every_part_of_a_baseline_learns(method: str, motions: MotionSet, shards: list[Shard]) -> None:
    """The same batch a few times: the loss falls, and every part of the network gets a gradient."""
    config = replace(CONFIG, scene_share=1.0, warmup=1).of_method(method)
    run = Run(config, [motions.body(0)], shards, "cpu", None)
    batch = PoolBatches(shards, config)[1]
    assert batch.scene_known.any()
    losses = [float(run.advance([batch])[0].total) for _ in range(12)]
    assert np.isfinite(losses).all()
    assert min(losses[-3:]) < losses[0]
    still = {
        name.split(".")[0] for name, value in run.model.named_parameters() if value.grad is None or not value.grad.any()
    }
    # All windows show their scene, and the paper's network at keyframes has no use here.
    assert still <= {"no_scene", "local"}


@pytest.mark.usefixtures("small_shards")
def test_a_run_of_a_baseline_resumes(motions: MotionSet, run_folder: Callable[[str], Path]) -> None:
    out, config = run_folder("mdm"), replace(CONFIG, validate_every=1).of_method("mdm")
    train(config, motions, out, validation=motions, stop_at=1)
    assert train(config, motions, out, validation=motions, stop_at=2).step == 2


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_tiny_baseline_learns_four_clips_by_heart(
    method: Method, motions: MotionSet, shards: list[Shard], tmp_path: Path
) -> None:
    """A second of each clip, sampled between keyframes half a second apart. Methods that are trained with keyframes
    give back the clip that these are of; the others one of the four, as their keyframes are only laid over it."""
    config = replace(CONFIG, learning_rate=4e-3, warmup=20, scene_share=0.0).of_method(method)
    assert isinstance(config.model, BaselineConfig)
    config = replace(config, model=replace(config.model, window_frames=FRAMES))
    run, rest_m = Run(config, [motions.body(0)], shards, "cpu", None), motions.body(0).rest_joints_m
    R, translation_m = decode(Validator(motions, run.statistics).features.double().numpy())
    R, translation_m = to_canonical(R[:, FIRST : FIRST + FRAMES], translation_m[:, FIRST : FIRST + FRAMES])
    features = torch.from_numpy(encode(R, translation_m, rest_m)).float()
    mask = torch.zeros(4, FRAMES)
    mask[:, ::INTERVAL] = 1
    plain = PoolBatches(shards, config)
    for step in range(STEPS[method]):
        drawn = plain[step]
        run.advance([
            replace(
                drawn, features=features, mask=mask, valid=torch.ones(4, FRAMES), noise=torch.zeros(4, FRAMES, 2),
                diffusion_noise=drawn.diffusion_noise[:, :FRAMES], looked_at=torch.zeros(4, dtype=torch.long),
            )
        ])  # fmt: skip
    prior = load_prior_by_name(str(write_run_weights(tmp_path / "w.safetensors", run.state(), motions)))
    assert prior.name == method
    joints_m = forward_kinematics(R, translation_m, rest_m)[0]
    keys = mask[0].numpy() > 0
    apart_m = np.zeros((4, 4))
    windows = [KeyframeWindow(R[i], translation_m[i], keys, rest_m, 30.0, body=motions.body(0)) for i in range(4)]
    for i, made in enumerate(prior.fill_many(windows, [0] * 4)):
        made_m, _ = forward_kinematics(made.R_parent_joint, made.translation_world_m, rest_m)
        apart_m[i] = np.linalg.norm(made_m - joints_m, axis=-1)[:, ~keys].mean((1, 2))
    between_m = np.linalg.norm(joints_m[:, None] - joints_m, axis=-1).mean((2, 3))
    knows = BASELINES[method].keyframes != "hidden"
    off_m = apart_m.diagonal() if knows else apart_m.min(1)
    assert off_m.mean() < 0.4 * between_m[~np.eye(4, dtype=bool)].mean()
