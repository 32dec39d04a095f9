"""The mask classification adapter against tiny graphs, and the table of class names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper
from tiny_graphs import constant_graph, save

from video2anim import networks
from video2anim.errors import ModelMissingError
from video2anim.networks.eomt import Eomt, to_pixel_values
from video2anim.networks.labels import COCO_PANOPTIC, SCENE_CLASS, scene_class
from video2anim.networks.segmentation import CLASSES

SIDE, CELLS, QUERIES = 64, 16, 6
OTHER, FLOOR, WALL, CEILING, FURNITURE, PERSON = range(6)


def outputs(names: tuple[str, ...], queries: list[tuple[str, float, slice, slice]]) -> dict[str, np.ndarray]:
    """Queries of (class, its logit over 0, rows, columns of the mask); the others are no object.

    A mask is cut out of those before it, but for a couch, which lies over them.
    """
    logits = np.zeros((1, QUERIES, len(names) + 1))
    masks = np.full((1, QUERIES, CELLS, CELLS), -9.0)
    logits[0, :, -1] = 20.0
    for query, (name, logit, rows, columns) in enumerate(queries):
        logits[0, query, -1], logits[0, query, names.index(name)] = 0.0, logit
        if name != "couch":
            masks[0, :query, rows, columns] = -9.0
        masks[0, query, rows, columns] = 9.0
    return {"class_queries_logits": logits, "masks_queries_logits": masks}


EVERY = slice(None)
ROOM = [
    ("wall-other-merged", 12.0, slice(0, 8), EVERY),
    ("floor-wood", 12.0, slice(8, 16), EVERY),
    ("chair", 12.0, slice(4, 12), slice(0, 4)),
    ("person", 14.0, slice(2, 14), slice(8, 12)),
]


def eomt(path: Path, queries: list = ROOM, names: tuple[str, ...] = COCO_PANOPTIC) -> Eomt:
    inputs = {"pixel_values": [1, 3, SIDE, SIDE]}
    return Eomt(constant_graph(path / "t.onnx", inputs=inputs, outputs=outputs(names, queries)))


def test_a_padded_picture_has_only_its_part_of_the_masks(tmp_path: Path) -> None:
    """A picture twice as wide as high fills the upper half of the square: rows 0 to 8 of 16 of every mask."""
    room = [
        ("wall-other-merged", 12.0, slice(0, 4), EVERY),
        ("floor-wood", 12.0, slice(4, 8), EVERY),
        ("ceiling-merged", 12.0, slice(8, 16), EVERY),  # in the padding: must not be seen
        ("chair", 13.0, slice(3, 6), slice(0, 4)),
    ]
    found = eomt(tmp_path, room).segment(np.zeros((80, 160, 3), np.uint8))  # a cell is 10 pixels
    (chair,) = found.instances
    assert (chair.label, chair.kind) == ("chair", "furniture")
    rows, columns = np.nonzero(chair.mask)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (30, 59, 0, 39)
    wanted = np.repeat([WALL, FLOOR], 40)[:, None].repeat(160, axis=1)
    wanted[chair.mask] = FURNITURE
    assert np.mean(found.semantic == wanted) > 0.999, "but for pixels where three masks meet"
    assert CEILING not in found.semantic
    assert found.semantic.dtype == np.uint8
    assert found.semantic.shape == (80, 160)


def test_each_pixel_goes_to_its_surest_segment(tmp_path: Path) -> None:
    # A double of the chair, less sure and a column wider: that column is no couch.
    said = outputs(COCO_PANOPTIC, [*ROOM, ("couch", 6.0, slice(4, 12), slice(0, 5))])
    said["masks_queries_logits"][0, :2, 4:12, 4] = -9.0
    path = constant_graph(tmp_path / "t.onnx", inputs={"pixel_values": [1, 3, SIDE, SIDE]}, outputs=said)
    found = Eomt(path).segment(np.zeros((SIDE, SIDE, 3), np.uint8))
    assert [(one.label, one.kind) for one in found.instances] == [("person", "person"), ("chair", "furniture")]
    person, chair = found.instances
    assert person.score == pytest.approx(np.exp(14) / (np.exp(14) + 133), rel=1e-5)
    assert chair.score == pytest.approx(np.exp(12) / (np.exp(12) + 133), rel=1e-5)
    assert not (person.mask & chair.mask).any()
    np.testing.assert_array_equal(np.flatnonzero(person.mask.any(axis=0))[[0, -1]], [32, 47])
    np.testing.assert_array_equal(np.flatnonzero(person.mask.any(axis=1))[[0, -1]], [8, 55])


def test_doubtful_queries_are_no_instances_but_add_to_the_classes(tmp_path: Path) -> None:
    """Two kinds of wall, neither likely alone, outweigh one floor."""
    names = {"wall-wood": 0.35, "wall-tile": 0.35, "floor-wood": 0.45}
    said = outputs(COCO_PANOPTIC, [(name, np.log(133 * p / (1 - p)), EVERY, EVERY) for name, p in names.items()])
    said["masks_queries_logits"][0, : len(names)] = 9.0  # all three everywhere
    path = constant_graph(tmp_path / "t.onnx", inputs={"pixel_values": [1, 3, SIDE, SIDE]}, outputs=said)
    found = Eomt(path).segment(np.zeros((SIDE, SIDE, 3), np.uint8))
    assert found.instances == ()
    assert (found.semantic == WALL).all()
    chair = eomt(tmp_path, [("chair", np.log(133 * 0.45 / 0.55), EVERY, EVERY)])
    assert chair.segment(np.zeros((SIDE, SIDE, 3), np.uint8)).instances == ()


def echo_graph(path: Path, side: int | str) -> Path:
    """Query 0 is a chair where the normalized red channel is positive; query 1 a bed where it is not."""
    logits = np.zeros((1, 2, len(COCO_PANOPTIC) + 1), np.float32)
    logits[0, 0, COCO_PANOPTIC.index("chair")] = logits[0, 1, COCO_PANOPTIC.index("bed")] = 12.0
    nodes = [
        helper.make_node("Slice", ["pixel_values", "at0", "at1", "axis"], ["red"]),
        helper.make_node("Constant", [], ["class_queries_logits"], value=numpy_helper.from_array(logits)),
        helper.make_node("Neg", ["red"], ["second"]),
        helper.make_node("Concat", ["red", "second"], ["masks_queries_logits"], axis=1),
    ]
    inputs = [helper.make_tensor_value_info("pixel_values", TensorProto.FLOAT, [1, 3, side, side])]
    constants = [
        helper.make_tensor(name, TensorProto.INT64, [1], [value])
        for name, value in (("at0", 0), ("at1", 1), ("axis", 1))
    ]
    results = [
        helper.make_tensor_value_info("class_queries_logits", TensorProto.FLOAT, list(logits.shape)),
        helper.make_tensor_value_info("masks_queries_logits", TensorProto.FLOAT, [1, 2, side, side]),
    ]
    return save(helper.make_graph(nodes, "echo", inputs, results, constants), path)


def test_pixel_values_by_hand() -> None:
    image = np.zeros((28, 28, 3), np.uint8)
    image[...] = (255, 0, 127)
    values = to_pixel_values(image, 14, 14)
    assert values.shape == (1, 3, 14, 14)
    assert values.dtype == np.float32
    expected = [(1.0 - 0.485) / 0.229, (0.0 - 0.456) / 0.224, (127 / 255 - 0.406) / 0.225]
    np.testing.assert_allclose(values[0, :, 3, 5], expected, rtol=1e-5)


def test_padding_is_black(tmp_path: Path) -> None:
    model = Eomt(echo_graph(tmp_path / "e.onnx", SIDE))
    values, shown = model._input(np.full((100, 50, 3), 255, np.uint8))
    assert shown == (64, 32)
    np.testing.assert_allclose(values[0, :, 10, 31], [(1 - 0.485) / 0.229, (1 - 0.456) / 0.224, (1 - 0.406) / 0.225])
    np.testing.assert_allclose(values[0, :, 10, 32], [-0.485 / 0.229, -0.456 / 0.224, -0.406 / 0.225], rtol=1e-6)


def test_a_network_of_any_size_is_shown_640(tmp_path: Path) -> None:
    """The halves of the picture stay halves."""
    model = Eomt(echo_graph(tmp_path / "e.onnx", "side"))
    image = np.zeros((90, 200, 3), np.uint8)
    image[:, :100, 0], image[:, 100:, 0] = 60, 190
    values, shown = model._input(image)
    assert (values.shape, shown) == ((1, 3, 640, 640), (288, 640))
    found = {one.label: one.mask for one in model.segment(image).instances}
    right = np.tile(np.arange(200) >= 100, (90, 1))
    assert np.mean(found["chair"] == right) > 0.98
    assert np.mean(found["bed"] == ~right) > 0.98


def test_other_vocabularies_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ModelMissingError, match=r"want class_queries_logits \(1, \*, 134\), got \(1, 6, 81\)"
    ) as caught:
        eomt(tmp_path, [], COCO_PANOPTIC[:80]).segment(np.zeros((8, 8, 3), np.uint8))
    assert "\n" not in str(caught.value)


def test_other_networks_are_refused(tmp_path: Path) -> None:
    found = outputs(COCO_PANOPTIC, ROOM)
    inputs = {"pixel_values": [1, 3, SIDE, SIDE]}
    only = {"class_queries_logits": found["class_queries_logits"]}
    with pytest.raises(ModelMissingError, match=r"want tensors .*masks_queries_logits.* got"):
        Eomt(constant_graph(tmp_path / "o.onnx", inputs=inputs, outputs=only))
    flat = found | {"masks_queries_logits": np.zeros((1, QUERIES, CELLS))}
    with pytest.raises(ModelMissingError, match=r"want masks_queries_logits \(1, 6, \*, \*\), got \(1, 6, 16\)"):
        Eomt(constant_graph(tmp_path / "f.onnx", inputs=inputs, outputs=flat)).segment(np.zeros((8, 8, 3), np.uint8))


def test_table_loads_the_users_file(tmp_path: Path) -> None:
    inputs = {"pixel_values": [1, 3, SIDE, SIDE]}
    path = constant_graph(tmp_path / "e.onnx", inputs=inputs, outputs=outputs(COCO_PANOPTIC, ROOM))
    image = np.zeros((48, 64, 3), np.uint8)
    found = networks.load_model(f"eomt-small-coco@{path}").segment(image)
    np.testing.assert_array_equal(found.semantic, Eomt(path).segment(image).semantic)


def test_the_vocabulary_has_the_published_numbers() -> None:
    assert len(COCO_PANOPTIC) == len(set(COCO_PANOPTIC)) == 133
    published = {0: "person", 56: "chair", 79: "toothbrush", 80: "banner", 119: "sky-other-merged", 132: "rug-merged"}
    assert {index: COCO_PANOPTIC[index] for index in published} == published


def test_the_table_of_classes_names_known_classes_once() -> None:
    named = [name for names in SCENE_CLASS.values() for name in names]
    assert len(named) == len(set(named))
    assert set(named) <= set(COCO_PANOPTIC)
    assert set(SCENE_CLASS) == set(CLASSES) - {"other"}
    wanted = {"couch": FURNITURE, "floor-wood": FLOOR, "rug-merged": FLOOR, "ceiling-merged": CEILING,
              "door-stuff": WALL, "person": PERSON, "tv": OTHER, "dog": OTHER, "car": OTHER, "cup": OTHER}  # fmt: skip
    assert {name: scene_class(name) for name in wanted} == wanted
