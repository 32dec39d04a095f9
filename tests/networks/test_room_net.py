"""The room network's adapter against tiny graphs of its contract: mirrored back, and at the picture's size."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from tiny_graphs import constant_graph, save

from video2anim.errors import ModelMissingError
from video2anim.networks.room_net import (
    OUTPUTS,
    VIEWS,
    RoomCamera,
    RoomDepth,
    RoomSegment,
    SceneNetwork,
    input_size,
)
from video2anim.networks.segmentation import CLASSES

HEIGHT, WIDTH = 192, 256
"""What a picture of 4 : 3 becomes."""
ROWS, COLUMNS = HEIGHT // 2, WIDTH // 2
RED, GREEN, BLUE, SLOPE, ONE = range(5)
"""What the picture graph computes of each cell: mean colors, how red rises to the right, and 1."""


def picture_graph(path: Path, answers: dict[str, list[dict[int, float]]], *, width: str | int = "w") -> Path:
    """A network whose outputs are sums over what `RED` ... `ONE` are; one dict of weights per channel."""
    kernel = np.zeros((5, 3, 3, 3), np.float32)
    for color in (RED, GREEN, BLUE):
        kernel[color, color, 1, 1] = 1.0
    kernel[SLOPE, RED, 1] = -0.5, 0.0, 0.5
    constants = {"kernel": kernel, "bias": np.eye(5, dtype=np.float32)[ONE]}
    nodes, infos = [], []
    for name, channels in answers.items():
        step = 8 if name == "camera" else 2
        mix = np.zeros((len(channels), 5, 1, 1), np.float32)
        for number, weights in enumerate(channels):
            for cue, weight in weights.items():
                mix[number, cue] = weight
        constants[f"{name}_mix"] = mix
        nodes += [
            helper.make_node(
                "AveragePool", ["picture"], [f"{name}_small"], kernel_shape=[step, step], strides=[step] * 2
            ),
            helper.make_node("Conv", [f"{name}_small", "kernel", "bias"], [f"{name}_cues"], pads=[1, 1, 1, 1]),
            helper.make_node("Conv", [f"{name}_cues", f"{name}_mix"], [name]),
        ]
        shape = [1, len(channels), f"{name}_h", f"{name}_w"]
        infos.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
    inputs = [helper.make_tensor_value_info("picture", TensorProto.FLOAT, [1, 3, "h", width])]
    stored = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    return save(helper.make_graph(nodes, "tiny", inputs, infos, stored), path)


def answers(**changed: list[dict[int, float]]) -> dict[str, list[dict[int, float]]]:
    nothing: dict[int, float] = {}
    plain = {
        "disparity": [{RED: 1.0}],
        "normal": [nothing, nothing, {ONE: -1.0}],
        "classes": [nothing] * len(CLASSES),
        "cues": [nothing] * 4,
        "camera": [nothing, {ONE: -1.0}, nothing, {ONE: -3.0}, {ONE: -2.0}],
    }
    return plain | changed


def outputs(rows: int = ROWS, columns: int = COLUMNS, **changed: np.ndarray) -> dict[str, np.ndarray]:
    """Constant answers of the contract's shapes; upright, level, facing."""
    normal, camera = np.zeros((1, 3, rows, columns)), np.zeros((1, 5, rows // 4, columns // 4))
    normal[:, 2], camera[:, 1] = -1.0, -1.0
    plain = {
        "disparity": np.zeros((1, 1, rows, columns)), "normal": normal,
        "classes": np.zeros((1, 6, rows, columns)), "cues": np.zeros((1, 4, rows, columns)), "camera": camera,
    }  # fmt: skip
    return plain | changed


def constant(path: Path, shapes: dict[str, np.ndarray], inputs: tuple[str, ...] = ("picture",)) -> Path:
    return constant_graph(path / "t.onnx", inputs={name: [1, 3, "h", "w"] for name in inputs}, outputs=shapes)  # type: ignore[dict-item, misc]


def slanted() -> np.ndarray:
    """A picture of the network's size, smooth and unlike its mirror image: red rises, green and blue fall."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return np.stack([0.5 * x + 0.2 * y, 200 - 0.4 * x, 240 - 0.7 * y], -1).astype(np.uint8)


def cell_means(image: np.ndarray, step: int) -> np.ndarray:
    rows, columns = image.shape[0] // step, image.shape[1] // step
    return image.astype(np.float64).reshape(rows, step, columns, step, 3).mean((1, 3))


@pytest.mark.parametrize(
    ("height", "width", "wanted"),
    [
        (480, 640, (192, 256)),
        (640, 480, (256, 192)),
        (192, 256, (192, 256)),
        (1080, 1920, (160, 288)),
        (1920, 1080, (288, 160)),
        (700, 700, (224, 224)),
        (60, 80, (192, 256)),
        (100, 4000, (32, 1408)),
    ],
)
def test_input_size_by_hand(height: int, width: int, wanted: tuple[int, int]) -> None:
    """About 256 x 192 pixels: 1080p is 295.6 x 166.3 of that area, in steps of 32."""
    assert input_size(height, width) == wanted


def test_input_size_of_another_area() -> None:
    assert input_size(480, 640, 512 * 384) == (384, 512)
    assert input_size(480, 640, 10) == (32, 32), "never nothing"


def test_what_mirrors_as_colours_do_is_kept_and_what_turns_round_cancels(tmp_path: Path) -> None:
    """A graph that answers colors in every channel says the same of x in a mirror, where the truth is reversed."""
    every = answers(
        normal=[{RED: 1.0}, {GREEN: 1.0}, {BLUE: 1.0}],
        classes=[{RED: 1.0}, {GREEN: 1.0}, {BLUE: 1.0}, {RED: 2.0}, {GREEN: 2.0}, {BLUE: 2.0}],
        cues=[{RED: 0.01}, {RED: 0.01}, {GREEN: 0.01}, {BLUE: 0.01}],
        camera=[{RED: 1.0}, {GREEN: -1.0}, {BLUE: 0.01}, {ONE: -3.0}, {ONE: -2.0}],
    )
    image = slanted()
    view = SceneNetwork(picture_graph(tmp_path / "t.onnx", every)).predict(image)
    mean, coarse = cell_means(image, 2), cell_means(image, 8)
    np.testing.assert_allclose(view.disparity, mean[..., 0], rtol=1e-5)
    np.testing.assert_allclose(view.class_logits[..., :3], mean, rtol=1e-5)
    np.testing.assert_allclose(view.class_logits[..., 3:], 2 * mean, rtol=1e-5)
    yz = mean[..., 1:] / np.linalg.norm(mean[..., 1:], axis=-1, keepdims=True)
    np.testing.assert_allclose(view.normal_camera[..., 0], 0.0, atol=1e-5)
    np.testing.assert_allclose(view.normal_camera[..., 1:], yz, rtol=1e-5)
    np.testing.assert_allclose(view.instances.center, 1 / (1 + np.exp(-0.01 * mean[..., 0])), rtol=1e-5)
    np.testing.assert_allclose(view.instances.boundary, 1 / (1 + np.exp(-0.01 * mean[..., 2])), rtol=1e-5)
    np.testing.assert_allclose(view.instances.offset[..., 0], 0.0, atol=1e-5)
    np.testing.assert_allclose(view.instances.offset[..., 1], 0.01 * mean[..., 1], rtol=1e-5)
    np.testing.assert_allclose(view.field.up, np.broadcast_to([0.0, -1.0], view.field.up.shape), atol=1e-6)
    np.testing.assert_allclose(view.field.latitude_rad, 0.01 * coarse[..., 2], rtol=1e-5)
    np.testing.assert_allclose(view.field.up_sigma_rad, math.exp(-3.0), rtol=1e-5)
    np.testing.assert_allclose(view.field.latitude_sigma_rad, math.exp(-2.0), rtol=1e-5)


def test_what_turns_round_in_a_mirror_is_turned_back(tmp_path: Path) -> None:
    """Slopes to the right are reversed in a mirror, as x of normals, offsets and up are: both views agree on them."""
    every = answers(
        disparity=[{RED: 1.0, SLOPE: 5.0}],
        normal=[{SLOPE: 0.5}, {}, {ONE: -1.0}],
        cues=[{}, {SLOPE: 0.1}, {}, {}],
        camera=[{SLOPE: 0.1}, {ONE: -1.0}, {}, {}, {}],
    )
    image = slanted()
    view = SceneNetwork(picture_graph(tmp_path / "t.onnx", every)).predict(image)
    for mean, step in ((cell_means(image, 2), 2), (cell_means(image, 8), 8)):
        inner = np.s_[:, 1:-1]
        slope = 0.5 * (mean[:, 2:, 0] - mean[:, :-2, 0])
        assert np.abs(slope - 0.5 * step).max() < 0.6, "red rises by half a gray level a pixel"
        if step == 2:
            np.testing.assert_allclose(view.disparity[inner], mean[inner][..., 0], rtol=1e-5)
            np.testing.assert_allclose(view.instances.offset[inner][..., 0], 0.1 * slope, atol=1e-5)
            normal = np.stack([0.5 * slope, 0 * slope, -np.ones_like(slope)], -1)
            normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
            np.testing.assert_allclose(view.normal_camera[inner], normal, atol=1e-5)
        else:
            up = np.stack([0.1 * slope, -np.ones_like(slope)], -1)
            up /= np.linalg.norm(up, axis=-1, keepdims=True)
            np.testing.assert_allclose(view.field.up[inner], up, atol=1e-5)


def test_a_network_that_ignores_the_picture_answers_the_mean_with_its_mirror(tmp_path: Path) -> None:
    ramp = np.broadcast_to(np.arange(COLUMNS), (1, 1, ROWS, COLUMNS)).astype(float)
    view = SceneNetwork(constant(tmp_path, outputs(disparity=ramp))).predict(slanted())
    np.testing.assert_allclose(view.disparity, (COLUMNS - 1) / 2, rtol=1e-6)


def test_depth_is_the_mean_of_its_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A network that ignores the picture and answers a ramp, steeper each time: mirrored looks are turned back."""
    net, seen = SceneNetwork(constant(tmp_path, outputs())), []

    def run(picture: np.ndarray) -> dict[str, np.ndarray]:
        seen.append(picture)
        rows, columns = picture.shape[2] // 2, picture.shape[3] // 2
        ramp = np.broadcast_to(np.linspace(0, len(seen), columns, dtype=np.float32), (1, rows, columns))
        channels = {"disparity": 1, "normal": 3, "classes": 6, "cues": 4, "camera": 5}
        return {name: np.repeat(ramp, count, axis=0) for name, count in channels.items()}

    monkeypatch.setattr(net, "_run", run)
    image = np.zeros((480, 640, 3), np.uint8)
    image[:, :320] = 200
    disparity = net.disparity(image)
    assert disparity.shape == (480, 640)
    ramp = np.linspace(0, 1, 640)
    wanted = [k * (1 - ramp if turned else ramp) for k, (_, turned) in enumerate(VIEWS["depth"], 1)]
    np.testing.assert_allclose(disparity[240], np.mean(wanted, axis=0), atol=0.03)
    for shown, (area_px, turned) in zip(seen, VIEWS["depth"], strict=True):
        assert shown.shape[2:] == input_size(480, 640, area_px)
        assert (shown[0, 0, 0, 0] < 150) == turned


def test_looks_of_several_sizes_are_averaged_in_cells_of_the_first(tmp_path: Path) -> None:
    net = SceneNetwork(picture_graph(tmp_path / "t.onnx", answers(disparity=[{RED: 1.0}])))
    one = net.predict(slanted(), ((ROWS * COLUMNS * 4, False),))
    two = net.predict(slanted(), ((ROWS * COLUMNS * 4, False), (ROWS * COLUMNS * 16, True)))
    assert two.disparity.shape == one.disparity.shape
    np.testing.assert_allclose(two.disparity[:, 2:-2], one.disparity[:, 2:-2], rtol=0.05)


def test_the_network_is_shown_rgb_from_0_to_255_and_whole(tmp_path: Path) -> None:
    """A picture twice as large; its means are those of the small one."""
    large = np.repeat(np.repeat(slanted(), 2, axis=0), 2, axis=1)
    net = SceneNetwork(picture_graph(tmp_path / "t.onnx", answers(disparity=[{RED: 1.0}])))
    np.testing.assert_allclose(net.predict(large).disparity, cell_means(slanted(), 2)[..., 0], atol=0.01)
    blue = np.zeros((60, 80, 3), np.uint8)
    blue[..., 2] = 255
    net = SceneNetwork(picture_graph(tmp_path / "b.onnx", answers(disparity=[{RED: 1.0, BLUE: 10.0}])))
    np.testing.assert_allclose(net.predict(blue).disparity, 2550.0, rtol=1e-6)


def test_expected_errors_stay_within_reason(tmp_path: Path) -> None:
    """Logs of -50 and 50 would weigh a cell by nothing or all."""
    for log, wanted in ((-50.0, 0.005), (50.0, 1.5)):
        wild = answers(camera=[{}, {ONE: -1.0}, {}, {ONE: log}, {ONE: log}])
        field = SceneNetwork(picture_graph(tmp_path / "t.onnx", wild)).predict(slanted()).field
        np.testing.assert_allclose(field.up_sigma_rad, wanted, rtol=1e-6)
        np.testing.assert_allclose(field.latitude_sigma_rad, wanted, rtol=1e-6)


def test_answers_are_finite_where_the_network_says_nothing(tmp_path: Path) -> None:
    """Normals and directions of length zero."""
    view = SceneNetwork(constant(tmp_path, {name: 0 * value for name, value in outputs().items()})).predict(slanted())
    for values in (view.normal_camera, view.field.up, view.instances.center):
        assert np.isfinite(values).all()


@pytest.mark.parametrize("size", [(90, 120), (300, 400), (400, 300), (123, 211)])
def test_depth_at_picture_size(tmp_path: Path, size: tuple[int, int]) -> None:
    """Disparity is red here: dark to the left of the middle, bright to the right."""
    net = RoomDepth(picture_graph(tmp_path / "t.onnx", answers()))
    assert (net.kind, net.name) == ("disparity", "room-depth")
    image = np.zeros((*size, 3), np.uint8)
    image[:, size[1] // 2 :, 0] = 204
    disparity = net.infer(image)
    assert disparity.shape == size
    assert disparity.dtype == np.float32
    near = size[1] // 10
    np.testing.assert_allclose(disparity[:, : size[1] // 2 - near], 0.0, atol=1e-3)
    np.testing.assert_allclose(disparity[:, size[1] // 2 + near :], 204.0, atol=1e-3)


def test_camera_answers_cells_of_the_whole_picture(tmp_path: Path) -> None:
    """Latitude is red here; the picture's upper half is brighter."""
    camera = [{}, {ONE: -2.0}, {RED: 0.002, ONE: -0.1}, {ONE: -3.0}, {ONE: -2.0}]
    net = RoomCamera(picture_graph(tmp_path / "t.onnx", answers(camera=camera)))
    assert net.name == "room-camera"
    image = np.zeros((480, 640, 3), np.uint8)
    image[:240, :, 0] = 100
    field = net.field(image)
    assert field.up.shape == (24, 32, 2)
    assert field.latitude_rad.shape == field.up_sigma_rad.shape == field.latitude_sigma_rad.shape == (24, 32)
    np.testing.assert_allclose(np.linalg.norm(field.up, axis=-1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(field.latitude_rad[:11], 0.1, atol=1e-5)
    np.testing.assert_allclose(field.latitude_rad[13:], -0.1, atol=1e-5)


def segmenter(path: Path) -> RoomSegment:
    """Red is furniture and its brightest spot a middle, blue is a person, green the floor, black a wall."""
    classes: list[dict[int, float]] = [{ONE: -9.0} for _ in CLASSES]
    classes[CLASSES.index("furniture")] = {RED: 0.2, BLUE: -0.2}
    classes[CLASSES.index("person")] = {BLUE: 0.2}
    classes[CLASSES.index("floor")] = {GREEN: 0.2}
    classes[CLASSES.index("wall")] = {ONE: 10.0}
    cues = [{RED: 0.2, ONE: -45.0}, {}, {}, {ONE: -9.0}]
    return RoomSegment(picture_graph(path / "t.onnx", answers(classes=classes, cues=cues)))


def room() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """480 x 640: two objects and two people, the second person before the floor."""
    image, masks = np.zeros((480, 640, 3), np.uint8), {}
    image[300:, :, 1] = 200
    for name, (rows, columns), color in (
        ("left", ((200, 300), (60, 160)), 0),
        ("right", ((220, 340), (400, 560)), 0),
        ("one", ((100, 280), (240, 300)), 2),
        ("two", ((120, 360), (330, 380)), 2),
    ):
        mask = np.zeros(image.shape[:2], bool)
        mask[rows[0] : rows[1], columns[0] : columns[1]] = True
        image[mask] = np.eye(3, dtype=np.uint8)[color] * 200
        masks[name] = mask
        if color == 0:  # brightest a little off the middle, falling off by 3 gray levels a pixel
            y, x = np.mgrid[: image.shape[0], : image.shape[1]]
            far = np.hypot(y - 0.5 * sum(rows) - 2.3, x - 0.5 * sum(columns) - 1.4)
            image[mask, 0] = np.maximum(200, 255 - 3 * far[mask]).astype(np.uint8)
    return image, masks


@pytest.mark.parametrize("portrait", [False, True])
def test_segments_at_picture_size(tmp_path: Path, portrait: bool) -> None:
    image, masks = room()
    if portrait:
        image, masks = image.transpose(1, 0, 2), {name: mask.T for name, mask in masks.items()}
    net = segmenter(tmp_path)
    assert net.name == "room-segment"
    found = net.segment(image)
    assert found.semantic.shape == image.shape[:2]
    assert found.semantic.dtype == np.uint8
    wanted = np.full(image.shape[:2], CLASSES.index("wall"))
    wanted[image[..., 1] > 0] = CLASSES.index("floor")
    wanted[masks["left"] | masks["right"]] = CLASSES.index("furniture")
    wanted[masks["one"] | masks["two"]] = CLASSES.index("person")
    assert (found.semantic == wanted).mean() > 0.985, "but for edges"
    assert sorted(one.kind for one in found.instances) == ["furniture", "furniture", "person", "person"]
    for name, mask in masks.items():
        kind = "furniture" if name in ("left", "right") else "person"
        best = max((one for one in found.instances if one.kind == kind), key=lambda one: (one.mask & mask).sum())
        assert (best.mask & mask).sum() / (best.mask | mask).sum() > 0.9, name
        assert best.label == kind
    for one in found.instances:
        assert one.mask.shape == image.shape[:2]
        assert one.mask.dtype == bool
        assert (found.semantic[one.mask] == CLASSES.index(one.kind)).all()
        assert 0.0 <= one.score <= 1.0
    scores = [one.score for one in found.instances]
    assert scores == sorted(scores, reverse=True)


def test_an_empty_room_has_no_instances(tmp_path: Path) -> None:
    found = segmenter(tmp_path).segment(np.zeros((480, 640, 3), np.uint8))
    assert found.instances == ()
    assert (found.semantic == CLASSES.index("wall")).all()
    speck = np.zeros((480, 640, 3), np.uint8)
    speck[100:120, 100:120, 2] = 200  # 0.13 % of the picture
    assert segmenter(tmp_path).segment(speck).instances == ()


@pytest.mark.parametrize("name", OUTPUTS)
def test_wrong_shapes_are_refused(tmp_path: Path, name: str) -> None:
    shape = outputs()[name].shape
    for wrong in ((1, shape[1] + 1, *shape[2:]), (*shape[:3], shape[3] - 1), shape[1:]):
        net = SceneNetwork(constant(tmp_path, outputs() | {name: np.ones(wrong)}))
        with pytest.raises(ModelMissingError, match=rf"want {name} \(1, ") as caught:
            net.predict(slanted())
        assert "\n" not in str(caught.value)


def test_other_networks_are_refused(tmp_path: Path) -> None:
    missing = outputs()
    del missing["camera"]
    with pytest.raises(ModelMissingError, match=r"want tensors .*camera.* got"):
        SceneNetwork(constant(tmp_path, missing))
    with pytest.raises(ModelMissingError, match=r"want tensors .*picture.* got .*image"):
        RoomDepth(constant(tmp_path, outputs(), ("image",)))
    garbage = tmp_path / "g.onnx"
    garbage.write_bytes(b"not a network")
    for adapter in (RoomDepth, RoomCamera, RoomSegment):
        with pytest.raises(ModelMissingError, match="cannot load") as caught:
            adapter(garbage)
        assert "\n" not in str(caught.value)


def test_a_network_of_one_size_is_refused_in_one_line(tmp_path: Path) -> None:
    """The contract is any multiple of 32; this one takes pictures 64 wide and nothing else."""
    path = picture_graph(tmp_path / "t.onnx", answers(), width=64)
    assert onnx.load(str(path)).graph.input[0].type.tensor_type.shape.dim[3].dim_value == 64
    with pytest.raises(ModelMissingError) as caught:
        RoomDepth(path).infer(np.zeros((480, 640, 3), np.uint8))
    assert "\n" not in str(caught.value)
