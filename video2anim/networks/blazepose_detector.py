"""BlazePose's person detector: faces and body circles in a 224 x 224 picture (SSD, fixed anchors).

Tensor contract: input (1, 224, 224, 3) RGB in [-1, 1]; outputs (1, 2254, 12) box and four key points per anchor,
in input pixels relative to the anchor, and (1, 2254, 1) logits. Source: the public pose_detection graph of MediaPipe.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.errors import ModelMissingError
from video2anim.networks.network import sigmoid
from video2anim.networks.tflite import TfliteNet

INPUT_PX = 224
_GRIDS = ((28, 2), (14, 2), (7, 6))
"""Cells per side and anchors per cell: strides 8, 16 and three layers of 32, two anchors a layer."""
_ANCHORS = sum(cells * cells * copies for cells, copies in _GRIDS)
_VALUES = 12
_NMS_IOU = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """People in one picture, best first, in pixels."""

    score: Float[np.ndarray, "people"]
    face_box_px: Float[np.ndarray, "people 4"]
    """x0, y0, x1, y1 of the head."""
    keypoints_px: Float[np.ndarray, "people 4 2"]
    """Mid hips, rim of the full-body circle, mid shoulders, rim of the upper-body circle."""

    def __len__(self) -> int:
        return len(self.score)

    def shifted(self, x_px: float, y_px: float) -> Detections:
        """The same people where the picture is a part of a larger one."""
        shift = np.array([x_px, y_px])
        return Detections(self.score, self.face_box_px + np.tile(shift, 2), self.keypoints_px + shift)


def concatenate(parts: list[Detections]) -> Detections:
    """All people of several lists."""
    if not parts:
        return Detections(np.zeros(0), np.zeros((0, 4)), np.zeros((0, 4, 2)))
    return Detections(
        np.concatenate([part.score for part in parts]),
        np.concatenate([part.face_box_px for part in parts]),
        np.concatenate([part.keypoints_px for part in parts]),
    )


def anchor_centers(input_size: int = INPUT_PX) -> Float[np.ndarray, "anchors 2"]:
    """x, y of every anchor in input pixels, in the network's order."""
    layers = []
    for cells, copies in _GRIDS:
        center = (np.arange(cells) + 0.5) * (input_size / cells)
        y, x = np.meshgrid(center, center, indexing="ij")
        layers.append(np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), copies, axis=0))
    return np.concatenate(layers)


def decode(
    values: Float[np.ndarray, "anchors 12"],
    logits: Float[np.ndarray, "anchors"],
    centers: Float[np.ndarray, "anchors 2"],
    min_score: float,
) -> Detections:
    """Network outputs to detections in input pixels (edge to edge), before suppression."""
    score = sigmoid(logits.astype(np.float64))
    keep = np.flatnonzero(score >= min_score)
    keep = keep[np.argsort(-score[keep], kind="stable")]
    points = values[keep].astype(np.float64).reshape(-1, 6, 2)
    box_center, box_size = points[:, 0] + centers[keep], points[:, 1]
    box = np.concatenate([box_center - 0.5 * box_size, box_center + 0.5 * box_size], axis=1)
    return Detections(score[keep], box, points[:, 2:] + centers[keep][:, None])


def suppress_weighted(found: Detections, iou: float = _NMS_IOU) -> Detections:
    """Blend overlapping detections (sorted best first) into one each, weighted by score."""
    left = np.arange(len(found))
    kept: list[Detections] = []
    while len(left):
        best = left[0]
        same = box_iou(found.face_box_px[best], found.face_box_px[left]) > iou
        same[0] = True
        group = left[same]
        weight = found.score[group] / found.score[group].sum()
        kept.append(
            Detections(
                found.score[best][None],
                np.einsum("n,nk->k", weight, found.face_box_px[group])[None],
                np.einsum("n,nkc->kc", weight, found.keypoints_px[group])[None],
            )
        )
        left = left[~same]
    return concatenate(kept)


def box_iou(box: Float[np.ndarray, "4"], boxes: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n"]:
    """Intersection over union of one box with several."""
    low, high = np.maximum(box[:2], boxes[:, :2]), np.minimum(box[2:], boxes[:, 2:])
    shared = np.prod(np.clip(high - low, 0.0, None), axis=1)
    area = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    union = np.prod(box[2:] - box[:2]) + area - shared
    return np.where(union > 0.0, shared / np.maximum(union, 1e-12), 0.0)


class BlazePoseDetector:
    """Finds people who fill a large part of an image (head at least about 1/20 of its longer side)."""

    def __init__(self, path: Path) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is not this network.
        """
        self._net = TfliteNet(path)
        wanted = ((1, _ANCHORS, _VALUES), (1, _ANCHORS, 1))
        if self._net.output_shapes != wanted:
            raise ModelMissingError(f"{path}: want outputs {wanted}, got {self._net.output_shapes}")
        self._centers = anchor_centers(self._net.input_size_px)

    def detect(self, image: UInt8[np.ndarray, "height width 3"], *, min_score: float = 0.5) -> Detections:
        """People in an RGB picture of any shape, best first."""
        size = self._net.input_size_px
        height, width = image.shape[:2]
        scale = size / max(height, width)
        fit_w, fit_h = max(1, round(width * scale)), max(1, round(height * scale))
        interpolation = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
        small = cv2.resize(image, (fit_w, fit_h), interpolation=interpolation)
        left, top = (size - fit_w) // 2, (size - fit_h) // 2
        canvas = np.zeros((size, size, 3), np.uint8)
        canvas[top : top + fit_h, left : left + fit_w] = small
        values, logits = self._net(canvas.astype(np.float32) / 127.5 - 1.0)
        found = suppress_weighted(decode(values[0], logits[0, :, 0], self._centers, min_score))
        stretch = np.array([width / fit_w, height / fit_h])
        # Edges of the picture are at -0.5 px where pixel (0, 0) is a center.
        shift = np.array([left, top])
        box = (found.face_box_px.reshape(-1, 2, 2) - shift) * stretch - 0.5
        return Detections(found.score, box.reshape(-1, 4), (found.keypoints_px - shift) * stretch - 0.5)
