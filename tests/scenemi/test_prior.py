"""The interpolation baseline against scipy, and the choice between priors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

import scenemi.model.load
from scenemi.model.load import load_prior
from scenemi.prior import InterpolationPrior, KeyframeWindow, padded
from video2anim.errors import ModelMissingError, UsageError

KEYS = np.array([0, 7, 15, 31, 40])


def window(keys: np.ndarray = KEYS) -> KeyframeWindow:
    rng = np.random.default_rng(5)
    frames = int(keys[-1]) + 1
    rotations = Rotation.random(frames * 22, random_state=5).as_matrix().reshape(frames, 22, 3, 3)
    is_keyframe = np.zeros(frames, dtype=bool)
    is_keyframe[keys] = True
    translation_m = rng.normal(size=(frames, 3))
    rotations[~is_keyframe], translation_m[~is_keyframe] = np.nan, np.nan
    return KeyframeWindow(rotations, translation_m, is_keyframe, np.zeros((22, 3)), 30.0)


def test_rotations_are_scipys_slerp_and_the_root_is_a_cubic_spline() -> None:
    given = window()
    filled = InterpolationPrior().fill(given)
    frames = np.arange(41)
    for joint in (0, 4, 21):
        truth = Slerp(KEYS, Rotation.from_matrix(given.R_parent_joint[KEYS, joint]))(frames).as_matrix()
        np.testing.assert_allclose(filled.R_parent_joint[:, joint], truth, atol=1e-7)
    spline = CubicSpline(KEYS, given.translation_world_m[KEYS])(frames)
    np.testing.assert_allclose(filled.translation_world_m, spline, atol=1e-12)


@pytest.mark.parametrize("keys", [[0], [0, 1], [0, 9], [0, 3, 9]])
def test_keyframes_are_kept_exactly_however_few(keys: list[int]) -> None:
    given = window(np.array(keys))
    filled = InterpolationPrior().fill(given)
    np.testing.assert_array_equal(filled.R_parent_joint[keys], given.R_parent_joint[keys])
    np.testing.assert_array_equal(filled.translation_world_m[keys], given.translation_world_m[keys])
    assert np.isfinite(filled.R_parent_joint).all()


def test_a_window_without_its_ends_or_with_nan_keyframes_is_refused() -> None:
    given = window()
    no_end = given.is_keyframe.copy()
    no_end[-1] = False
    with pytest.raises(ValueError, match="first and the last"):
        KeyframeWindow(given.R_parent_joint, given.translation_world_m, no_end, given.rest_joints_m, 30.0)
    more = given.is_keyframe.copy()
    more[3] = True
    with pytest.raises(ValueError, match="NaN"):
        KeyframeWindow(given.R_parent_joint, given.translation_world_m, more, given.rest_joints_m, 30.0)


def test_without_weights_auto_is_interpolation_and_scenemi_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenemi.model.load, "WEIGHTS_FOLDER", tmp_path)
    assert load_prior("auto").name == "interpolation"
    assert load_prior("interpolation").name == "interpolation"
    with pytest.raises(ModelMissingError, match="prior scenemi"):
        load_prior("scenemi")
    with pytest.raises(UsageError, match="got 'best'"):
        load_prior("best")  # type: ignore[arg-type]


def test_auto_takes_the_weights_that_ship_and_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of other weights in the folder was enough to choose `scenemi`, which then failed."""
    (tmp_path / "research.safetensors").touch()
    monkeypatch.setattr(scenemi.model.load, "WEIGHTS_FOLDER", tmp_path)
    assert load_prior("auto").name == "interpolation"


def test_a_prior_has_the_seed_it_is_given() -> None:
    assert getattr(load_prior("scenemi", seed=7), "seed", None) == 7


def test_padding_holds_the_last_pose_and_does_not_change_the_rest() -> None:
    given = window()
    longer = padded(given, 121)
    assert longer.is_keyframe[41:].all()
    np.testing.assert_array_equal(longer.R_parent_joint[120], given.R_parent_joint[40])
    filled, filled_longer = InterpolationPrior().fill(given), InterpolationPrior().fill(longer)
    np.testing.assert_allclose(filled_longer.R_parent_joint[:41], filled.R_parent_joint, atol=1e-9)
    with pytest.raises(ValueError, match="more than 40"):
        padded(given, 40)
