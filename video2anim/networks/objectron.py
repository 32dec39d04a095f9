"""Objectron's detector: everyday objects in a picture.

Tensor contract of `object_detection_ssd_mobilenetv2_oidv4_fp16.tflite`: input (1, 300, 300, 3) RGB in [-1, 1], the
picture stretched to it; outputs (1, 1917, 4) boxes y, x, height, width relative to the anchors (SSD: middle tenfold,
logarithm of the size fivefold), and (1, 1917, 24) logits, class 0 = nothing.
Source: the public objectron and object_detection_oid_v4 graphs of MediaPipe.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from video2anim.errors import ModelMissingError
from video2anim.networks.blazepose_detector import box_iou
from video2anim.networks.network import sigmoid
from video2anim.networks.tflite import TfliteNet
from video2anim.networks.tiles import square_tiles

WORDS = (
    "", "bicycle", "shoe", "laptop", "person", "chair", "cow", "desk", "cat", "mouse", "monitor", "box", "cup", "cup",
    "exercise bike", "table", "bottle", "shoe", "vehicle", "shoe", "dog", "book", "camera", "car",
)  # fmt: skip
"""Our word for each class. Boots, high heels and footwear are shoes, a mug and a coffee cup are cups."""
_KINDS = {"desk": "table", "car": "vehicle"}
"""Labels that the network confuses: of one object that has both, the likelier one stays."""
_STRIDES = (16, 32, 64, 128, 256, 512)
_SCALES = (0.2, 0.35, 0.5, 0.65, 0.8, 0.95, 1.0)
"""Share of the image that an anchor of each layer covers; the last value serves to interpolate in the last layer."""
_CENTER_SCALE, _SIZE_SCALE = 10.0, 5.0
_SAME_IOU = 0.4
_CUT_RATIO = 0.03
"""A box this near (share of the tile's side) to an edge of its tile inside the image is cut by it and left out."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundObject:
    """An object in a picture."""

    label: str
    """One of `WORDS`."""
    score: float
    """0 to 1."""
    box_px: Float[np.ndarray, "4"]
    """x0, y0, x1, y1; may reach beyond the picture."""


class ObjectFinder:
    """Detector of objects."""

    def __init__(self, path: Path) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is not that network.
        """
        self._net = TfliteNet(path)
        self._anchors = anchor_boxes(self._net.input_size_px)
        wanted = ((1, len(self._anchors), 4), (1, len(self._anchors), len(WORDS)))
        if self._net.output_shapes != wanted:
            raise ModelMissingError(f"{path}: want outputs {wanted}, got {self._net.output_shapes}")

    def find(self, image: UInt8[np.ndarray, "height width 3"], *, min_score: float = 0.3) -> tuple[FoundObject, ...]:
        """Objects in an RGB picture of any shape, best first: in the whole picture, and in square tiles."""
        height, width = image.shape[:2]
        found = self._detect(image, min_score)
        # A smaller tile would only magnify blur.
        for x0, y0, side in square_tiles(width, height, min_px=self._net.input_size_px // 2):
            inside = np.array([x0, y0, x0 + side, y0 + side])
            tile = self._detect(image[y0 : y0 + side, x0 : x0 + side], min_score)
            moved = [FoundObject(item.label, item.score, item.box_px + inside[[0, 1, 0, 1]]) for item in tile]
            found += [item for item in moved if not is_cut(item.box_px, inside, width, height)]
        return distinct(found)

    def _detect(self, image: UInt8[np.ndarray, "height width 3"], min_score: float) -> list[FoundObject]:
        height, width = image.shape[:2]
        side = self._net.input_size_px
        interpolation = cv2.INTER_AREA if max(height, width) > side else cv2.INTER_LINEAR
        small = cv2.resize(image, (side, side), interpolation=interpolation)
        codes, logits = self._net(small.astype(np.float32) / 127.5 - 1.0)
        boxes, scores, classes = decode(codes[0], logits[0], self._anchors, min_score)
        # Edges of the picture are at -0.5 px where pixel (0, 0) is a center.
        boxes_px = boxes * (width, height, width, height) - 0.5
        return [
            FoundObject(WORDS[number], float(score), box_px)
            for number, score, box_px in zip(classes, scores, boxes_px, strict=True)
        ]


def anchor_boxes(input_px: int = 300) -> Float[np.ndarray, "anchors 4"]:
    """y, x of the center, height and width of every anchor, as shares of the image, in the network's order."""
    layers = []
    for k, stride in enumerate(_STRIDES):
        scale, between = _SCALES[k], math.sqrt(_SCALES[k] * _SCALES[k + 1])
        if k == 0:
            shapes = [(0.1, 1.0), (scale, 2.0), (scale, 0.5)]
        else:
            shapes = [*((scale, aspect) for aspect in (1.0, 2.0, 0.5, 3.0, 1 / 3)), (between, 1.0)]
        cells = math.ceil(input_px / stride)
        center = (np.arange(cells) + 0.5) / cells
        y, x = np.meshgrid(center, center, indexing="ij")
        sizes = np.array([(side / math.sqrt(aspect), side * math.sqrt(aspect)) for side, aspect in shapes])
        centers = np.repeat(np.stack([y.ravel(), x.ravel()], axis=1), len(shapes), axis=0)
        layers.append(np.concatenate([centers, np.tile(sizes, (cells * cells, 1))], axis=1))
    return np.concatenate(layers)


def decode(
    codes: Float[np.ndarray, "anchors 4"],
    logits: Float[np.ndarray, "anchors classes"],
    anchors: Float[np.ndarray, "anchors 4"],
    min_score: float,
) -> tuple[Float[np.ndarray, "found 4"], Float[np.ndarray, "found"], Int[np.ndarray, "found"]]:
    """x0, y0, x1, y1 as shares of the picture, score and class number of all that is likely enough."""
    scores = sigmoid(logits.astype(np.float64))
    scores[:, 0] = 0.0
    rows, classes = np.nonzero(scores >= min_score)
    code, anchor = codes[rows].astype(np.float64), anchors[rows]
    center = anchor[:, :2] + code[:, :2] / _CENTER_SCALE * anchor[:, 2:]
    half = 0.5 * anchor[:, 2:] * np.exp(code[:, 2:] / _SIZE_SCALE)
    return np.concatenate([center - half, center + half], axis=1)[:, [1, 0, 3, 2]], scores[rows, classes], classes


def distinct(found: Iterable[FoundObject]) -> tuple[FoundObject, ...]:
    """Each object once, best first: what overlaps a better one of its kind is the same."""
    kept: list[FoundObject] = []
    for item in sorted(found, key=lambda item: -item.score):
        same = [other.box_px for other in kept if _kind(other) == _kind(item)]
        if not same or box_iou(item.box_px, np.array(same)).max() <= _SAME_IOU:
            kept.append(item)
    return tuple(kept)


def is_cut(box_px: Float[np.ndarray, "4"], tile_px: Float[np.ndarray, "4"], width_px: int, height_px: int) -> bool:
    """Whether a box touches an edge of its tile (x0, y0, x1, y1) that is no edge of the picture."""
    reach = _CUT_RATIO * (tile_px[2] - tile_px[0])
    before = (box_px[:2] < tile_px[:2] + reach) & (tile_px[:2] > 0)
    behind = (box_px[2:] > tile_px[2:] - reach) & (tile_px[2:] < (width_px, height_px))
    return bool(before.any() or behind.any())


def _kind(found: FoundObject) -> str:
    return _KINDS.get(found.label, found.label)
