"""Black bars around a picture: letterboxes and pillarboxes, as editors and social networks add them.

They are no part of the camera's image: networks would see a window, and the ground would become black.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

_BLACK = 24
"""Luminance of black (16 in limited range) with the noise of compression. Not measured."""
_MIN_RATIO = 0.02
"""Share of the side that a bar has at least: a thumbnail (`has_dark_edges`) shows no row of thinner ones. Bars at
opposite sides differ by less, as dark scenes rarely end so evenly. Not measured."""


@dataclass(frozen=True, slots=True)
class Crop:
    """A part of a picture."""

    left_px: int
    top_px: int
    width_px: int
    height_px: int

    def of(self, image: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "rows columns 3"]:
        """That part of an image."""
        return image[self.top_px : self.top_px + self.height_px, self.left_px : self.left_px + self.width_px]


def has_dark_edges(thumbnail_rgb: UInt8[np.ndarray, "height width 3"]) -> bool:
    """Whether opposite edges of a small picture are black: a quick look, since few videos have bars."""
    return any(int(thumbnail_rgb.take([0, -1], axis).max()) <= _BLACK for axis in (0, 1))


def dark_margins(luminance: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "4"]:
    """How far black rows reach from the top and the bottom, and columns from the left and the right, as shares of the
    side. All 1 for a black picture."""
    left, top, width, height = cv2.boundingRect((luminance > _BLACK).astype(np.uint8))
    if not width:
        return np.ones(4)
    rows, columns = luminance.shape
    return np.array([top / rows, 1 - (top + height) / rows, left / columns, 1 - (left + width) / columns])


def picture_area(margins: Float[np.ndarray, "pictures 4"], size_px: tuple[int, int]) -> Crop:
    """The part of pictures inside of their bars; all of it where there are none.

    Args:
        margins: Of each picture, by `dark_margins`.
        size_px: Width and height of the pictures.
    """
    width, height = size_px
    margin = margins.min(0) if len(margins) else np.zeros(4)
    top, bottom = _bars_px(margin[:2], height)
    left, right = _bars_px(margin[2:], width)
    return Crop(int(left), int(top), int(width - left - right), int(height - top - bottom))


def _bars_px(margin: Float[np.ndarray, "2"], side_px: int) -> Int[np.ndarray, "2"]:
    """Even numbers of lines of the bars at both ends, with the blurred one between bar and picture."""
    if margin.min() < _MIN_RATIO or abs(margin[0] - margin[1]) >= _MIN_RATIO or margin.sum() > 1 - _MIN_RATIO:
        return np.zeros(2, int)
    # Shares of whole lines are whole again but for rounding.
    return 2 * np.ceil((np.round(margin * side_px, 3) + 1) / 2).astype(int)
