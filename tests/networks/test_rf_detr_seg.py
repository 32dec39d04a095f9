"""RF-DETR-Seg's adapter against tiny graphs with masks and classes of known answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper
from tiny_graphs import constant_graph, save

from video2anim import networks
from video2anim.errors import ModelMissingError
from video2anim.networks.rf_detr_seg import RfDetrSeg
from video2anim.networks.segmentation import CLASSES

SIDE, CELLS, QUERIES = 64, 16, 5
PERSON, CHAIR, CUP = 1, 62, 47
OTHER, FURNITURE, HUMAN = (CLASSES.index(name) for name in ("other", "furniture", "person"))


def outputs() -> dict[str, np.ndarray]:
    """A person, surer than a chair that overlaps it, a cup, a doubtful chair, and a chair without a mask."""
    labels = np.full((1, QUERIES, 91), -8.0)
    masks = np.full((1, QUERIES, CELLS, CELLS), -5.0)
    for query, (slot, logit, columns) in enumerate(
        [(CHAIR, 1.0, slice(4, 12)), (PERSON, 3.0, slice(0, 8)), (CUP, 4.0, slice(12, 16)), (CHAIR, -0.1, slice(0, 16))]
    ):
        labels[0, query, slot], masks[0, query, :, columns] = logit, 5.0
    labels[0, 4, CHAIR] = 2.0
    return {"dets": np.zeros((1, QUERIES, 4)), "labels": labels, "masks": masks}


def net(path: Path, **changed: np.ndarray) -> RfDetrSeg:
    inputs = {"input": [1, 3, SIDE, SIDE]}
    return RfDetrSeg(constant_graph(path / "t.onnx", inputs=inputs, outputs=outputs() | changed))


def test_instances_and_classes_at_picture_size(tmp_path: Path) -> None:
    found = net(tmp_path).segment(np.zeros((48, 160, 3), np.uint8))  # a cell is 10 columns wide
    person, chair = found.instances
    assert (person.label, person.kind, chair.label, chair.kind) == ("person", "person", "chair", "furniture")
    assert person.score == pytest.approx(1 / (1 + np.exp(-3)), rel=1e-5)
    assert chair.score == pytest.approx(1 / (1 + np.exp(-1)), rel=1e-5)
    columns = np.arange(160)
    np.testing.assert_array_equal(person.mask, np.tile(columns < 80, (48, 1)))
    np.testing.assert_array_equal(chair.mask, np.tile((columns >= 40) & (columns < 120), (48, 1)))
    wanted = np.where(columns < 80, HUMAN, np.where(columns < 120, FURNITURE, OTHER))
    assert found.semantic.dtype == np.uint8
    np.testing.assert_array_equal(found.semantic, np.tile(wanted, (48, 1)))


def test_nothing_seen(tmp_path: Path) -> None:
    found = net(tmp_path, labels=np.full((1, QUERIES, 91), np.nan)).segment(np.zeros((20, 30, 3), np.uint8))
    assert found.instances == ()
    assert (found.semantic == OTHER).all()


def test_slots_without_a_category_are_nothing(tmp_path: Path) -> None:
    labels = np.full((1, QUERIES, 91), -8.0)
    labels[0, :, 0], labels[0, 1, 12] = 5.0, 6.0
    assert net(tmp_path, labels=labels).segment(np.zeros((20, 30, 3), np.uint8)).instances == ()


def test_the_picture_is_stretched_and_normalised(tmp_path: Path) -> None:
    """Query 0 is a chair where the normalized red channel is positive."""
    nodes = [
        helper.make_node("Slice", ["input", "at0", "at1", "axis"], ["masks"]),
        helper.make_node("Constant", [], ["labels"], value=helper.make_tensor(
            "l", TensorProto.FLOAT, [1, 1, 91], [9.0 if slot == CHAIR else -9.0 for slot in range(91)]
        )),
    ]  # fmt: skip
    constants = [
        helper.make_tensor(name, TensorProto.INT64, [1], [value])
        for name, value in (("at0", 0), ("at1", 1), ("axis", 1))
    ]
    picture = helper.make_tensor_value_info("input", TensorProto.FLOAT, [1, 3, "h", "w"])
    results = [
        helper.make_tensor_value_info("labels", TensorProto.FLOAT, [1, 1, 91]),
        helper.make_tensor_value_info("masks", TensorProto.FLOAT, [1, 1, "h", "w"]),
    ]
    path = save(helper.make_graph(nodes, "echo", [picture], results, constants), tmp_path / "echo.onnx")
    image = np.zeros((90, 240, 3), np.uint8)
    image[:, 120:, 0] = 130  # 130 / 255 > 0.485 > 100 / 255
    image[:, :120, 0] = 100
    (chair,) = RfDetrSeg(path).segment(image).instances
    np.testing.assert_array_equal(chair.mask, np.tile(np.arange(240) >= 120, (90, 1)))


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"labels": np.zeros((1, QUERIES, 80))}, r"want labels \(1, \*, 91\), got \(1, 5, 80\)"),
        ({"masks": np.zeros((1, QUERIES, CELLS))}, r"want masks \(1, 5, \*, \*\), got \(1, 5, 16\)"),
        ({"masks": np.zeros((1, 4, CELLS, CELLS))}, r"want masks \(1, 5, \*, \*\), got \(1, 4, 16, 16\)"),
    ],
)
def test_other_outputs_are_refused(tmp_path: Path, changed: dict[str, np.ndarray], told: str) -> None:
    with pytest.raises(ModelMissingError, match=told) as caught:
        net(tmp_path, **changed).segment(np.zeros((20, 30, 3), np.uint8))
    assert "\n" not in str(caught.value)


def test_a_detector_without_masks_is_refused(tmp_path: Path) -> None:
    found = {name: value for name, value in outputs().items() if name != "masks"}
    path = constant_graph(tmp_path / "d.onnx", inputs={"input": [1, 3, SIDE, SIDE]}, outputs=found)
    with pytest.raises(ModelMissingError, match=r"want tensors \('input',\) -> \('labels', 'masks'\), got"):
        RfDetrSeg(path)


def test_table_loads_the_users_file(tmp_path: Path) -> None:
    path = constant_graph(tmp_path / "r.onnx", inputs={"input": [1, 3, SIDE, SIDE]}, outputs=outputs())
    assert isinstance(networks.load_model(f"rf-detr-seg-small@{path}"), RfDetrSeg)
