"""Objectron: anchors, decoding and tiles by hand; objects of a real picture with the real weights."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from video2anim.errors import ModelMissingError
from video2anim.networks import ensure, load_model, objectron
from video2anim.networks.blazepose_detector import box_iou
from video2anim.networks.objectron import FoundObject, ObjectFinder
from video2anim.networks.tiles import square_tiles

CHAIR = objectron.WORDS.index("chair")
LEFT_CHAIR_PX = np.array([163.0, 310.0, 303.0, 540.0])
"""By hand."""


@pytest.fixture(scope="module")
def finder() -> ObjectFinder:
    try:
        return load_model("objectron")
    except ModelMissingError as error:
        pytest.skip(f"weights are neither in the cache nor to be had: {error}")


@pytest.fixture(scope="module")
def office(shared_media: Path) -> np.ndarray:
    """First frame of the squat clip, RGB 720 x 720: a man passes office chairs."""
    ok, bgr = cv2.VideoCapture(str(shared_media / "videos" / "bodypose3d_squat.mp4")).read()
    assert ok
    return np.ascontiguousarray(bgr[:, :, ::-1])


def test_anchors_by_hand() -> None:
    anchors = objectron.anchor_boxes()
    assert anchors.shape == (1917, 4)
    wide, high = 0.2 * math.sqrt(2.0), 0.2 / math.sqrt(2.0)
    center = 0.5 / 19
    np.testing.assert_allclose(anchors[:2], [[center, center, 0.1, 0.1], [center, center, high, wide]])
    np.testing.assert_allclose(anchors[2:4], [[center, center, wide, high], [center, 1.5 / 19, 0.1, 0.1]])
    second = anchors[19 * 19 * 3 :]
    np.testing.assert_allclose(second[0], [0.05, 0.05, 0.35, 0.35])
    np.testing.assert_allclose(second[3], [0.05, 0.05, 0.35 / math.sqrt(3.0), 0.35 * math.sqrt(3.0)])
    np.testing.assert_allclose(second[5], [0.05, 0.05, math.sqrt(0.35 * 0.5), math.sqrt(0.35 * 0.5)])
    np.testing.assert_allclose(anchors[-1], [0.5, 0.5, math.sqrt(0.95), math.sqrt(0.95)])


def test_decode_by_hand() -> None:
    codes = np.array([[1.0, -2.0, 5.0 * math.log(2.0), 0.0], [0.0, 0.0, 0.0, 0.0]])
    anchors = np.array([[0.5, 0.5, 0.2, 0.4], [0.1, 0.1, 0.1, 0.1]])
    logits = np.full((2, 24), -20.0)
    logits[0, CHAIR], logits[0, 3], logits[1, 0] = math.log(4.0), -math.log(4.0), 20.0
    boxes, scores, classes = objectron.decode(codes, logits, anchors, 0.3)
    # Middle y = 0.5 + 0.1 x 0.2, x = 0.5 - 0.2 x 0.4; height doubled. Class 0 is nothing.
    np.testing.assert_allclose(boxes, [[0.22, 0.32, 0.62, 0.72]])
    np.testing.assert_allclose(scores, [0.8])
    np.testing.assert_array_equal(classes, [CHAIR])


def test_words_have_a_place_for_each_class() -> None:
    assert len(objectron.WORDS) == 24
    assert [objectron.WORDS[k] for k in (4, 5, 7, 12, 13, 15)] == ["person", "chair", "desk", "cup", "cup", "table"]


def obj(label: str, score: float, *box_px: float) -> FoundObject:
    return FoundObject(label, score, np.array(box_px))


def test_each_thing_stays_once() -> None:
    best = obj("table", 0.9, 0, 0, 10, 10)
    chair = obj("chair", 0.8, 0, 0, 10, 10)
    # Shares 1/3 of the union with the best one; the desk shares 9/11 of it and is the same object by another name.
    beside = obj("table", 0.5, 5, 0, 15, 10)
    found = [obj("desk", 0.6, 1, 0, 11, 10), beside, obj("chair", 0.4, 0, 1, 10, 11), chair, best]
    assert objectron.distinct(found) == (best, chair, beside)
    assert objectron.distinct([]) == ()


def test_what_a_tile_cuts_is_left_to_others() -> None:
    tile = np.array([100, 0, 200, 100])
    cut = {
        (120.0, 20.0, 150.0, 60.0): False,
        (101.0, 20.0, 150.0, 60.0): True,
        (120.0, 20.0, 198.0, 60.0): True,
        (120.0, 20.0, 150.0, 98.0): True,
        (120.0, -3.0, 150.0, 60.0): False,  # the upper edge is the picture's
    }
    for box, wanted in cut.items():
        assert objectron.is_cut(np.array(box), tile, 300, 200) is wanted, box
    assert not objectron.is_cut(np.array([120.0, 20.0, 198.0, 98.0]), tile, 200, 100)


def test_tiles_by_hand() -> None:
    large, small = [(0, 0, 480), (160, 0, 480)], [(x, y, 240) for y in (0, 120, 240) for x in (0, 133, 267, 400)]
    assert list(square_tiles(640, 480, min_px=150)) == large + small
    assert list(square_tiles(640, 480, min_px=241)) == large
    # A square picture has no tile of its own size.
    assert list(square_tiles(300, 300, min_px=150)) == [(x, y, 150) for y in (0, 75, 150) for x in (0, 75, 150)]


class _SpotNet:
    """Stands for the detector: a chair of a tenth of the input where the picture is brightest."""

    output_shapes = ((1, 1917, 4), (1, 1917, 24))
    input_size_px = 300

    def __init__(self, path: Path) -> None:
        self.anchors = objectron.anchor_boxes()

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert image.shape == (300, 300, 3)
        assert image.min() >= -1.0
        codes, logits = np.zeros((1, 1917, 4)), np.full((1, 1917, 24), -20.0)
        if image.max() > 0.0:
            rows, columns = np.nonzero(image[..., 0] > 0.5 * image.max())
            spot = np.array([rows.mean() + 0.5, columns.mean() + 0.5]) / 300
            nearest = 3 * np.argmin(np.linalg.norm(self.anchors[: 19 * 19 * 3 : 3, :2] - spot, axis=1))
            codes[0, nearest, :2] = 10.0 * (spot - self.anchors[nearest, :2]) / 0.1
            logits[0, nearest, CHAIR] = 2.0
        return codes, logits


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> ObjectFinder:
    monkeypatch.setattr(objectron, "TfliteNet", _SpotNet)
    return ObjectFinder(Path())


def test_tiles_see_a_thing_where_it_is(stand_in: ObjectFinder) -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    image[298:303, 418:423] = 255
    found = stand_in.find(image)
    assert {item.label for item in found} == {"chair"}
    middles = np.array([0.5 * (item.box_px[:2] + item.box_px[2:]) for item in found])
    np.testing.assert_allclose(middles, np.tile([420.0, 300.0], (len(found), 1)), atol=0.6)
    widths = sorted(float(item.box_px[2] - item.box_px[0]) for item in found)
    # 64 x 48 in the whole picture and 48 x 48 in its tiles are the same (IoU 3/4); 24 x 24 in tiles of half the side.
    np.testing.assert_allclose(widths, [24.0, 64.0])


def test_other_networks_are_refused() -> None:
    with pytest.raises(ModelMissingError, match="want outputs"):
        load_model(f"objectron@{ensure('blazepose-detector')}")


def test_chairs_of_an_office(finder: ObjectFinder, office: np.ndarray) -> None:
    found = finder.find(office)
    assert [item.score for item in found] == sorted((item.score for item in found), reverse=True)
    assert not any(item.score > 0.5 for item in found if item.label not in ("chair", "shoe"))
    sure = sorted(
        (item.box_px for item in found if item.label == "chair" and item.score > 0.6), key=lambda box_px: box_px[0]
    )
    np.testing.assert_allclose(sure, np.stack([LEFT_CHAIR_PX, np.array([293, 311, 425, 506])]), atol=16)
    man = next(item.box_px for item in found if item.label == "person")
    assert box_iou(man, np.array([[443, 0, 694, 719]]))[0] > 0.7


def test_mirrored_picture_gives_mirrored_boxes(finder: ObjectFinder, office: np.ndarray) -> None:
    mirrored = np.ascontiguousarray(office[:, ::-1])
    there, back = (
        next(item for item in finder.find(image) if item.label == "chair").box_px for image in (office, mirrored)
    )
    np.testing.assert_allclose(719.0 - back[[2, 0]], there[[0, 2]], atol=12.0)
