"""GeoCalib (Veicht et al. 2024; pinhole weights, ONNX): perspective field of one picture.

Tensor contract: input `image` (1, 3, H, W) float32, RGB in [0, 1] without further normalization, H and W multiples of
32; outputs `up_field` (1, 2, H, W), unit directions in the picture (x right, y down) in which up lies, `up_confidence`
(1, 1, H, W) in [0, 1], `latitude_field` (1, 1, H, W) in radians, positive above the horizon, and `latitude_confidence`
(1, 1, H, W) in [0, 1]. The picture's shorter side is brought to 320 and the middle is cut out in multiples of 32. The
network's part of GeoCalib only: the fit of a camera to the field is `geometry.perspective_field`.

Source: `scripts/geocalib/export_onnx.py` and `src/colmap/calibration/geocalib.cc` of https://github.com/colmap/colmap,
whose release holds the export; conventions in `geocalib/perspective_fields.py` and `geocalib/gravity.py` of
https://github.com/cvg/GeoCalib. Code Apache-2.0, weights CC-BY-4.0.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.geometry.perspective_field import PerspectiveField
from video2anim.networks.network import Network, resized, to_unit_values

SHORT_SIDE_PX = 320
MULTIPLE_PX = 32
CELL_PX = 16
"""Side of a cell of the answer in pixels of the input: the fields vary slowly, and neighbors err together."""
SURE_SIGMA_RAD = 0.01
"""Error at confidence 1. The confidences are weights of squared errors without a unit; this is the error from which
GeoCalib's own fit trusts a residual less (`up_loss_fn_scale`, `lat_loss_fn_scale`)."""
_OUTPUTS = {"up_field": 2, "up_confidence": 1, "latitude_field": 1, "latitude_confidence": 1}


class GeoCalib:
    """Perspective field network, for slot `camera`."""

    name = "geocalib"

    def __init__(self, path: Path) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is no network of that contract.
        """
        self._network = Network(path, inputs=("image",), outputs=tuple(_OUTPUTS))

    def field(self, image: UInt8[np.ndarray, "height width 3"]) -> PerspectiveField:
        """Up and latitude on cells over the whole picture, about 20 along its shorter side.

        Cells at the border that the network was not shown repeat their neighbors with an error that says nothing is
        known: pi for the direction, half of it for the latitude.

        Raises:
            ModelMissingError: the network's outputs are not those of the contract.
        """
        height, width = image.shape[:2]
        whole, (top, left), (net_h, net_w) = placement(height, width, self._network.fixed_size("image"))
        whole_h, whole_w = whole
        shown = resized(image, whole_h, whole_w)[top : top + net_h, left : left + net_w]
        found = self._network.run({"image": to_unit_values(shown)}, tuple(_OUTPUTS))
        for name, channels in _OUTPUTS.items():
            self._network.expect_shape(name, found[name], (1, channels, net_h, net_w))
        margins = ((top, whole_h - net_h - top), (left, whole_w - net_w - left))
        up, up_sigma = _cells(found["up_field"][0], found["up_confidence"][0, 0], margins, math.pi)
        latitude, latitude_sigma = _cells(
            found["latitude_field"][0], found["latitude_confidence"][0, 0], margins, 0.5 * math.pi
        )
        length = np.linalg.norm(up, axis=-1, keepdims=True)
        return PerspectiveField(
            up=np.where(length > 1e-6, up / np.maximum(length, 1e-6), np.array([0.0, -1.0], np.float32)),
            latitude_rad=latitude[..., 0],
            up_sigma_rad=np.where(length[..., 0] > 1e-6, up_sigma, np.float32(math.pi)),
            latitude_sigma_rad=latitude_sigma,
        )


def placement(
    height: int, width: int, fixed: tuple[int, int] | None = None
) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
    """Size (height, width) to resize the picture to, corner (top, left) of the part shown, and that part's size.

    The ratio is kept: what a network of one size cannot take in is cut off at two sides.
    """
    if fixed is None:
        scale = SHORT_SIDE_PX / min(height, width)
        whole = (max(MULTIPLE_PX, round(height * scale)), max(MULTIPLE_PX, round(width * scale)))
        net = (whole[0] // MULTIPLE_PX * MULTIPLE_PX, whole[1] // MULTIPLE_PX * MULTIPLE_PX)
    else:
        scale = max(fixed[0] / height, fixed[1] / width)
        whole = (max(fixed[0], round(height * scale)), max(fixed[1], round(width * scale)))
        net = fixed
    return whole, ((whole[0] - net[0]) // 2, (whole[1] - net[1]) // 2), net


def _cells(
    values: Float[np.ndarray, "channels height width"],
    confidence: Float[np.ndarray, "height width"],
    margins: tuple[tuple[int, int], tuple[int, int]],
    unknown_sigma_rad: float,
) -> tuple[Float[np.ndarray, "rows columns channels"], Float[np.ndarray, "rows columns"]]:
    """Means over cells weighted by confidence, and their errors; what was not shown has no weight."""
    good = np.isfinite(values).all(axis=0) & np.isfinite(confidence)
    weight = np.pad(np.where(good, np.clip(confidence.astype(np.float64), 0.0, 1.0), 0.0), margins)
    faint = np.maximum(weight, 1e-12)  # so that cells of the margin get their neighbors' values
    height, width = weight.shape
    size = (max(1, round(width / CELL_PX)), max(1, round(height / CELL_PX)))
    mean_weight = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    area = cv2.resize(faint, size, interpolation=cv2.INTER_AREA)
    means = []
    for channel in values:
        whole = np.pad(np.where(good, channel, 0.0), margins, mode="edge")
        means.append(cv2.resize(whole * faint, size, interpolation=cv2.INTER_AREA) / area)
    sigma = np.minimum(SURE_SIGMA_RAD / np.sqrt(np.maximum(mean_weight, 1e-12)), unknown_sigma_rad)
    return np.stack(means, axis=-1).astype(np.float32), sigma.astype(np.float32)
