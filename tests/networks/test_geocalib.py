"""GeoCalib's adapter against tiny graphs: known fields come back in place, with errors from the confidences."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper
from tiny_graphs import constant_graph, save

from video2anim import networks
from video2anim.errors import ModelMissingError
from video2anim.geometry.perspective_field import field_of_camera, fit_camera
from video2anim.networks.geocalib import GeoCalib, placement

SURE_SIGMA_RAD = 0.01
"""`up_loss_fn_scale` and `lat_loss_fn_scale` of GeoCalib."""


def outputs(height: int = 64, width: int = 96, **changed: np.ndarray) -> dict[str, np.ndarray]:
    """Upright, the horizon in the middle, sure everywhere."""
    up = np.zeros((1, 2, height, width))
    up[:, 1] = -1.0
    latitude = np.broadcast_to(np.linspace(0.315, -0.315, height)[:, None], (1, 1, height, width))
    sure = np.ones((1, 1, height, width))
    return {"up_field": up, "up_confidence": sure, "latitude_field": latitude, "latitude_confidence": sure} | changed


def net(path: Path, height: int = 64, width: int = 96, **changed: np.ndarray) -> GeoCalib:
    inputs = {"image": [1, 3, height, width]}
    return GeoCalib(constant_graph(path / "t.onnx", inputs=inputs, outputs=outputs(height, width, **changed)))


def image(height: int, width: int) -> np.ndarray:
    return np.zeros((height, width, 3), np.uint8)


def test_fields_become_means_of_cells(tmp_path: Path) -> None:
    field = net(tmp_path).field(image(64, 96))
    assert field.up.shape == (4, 6, 2)
    assert field.up.dtype == field.latitude_rad.dtype == np.float32
    np.testing.assert_allclose(field.up, np.broadcast_to([0.0, -1.0], (4, 6, 2)))
    # 64 rows from 0.315 to -0.315 fall by 0.01 each; a cell's middle is the mean of its 16.
    rows = 0.315 - 0.01 * (np.arange(4) * 16 + 7.5)
    np.testing.assert_allclose(field.latitude_rad, np.tile(rows[:, None], (1, 6)), atol=1e-6)
    np.testing.assert_allclose(field.up_sigma_rad, SURE_SIGMA_RAD, rtol=1e-5)
    np.testing.assert_allclose(field.latitude_sigma_rad, SURE_SIGMA_RAD, rtol=1e-5)


def test_unsure_pixels_weigh_less_and_err_more(tmp_path: Path) -> None:
    up, confidence = outputs()["up_field"].copy(), np.ones((1, 1, 64, 96))
    up[:, :, :16, :8] = np.array([1.0, 0.0])[None, :, None, None]  # half of the first cell points right
    confidence[:, :, :16, :8] = 0.25
    confidence[:, :, 16:32, :16] = 0.04  # all of the one below
    field = net(tmp_path, up_field=up, up_confidence=confidence).field(image(64, 96))
    right, upward = 0.25, 1.0
    np.testing.assert_allclose(field.up[0, 0], np.array([right, -upward]) / math.hypot(right, upward), rtol=1e-5)
    assert field.up_sigma_rad[0, 0] == pytest.approx(SURE_SIGMA_RAD / math.sqrt(0.625), rel=1e-5)
    assert field.up_sigma_rad[1, 0] == pytest.approx(SURE_SIGMA_RAD / 0.2, rel=1e-5)
    assert field.up_sigma_rad[0, 1] == pytest.approx(SURE_SIGMA_RAD, rel=1e-5)
    np.testing.assert_allclose(field.latitude_sigma_rad, SURE_SIGMA_RAD, rtol=1e-5, err_msg="a confidence of its own")
    np.testing.assert_allclose(np.linalg.norm(field.up, axis=-1), 1.0, rtol=1e-6)


def test_what_was_cut_off_is_unknown_and_the_rest_in_place(tmp_path: Path) -> None:
    """A square network sees the middle of a picture twice as wide: columns 64 to 128 of 192."""
    field = net(tmp_path, 64, 64).field(image(64, 192))
    assert field.up.shape == (4, 12, 2)
    seen = field.up_sigma_rad < 1.0
    np.testing.assert_array_equal(seen, np.tile(np.repeat([False, True, False], 4), (4, 1)))
    np.testing.assert_allclose(field.up_sigma_rad[~seen], math.pi)
    np.testing.assert_allclose(field.latitude_sigma_rad[~seen], 0.5 * math.pi)
    np.testing.assert_allclose(field.latitude_rad[:, 0], field.latitude_rad[:, 4], rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(field.up, axis=-1), 1.0, rtol=1e-6)


def test_senseless_pixels_are_left_out(tmp_path: Path) -> None:
    latitude = outputs()["latitude_field"].copy()
    latitude[:, :, :16, :8] = np.nan
    latitude[:, :, 16:32, :16] = np.inf
    field = net(tmp_path, latitude_field=latitude).field(image(64, 96))
    assert np.isfinite(field.latitude_rad).all()
    assert field.latitude_rad[0, 0] == pytest.approx(0.24, abs=1e-6)
    assert field.latitude_sigma_rad[0, 0] == pytest.approx(SURE_SIGMA_RAD * math.sqrt(2), rel=1e-5)
    assert field.latitude_sigma_rad[1, 0] == pytest.approx(0.5 * math.pi)


@pytest.mark.parametrize(
    ("size", "fixed", "wanted"),
    [
        ((480, 640), None, ((320, 427), (0, 5), (320, 416))),
        ((1080, 1920), None, ((320, 569), (0, 12), (320, 544))),
        ((1920, 1080), None, ((569, 320), (12, 0), (544, 320))),
        ((480, 640), (320, 320), ((320, 427), (0, 53), (320, 320))),
        ((50, 50), (320, 320), ((320, 320), (0, 0), (320, 320))),
    ],
)
def test_placement_keeps_the_ratio_and_cuts_the_middle_out(size: tuple, fixed: tuple | None, wanted: tuple) -> None:
    assert placement(*size, fixed) == wanted


def test_the_network_is_shown_plain_rgb_of_the_middle(tmp_path: Path) -> None:
    """A network of any size whose latitude is the red channel and whose up points along (green, blue)."""
    nodes = [
        helper.make_node("Slice", ["image", "at0", "at1", "axis"], ["latitude_field"]),
        helper.make_node("Slice", ["image", "at1", "at3", "axis"], ["up_field"]),
        helper.make_node("Mul", ["latitude_field", "zero"], ["none"]),
        helper.make_node("Add", ["none", "one"], ["up_confidence"]),
        helper.make_node("Identity", ["up_confidence"], ["latitude_confidence"]),
    ]
    numbers = {"at0": [0], "at1": [1], "at3": [3], "axis": [1]}
    constants = [helper.make_tensor(name, TensorProto.INT64, [1], value) for name, value in numbers.items()]
    constants += [helper.make_tensor(name, TensorProto.FLOAT, [], [v]) for name, v in (("zero", 0.0), ("one", 1.0))]
    made = {"up_field": 2, "up_confidence": 1, "latitude_field": 1, "latitude_confidence": 1}
    results = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, channels, "h", "w"])
        for name, channels in made.items()
    ]
    picture = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "h", "w"])
    path = save(helper.make_graph(nodes, "echo", [picture], results, constants), tmp_path / "echo.onnx")
    shown = image(320, 427)
    shown[:, :, 0] = np.arange(427) // 2
    shown[:, :, 1:] = (102, 204)
    field = GeoCalib(path).field(shown)
    assert field.up.shape == (20, 27, 2)
    # The cells are 427 / 27 px wide; away from the cut the mean of a cell is the value in its middle.
    middles = (np.arange(27) + 0.5) * 427 / 27 - 0.5
    np.testing.assert_allclose(field.latitude_rad[7, 1:-1], (middles[1:-1] - 0.5) / 2 / 255, atol=0.5 / 255)
    np.testing.assert_allclose(field.up, np.broadcast_to([1, 2] / np.sqrt(5), (20, 27, 2)), rtol=1e-5)
    # Five columns at the left and six at the right were not shown: those cells are known, but less surely.
    assert SURE_SIGMA_RAD < field.up_sigma_rad[0, 0] < field.up_sigma_rad[0, 26] < 0.02
    np.testing.assert_allclose(field.up_sigma_rad[:, 1:-1], SURE_SIGMA_RAD, rtol=1e-5)
    field = GeoCalib(path).field(shown.transpose(1, 0, 2))  # now rows
    np.testing.assert_allclose(field.latitude_rad[1:-1, 7], (middles[1:-1] - 0.5) / 2 / 255, atol=0.5 / 255)
    assert SURE_SIGMA_RAD < field.up_sigma_rad[0, 0] < field.up_sigma_rad[26, 0] < 0.02


@pytest.mark.parametrize("size", [(480, 640), (640, 480)])
def test_a_known_camera_is_fitted_to_its_field(tmp_path: Path, size: tuple[int, int]) -> None:
    """What an ideal network says of the picture's middle, its edges cut off, gives lens and gravity back."""
    up_camera = np.array([0.1, -0.95, 0.3]) / np.linalg.norm([0.1, -0.95, 0.3])
    whole, (top, left), (net_h, net_w) = placement(*size)
    assert whole != (net_h, net_w)
    aspect = size[1] / size[0]
    up, latitude = field_of_camera(*whole, aspect, 1.1, up_camera)
    up, latitude = (values[top : top + net_h, left : left + net_w] for values in (up, latitude))
    found = fit_camera(
        [
            net(
                tmp_path,
                net_h,
                net_w,
                up_field=up.transpose(2, 0, 1)[None],
                latitude_field=latitude[None, None],
            ).field(image(*size))
        ],
        aspect,
    )
    assert found.focal_ratio == pytest.approx(1.1, rel=0.005)
    np.testing.assert_allclose(found.up_camera, up_camera, atol=0.003)


def test_other_networks_are_refused_in_one_line(tmp_path: Path) -> None:
    missing = {name: value for name, value in outputs().items() if name != "up_confidence"}
    with pytest.raises(ModelMissingError, match=r"want tensors .*up_confidence.* got"):
        GeoCalib(constant_graph(tmp_path / "m.onnx", inputs={"image": [1, 3, 64, 96]}, outputs=missing))
    with pytest.raises(ModelMissingError, match=r"want up_field \(1, 2, 64, 96\), got \(1, 3, 64, 96\)") as caught:
        net(tmp_path, up_field=np.ones((1, 3, 64, 96))).field(image(64, 96))
    assert "\n" not in str(caught.value)


def test_table_loads_the_users_file(tmp_path: Path) -> None:
    path = constant_graph(tmp_path / "g.onnx", inputs={"image": [1, 3, 64, 96]}, outputs=outputs())
    field = networks.load_model(f"geocalib@{path}").field(image(64, 96))
    np.testing.assert_array_equal(field.latitude_rad, GeoCalib(path).field(image(64, 96)).latitude_rad)
