"""Frechet distance and the features it is taken of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import sqrtm

from scenemi.evaluation.fid import shipped_features
from scenemi.evaluation.frechet import frechet_distance, gaussian_distance
from scenemi.evaluation.motion_autoencoder import (
    AutoencoderConfig,
    FidFeatures,
    MotionAutoencoder,
    from_tensors,
    motion_channels,
    to_tensors,
)
from scenemi.evaluation.windows import EvaluationWindow, with_noise
from scenemi.prior import WindowMotion
from video2anim.errors import InputError, ModelMissingError
from video2anim.geometry.rotations import matrix_from_axis_angle

Windows = tuple[EvaluationWindow, ...]


def test_distance_of_axis_aligned_gaussians_is_the_closed_form() -> None:
    deviation_a, deviation_b, shift = np.array([1.0, 2.0, 0.5]), np.array([3.0, 1.0, 0.5]), np.array([1.0, -2.0, 0.0])
    found = gaussian_distance(np.zeros(3), np.diag(deviation_a**2), shift, np.diag(deviation_b**2))
    assert found == pytest.approx((shift**2).sum() + ((deviation_a - deviation_b) ** 2).sum(), rel=1e-9)


def test_distance_of_any_gaussians_is_that_of_the_matrix_square_root() -> None:
    rng = np.random.default_rng(0)
    a, b = (m @ m.T for m in rng.normal(size=(2, 6, 6)))
    expected = np.trace(a + b - 2 * np.real(sqrtm(a @ b)))
    assert gaussian_distance(np.zeros(6), a, np.zeros(6), b) == pytest.approx(float(expected), rel=1e-6)


def test_distance_to_itself_is_zero_also_with_fewer_samples_than_features() -> None:
    few = np.random.default_rng(1).normal(size=(5, 12))
    assert frechet_distance(few, few) == pytest.approx(0.0, abs=1e-6)


def test_distance_of_samples_tends_to_that_of_their_laws() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.normal(0, 1, (40_000, 3)), rng.normal(0.5, 2, (40_000, 3))
    assert frechet_distance(a, b) == pytest.approx(3 * (0.25 + 1.0), rel=0.03)
    assert frechet_distance(a, b) == pytest.approx(frechet_distance(b, a), rel=1e-9)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (np.zeros((1, 3)), np.zeros((4, 3))),
        (np.zeros((4, 3)), np.zeros((4, 2))),
        (np.full((4, 3), np.nan), np.zeros((4, 3))),
    ],
)
def test_sets_without_a_distance_are_refused(a: np.ndarray, b: np.ndarray) -> None:
    with pytest.raises(ValueError, match="frechet_distance"):
        frechet_distance(a, b)


def test_features_do_not_depend_on_place_and_heading(windows: Windows) -> None:
    window = windows[0]
    R_world_old = matrix_from_axis_angle(np.array([0.0, 1.3, 0.0]))
    turned = window.R_parent_joint.copy()
    turned[:, 0] = R_world_old @ turned[:, 0]
    there = motion_channels(turned, window.translation_m @ R_world_old.T + [5.0, 0.0, 1.0], window.body.rest_joints_m)
    here = motion_channels(window.R_parent_joint, window.translation_m, window.body.rest_joints_m)
    np.testing.assert_allclose(there, here, atol=1e-5)


def test_encoder_survives_its_file(windows: Windows) -> None:
    model = MotionAutoencoder(AutoencoderConfig(width=8, code=4)).eval()
    back = from_tensors(*to_tensors(model, {}))
    rest_m = windows[0].body.rest_joints_m
    motions = [WindowMotion(window.R_parent_joint, window.translation_m) for window in windows]
    # fp16 weights
    np.testing.assert_allclose(FidFeatures(back, rest_m)(motions), FidFeatures(model, rest_m)(motions), atol=5e-3)
    arrays, text = to_tensors(model, {})
    with pytest.raises(InputError, match="want format"):
        from_tensors(arrays, {**text, "format": "something"})
    arrays.pop("encoder.0.weight")
    with pytest.raises(InputError, match="do not fit"):
        from_tensors(arrays, text)


def test_windows_of_another_length_are_refused(windows: Windows) -> None:
    features = FidFeatures(MotionAutoencoder(AutoencoderConfig(width=8, code=4)), windows[0].body.rest_joints_m)
    with pytest.raises(InputError, match="want windows of 121 frames, got 60"):
        features([WindowMotion(windows[0].R_parent_joint[:60], windows[0].translation_m[:60])])


def test_shipped_features_see_more_noise_as_farther_away(windows: Windows) -> None:
    features = shipped_features()
    true = features([WindowMotion(window.R_parent_joint, window.translation_m) for window in windows])
    distances = []
    for level in (2.0, 8.0, 30.0):
        rng = np.random.default_rng(0)
        noisy = [with_noise(window.R_parent_joint, window.translation_m, level, rng) for window in windows]
        distances.append(frechet_distance(true, features([WindowMotion(*motion) for motion in noisy])))
    assert 0 < distances[0] < distances[1] < distances[2]


def test_only_the_shipped_file_is_accepted(tmp_path: Path) -> None:
    with pytest.raises(ModelMissingError, match="no file"):
        shipped_features(tmp_path / "features.safetensors")
    (tmp_path / "other.safetensors").write_bytes(b"not these")
    with pytest.raises(ModelMissingError, match="has digest"):
        shipped_features(tmp_path / "other.safetensors")
