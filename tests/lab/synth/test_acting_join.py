"""A captured walk goes over into a procedural motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from acting_checks import adult

from scenemi.data.container import MotionArchive
from scenemi.data.retarget import retarget
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import UsageError
from video2anim.lab.synth.acting import act, joined
from video2anim.lab.synth.world import ProceduralMotion
from video2anim.types.skeleton import forward_kinematics

MOTION = Path(__file__).parents[4] / "shared" / "motion"


@pytest.mark.parametrize("kind", ["sit", "pick_up", "walk"])
def test_procedural_motion_after_a_procedural_walk(kind: str) -> None:
    body = adult(0.45)
    walk, procedural = act("walk", body, np.random.default_rng(1)), act(kind, body, np.random.default_rng(2))
    count = 60
    both = joined(walk.translation_m[:count], walk.R_parent_joint[:count], walk.contact[:count], procedural, body)
    np.testing.assert_array_equal(both.translation_m[: count - 1], walk.translation_m[: count - 1])
    _smooth(both, body, count, slide_m=0.0016)
    assert len(both.props) == len(procedural.props)
    for moved, prop in zip(both.props, procedural.props, strict=True):
        assert moved.position_m[1] == prop.position_m[1]
        frame = moved.frames[0]
        before = np.linalg.norm(procedural.translation_m[prop.frames[0]] - np.array(prop.position_m))
        after = np.linalg.norm(both.translation_m[frame] - np.array(moved.position_m))
        assert after == pytest.approx(before, abs=1e-6)


@pytest.mark.skipif(not (MOTION / "cmu.npz").exists(), reason="motion data not next to the repository")
@pytest.mark.parametrize("name", ["cmu38_train_walking_2", "cmu38_train_walking_36"])
def test_procedural_motion_after_a_captured_walk(name: str) -> None:
    body = adult(0.45)
    captured = retarget(MotionArchive.read(MOTION / "cmu.npz").clip(name), body)
    count = min(70, len(captured.translation_m) - 6)
    procedural = act("sit", body, np.random.default_rng(3))
    both = joined(
        captured.translation_m[:count], captured.R_parent_joint[:count], captured.contact[:count], procedural, body
    )
    _smooth(both, body, count, slide_m=0.005)


def _smooth(both: ProceduralMotion, body: ShapedBody, count: int, slide_m: float) -> None:
    joints, _ = forward_kinematics(both.R_parent_joint, both.translation_m, body.rest_joints_m)
    step = np.linalg.norm(np.diff(joints, axis=0), axis=-1)
    touching = both.contact[1:] & both.contact[:-1]
    assert (step * touching)[count - 1 :].max() <= slide_m
    seam = step[count - 2 : count + 5]  # what lies before is the capture's own
    assert np.abs(np.diff(seam, axis=0)).max() < 0.045
    assert joints[..., 1].min() > -0.02


def test_too_short_a_capture_is_refused() -> None:
    body = adult(0.45)
    procedural = act("walk", body, np.random.default_rng(1))
    with pytest.raises(UsageError, match="at least 3 captured frames"):
        joined(procedural.translation_m[:2], procedural.R_parent_joint[:2], procedural.contact[:2], procedural, body)
