"""Numbers that benchmark scripts work out themselves."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from tiny_truth import Tiny

from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types.skeleton import forward_kinematics

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return {name: importlib.import_module(name) for name in ("v2a_bench", "hidden_stretches")}


def test_paired_interval(scripts: dict[str, ModuleType]) -> None:
    found = scripts["v2a_bench"].paired_interval([-1.0, -2.0, -3.0, -2.0])
    assert found["mean"] == -2.0
    assert -3.0 <= found["low"] < -2.0 < found["high"] <= -1.0
    assert scripts["v2a_bench"].paired_interval([0.5, 0.5]) == {"mean": 0.5, "low": 0.5, "high": 0.5}


def test_error_after_alignment_by_two_frames(scripts: dict[str, ModuleType]) -> None:
    rng = np.random.default_rng(0)
    true_m = rng.normal(size=(6, 22, 3))
    R = matrix_from_axis_angle(np.array([0.1, 0.7, -0.2]))
    moved_m = 1.2 * true_m @ R.T + np.array([1.0, 2.0, 3.0])
    assert scripts["hidden_stretches"].w_mpjpe_after(moved_m, true_m) == pytest.approx(0.0, abs=1e-9)
    off_m = true_m.copy()
    off_m[2:] += np.array([0.1, 0.0, 0.0])
    assert scripts["hidden_stretches"].w_mpjpe_after(off_m, true_m) == pytest.approx(0.1)


def test_interpolation_keeps_the_ends_and_moves_evenly(scripts: dict[str, ModuleType], tiny: Tiny) -> None:
    walked = tiny.people[0]
    made = scripts["hidden_stretches"].interpolated(walked, 2, 6)
    np.testing.assert_allclose(made.joints_world_m[[0, 2, 6]], walked.joints_world_m[[0, 2, 6]], atol=1e-9)
    steps_m = np.diff(made.T_world_root[2:7, :3, 3], axis=0)
    np.testing.assert_allclose(steps_m, steps_m[[0]].repeat(4, 0), atol=1e-9)
    joints_m, _ = forward_kinematics(made.R_parent_joint, made.T_world_root[:, :3, 3], made.rest_joints_m)
    np.testing.assert_allclose(made.joints_world_m, joints_m, atol=1e-9)
