"""Laws of rotations, for numpy and torch alike."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from video2anim.geometry import rotations as r

settings.register_profile("laws", max_examples=60, deadline=None, derandomize=True)
settings.load_profile("laws")

COMPONENT = st.floats(-1, 1, allow_subnormal=False)
ANGLES = st.one_of(
    st.floats(0, np.pi), st.sampled_from([0.0, 1e-12, 1e-7, 1e-4, np.pi / 2, np.pi - 1e-4, np.pi - 1e-7, np.pi])
)
SHAPES = [(), (5,), (2, 3)]


@st.composite
def rotation_vectors(draw: st.DrawFn) -> np.ndarray:
    axis = np.array([draw(COMPONENT), draw(COMPONENT), draw(COMPONENT)])
    length = np.linalg.norm(axis)
    axis = axis / length if length > 1e-3 else np.array([0.0, 1.0, 0.0])
    return axis * draw(ANGLES)


def random_vectors(shape: tuple[int, ...], seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.7, 1.7, (*shape, 3))


@given(rotation_vectors())
def test_matrices_are_rotations_and_agree_with_scipy(vector: np.ndarray) -> None:
    R = r.matrix_from_axis_angle(vector)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(R, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)


@given(rotation_vectors())
def test_all_forms_make_the_round_trip(vector: np.ndarray) -> None:
    R = r.matrix_from_axis_angle(vector)
    q = r.quaternion_from_matrix(R)
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-12)
    assert q[0] >= 0
    np.testing.assert_allclose(r.matrix_from_quaternion(q), R, atol=1e-10)
    np.testing.assert_allclose(r.matrix_from_rot6d(r.rot6d_from_matrix(R)), R, atol=1e-10)
    again = r.axis_angle_from_matrix(R)
    assert np.linalg.norm(again) <= np.pi + 1e-9
    np.testing.assert_allclose(r.matrix_from_axis_angle(again), R, atol=1e-10)
    if np.linalg.norm(vector) < np.pi - 1e-3:
        np.testing.assert_allclose(again, vector, atol=1e-9)


@given(rotation_vectors(), st.floats(0.01, 100))
def test_quaternions_of_any_length_and_either_sign_mean_the_same(vector: np.ndarray, length: float) -> None:
    q = r.quaternion_from_matrix(r.matrix_from_axis_angle(vector))
    np.testing.assert_allclose(r.matrix_from_quaternion(-length * q), r.matrix_from_quaternion(q), atol=1e-12)


@given(rotation_vectors(), rotation_vectors())
def test_group_laws(a: np.ndarray, b: np.ndarray) -> None:
    A, B = r.matrix_from_axis_angle(a), r.matrix_from_axis_angle(b)
    np.testing.assert_allclose(r.matrix_from_axis_angle(-a), A.T, atol=1e-12)
    AB = r.matrix_from_quaternion(r.quaternion_from_matrix(A @ B))
    np.testing.assert_allclose(AB, A @ B, atol=1e-10)
    np.testing.assert_allclose((A @ B).T, B.T @ A.T, atol=1e-12)


@given(rotation_vectors(), rotation_vectors(), st.floats(0, 1))
def test_slerp_goes_the_short_way_at_even_speed(a: np.ndarray, b: np.ndarray, weight: float) -> None:
    qa, qb = (r.quaternion_from_matrix(r.matrix_from_axis_angle(v)) for v in (a, b))
    q = r.slerp(qa, qb, np.array([weight]))
    between = 2 * np.arccos(np.clip(abs(qa @ qb), 0, 1))
    gone = 2 * np.arccos(np.clip(abs(qa @ q), 0, 1))
    assert gone == pytest.approx(weight * between, abs=2e-4)
    np.testing.assert_allclose(abs(r.slerp(qa, -qb, np.array([weight])) @ q), 1.0, atol=1e-9)
    for end, quaternion in ((0.0, qa), (1.0, qb)):
        np.testing.assert_allclose(abs(r.slerp(qa, qb, np.array([end])) @ quaternion), 1.0, atol=1e-9)


@given(rotation_vectors(), st.floats(0.0, 0.2))
def test_nearest_rotation(vector: np.ndarray, noise: float) -> None:
    R = r.matrix_from_axis_angle(vector)
    bent = R * (1 + noise) + noise * np.ones((3, 3)) * 0.1
    N = r.nearest_rotation(bent)
    np.testing.assert_allclose(N @ N.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(N) == pytest.approx(1.0)
    assert np.linalg.norm(N - bent) <= np.linalg.norm(R - bent) + 1e-12
    np.testing.assert_allclose(r.nearest_rotation(R), R, atol=1e-12)


def test_nearest_rotation_never_mirrors() -> None:
    mirrors = np.stack([np.diag([1.0, 1, -1]), -np.eye(3), np.diag([-1.0, 0.5, 0.2])])
    np.testing.assert_allclose(np.linalg.det(r.nearest_rotation(mirrors)), 1.0)


@given(rotation_vectors(), rotation_vectors())
def test_rotation_between_directions(a: np.ndarray, b: np.ndarray) -> None:
    start, goal = (r.matrix_from_axis_angle(v)[:, 0] for v in (a, b))
    if start @ goal < -0.999:
        return
    R = r.rotation_between(3 * start, 0.5 * goal)
    np.testing.assert_allclose(R @ start, goal, atol=1e-9)
    angle = np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))
    assert angle == pytest.approx(np.arccos(np.clip(start @ goal, -1, 1)), abs=1e-5), "the smallest one"


def test_rotation_between_opposites_is_refused() -> None:
    with pytest.raises(ValueError, match="opposite"):
        r.rotation_between(np.array([0.0, 0, 1]), np.array([0.0, 0, -1]))


def test_continuous_quaternions_keep_the_rotation_and_do_not_jump() -> None:
    angle = np.linspace(0, 6 * np.pi, 80)
    R = r.matrix_from_axis_angle(angle[:, None, None] * np.array([[0, 1.0, 0], [0.6, 0, 0.8]]))
    q = r.continuous_quaternions(r.quaternion_from_matrix(R))
    assert ((q[1:] * q[:-1]).sum(-1) > 0).all()
    np.testing.assert_allclose(r.matrix_from_quaternion(q), R, atol=1e-10)


CONVERSIONS: list[tuple[Callable, tuple[int, ...]]] = [
    (r.matrix_from_axis_angle, (3,)), (r.matrix_from_quaternion, (4,)), (r.quaternion_from_matrix, (3, 3)),
    (r.axis_angle_from_matrix, (3, 3)), (r.matrix_from_rot6d, (6,)), (r.rot6d_from_matrix, (3, 3)),
]  # fmt: skip


def inputs_for(shape: tuple[int, ...], trailing: tuple[int, ...]) -> np.ndarray:
    if trailing == (3, 3):
        return Rotation.from_rotvec(random_vectors(shape).reshape(-1, 3)).as_matrix().reshape(*shape, 3, 3)
    return np.random.default_rng(1).normal(size=(*shape, *trailing))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("function", "trailing"), CONVERSIONS)
def test_leading_axes_and_torch(function: Callable, trailing: tuple[int, ...], shape: tuple[int, ...]) -> None:
    values = inputs_for(shape, trailing)
    result = function(values)
    assert result.shape[: len(shape)] == shape
    one_by_one = [function(v) for v in values.reshape(-1, *trailing)]
    np.testing.assert_allclose(
        result.reshape(len(one_by_one), -1), np.reshape(one_by_one, (len(one_by_one), -1)), atol=1e-12
    )
    tensor = function(torch.from_numpy(np.asarray(values)))
    assert isinstance(tensor, torch.Tensor)
    assert tensor.dtype == torch.float64
    np.testing.assert_allclose(tensor.numpy(), result, atol=1e-12)
    assert function(torch.from_numpy(np.asarray(values)).float()).dtype == torch.float32


@pytest.mark.parametrize("shape", SHAPES)
def test_slerp_leading_axes_and_torch(shape: tuple[int, ...]) -> None:
    a, b = (r.quaternion_from_matrix(r.matrix_from_axis_angle(random_vectors(shape, seed))) for seed in (1, 2))
    weight = np.full((*shape, 1), 0.3)
    result = r.slerp(a, b, weight)
    assert result.shape == (*shape, 4)
    np.testing.assert_allclose(r.slerp(*map(torch.from_numpy, (a, b, weight))).numpy(), result, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1.0, np.pi - 1e-6, np.pi])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_everywhere(angle: float, dtype: torch.dtype) -> None:
    axis = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.0, 0.8]])
    vector = torch.tensor(angle * axis, dtype=dtype, requires_grad=True)
    R = r.matrix_from_axis_angle(vector)
    (R * torch.arange(9.0, dtype=dtype).reshape(3, 3)).sum().backward()
    assert torch.isfinite(vector.grad).all()
    for function in (r.quaternion_from_matrix, r.axis_angle_from_matrix, r.rot6d_from_matrix):
        leaf = R.detach().clone().requires_grad_(True)
        function(leaf).sum().backward()
        assert torch.isfinite(leaf.grad).all(), function.__name__
    six = r.rot6d_from_matrix(R.detach()).clone().requires_grad_(True)
    r.matrix_from_rot6d(six)[..., 0].sum().backward()
    assert torch.isfinite(six.grad).all()


def test_gradient_at_identity_is_the_generator() -> None:
    jacobian = torch.autograd.functional.jacobian(r.matrix_from_axis_angle, torch.zeros(3, dtype=torch.float64))
    generator = np.zeros((3, 3, 3))
    for i, (row, column) in enumerate(((2, 1), (0, 2), (1, 0))):
        generator[row, column, i], generator[column, row, i] = 1.0, -1.0
    np.testing.assert_allclose(jacobian.numpy(), generator, atol=1e-9)
