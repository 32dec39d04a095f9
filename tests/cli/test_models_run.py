"""`video2anim models run` as a user has it: arrays of known networks, and refusals of one line."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from command import Answer, video2anim
from onnx import TensorProto, helper, numpy_helper

from video2anim.artifacts.images import write_png
from video2anim.cli.pictures import camera_arrays
from video2anim.geometry.perspective_field import field_of_camera
from video2anim.lab.synth.cameras import look_rotation
from video2anim.networks.segmentation import CLASSES

HEIGHT, WIDTH = 48, 64
ROWS, COLUMNS = 96, 128
"""Half of what the room network is shown of a picture of 4 : 3."""
FOCAL_RATIO, UP = 0.9, np.array([0.0, -math.cos(-0.2), math.sin(-0.2)])
"""A camera that looks down by 0.2 rad, without roll: its fields are their own mirror images."""


def room_net(path: Path, **changed: np.ndarray) -> Path:
    """A network of the room network's contract: disparity is red, objects are red, all else is constant."""
    up, latitude = field_of_camera(ROWS // 4, COLUMNS // 4, WIDTH / HEIGHT, FOCAL_RATIO, UP)
    camera = np.stack([up[..., 0], up[..., 1], latitude, np.full_like(latitude, -3.0), np.full_like(latitude, -3.0)])
    classes = np.zeros((1, 6, ROWS, COLUMNS))
    classes[:, CLASSES.index("floor"), ROWS // 2 :] = 40.0
    classes[:, CLASSES.index("wall"), : ROWS // 2] = 40.0
    person = np.zeros((6, 3, 1, 1))
    person[CLASSES.index("person"), 0] = 1.0
    red = np.eye(3)[:1].reshape(1, 3, 1, 1)
    normal = np.broadcast_to(np.array([0.0, 0.0, -1.0])[None, :, None, None], (1, 3, ROWS, COLUMNS))
    maps = {"still": classes, "normal": normal, "camera": camera[None],
            "cues": np.full((1, 4, ROWS, COLUMNS), -9.0)} | changed  # fmt: skip
    constants = {"red": red, "person": person}
    nodes = [
        helper.make_node("AveragePool", ["picture"], ["small"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("AveragePool", ["picture"], ["coarse"], kernel_shape=[8, 8], strides=[8, 8]),
        helper.make_node("Conv", ["small", "red"], ["disparity"]),
        helper.make_node("Conv", ["small", "person"], ["seen"]),
    ]
    # Maps are stretched to what the picture's size asks for; of the size they are made for they stay as they are.
    for name, value in maps.items():
        constants[f"{name} made"], constants[f"{name} channels"] = value, np.array([1, value.shape[1]])
        cells = "coarse" if name == "camera" else "small"
        nodes += [
            helper.make_node("Shape", [cells], [f"{name} extent"], start=2),
            helper.make_node("Concat", [f"{name} channels", f"{name} extent"], [f"{name} size"], axis=0),
            helper.make_node("Resize", [f"{name} made", "", "", f"{name} size"], [name], mode="nearest"),
        ]
    nodes.append(helper.make_node("Add", ["seen", "still"], ["classes"]))
    infos = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, None, None, None])
        for name in ("disparity", "normal", "classes", "cues", "camera")
    ]
    inputs = [helper.make_tensor_value_info("picture", TensorProto.FLOAT, [1, 3, "h", "w"])]
    stored = [
        numpy_helper.from_array(value if value.dtype == np.int64 else value.astype(np.float32), name)
        for name, value in constants.items()
    ]
    graph = helper.make_graph(nodes, "tiny", inputs, infos, stored)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), str(path))
    return path


@pytest.fixture
def net(tmp_path: Path) -> Path:
    return room_net(tmp_path / "net.onnx")


@pytest.fixture
def shown(tmp_path: Path) -> list[Path]:
    """Two pictures: one empty, one with a red block in columns 16 to 31 of rows 8 to 39."""
    empty = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    block = empty.copy()
    block[8:40, 16:32, 0] = 200
    paths = [tmp_path / "b_empty.png", tmp_path / "a_block.png"]
    for path, picture in zip(paths, (empty, block), strict=True):
        write_png(path, picture)
    return paths


def arrays(answer: Answer, path: Path) -> dict[str, np.ndarray]:
    assert answer.code == 0, answer.err
    assert answer.out.strip().splitlines() == [str(path)]
    assert answer.err == ""
    assert not list(path.parent.glob(".*")), "nothing half-written stays"
    with np.load(path, allow_pickle=False) as archive:
        return dict(archive)


def test_depth(net: Path, shown: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "depth.npz"
    answer = video2anim("models", "run", "depth", *shown, "--out", out, "--model", f"room-depth@{net}")
    found = arrays(answer, out)
    assert set(found) == {"frames", "model", "depth", "kind"}
    assert found["frames"].tolist() == ["b_empty", "a_block"], "in the order given"
    assert (found["model"].item(), found["kind"].item()) == ("room-depth", "disparity")
    assert found["depth"].shape == (2, HEIGHT, WIDTH)
    assert found["depth"].dtype == np.float32
    np.testing.assert_allclose(found["depth"][0], 0.0, atol=1e-4)
    np.testing.assert_allclose(found["depth"][1, 14:34, 20:28], 200.0, atol=1.0)
    np.testing.assert_allclose(found["depth"][1, :, 40:], 0.0, atol=1.0)


def test_camera(net: Path, shown: list[Path], tmp_path: Path) -> None:
    """The fields of a known camera, as a perfect network says them, give its numbers back."""
    out = tmp_path / "camera.npz"
    answer = video2anim("models", "run", "camera", *shown, "--out", out, "--model", f"room-camera@{net}")
    found = arrays(answer, out)
    shapes = {name: value.shape for name, value in found.items()}
    assert shapes == {
        "frames": (2,), "model": (), "focal_px": (2,), "fov_y_rad": (2,), "focal_log_sigma": (2,), "up_camera": (2, 3),
        "pitch_rad": (2,), "roll_rad": (2,), "up_sigma_rad": (2,), "up_field": (2, ROWS // 4, COLUMNS // 4, 2),
        "latitude_rad": (2, ROWS // 4, COLUMNS // 4),
    }  # fmt: skip
    np.testing.assert_allclose(found["focal_px"], FOCAL_RATIO * HEIGHT, rtol=1e-3)
    np.testing.assert_allclose(found["fov_y_rad"], 2 * math.atan(0.5 / FOCAL_RATIO), rtol=1e-3)
    np.testing.assert_allclose(found["up_camera"], np.broadcast_to(UP, (2, 3)), atol=1e-3)
    np.testing.assert_allclose(found["pitch_rad"], -0.2, atol=1e-3)
    np.testing.assert_allclose(found["roll_rad"], 0.0, atol=1e-3)
    assert (found["focal_log_sigma"] > 0).all()
    assert (found["up_sigma_rad"] > 0).all()
    up, latitude = field_of_camera(ROWS // 4, COLUMNS // 4, WIDTH / HEIGHT, FOCAL_RATIO, UP)
    np.testing.assert_allclose(found["up_field"][0], up, atol=1e-5)
    np.testing.assert_allclose(found["latitude_rad"][1], latitude, atol=1e-5)


def test_segment(net: Path, shown: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "segment.npz"
    answer = video2anim("models", "run", "segment", *shown, "--out", out, "--model", f"room-segment@{net}")
    found = arrays(answer, out)
    assert set(found) == {
        "frames", "model", "semantic", "classes", "masks", "mask_frame", "mask_label", "mask_kind", "mask_score"
    }  # fmt: skip
    assert tuple(found["classes"]) == CLASSES
    assert found["semantic"].shape == (2, HEIGHT, WIDTH)
    assert found["semantic"].dtype == np.uint8
    assert (found["semantic"][0, :23] == CLASSES.index("wall")).all()
    assert (found["semantic"][0, 25:] == CLASSES.index("floor")).all()
    assert (found["semantic"][1, 10:38, 18:30] == CLASSES.index("person")).all()
    assert found["masks"].shape == (1, HEIGHT, WIDTH)
    assert found["masks"].dtype == bool
    assert found["mask_frame"].tolist() == [1], "the second picture given"
    assert found["mask_label"].tolist() == found["mask_kind"].tolist() == ["person"]
    assert found["mask_score"].shape == (1,)
    assert 0.9 < found["mask_score"][0] <= 1.0
    block = np.zeros((HEIGHT, WIDTH), bool)
    block[8:40, 16:32] = True
    assert (found["masks"][0] & block).sum() / (found["masks"][0] | block).sum() > 0.85


def test_no_instances_are_arrays_of_no_rows(net: Path, shown: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "segment.npz"
    found = arrays(
        video2anim("models", "run", "segment", shown[0], "--out", out, "--model", f"room-segment@{net}"), out
    )
    assert found["masks"].shape == (0, HEIGHT, WIDTH)
    for name in ("mask_frame", "mask_label", "mask_kind", "mask_score"):
        assert found[name].shape == (0,)


def test_one_picture_and_an_older_file_is_replaced(net: Path, shown: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "depth.npz"
    out.write_bytes(b"an older answer")
    words = ("models", "run", "depth", shown[1], "--out", out, "--model", f"room-depth@{net}")
    assert arrays(video2anim(*words), out)["depth"].shape == (1, HEIGHT, WIDTH)


def test_gray_pictures_are_pictures(net: Path, tmp_path: Path) -> None:
    write_png(tmp_path / "gray.png", np.full((HEIGHT, WIDTH), 120, np.uint8))
    out = tmp_path / "depth.npz"
    words = ("models", "run", "depth", tmp_path / "gray.png", "--out", out, "--model", f"room-depth@{net}")
    np.testing.assert_allclose(arrays(video2anim(*words), out)["depth"], 120.0, atol=0.5)


@pytest.mark.parametrize("told", [{}, {"--model": "depth"}])
def test_the_slots_first_model_is_the_default(
    shown: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: dict[str, str]
) -> None:
    """Without weights: a stand-in for the loaded model says which one was asked for, and that its depth is meters."""
    asked = []

    class Metres:
        kind = "metric"

        def infer(self, image: np.ndarray) -> np.ndarray:
            return np.full(image.shape[:2], 2.5)

    def load(name: str) -> Metres:
        asked.append(name)
        return Metres()

    monkeypatch.setattr("video2anim.networks.load_model", load)
    out = tmp_path / "depth.npz"
    words = [word for pair in told.items() for word in pair]
    found = arrays(video2anim("models", "run", "depth", *shown, "--out", out, *words), out)
    assert asked == ["depth"]
    assert found["kind"].item() == "metric"
    assert found["depth"].dtype == np.float32
    assert (found["depth"] == 2.5).all()


def test_a_camera_model_without_fields_tells_its_focal_length_alone() -> None:
    class Lens:
        def focal_px(self, image: np.ndarray) -> float:
            return 100.0 + image[0, 0, 0]

    shown = [np.full((60, 80, 3), value, np.uint8) for value in (0, 20)]
    found = camera_arrays(Lens(), shown)
    assert set(found) == {"focal_px", "fov_y_rad"}
    np.testing.assert_allclose(found["focal_px"], [100.0, 120.0])
    np.testing.assert_allclose(found["fov_y_rad"], [2 * math.atan(0.3), 2 * math.atan(0.25)])


def test_a_depth_model_that_tells_the_lens_runs_as_camera(shown: list[Path], tmp_path: Path) -> None:
    """Through the table and a tiny network of the model's contract."""
    inputs = [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, HEIGHT, WIDTH])]
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5 - WIDTH / 2) / 50.0, (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / 50.0)
    z = 2.0 + 0.5 * np.sin(np.arange(WIDTH) / 9.0) * np.ones((HEIGHT, 1))
    outputs = {
        "points": np.stack([x * z, y * z, z], -1)[None],
        "mask": np.ones((1, HEIGHT, WIDTH)),
        "scale": np.ones(1),
    }
    nodes = [
        helper.make_node("Constant", [], [name], value=numpy_helper.from_array(value.astype(np.float32)))
        for name, value in outputs.items()
    ]
    infos = [helper.make_tensor_value_info(name, TensorProto.FLOAT, value.shape) for name, value in outputs.items()]
    graph = helper.make_graph(nodes, "tiny", inputs, infos)
    own, out = tmp_path / "net.onnx", tmp_path / "lens.npz"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), str(own))
    answer = video2anim("models", "run", "camera", *shown, "--out", out, "--model", f"moge-2-small@{own}")
    found = arrays(answer, out)
    assert set(found) == {"frames", "model", "focal_px", "fov_y_rad"}
    np.testing.assert_allclose(found["focal_px"], 50.0, rtol=0.02)
    assert found["model"].item() == "moge-2-small"


def test_the_stage_asks_for_gravity_too(tmp_path: Path) -> None:
    from video2anim.cli.compose import pipeline_nodes
    from video2anim.errors import UsageError
    from video2anim.pipeline.config import resolve

    options = {"camera": {"camera_model": f"moge-2-small@{tmp_path / 'net.onnx'}"}}
    with pytest.raises(UsageError, match=r"camera\.camera_model: want a model of slot camera.*got 'moge"):
        resolve(pipeline_nodes(), "p", [("--set", options)])


class Turned:
    """A camera model that sees the field of a camera turned as the synthetic world turns them."""

    def __init__(self, pitch_rad: float, roll_rad: float) -> None:
        self.up = look_rotation(0.3, pitch_rad, roll_rad)[1]

    def field(self, image: np.ndarray) -> Any:
        from video2anim.geometry.perspective_field import PerspectiveField

        sigma = np.full((12, 16), 0.05)
        aspect = image.shape[1] / image.shape[0]
        return PerspectiveField(*field_of_camera(12, 16, aspect, FOCAL_RATIO, self.up), sigma, sigma)


@pytest.mark.parametrize("pitch_rad", [-0.4, 0.25])
def test_a_positive_pitch_looks_up(pitch_rad: float) -> None:
    found = camera_arrays(Turned(pitch_rad, 0.0), [np.zeros((HEIGHT, WIDTH, 3), np.uint8)])
    np.testing.assert_allclose(found["pitch_rad"], [pitch_rad], atol=1e-4)


@pytest.mark.parametrize("roll_rad", [0.15, -0.2])
def test_a_positive_roll_turns_the_camera_clockwise(roll_rad: float) -> None:
    """As seen from behind: like `roll_rad` of the synthetic `meta.json`, whose `look_rotation` made this camera."""
    found = camera_arrays(Turned(-0.3, roll_rad), [np.zeros((HEIGHT, WIDTH, 3), np.uint8)])
    np.testing.assert_allclose(found["roll_rad"], [roll_rad], atol=1e-4)


def expect_refusal(answer: Answer, code: int, *said: str) -> None:
    assert answer.code == code, answer.err
    assert answer.out == ""
    assert len(answer.err.splitlines()) == 1, answer.err
    for words in said:
        assert words in answer.err


def run_depth(net: Path, out: Path, *images: Path, model: str = "") -> Answer:
    return video2anim("models", "run", "depth", *images, "--out", out, "--model", model or f"room-depth@{net}")


def test_pictures_that_are_none(net: Path, shown: list[Path], tmp_path: Path) -> None:
    text, nothing, folder = tmp_path / "text.png", tmp_path / "empty.png", tmp_path / "folder.png"
    text.write_text("no picture at all")
    nothing.write_bytes(b"")
    folder.mkdir()
    cut = tmp_path / "cut.png"
    cut.write_bytes(shown[1].read_bytes()[:40])
    out = tmp_path / "out.npz"
    for path in (text, nothing, cut):
        expect_refusal(run_depth(net, out, shown[0], path), 3, "want a JPEG, PNG", str(path))
    expect_refusal(run_depth(net, out, shown[0], folder), 3, "a folder", str(folder))
    expect_refusal(run_depth(net, out, tmp_path / "absent.png"), 3, "nothing", "absent.png")
    assert not out.exists()


def test_pictures_of_two_sizes(net: Path, shown: list[Path], tmp_path: Path) -> None:
    write_png(tmp_path / "other.png", np.zeros((HEIGHT, 2 * WIDTH, 3), np.uint8))
    answer = run_depth(net, tmp_path / "out.npz", shown[0], tmp_path / "other.png")
    expect_refusal(answer, 3, "want one size, 64x48", str(shown[0]), "got 128x48", "other.png")
    assert not (tmp_path / "out.npz").exists()


def test_the_same_name_twice(net: Path, shown: list[Path], tmp_path: Path) -> None:
    """In another folder, or of another format: `frames` could not tell them apart."""
    (tmp_path / "more").mkdir()
    double = tmp_path / "more" / shown[0].name
    double.write_bytes(shown[0].read_bytes())
    for other in (double, shown[0]):
        answer = run_depth(net, tmp_path / "out.npz", shown[0], shown[1], other)
        expect_refusal(answer, 2, "want file names that differ", "'b_empty' twice")


def test_models_of_another_slot_or_unknown(net: Path, shown: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out.npz"
    for model in (f"room-camera@{net}", "geocalib", "camera"):
        answer = run_depth(net, out, shown[0], model=model)
        expect_refusal(answer, 2, "--model: want a model of slot depth, got", "of slot camera")
    expect_refusal(run_depth(net, out, shown[0], model="no-such-net"), 2, "unknown model 'no-such-net'", "room-depth")


def test_weights_that_are_absent_or_none(shown: list[Path], tmp_path: Path) -> None:
    out, rubbish = tmp_path / "out.npz", tmp_path / "rubbish.onnx"
    rubbish.write_bytes(b"no network")
    absent = tmp_path / "absent.onnx"
    expect_refusal(run_depth(absent, out, shown[0]), 4, "room-depth", str(absent))
    expect_refusal(run_depth(rubbish, out, shown[0]), 4, str(rubbish), "cannot load")
    wrong = room_net(tmp_path / "wrong.onnx", normal=np.zeros((1, 4, ROWS, COLUMNS)))
    expect_refusal(run_depth(wrong, out, shown[0]), 4, str(wrong), "want normal (1, 3, 96, 128)")
    other = room_net(tmp_path / "other.onnx")
    expect_refusal(run_depth(other, out, shown[0], model=f"moge-2-small@{other}"), 4, "want tensors")
    assert not out.exists()


@pytest.mark.parametrize("name", ["depth", "depth.npy", "depth.NPZ.txt"])
def test_out_must_be_an_npz(net: Path, shown: list[Path], tmp_path: Path, name: str) -> None:
    expect_refusal(run_depth(net, tmp_path / name, shown[0]), 2, "--out: want a file name that ends in .npz", name)


def test_folders_that_cannot_be_written(net: Path, shown: list[Path], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    for out in (tmp_path / "absent" / "out.npz", tmp_path / "file" / "out.npz"):
        expect_refusal(run_depth(net, out, shown[0]), 3, "--out: cannot write", str(out), "choose another")


def test_a_folder_of_the_wanted_name(net: Path, shown: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out.npz"
    out.mkdir()
    expect_refusal(run_depth(net, out, shown[0]), 3, "--out: cannot write", str(out))
    assert not list(tmp_path.glob(".*")), "nothing half-written stays"


def test_usage_errors_of_the_parser(net: Path, shown: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out.npz"
    for words in (("pose", shown[0], "--out", out), ("depth", "--out", out), ("depth", shown[0])):
        answer = video2anim("models", "run", *words)
        assert answer.code == 2
        assert "Usage" in answer.err
        assert "Traceback" not in answer.err
