"""MoGe-2 (ViT-S with normals, ONNX): metric depth, normals and focal length of one picture.

Tensor contract: input `image` (1, 3, H, W) float32, RGB in [0, 1], any H and W (the network normalizes and resizes
inside), and `num_tokens`, an int64 scalar, about how many patches of 14 px it shall look at (1200 to 3600; an export of
one size has no such input); outputs `points` (1, H, W, 3), in the camera frame (x right, y down, z forward) up to one
scale and one shift along z, `mask` (1, H, W), 0.5 and more where there is geometry, the factor to meters, (1,), called
`scale` in the published file and `metric_scale` in the documentation, and optionally `normal` (1, H, W, 3), of unit
length. Depth in meters is the factor times z plus the shift, and the shift comes with the focal length from the point
map: the one pair for which the points project onto their own pixels. Pixels without geometry are NaN.

Source: `docs/onnx.md` and `moge/model/v2.py` of https://github.com/microsoft/MoGe; the published file is
Ruicheng/moge-2-vits-normal-onnx. Code and weights MIT, the DINOv2 part Apache-2.0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from video2anim.errors import ModelMissingError
from video2anim.networks.network import Network, resized, to_unit_values

TOKENS = 1800
PATCH = 14
_SCALE_NAMES = ("scale", "metric_scale")
_MASK_FROM = 0.5
_SOLVE_POINTS = 4096
"""Points of the map, evenly spread, that focal length and shift are solved from."""
_SOLVE_STEPS = 20
_FLAT = 1e-6
"""Ratio of the eigenvalues of the normal equations below which distance and focal length cannot be told apart: a map
whose depth varies by less than about 0.2 %."""


@dataclass(frozen=True, slots=True, eq=False)
class MetricGeometry:
    """One picture's geometry, at its own size."""

    depth_m: Float[np.ndarray, "height width"]
    """Along the optical axis; NaN outside `valid`."""
    valid: Bool[np.ndarray, "height width"]
    """Pixels with geometry; none at all where no focal length explains the point map."""
    focal_px: float
    """Of the picture, principal point in its middle; NaN where no focal length explains the point map."""
    normal_camera: Float[np.ndarray, "height width 3"] | None
    """Unit length, camera frame, NaN outside `valid`; None where the export has none."""


class Moge:
    """Metric geometry network, which tells the lens too. `kind` and `name` are those of a `DepthClip`."""

    kind = "metric"
    name = "moge-2-small"

    def __init__(self, path: Path, *, tokens: int = TOKENS) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is no network of that contract.
        """
        self._tokens = tokens
        self._network = Network(path, inputs=("image",), optional_inputs=("num_tokens",), outputs=("points", "mask"))
        scale = next((name for name in _SCALE_NAMES if name in self._network.outputs), None)
        if scale is None:
            raise ModelMissingError(f"{path}: want an output scale or metric_scale (a MoGe-2 export), got others")
        self._scale = scale

    def infer(self, image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """Depth in meters at the picture's own size, float32; NaN where there is none.

        Raises:
            ModelMissingError: the network's outputs are not those of the contract.
        """
        return self.infer_all(image).depth_m

    def focal_px(self, image: UInt8[np.ndarray, "height width 3"]) -> float:
        """Focal length of the picture in pixels, principal point in its middle; NaN where none explains the points.

        Raises:
            ModelMissingError: the network's outputs are not those of the contract.
        """
        return self.infer_all(image).focal_px

    def infer_all(self, image: UInt8[np.ndarray, "height width 3"]) -> MetricGeometry:
        """Depth, valid pixels, focal length and normals.

        Raises:
            ModelMissingError: the network's outputs are not those of the contract.
        """
        height, width = image.shape[:2]
        net_h, net_w = self._network.fixed_size("image") or input_size(height, width, self._tokens)
        feeds: dict[str, np.ndarray] = {"image": to_unit_values(resized(image, net_h, net_w))}
        if "num_tokens" in self._network.inputs:
            feeds["num_tokens"] = np.array(self._tokens, np.int64)
        names = [name for name in ("points", "mask", self._scale, "normal") if name in self._network.outputs]
        found = self._network.run(feeds, names)
        self._network.expect_shape("points", found["points"], (1, net_h, net_w, 3))
        self._network.expect_shape("mask", found["mask"], (1, net_h, net_w))
        self._network.expect_shape(self._scale, found[self._scale].reshape(-1), (1,))
        points, meters = found["points"][0], float(found[self._scale].reshape(-1)[0])
        valid = (found["mask"][0] > _MASK_FROM) & np.isfinite(points).all(-1)
        focal_net_px, shift = focal_and_shift(points, valid)
        depth_m = meters * (points[..., 2] + np.float32(shift))
        valid &= np.isfinite(depth_m) & (depth_m > 0.0)
        normal = found.get("normal")
        if normal is not None:
            self._network.expect_shape("normal", normal, (1, net_h, net_w, 3))
        shown = cv2.resize(valid.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)
        return MetricGeometry(
            depth_m=_known_at_size(depth_m, valid, shown),
            valid=shown,
            focal_px=focal_net_px * math.sqrt(width / net_w * height / net_h),
            normal_camera=None if normal is None else _normals_at_size(normal[0], valid, shown),
        )


def input_size(height: int, width: int, tokens: int = TOKENS) -> tuple[int, int]:
    """Height and width to show: the ratio kept, no larger than what the tokens cover, never enlarged.

    The sides need not be multiples of the patch: the network resizes inside and, unlike after a resize out here, knows
    the picture's true ratio then.
    """
    scale = min(1.0, math.sqrt(tokens * PATCH**2 / (height * width)))
    return max(1, round(height * scale)), max(1, round(width * scale))


def focal_and_shift(
    points: Float[np.ndarray, "height width 3"], valid: Bool[np.ndarray, "height width"]
) -> tuple[float, float]:
    """Focal length in pixels of the map and shift along z for which points fall onto their pixels.

    Least squares of f x / (z + shift) - u over the valid pixels, u from the middle of the map: a linear estimate
    (weighted by depth), then damped Gauss-Newton steps. Both are NaN where there are fewer than three points or their
    depths are too equal to tell the two apart.
    """
    height, width = valid.shape
    rows, columns = np.nonzero(valid)
    if rows.size < 3:
        return math.nan, math.nan
    spread = np.linspace(0, rows.size - 1, min(rows.size, _SOLVE_POINTS)).astype(int)
    rows, columns = rows[spread], columns[spread]
    half = 0.5 * math.hypot(height, width)
    uv = np.stack([columns - 0.5 * (width - 1), rows - 0.5 * (height - 1)], axis=-1) / half
    xyz = points[rows, columns].astype(np.float64)
    unit = np.abs(xyz).max()
    if unit == 0.0:
        return math.nan, math.nan
    xy, z = xyz[:, :2] / unit, xyz[:, 2:] / unit
    design = np.stack([xy.ravel(), -uv.ravel()], axis=-1)
    focal, shift = np.linalg.lstsq(design, (uv * z).ravel(), rcond=None)[0]
    nearest = float(z.min())
    if not (focal > 0.0 and nearest + shift > 0.0):
        shift = max(0.0, -nearest) + 0.1
        focal = _best_focal(xy, z + shift, uv)
    focal, shift, curvature = _refined(xy, z, uv, focal, shift)
    eigenvalues = np.linalg.eigvalsh(curvature)
    if not (np.isfinite(eigenvalues).all() and focal > 0.0 and eigenvalues[0] > _FLAT * eigenvalues[1]):
        return math.nan, math.nan
    return float(focal * half), float(shift * unit)


def _best_focal(
    xy: Float[np.ndarray, "points 2"], depth: Float[np.ndarray, "points 1"], uv: Float[np.ndarray, "points 2"]
) -> float:
    ratio = xy / depth
    return float((ratio * uv).sum() / max((ratio * ratio).sum(), 1e-12))


def _refined(
    xy: Float[np.ndarray, "points 2"],
    z: Float[np.ndarray, "points 1"],
    uv: Float[np.ndarray, "points 2"],
    focal: float,
    shift: float,
) -> tuple[float, float, Float[np.ndarray, "2 2"]]:
    """Gauss-Newton over the logarithms of focal length and nearest depth, so that both stay positive.

    Returns focal length, shift and the matrix of the normal equations there, in relative changes of the focal length
    and of the mean depth.
    """
    nearest = float(z.min())

    def cost(f: float, s: float) -> float:
        return float(np.square(f * xy / (z + s) - uv).sum())

    best = cost(focal, shift)
    for _ in range(_SOLVE_STEPS):
        depth, gap = z + shift, nearest + shift
        shown = focal * xy / depth
        slopes = np.stack([shown.ravel(), (-shown * gap / depth).ravel()], axis=-1)
        step = np.linalg.lstsq(slopes, (uv - shown).ravel(), rcond=None)[0]
        for part in (1.0, 0.5, 0.25, 0.1, 0.01):
            moved = np.exp(np.clip(part * step, -2.0, 2.0))
            trial = (focal * float(moved[0]), gap * float(moved[1]) - nearest)
            if (after := cost(*trial)) < best:
                break
        else:
            break
        gained, best = best - after, after
        focal, shift = trial
        if gained <= 1e-12 * best:
            break
    depth = z + shift
    shown = focal * xy / depth
    slopes = np.stack([shown.ravel(), (-shown * depth.mean() / depth).ravel()], axis=-1)
    return focal, shift, slopes.T @ slopes


def _known_at_size(
    values: Float[np.ndarray, "net_height net_width"],
    known: Bool[np.ndarray, "net_height net_width"],
    shown: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Straight lines between known values only; NaN where nothing is shown."""
    size = (shown.shape[1], shown.shape[0])
    weight = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    total = cv2.resize(np.where(known, values, 0.0).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return np.where(shown & (weight > 0.0), total / np.maximum(weight, 1e-6), np.float32(np.nan))


def _normals_at_size(
    normal: Float[np.ndarray, "net_height net_width 3"],
    known: Bool[np.ndarray, "net_height net_width"],
    shown: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width 3"]:
    axes = np.stack([_known_at_size(normal[..., axis], known, shown) for axis in range(3)], axis=-1)
    return axes / np.maximum(np.linalg.norm(axes, axis=-1, keepdims=True), 1e-6)
