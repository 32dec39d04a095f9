"""The crop regressor against tiny graphs of its contract, and its numbers against hand computation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from tiny_graphs import constant_graph, save

from video2anim import networks
from video2anim.errors import ModelMissingError
from video2anim.geometry.projection import project
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.networks.body_estimate import (
    BodyEstimate,
    full_frame_translation,
    nearest_rotations,
    square_of_box,
    square_of_roi,
)
from video2anim.networks.hmr2 import Hmr2, to_input
from video2anim.networks.roi import SquareRoi
from video2anim.types.camera import Intrinsics

CAMERA = Intrinsics.centered(1000.0, 1280, 720)  # principal point 639.5, 359.5
SQUARE = np.array([800.0, 500.0, 400.0])
BLACK = np.array([-0.485 / 0.229, -0.456 / 0.224, -0.406 / 0.225])
IMAGE = np.zeros((720, 1280, 3), np.uint8)
FACING = np.diag([1.0, -1.0, -1.0])


def outputs(**changed: np.ndarray) -> dict[str, np.ndarray]:
    """Someone upright who faces the camera; local joint k is turned by 0.1 k about z."""
    turns = np.zeros((23, 3))
    turns[:, 2] = 0.1 * np.arange(1, 24)
    return {
        "global_orient": FACING[None, None],
        "body_pose": matrix_from_axis_angle(turns)[None],
        "betas": np.arange(10.0)[None] / 10,
        "pred_cam": np.array([[0.8, 0.1, -0.2]]),
    } | changed


def net(path: Path, **changed: np.ndarray) -> Hmr2:
    inputs = {"image": [1, 3, 256, 256]}
    return Hmr2(constant_graph(path / "tiny.onnx", inputs=inputs, outputs=outputs(**changed)))


def test_square_holds_the_box_in_its_middle_strip() -> None:
    tall, wide = np.array([100.0, 50, 200, 250]), np.array([0.0, 50, 300, 250])
    np.testing.assert_allclose(square_of_box(tall), [150, 150, 200])
    np.testing.assert_allclose(square_of_box(np.stack([tall, wide]), 1.2), [[150, 150, 240], [150, 150, 480]])
    # The circle of a pose crop is 1 / 1.25 of its side; its turn is dropped.
    np.testing.assert_allclose(square_of_roi(SquareRoi(10, 20, 250, 0.7)), [10, 20, 200])


def test_input_by_hand() -> None:
    image = np.zeros((300, 400, 3), np.uint8)
    image[140, 210] = (255, 0, 127)
    values = to_input(image, np.array([200.0, 150.0, 256.0]))
    assert values.shape == (1, 3, 256, 256)
    assert values.dtype == np.float32
    # The center (200, 150) lies at crop pixel 128; the mark is 10 to the right of it and 10 above.
    expected = [(1.0 - 0.485) / 0.229, (0.0 - 0.456) / 0.224, (127 / 255 - 0.406) / 0.225]
    np.testing.assert_allclose(values[0, :, 118, 138], expected, rtol=1e-5)
    rest = np.delete(values[0].reshape(3, -1), 118 * 256 + 138, axis=1)
    np.testing.assert_allclose(rest, np.tile(BLACK[:, None], (1, rest.shape[1])), rtol=1e-5)


def test_input_is_black_outside_the_picture_and_averaged_inside() -> None:
    image = np.full((256, 256, 3), 255, np.uint8)
    image[::2] = 0  # rows in turn: gray once two of them are one
    values = to_input(image, np.array([256.0, 128.0, 512.0]))
    np.testing.assert_allclose(values[0, :, :, 140], np.tile(BLACK[:, None], (1, 256)), rtol=1e-5)
    np.testing.assert_allclose(values[0, 0, 100, 60], (0.5 - 0.485) / 0.229, atol=0.02)


def test_translation_by_hand() -> None:
    xyz_m = full_frame_translation(np.array([0.8, 0.1, -0.2]), SQUARE, CAMERA)
    # z = 2 * 1000 / (0.8 * 400); x = 0.1 + (800 - 639.5) * z / 1000; y = -0.2 + (500 - 359.5) * z / 1000
    np.testing.assert_allclose(xyz_m, [1.103125, 0.678125, 6.25], rtol=1e-12)
    # Seen in the crop, the point lies s * t_x half sides from the middle: 0.8 * 0.1 * 200 px.
    np.testing.assert_allclose(project(xyz_m, CAMERA), [800 + 16, 500 - 32], rtol=1e-12)


def test_a_camera_without_positive_scale_has_no_translation() -> None:
    cameras = np.array([[0.8, 0.1, -0.2], [0.0, 0, 0], [-1.0, 0, 0], [np.nan, 0, 0]])
    xyz_m = full_frame_translation(cameras, np.tile(SQUARE, (4, 1)), CAMERA)
    np.testing.assert_array_equal(np.isnan(xyz_m).all(-1), [False, True, True, True])


def test_infer_gives_22_joints_in_the_camera(tmp_path: Path) -> None:
    found = net(tmp_path).infer(IMAGE, SQUARE, CAMERA)
    assert found.body_model == "smpl"
    assert found.valid
    assert found.R_parent_joint.shape == (22, 3, 3)
    root = found.R_parent_joint[0]
    np.testing.assert_allclose(root @ [0, 1, 0], [0, -1, 0], atol=1e-6, err_msg="up in the body is up in the picture")
    np.testing.assert_allclose(root @ [0, 0, 1], [0, 0, -1], atol=1e-6, err_msg="the face looks at the camera")
    np.testing.assert_allclose(root @ [1, 0, 0], [1, 0, 0], atol=1e-6, err_msg="its left is the picture's right")
    for joint in range(1, 22):
        angle = 0.1 * joint
        np.testing.assert_allclose(found.R_parent_joint[joint, :2, 0], [np.cos(angle), np.sin(angle)], atol=1e-6)
    np.testing.assert_allclose(found.translation_camera_m, [1.103125, 0.678125, 6.25], rtol=1e-6)
    np.testing.assert_allclose(found.betas, np.arange(10) / 10, rtol=1e-6)


def test_the_network_is_shown_the_crop(tmp_path: Path) -> None:
    """Betas that are ten normalized red values of the middle row."""
    graph = onnx.load(str(constant_graph(tmp_path / "c.onnx", inputs={}, outputs=outputs()))).graph
    nodes = [node for node in graph.node if node.output[0] != "betas"]
    nodes += [
        helper.make_node("Slice", ["image", "starts", "ends"], ["row"]),
        helper.make_node("Reshape", ["row", "shape"], ["betas"]),
    ]
    numbers = {"starts": [0, 0, 128, 128], "ends": [1, 1, 129, 138], "shape": [1, 10]}
    constants = [helper.make_tensor(name, TensorProto.INT64, [len(v)], v) for name, v in numbers.items()]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 256, 256])
    path = save(helper.make_graph(nodes, "echo", [image], list(graph.output), constants), tmp_path / "echo.onnx")
    picture = IMAGE.copy()
    picture[500, 800:810, 0] = np.arange(10) * 20
    found = Hmr2(path).infer(picture, np.array([800.0, 500.0, 256.0]), CAMERA)
    np.testing.assert_allclose(found.betas, (np.arange(10) * 20 / 255 - 0.485) / 0.229, rtol=1e-5)


def test_half_precision_rotations_become_rotations() -> None:
    exact = matrix_from_axis_angle(np.random.default_rng(0).normal(size=(50, 3)))
    found = nearest_rotations(exact.astype(np.float16))
    assert found is not None
    np.testing.assert_allclose(found @ np.swapaxes(found, -1, -2), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(found, exact, atol=2e-3)
    assert nearest_rotations(-exact) is None, "mirrored"


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"body_pose": np.zeros((1, 23, 3, 3))}, "want rotation matrices"),
        ({"global_orient": np.full((1, 1, 3, 3), np.nan)}, "want rotation matrices"),
        ({"body_pose": np.tile(np.eye(3), (1, 21, 1, 1))}, r"want body_pose \(1, 23, 3, 3\), got \(1, 21, 3, 3\)"),
        ({"pred_cam": np.ones((1, 4))}, r"want pred_cam \(1, 3\), got \(1, 4\)"),
    ],
)
def test_other_outputs_are_refused(tmp_path: Path, changed: dict[str, np.ndarray], told: str) -> None:
    with pytest.raises(ModelMissingError, match=told) as caught:
        net(tmp_path, **changed).infer(IMAGE, SQUARE, CAMERA)
    assert "\n" not in str(caught.value)


def test_other_tensors_are_refused(tmp_path: Path) -> None:
    path = constant_graph(tmp_path / "o.onnx", inputs={"imgs": [1, 3, 256, 256]}, outputs=outputs())
    with pytest.raises(ModelMissingError, match=r"want tensors \('image',\).*got \('imgs',\)"):
        Hmr2(path)


def test_a_senseless_camera_is_not_valid(tmp_path: Path) -> None:
    found = net(tmp_path, pred_cam=np.array([[-0.5, 0.0, 0.0]])).infer(IMAGE, SQUARE, CAMERA)
    assert not found.valid
    assert np.isnan(found.translation_camera_m).all()


def test_table_loads_the_users_file(tmp_path: Path) -> None:
    path = constant_graph(tmp_path / "mine.onnx", inputs={"image": [1, 3, 256, 256]}, outputs=outputs())
    assert isinstance(networks.load_model(f"hmr2@{path}"), Hmr2)


def test_estimate_gives_pelvis_and_one_shape() -> None:
    betas = np.zeros((4, 10))
    betas[:, 0] = [1.0, 2.0, 9.0, 100.0]
    valid = np.array([True, True, True, False])
    translation = np.arange(12.0).reshape(4, 3)
    estimate = BodyEstimate("smpl", valid, np.tile(np.eye(3), (4, 22, 1, 1)), translation, betas)
    np.testing.assert_allclose(estimate.pelvis_camera_m(np.array([0.0, -0.2, 0.5]))[1], [3.0, 3.8, 5.5])
    shape = estimate.shape()
    assert shape.model == "smpl"
    assert shape.parameters["beta_0"] == 2.0
    assert list(shape.parameters) == [f"beta_{i}" for i in range(10)]
