"""Objectron's chair network: the upright 3D box of a chair, as nine points of the picture.

Tensor contract of `object_detection_3d_chair.tflite`: input (1, 224, 224, 3) RGB in [0, 1], a crop around the chair;
outputs (1, 18) = 9 x (x, y) in input pixels, edge to edge, and (1, 1) the probability that a chair is there.
Source: the public box_landmark graph of MediaPipe; order of the points: class Box of the Objectron data set.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.errors import ModelMissingError
from video2anim.networks.roi import SquareRoi
from video2anim.networks.tflite import TfliteNet

CORNERS = np.array([(0, 0, 0), *((x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1))], np.float64)
"""The points of a chair's box in units of half its size: center, then corners; x to the left of who sits in it, y up,
z to where the sitter looks."""
_CROP_RATIOS = (1.3, 1.45, 1.6)
"""Sides of the crops that the chair network is applied to, over the longer side of the detected box."""


@dataclass(frozen=True, slots=True, eq=False)
class ChairBox:
    """The upright box around a chair, as the picture shows it."""

    confidence: float
    """Probability that the crop shows a chair."""
    points_px: Float[np.ndarray, "9 2"]
    """Center, then corners in the order of `CORNERS`: 1, 2, 6, 5 stand on the floor, 2, 6, 8, 4 are the front."""


class ChairBoxes:
    """The upright 3D box of a chair from a crop around it.

    It also responds to hair, bags and some shelves, so a detection must come first.
    """

    def __init__(self, path: Path) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is not that network.
        """
        self._net = TfliteNet(path)
        wanted = ((1, 2 * len(CORNERS)), (1, 1))
        if self._net.output_shapes != wanted:
            raise ModelMissingError(f"{path}: want outputs {wanted}, got {self._net.output_shapes}")

    def fit(
        self, image: UInt8[np.ndarray, "height width 3"], box_px: Float[np.ndarray, "4"], *, min_confidence: float = 0.5
    ) -> ChairBox | None:
        """The likeliest box of several crops around `box_px`; None where none is likely."""
        views = [self._predict(image, _square_around(box_px, ratio)) for ratio in _CROP_RATIOS]
        confidence, points_px = max(views, key=lambda view: view[0])
        if confidence < min_confidence:
            return None
        return ChairBox(confidence, points_px)

    def _predict(
        self, image: UInt8[np.ndarray, "height width 3"], roi: SquareRoi
    ) -> tuple[float, Float[np.ndarray, "9 2"]]:
        side = self._net.input_size_px
        crop = roi.crop(image, side, border=cv2.BORDER_REPLICATE)
        points, confidence = self._net(crop.astype(np.float32) / 255.0)
        return float(confidence[0, 0]), roi.to_pixels(points[0].astype(np.float64).reshape(-1, 2) / side)


def _square_around(box_px: Float[np.ndarray, "4"], ratio: float) -> SquareRoi:
    x0, y0, x1, y1 = (float(v) for v in box_px)
    return SquareRoi(0.5 * (x0 + x1), 0.5 * (y0 + y1), ratio * max(x1 - x0, y1 - y0), 0.0)
