"""Depth Anything V2 (small, ONNX): relative disparity, or metric depth indoors, of one picture.

Tensor contract of both: input `pixel_values` (1, 3, H, W) float32, RGB in [0, 1] less the ImageNet mean over its
deviation, H and W multiples of 14; output `predicted_depth` (1, H, W) float32. Relative: disparity up to one scale and
offset, larger is nearer. Source: the model card of onnx-community/depth-anything-v2-small. Metric: meters along the
optical axis, 0 to 20 (fine-tuned on Hypersim, rooms); the same architecture, so the same tensors from the same
exporter. Source: the model card of depth-anything/Depth-Anything-V2-Metric-Hypersim-Small (Apache-2.0, `max_depth` 20).
No export of it with a published digest is known, so the user brings one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.errors import ModelMissingError
from video2anim.networks.onnx import open_session

PATCH = 14
SHORT_SIDE_PX = 518
"""Side the network was trained with; the picture's shorter side is brought to it."""
MEAN_RGB = (0.485, 0.456, 0.406)
STD_RGB = (0.229, 0.224, 0.225)


class DepthAnything:
    """Disparity network. `kind` and `name` are those of a `DepthClip`."""

    kind: Literal["disparity", "metric"] = "disparity"
    name = "depth-anything-v2-small"

    def __init__(self, path: Path, *, short_side_px: int = SHORT_SIDE_PX) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is no network of that contract.
        """
        self._path, self._short_side_px = path, short_side_px
        self._session = open_session(path, inputs=("pixel_values",), outputs=("predicted_depth",))
        shape = self._session.inputs["pixel_values"].shape
        self._fixed_hw = tuple(shape[2:]) if all(isinstance(n, int) for n in shape[2:]) else None

    def infer(self, image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """Disparity at the picture's own size, float32, up to scale and offset.

        Raises:
            ModelMissingError: the network's output is not of the contract's shape.
        """
        height, width = image.shape[:2]
        net_h, net_w = self._fixed_hw or input_size(height, width, self._short_side_px)
        pixel_values = to_pixel_values(image, net_h, net_w)
        disparity = self._session.run(["predicted_depth"], {"pixel_values": pixel_values})[0]
        if disparity.ndim != 3 or disparity.shape[0] != 1:
            raise ModelMissingError(f"{self._path}: want predicted_depth (1, H, W), got {disparity.shape}")
        return cv2.resize(disparity[0].astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)


class DepthAnythingMetric(DepthAnything):
    """Metric depth network for rooms: the same tensors, whose values are meters."""

    kind = "metric"
    name = "depth-anything-v2-metric-indoor-small"

    def infer(self, image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """Depth in meters at the picture's own size, float32; NaN where the network gives no positive number.

        Raises:
            ModelMissingError: the network's output is not of the contract's shape.
        """
        depth_m = super().infer(image)
        return np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.float32(np.nan))


def input_size(height: int, width: int, short_side_px: int = SHORT_SIDE_PX) -> tuple[int, int]:
    """Height and width of the network's input: shorter side as asked, ratio kept, multiples of the patch."""
    scale = short_side_px / min(height, width)
    return _to_patches(height * scale), _to_patches(width * scale)


def to_pixel_values(
    image: UInt8[np.ndarray, "height width 3"], net_height: int, net_width: int
) -> Float[np.ndarray, "1 3 net_height net_width"]:
    """Resize (areas when shrinking, cubic when growing), scale to [0, 1], normalize, channels first."""
    grows = net_width > image.shape[1]
    resized = cv2.resize(image, (net_width, net_height), interpolation=cv2.INTER_CUBIC if grows else cv2.INTER_AREA)
    normal = (resized.astype(np.float32) / 255.0 - np.array(MEAN_RGB, np.float32)) / np.array(STD_RGB, np.float32)
    return np.ascontiguousarray(normal.transpose(2, 0, 1)[None])


def _to_patches(length_px: float) -> int:
    return max(PATCH, round(length_px / PATCH) * PATCH)
