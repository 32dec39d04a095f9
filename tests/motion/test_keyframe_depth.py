"""The depth loss of keyframes against the Chamfer loss of each frame by itself."""

from __future__ import annotations

import numpy as np
import torch

from video2anim.geometry.chamfer import ChamferConfig, ChamferLoss
from video2anim.motion.keyframe_depth import DepthLoss, DepthTarget

HUBER_M = 0.05
COUNTS = ((300, 420), (150, 90), (400, 400))


def targets() -> tuple[DepthTarget, ...]:
    rng = np.random.default_rng(0)
    return tuple(
        DepthTarget(5 * row, rng.normal(0, 0.2, (skin, 3)), rng.normal(0.05, 0.2, (depth, 3)))
        for row, (skin, depth) in enumerate(COUNTS)
    )


def by_frame(shift_m: torch.Tensor) -> torch.Tensor:
    """Mean of each frame's own loss, neighbors looked up now."""
    config = ChamferConfig(huber_m=HUBER_M, trim_ratio=0.1)
    terms = [
        ChamferLoss(target.depth_m, config)(torch.as_tensor(target.visible_m, dtype=torch.float32) + shift)
        for target, shift in zip(targets(), shift_m, strict=True)
    ]
    return torch.stack(terms).mean()


def at_once(loss: DepthLoss, shift_m: torch.Tensor) -> torch.Tensor:
    skin_m = [target.visible_m for target in targets()]
    frame = torch.as_tensor(np.repeat(np.arange(len(skin_m)), [len(points) for points in skin_m]))
    return loss(torch.as_tensor(np.concatenate(skin_m), dtype=torch.float32) + shift_m[frame])


def test_all_frames_at_once_cost_what_they_cost_one_by_one() -> None:
    loss = DepthLoss(targets(), huber_m=HUBER_M)
    for size_m in (0.0, 0.1, 0.02):
        shift_m = torch.as_tensor(np.random.default_rng(1).normal(0, 1, (3, 3)) * size_m, dtype=torch.float32)
        here, there = shift_m.clone().requires_grad_(), shift_m.clone().requires_grad_()
        mine, theirs = at_once(loss, here), by_frame(there)
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-7)
        mine.backward()
        theirs.backward()
        torch.testing.assert_close(here.grad, there.grad, rtol=1e-3, atol=1e-6)


def test_neighbors_are_kept_for_small_moves_and_looked_up_after_large_ones() -> None:
    fresh_m = torch.zeros(3, 3)
    small_m, large_m = fresh_m.clone(), fresh_m.clone()
    small_m[1, 0], large_m[1, 0] = 0.005, 0.05
    loss = DepthLoss(targets(), huber_m=HUBER_M)
    at_once(loss, fresh_m)
    kept = loss._skin.clone()
    at_once(loss, small_m)
    assert torch.equal(loss._skin, kept)
    found = at_once(loss, large_m)
    assert not torch.equal(loss._skin, kept)
    torch.testing.assert_close(found, by_frame(large_m), rtol=1e-4, atol=1e-7)
