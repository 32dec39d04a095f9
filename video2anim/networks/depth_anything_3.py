"""Depth Anything 3 (small, ONNX): relative depth of one picture, and the lens it implies.

Tensor contract: input `pixel_values` (1, 1, 3, H, W) float32 (batch, views, channels; an export for one view may leave
the second axis out), RGB in [0, 1] less the ImageNet mean over its deviation, H and W multiples of 14; outputs
`predicted_depth` (1, 1, H, W) float32, positive depth up to one scale, larger is farther; and, where the export has
them, `confidence` (1, 1, H, W), `extrinsics` (1, 1, 3, 4) and `intrinsics` (1, 1, 3, 3) in pixels of the input. Of one
view the extrinsics say nothing and are not read. Pictures are brought to a longer side of 504 with their ratio kept.

The graph is a small file that names its weights `model.onnx_data`, which must lie beside it. Source: the model card of
onnx-community/depth-anything-v3-small (Apache-2.0, as DA3-SMALL and DA3-BASE are; LARGE and GIANT are CC-BY-NC-4.0) and
the processing notes of https://github.com/ByteDance-Seed/Depth-Anything-3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.networks.depth_anything import PATCH, to_pixel_values
from video2anim.networks.network import Network

LONG_SIDE_PX = 504
"""Longer side at which the project runs its networks."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenDepth:
    """One picture's answer, at its own size."""

    depth: Float[np.ndarray, "height width"]
    """Up to one scale; larger is farther; NaN where the network gives no positive number."""
    confidence: Float[np.ndarray, "height width"] | None
    """Larger is surer, without a unit; None where the export has none."""
    focal_px: float
    """Of the picture; NaN where the export has no intrinsics or they are no lens."""


class DepthAnything3:
    """Relative depth network, which tells the lens too. `kind` and `name` are those of a `DepthClip`."""

    kind = "depth"
    name = "depth-anything-3-small"

    def __init__(self, path: Path, *, long_side_px: int = LONG_SIDE_PX) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is no network of that contract.
        """
        self._network = Network(path, inputs=("pixel_values",), outputs=("predicted_depth",))
        self._long_side_px = long_side_px

    def infer(self, image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """Depth at the picture's own size, float32, up to one scale; NaN where there is none.

        Raises:
            ModelMissingError: the network's output is not of the contract's shape.
        """
        return self.infer_all(image).depth

    def focal_px(self, image: UInt8[np.ndarray, "height width 3"]) -> float:
        """Focal length of the picture in pixels, NaN where the network does not tell.

        Raises:
            ModelMissingError: the network's output is not of the contract's shape.
        """
        return self.infer_all(image).focal_px

    def infer_all(self, image: UInt8[np.ndarray, "height width 3"]) -> SeenDepth:
        """Depth, confidence and focal length.

        Raises:
            ModelMissingError: the network's output is not of the contract's shape.
        """
        height, width = image.shape[:2]
        net_h, net_w = self._network.fixed_size("pixel_values") or input_size(height, width, self._long_side_px)
        pixel_values = to_pixel_values(image, net_h, net_w)
        views = (1,) * (self._network.rank("pixel_values") - 4)
        names = [name for name in ("predicted_depth", "confidence", "intrinsics") if name in self._network.outputs]
        found = self._network.run({"pixel_values": pixel_values.reshape(1, *views, 3, net_h, net_w)}, names)
        for name in ("predicted_depth", "confidence"):
            if name in found:
                self._network.expect_shape(name, found[name], (1, *views, None, None))
        depth = _at_size(found["predicted_depth"], height, width)
        confidence = found.get("confidence")
        return SeenDepth(
            depth=np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(np.nan)),
            confidence=None if confidence is None else _at_size(confidence, height, width),
            focal_px=_focal_px(found.get("intrinsics"), width / net_w, height / net_h),
        )


def input_size(height: int, width: int, long_side_px: int = LONG_SIDE_PX) -> tuple[int, int]:
    """Height and width of the network's input: longer side as asked, ratio kept, multiples of the patch."""
    scale = long_side_px / max(height, width)
    return max(PATCH, round(height * scale / PATCH) * PATCH), max(PATCH, round(width * scale / PATCH) * PATCH)


def _at_size(values: np.ndarray, height: int, width: int) -> Float[np.ndarray, "height width"]:
    plane = values.reshape(values.shape[-2:])
    return cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR)


def _focal_px(intrinsics: np.ndarray | None, width_ratio: float, height_ratio: float) -> float:
    """Mean of both focal lengths, each brought from pixels of the input to those of the picture."""
    if intrinsics is None or intrinsics.size != 9:
        return math.nan
    fx, fy = (float(intrinsics.reshape(3, 3)[axis, axis]) for axis in (0, 1))
    if not (0.0 < fx < math.inf and 0.0 < fy < math.inf):
        return math.nan
    return 0.5 * (fx * width_ratio + fy * height_ratio)
