"""Perspective fields, and the camera that explains them best.

A perspective field (Jin et al. 2023) says for each pixel where up is in the picture and how high above the horizon the
pixel looks. Both follow from the lens and gravity alone, and fix them: vertical field of view, pitch and roll are
fitted by robust least squares.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

_STARTS = (0.55, 0.95, 1.7)
"""Focal lengths, in picture heights, that the fit starts from."""
_KNOWN_SIGMA = 1e-3
"""Standard deviation of the logarithm of a known focal length: far below that of any field."""
_INDEPENDENT_CELLS = 2.3
"""So many independent observations all fields of a view are worth together; calibrated on held-out renders
(`benchmarks/room_net.py`)."""


@dataclass(frozen=True, slots=True, eq=False)
class PerspectiveField:
    """Up and latitude on a regular grid of cells over one picture."""

    up: Float[np.ndarray, "rows columns 2"]
    """Unit direction in the picture (x right, y down) in which a point that rises moves, at the cells' centers."""
    latitude_rad: Float[np.ndarray, "rows columns"]
    """Angle of the cell's ray over the horizon; positive looks up."""
    up_sigma_rad: Float[np.ndarray, "rows columns"]
    """Expected error of the direction."""
    latitude_sigma_rad: Float[np.ndarray, "rows columns"]
    """Expected error of the latitude."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldCamera:
    """Lens and gravity that explain a field."""

    focal_ratio: float
    """Focal length in picture heights."""
    up_camera: Float[np.ndarray, "3"]
    """Unit up vector in camera axes (+X right, +Y down, +Z forward)."""
    covariance: Float[np.ndarray, "3 3"]
    """Of the focal length's logarithm, pitch and roll (radians)."""

    @property
    def focal_log_sigma(self) -> float:
        """Standard deviation of the focal length's logarithm."""
        return math.sqrt(self.covariance[0, 0])

    @property
    def up_sigma_rad(self) -> float:
        """Expected error of the up vector."""
        return math.sqrt(self.covariance[1, 1] + self.covariance[2, 2])

    @property
    def fov_y_rad(self) -> float:
        """Vertical field of view."""
        return 2 * math.atan(0.5 / self.focal_ratio)

    def with_focal(self, focal_ratio: float) -> FieldCamera:
        """What the field says of gravity if the focal length is known from elsewhere.

        A network that knows no such lens sees where the horizon is, and turns it into an angle by a focal length of its
        own. So the horizon stays for the part of the focal length's error that the network's standard deviation does
        not expect (James and Stein's estimator of one mean), the pitch for the rest.
        """
        error = math.log(self.focal_ratio / focal_ratio)
        unexpected = max(0.0, 1 - self.covariance[0, 0] / error**2) if error else 0.0
        pitch, roll = pitch_roll_of(self.up_camera)
        pitch = math.atan(math.tan(pitch) * math.exp(unexpected * error))
        covariance = np.diag([_KNOWN_SIGMA**2, 0.0, 0.0])
        along = self.covariance[1:, 0]
        covariance[1:, 1:] = self.covariance[1:, 1:] - np.outer(along, along) / self.covariance[0, 0]
        return FieldCamera(focal_ratio, up_of(pitch, roll), covariance)


def field_of_camera(
    rows: int, columns: int, aspect: float, focal_ratio: float, up_camera: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "rows columns 2"], Float[np.ndarray, "rows columns"]]:
    """Up and latitude of a pinhole camera with its principal point in the middle.

    Args:
        aspect: Width over height of the picture.
        focal_ratio: Focal length in picture heights.
    """
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * aspect / focal_ratio
    y = ((np.arange(rows) + 0.5) / rows - 0.5) / focal_ratio
    ray_x, ray_y = np.meshgrid(x, y)
    in_picture = np.stack([up_camera[0] - ray_x * up_camera[2], up_camera[1] - ray_y * up_camera[2]], -1)
    in_picture /= np.maximum(np.linalg.norm(in_picture, axis=-1, keepdims=True), 1e-9)
    along = ray_x * up_camera[0] + ray_y * up_camera[1] + up_camera[2]
    return in_picture, np.arcsin(np.clip(along / np.sqrt(1 + ray_x**2 + ray_y**2), -1, 1))


def fit_camera(fields: Sequence[PerspectiveField], aspect: float) -> FieldCamera:
    """The one camera that explains the fields of one or several pictures of the same view best.

    Robust (soft L1) least squares of up directions and latitudes over their expected errors, from several starts.
    Errors of neighboring cells go together, so the uncertainty counts a field as few independent cells, and is no
    smaller than what is left unexplained.

    Args:
        fields: Perspective fields.
        aspect: Width over height of the pictures.

    Raises:
        ValueError: there is no field, or one holds values that are not finite.
    """
    if not fields or not all(np.isfinite(f.latitude_rad).all() and np.isfinite(f.up).all() for f in fields):
        raise ValueError("fit_camera: want at least one field of finite values")

    def residuals(state: np.ndarray) -> np.ndarray:
        parts = []
        for field in fields:
            rows, columns = field.latitude_rad.shape
            up, latitude = field_of_camera(rows, columns, aspect, math.exp(state[0]), up_of(state[1], state[2]))
            cross = up[..., 0] * field.up[..., 1] - up[..., 1] * field.up[..., 0]
            turned = np.arctan2(cross, (up * field.up).sum(-1))
            parts += [turned / field.up_sigma_rad, (latitude - field.latitude_rad) / field.latitude_sigma_rad]
        return np.concatenate([part.ravel() for part in parts])

    latitude = np.median([np.median(field.latitude_rad) for field in fields])
    center = np.mean([_middle_up(field) for field in fields], axis=0)
    roll = math.atan2(center[0], -center[1])
    best = None
    bounds = ([math.log(0.2), -1.5, roll - 1.5], [math.log(8.0), 1.5, roll + 1.5])
    for start_ratio in _STARTS:
        start = np.array([math.log(start_ratio), float(latitude), roll])
        found = least_squares(residuals, start, loss="soft_l1", bounds=bounds, x_scale=[0.1, 0.05, 0.05])
        if best is None or found.cost < best.cost:
            best = found
    assert best is not None
    # What the cells miss beyond what they expected is shared by all of them.
    spread = max(1.0, float(np.median(np.abs(best.fun))) / 0.6)
    information = best.jac.T @ best.jac / (best.fun.size / 2) * _INDEPENDENT_CELLS / spread**2
    covariance = np.linalg.inv(information + 1e-9 * np.eye(3))
    return FieldCamera(math.exp(best.x[0]), up_of(best.x[1], best.x[2]), covariance)


def up_of(pitch_rad: Any, roll_rad: Any) -> Float[np.ndarray, "*batch 3"]:
    """Up in camera axes of a camera that looks up by pitch and is turned by roll about its axis."""
    level = np.cos(pitch_rad)
    return np.stack([level * np.sin(roll_rad), -level * np.cos(roll_rad), np.sin(pitch_rad)], -1)


def pitch_roll_of(up_camera: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Pitch (positive looks up) and roll of a camera whose unit up vector is given in its own axes."""
    return math.asin(float(np.clip(up_camera[2], -1, 1))), math.atan2(float(up_camera[0]), float(-up_camera[1]))


def _middle_up(field: PerspectiveField) -> Float[np.ndarray, "2"]:
    rows, columns = field.latitude_rad.shape
    return field.up[rows // 3 : rows - rows // 3, columns // 3 : columns - columns // 3].mean((0, 1))
