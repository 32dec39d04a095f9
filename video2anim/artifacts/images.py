"""Lossless pictures and masks on disk."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from video2anim.errors import ArtifactError, InputError

_ERRORS_ONLY = cv2.utils.logging.LOG_LEVEL_ERROR


def write_png(path: Path, image: np.ndarray) -> None:
    """Write uint8 RGB (H, W, 3), uint8 gray (H, W) or a bool mask (H, W)."""
    path.write_bytes(png_bytes(image, path.name))


def png_bytes(image: np.ndarray, name: str = "image") -> bytes:
    """A picture as PNG; kinds as `write_png` takes them."""
    if image.dtype == np.bool_:
        image = image.astype(np.uint8) * 255
    if image.dtype != np.uint8:
        raise TypeError(f"{name}: want uint8 or bool, got {image.dtype}")
    if image.ndim == 3:
        image = image[..., ::-1]
    ok, encoded = cv2.imencode(".png", np.ascontiguousarray(image))
    if not ok:
        raise ArtifactError(f"{name}: image of shape {image.shape} could not be encoded")
    return encoded.tobytes()


def read_png(path: Path, dtype: np.dtype) -> np.ndarray:
    """Read what `write_png` wrote; masks are thresholded at 128, so a paint program may edit them.

    Raises:
        ArtifactError: not a readable picture.
    """
    data = np.frombuffer(path.read_bytes(), np.uint8)
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(
        _ERRORS_ONLY
    )  # a cut-off file is told by the exception, not by a line of OpenCV's own
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        raise ArtifactError(f"want a PNG, got unreadable bytes at {path}")
    if dtype == np.bool_:
        gray = image if image.ndim == 2 else image[..., :3].max(-1)
        return gray >= 128
    return np.ascontiguousarray(image[..., 2::-1]) if image.ndim == 3 else image


def read_picture(path: Path) -> np.ndarray:
    """A photograph of any common format as uint8 RGB (H, W, 3), upright by its EXIF orientation.

    Raises:
        InputError: missing, or not a picture that can be read.
    """
    if not path.is_file():
        raise InputError(f"pictures: want an image file, found {'a folder' if path.is_dir() else 'nothing'} at {path}")
    data = np.frombuffer(path.read_bytes(), np.uint8)
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(_ERRORS_ONLY)
    try:
        image = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if len(data) else None
    except cv2.error:
        image = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        raise InputError(f"pictures: want a JPEG, PNG or other common image, got unreadable bytes at {path}")
    return image
