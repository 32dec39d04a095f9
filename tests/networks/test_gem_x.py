"""The temporal regressor against tiny graphs of its contract, and its numbers against hand computation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper
from tiny_graphs import constant_graph, save

from video2anim import networks
from video2anim.errors import InputError, ModelMissingError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.networks.gem_x import (
    WINDOW,
    GemSmpl,
    camera_turns,
    coco_keypoints,
    decode,
    track_squares,
    window_starts,
)
from video2anim.types.camera import Intrinsics
from video2anim.types.people import PersonTrack

CAMERA = Intrinsics.centered(1000.0, 1280, 720)
INPUTS = {
    "obs": [1, WINDOW, 17, 3],
    "bbx_xys": [1, WINDOW, 3],
    "K_fullimg": [1, WINDOW, 3, 3],
    "f_imgseq": [1, WINDOW, 1024],
    "f_cam_angvel": [1, WINDOW, 6],
}
ROWS = np.array([1.0, 0, 0, 0, 1, 0])
"""No rotation: the first two rows of the unit matrix."""
SQUARE = np.array([800.0, 500.0, 400.0])


def mean_of_rest() -> np.ndarray:
    """Statistics under which zeros are the rest pose with betas 0.3."""
    return np.concatenate([np.tile(ROWS, 21), np.full(10, 0.3), ROWS, ROWS, np.zeros(3)])


def with_statistics(path: Path, *, mean: np.ndarray | None = None, std: np.ndarray | None = None) -> Path:
    np.savez(
        path.with_suffix(".stats.npz"),
        mean=mean_of_rest() if mean is None else mean,
        std=np.full(151, 2.0) if std is None else std,
    )
    return path


def constant_net(folder: Path, pred_x: np.ndarray, pred_cam: np.ndarray) -> GemSmpl:
    outputs = {"pred_x": pred_x, "pred_cam": pred_cam}
    return GemSmpl(with_statistics(constant_graph(folder / "tiny.onnx", inputs=INPUTS, outputs=outputs)))


def echo_net(folder: Path) -> GemSmpl:
    """Camera = the box; betas = the first ten numbers of the image token; root = the turn of the camera."""
    nodes = [
        helper.make_node("Identity", ["bbx_xys"], ["pred_cam"]),
        helper.make_node("Slice", ["f_imgseq", "start", "end", "axis"], ["betas"]),
        helper.make_node("Concat", ["body", "betas", "f_cam_angvel", "rest"], ["pred_x"], axis=2),
    ]
    constants = [
        *(
            helper.make_tensor(name, TensorProto.INT64, [1], [v])
            for name, v in (("start", 0), ("end", 10), ("axis", 2))
        ),
        numpy_helper.from_array(np.tile(ROWS, (1, WINDOW, 21)).astype(np.float32), "body"),
        numpy_helper.from_array(np.zeros((1, WINDOW, 9), np.float32), "rest"),
    ]
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in INPUTS.items()]
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, WINDOW, width])
        for name, width in (("pred_x", 151), ("pred_cam", 3))
    ]
    path = save(helper.make_graph(nodes, "echo", inputs, outputs, constants), folder / "echo.onnx")
    return GemSmpl(with_statistics(path, mean=np.zeros(151), std=np.ones(151)))


def keypoints(frames: int) -> np.ndarray:
    return np.ones((frames, 17, 3))


@pytest.mark.parametrize(
    ("frames", "starts"),
    [(1, [0]), (120, [0]), (121, [0, 1]), (180, [0, 60]), (240, [0, 60, 120]), (250, [0, 60, 120, 130])],
)
def test_windows_overlap_and_end_with_the_track(frames: int, starts: list[int]) -> None:
    assert window_starts(frames) == starts


def test_camera_turns_by_hand() -> None:
    """A camera that turns by 0.1 rad a frame about its y axis sees the world turn the other way."""
    angles = 0.1 * np.arange(4)
    R_first_camera = matrix_from_axis_angle(np.stack([0 * angles, angles, 0 * angles], -1))
    row = [np.cos(0.1), 0, -np.sin(0.1), 0, 1, 0]
    np.testing.assert_allclose(camera_turns(R_first_camera), np.tile(row, (4, 1)), atol=1e-12)
    np.testing.assert_allclose(camera_turns(np.eye(3)[None]), ROWS[None], atol=1e-12)


def test_features_decode_by_hand() -> None:
    features = np.concatenate([np.tile(ROWS, 21), np.arange(10.0), ROWS, ROWS, np.zeros(3)])[None]
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # about z
    features[0, 136:142] = 3 * quarter[:2].ravel()  # lengths do not matter
    features[0, 6:12] = quarter.T[:2].ravel()
    local, betas = decode(features)
    np.testing.assert_allclose(local[0, 0], quarter, atol=1e-12)
    np.testing.assert_allclose(local[0, 2], quarter.T, atol=1e-12)
    np.testing.assert_allclose(local[0, [1, *range(3, 22)]], np.tile(np.eye(3), (20, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(betas[0], np.arange(10))


def track(valid: list[bool], boxes: list[list[float]]) -> PersonTrack:
    """Landmark k lies at (k, 10 k) with visibility k / 100."""
    frames, k = len(valid), np.arange(33.0)
    landmarks = np.tile(np.stack([k, 10 * k], -1), (frames, 1, 1))
    landmarks[~np.array(valid)] = np.nan
    return PersonTrack(
        person_id=4,
        valid=np.array(valid),
        score=np.ones(frames),
        box_px=np.array(boxes, float),
        landmarks_px=landmarks,
        landmarks_m=np.zeros((frames, 33, 3)),
        visibility=np.tile(k / 100, (frames, 1)),
        mask_crop=np.zeros((frames, 64, 64), np.uint8),
        T_image_crop=np.zeros((frames, 2, 3)),
    )


def test_keypoints_of_a_track() -> None:
    box = [0.0, 0, 100, 200]
    found = coco_keypoints(track([True, False], [box, [np.nan] * 4]))
    assert found.shape == (2, 17, 3)
    for coco, blazepose in ((0, 0), (1, 2), (4, 8), (5, 11), (10, 16), (11, 23), (16, 28)):
        np.testing.assert_allclose(found[0, coco], [blazepose, 10 * blazepose, blazepose / 100])
    np.testing.assert_array_equal(found[1], 0.0)


def test_squares_of_a_track_bridge_gaps() -> None:
    gap = [np.nan] * 4
    found = track_squares(track([True, False, True, False], [[0, 0, 100, 200], gap, [20, 0, 320, 200], gap]))
    # Sides: 1.2 * 1.1 * 200, and for the wide one 1.2 * 1.1 * 300 * 256 / 192; the last is held.
    np.testing.assert_allclose(found, [[50, 100, 264], [110, 100, 396], [170, 100, 528], [170, 100, 528]])
    with pytest.raises(InputError, match="person 4: want a track with a valid frame"):
        track_squares(track([False], [gap]))


@pytest.mark.parametrize("frames", [3, 120, 150])
def test_infer_by_hand(tmp_path: Path, frames: int) -> None:
    pred_x = np.zeros((1, WINDOW, 151))
    pred_x[..., 126] = 0.5
    net = constant_net(tmp_path, pred_x, np.tile([0.8, 0.1, -0.2], (1, WINDOW, 1)))
    found = net.infer(keypoints(frames), np.tile(SQUARE, (frames, 1)), CAMERA)
    assert found.body_model == "smplx"
    assert found.valid.all()
    np.testing.assert_allclose(found.R_parent_joint, np.tile(np.eye(3), (frames, 22, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(found.betas, np.tile([0.3 + 2 * 0.5] + [0.3] * 9, (frames, 1)), rtol=1e-6)
    # z = 2 * 1000 / (0.8 * 400); x = 0.1 + (800 - 639.5) * z / 1000; y = -0.2 + (500 - 359.5) * z / 1000
    np.testing.assert_allclose(found.translation_camera_m, np.tile([1.103125, 0.678125, 6.25], (frames, 1)), rtol=1e-6)


@pytest.mark.parametrize("frames", [50, 150, 250])
def test_every_frame_gets_its_own_values_back(tmp_path: Path, frames: int) -> None:
    rng = np.random.default_rng(0)
    squares = rng.uniform(1, 3, (frames, 3))
    tokens = rng.normal(size=(frames, 1024))
    R_first_camera = matrix_from_axis_angle(rng.normal(0, 0.3, (frames, 3)))
    found = echo_net(tmp_path).infer(
        keypoints(frames), squares, CAMERA, R_first_camera=R_first_camera, image_tokens=tokens
    )
    np.testing.assert_allclose(found.betas, tokens[:, :10], rtol=1e-5, atol=1e-6)
    scale, side = squares[:, 0], squares[:, 2]
    np.testing.assert_allclose(found.translation_camera_m[:, 2], 2000 / (scale * side), rtol=1e-5)
    turns = np.swapaxes(R_first_camera[1:], 1, 2) @ R_first_camera[:-1]
    np.testing.assert_allclose(found.R_parent_joint[:-1, 0], turns, atol=1e-5)


def test_frames_where_nobody_is_seen_are_not_valid(tmp_path: Path) -> None:
    net = constant_net(tmp_path, np.zeros((1, WINDOW, 151)), np.tile([0.8, 0, 0], (1, WINDOW, 1)))
    seen = keypoints(4)
    seen[1, :, 2] = 0.0
    seen[2, 1:, 2] = 0.4
    found = net.infer(seen, np.tile(SQUARE, (4, 1)), CAMERA)
    np.testing.assert_array_equal(found.valid, [True, False, True, True])
    assert np.isfinite(found.translation_camera_m).all()


def test_other_networks_and_outputs_are_refused(tmp_path: Path) -> None:
    cam = np.tile([0.8, 0.0, 0.0], (1, WINDOW, 1))
    squares = np.tile(SQUARE, (2, 1))
    with pytest.raises(ModelMissingError, match=r"want finite pred_x \(1, 120, 151\), got \(1, 120, 585\)"):
        constant_net(tmp_path, np.zeros((1, WINDOW, 585)), cam).infer(keypoints(2), squares, CAMERA)
    with pytest.raises(ModelMissingError, match="with NaN"):
        constant_net(tmp_path, np.full((1, WINDOW, 151), np.nan), cam).infer(keypoints(2), squares, CAMERA)
    path = constant_graph(tmp_path / "o.onnx", inputs=INPUTS, outputs={"pred_x": cam})
    with pytest.raises(ModelMissingError, match=r"want tensors .*pred_cam.* got "):
        GemSmpl(path)


def test_statistics_are_asked_for_in_one_line(tmp_path: Path) -> None:
    outputs = {"pred_x": np.zeros((1, WINDOW, 151)), "pred_cam": np.ones((1, WINDOW, 3))}
    path = constant_graph(tmp_path / "g.onnx", inputs=INPUTS, outputs=outputs)
    with pytest.raises(
        ModelMissingError, match=r"want `mean` and `std` .* at .*g\.stats\.npz, there is none"
    ) as caught:
        GemSmpl(path)
    assert "\n" not in str(caught.value)
    with pytest.raises(ModelMissingError, match=r"got \(150,\) and \(151,\)"):
        GemSmpl(with_statistics(path, mean=np.zeros(150)))
    with pytest.raises(ModelMissingError, match="finite and positive"):
        GemSmpl(with_statistics(path, std=np.zeros(151)))
    path.with_suffix(".stats.npz").write_bytes(b"no archive")
    with pytest.raises(ModelMissingError, match="save them again"):
        GemSmpl(path)
    np.savez(path.with_suffix(".stats.npz"), mean=np.array([{"not": "numbers"}]), std=np.ones(151))
    with pytest.raises(ModelMissingError, match="save them again"):
        GemSmpl(path)
    assert isinstance(networks.load_model(f"gem-smpl@{with_statistics(path)}"), GemSmpl)
