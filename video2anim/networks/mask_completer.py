"""A learned completer of the user's: the whole outline and the colors of a partly hidden object.

Tensor contract, of an ONNX network of the user's (tensor names are this adapter's): inputs, float32, of a square crop,

- `picture` (1, 3, 256, 256), RGB in [0, 1], gray (127) beyond the picture's border,
- `visible` (1, 1, 256, 256), 1 where the object is seen, else 0,
- `hidden` (1, 1, 256, 256), 1 where something nearer, or never-seen ground, may hide it, else 0; nowhere both,

and outputs `amodal` (1, 1, 256, 256), logits of the whole outline, positive inside, and `color` (1, 3, 256, 256), the
object's RGB in [0, 1], read only where it is hidden. The crop's middle is that of the seen pixels' box, whose longer
side takes half of it: half as much again as is seen can be hidden at each side. The tasks are those of pix2gestalt
(Ozguroglu et al. 2024) and of mask completers such as AISFormer (Tran et al. 2022); neither publishes a network of this
contract.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from video2anim.errors import StageError
from video2anim.networks.amodal import GRAY
from video2anim.networks.network import Network, resized, to_unit_values

SIDE_PX = 256
FILL = 0.5
"""Share of the crop that the longer side of the visible box takes."""
_MIN_SIDE_PX = 16
"""Of the crop in the picture."""


@dataclass(frozen=True, slots=True, eq=False)
class Completion:
    """An object as it would be seen with nothing in front, at the picture's size."""

    amodal: Bool[np.ndarray, "height width"]
    """The visible pixels and those hidden ones that the network adds."""
    rgb: UInt8[np.ndarray, "height width 3"]
    """The picture, with the network's colors in what it adds."""


class MaskCompleter:
    """Completer of outlines and colors, for slot `completer`."""

    name = "completer"

    def __init__(self, path: Path) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is no network of that contract.
        """
        self._network = Network(path, inputs=("picture", "visible", "hidden"), outputs=("amodal", "color"))

    def complete(
        self,
        picture_rgb: UInt8[np.ndarray, "height width 3"],
        visible: Bool[np.ndarray, "height width"],
        hidden: Bool[np.ndarray, "height width"],
    ) -> Completion:
        """Outline and colors; nothing is added but where the object may be hidden.

        Args:
            picture_rgb: Without people.
            visible: Pixels of the object, at least one.
            hidden: Pixels where it may be hidden.

        Raises:
            StageError: numbers are not finite.
            ModelMissingError: the network's outputs are not those of the contract.
        """
        corner, side = crop_of(visible)
        may_be_hidden = hidden & ~visible
        feeds = {
            "picture": to_unit_values(resized(_cut(picture_rgb, corner, side, GRAY), SIDE_PX, SIDE_PX)),
            "visible": _as_input(_cut(visible, corner, side, False)),
            "hidden": _as_input(_cut(may_be_hidden, corner, side, False)),
        }
        feeds["hidden"] *= 1.0 - feeds["visible"]
        found = self._network.run(feeds, ("amodal", "color"))
        for name, channels in (("amodal", 1), ("color", 3)):
            self._network.expect_shape(name, found[name], (1, channels, SIDE_PX, SIDE_PX))
            if not np.isfinite(found[name]).all():
                wrong = (~np.isfinite(found[name])).mean()
                raise StageError(f"{self.name}: want finite {name}, got {wrong:.0%} that are not")
        size = (side, side)
        logits = cv2.resize(found["amodal"][0, 0], size, interpolation=cv2.INTER_LINEAR)
        color = cv2.resize(found["color"][0].transpose(1, 2, 0), size, interpolation=cv2.INTER_LINEAR)
        inside, added = _overlap(visible.shape, corner, side), np.zeros_like(visible)
        added[inside.there] = (logits[inside.here] > 0.0) & may_be_hidden[inside.there]
        rgb = picture_rgb.copy()
        rgb[added] = np.round(255.0 * np.clip(color[inside.here], 0.0, 1.0)).astype(np.uint8)[added[inside.there]]
        return Completion(visible | added, rgb)


def crop_of(visible: Bool[np.ndarray, "height width"]) -> tuple[tuple[int, int], int]:
    """Top-left pixel (row, column), which may lie outside the picture, and side of the square to show.

    Raises:
        ValueError: nothing is visible.
    """
    rows, columns = np.nonzero(visible)
    if not len(rows):
        raise ValueError("crop_of: want a mask with pixels, got an empty one")
    low, high = (rows.min(), columns.min()), (rows.max() + 1, columns.max() + 1)
    side = max(_MIN_SIDE_PX, round(max(high[0] - low[0], high[1] - low[1]) / FILL))
    return (int(low[0] + high[0] - side) // 2, int(low[1] + high[1] - side) // 2), int(side)


@dataclass(frozen=True, slots=True)
class _Overlap:
    """Where crop and picture are the same pixels."""

    here: tuple[slice, slice]
    """In the crop."""
    there: tuple[slice, slice]
    """In the picture."""


def _overlap(shape: tuple[int, ...], corner: tuple[int, int], side: int) -> _Overlap:
    spans = [(max(0, first), min(length, first + side)) for first, length in zip(corner, shape[:2], strict=True)]
    (top, bottom), (left, right) = spans
    here = slice(top - corner[0], bottom - corner[0]), slice(left - corner[1], right - corner[1])
    return _Overlap(here, (slice(top, bottom), slice(left, right)))


def _cut(image: np.ndarray, corner: tuple[int, int], side: int, beyond: int | bool) -> np.ndarray:
    """The square, with one value beyond the picture's border."""
    square = np.full((side, side, *image.shape[2:]), beyond, image.dtype)
    both = _overlap(image.shape, corner, side)
    square[both.here] = image[both.there]
    return square


def _as_input(mask: Bool[np.ndarray, "side side"]) -> Float[np.ndarray, "1 1 256 256"]:
    """1 where at least half of an input's pixel is in the mask."""
    size, grows = (SIDE_PX, SIDE_PX), mask.shape[0] < SIDE_PX
    share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR if grows else cv2.INTER_AREA)
    return (share >= 0.5).astype(np.float32)[None, None]
