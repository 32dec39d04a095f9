"""Bars around a picture: letterboxes and pillarboxes of black, of a color, or of the blurred picture itself, as editors
and social networks add them.

They are no part of the camera's image: networks would see a window or a second person, and the ground would become
black. A bar has little detail and ends in one straight line of pixels, which no scene does at both sides of a picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

EVERY = 5
"""Of so many pictures one is looked at: the shortest clip has as many."""
_DETAIL = 1 / 60
"""Second differences of luminance larger than this share of the picture's contrast are detail: 4 levels in daylight.
Blurred bars after H.264 at crf 18 to 34 have up to 34 % of such pixels in a line, where there is text on them; the last
line of a bar has 75 % or more (a script that is not kept, three clips of the media folder with bars of nine kinds)."""
_PLAIN_SHARE = 0.4
"""Most pixels with detail in a line of a bar, as a share: between the two of `_DETAIL`."""
_EDGE_SHARE = 0.7
"""Fewest pixels with detail in the line where a bar ends, as a share: between the two of `_DETAIL`."""
_MIN_RATIO = 0.02
"""Share of the side that a bar has at least. Bars at opposite sides differ by less. Not measured."""


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


def bar_margins(luminance: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "4"]:
    """How far bars reach from the top, the bottom, the left and the right, as shares of the side; 0 without a bar."""
    values = luminance.astype(np.int16)
    least = _DETAIL * float(np.ptp(np.percentile(values, (1, 99))))
    top, bottom = _margins(values, least)
    between = values[round(top * len(values)) : len(values) - round(bottom * len(values))]
    return np.array([top, bottom, *_margins(between.T, least)])


def _margins(lines: Int[np.ndarray, "lines pixels"], least: float) -> tuple[float, float]:
    """Shares of the first and the last lines that are bars; `least` is the smallest detail."""
    if len(lines) < 3:
        return 0.0, 0.0
    detail = (np.abs(lines[2:] - 2 * lines[1:-1] + lines[:-2]) > least).mean(1)
    return _bar(detail) / len(lines), _bar(detail[::-1]) / len(lines)


def _bar(detail: Float[np.ndarray, "lines"]) -> int:
    """Lines before the edge, from the shares of pixels with detail in all lines but the first and the last."""
    half = detail[: len(detail) // 2]
    busy = int(np.argmax(half > _PLAIN_SHARE))
    # The line between bar and picture may be blurred.
    is_edge = half[busy : busy + 3].max(initial=0) > _EDGE_SHARE
    return busy + 2 if is_edge and busy else 0


def picture_area(margins: Float[np.ndarray, "pictures 4"], size_px: tuple[int, int]) -> Crop:
    """The part of pictures inside of their bars; all of it where there are none.

    Args:
        margins: Of each picture, by `bar_margins`.
        size_px: Width and height of the pictures.
    """
    width, height = size_px
    margin = np.median(margins, 0) if len(margins) else np.zeros(4)
    top, bottom = _bars_px(margin[:2], height)
    left, right = _bars_px(margin[2:], width)
    return Crop(int(left), int(top), int(width - left - right), int(height - top - bottom))


def _bars_px(margin: Float[np.ndarray, "2"], side_px: int) -> Int[np.ndarray, "2"]:
    """Even numbers of lines of the bars at both ends, with the blurred one between bar and picture."""
    if margin.min() < _MIN_RATIO or abs(margin[0] - margin[1]) >= _MIN_RATIO or margin.sum() > 1 - _MIN_RATIO:
        return np.zeros(2, int)
    # Shares of whole lines are whole again but for rounding.
    return 2 * np.ceil((np.round(margin * side_px, 3) + 1) / 2).astype(int)
