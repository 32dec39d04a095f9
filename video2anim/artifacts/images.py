"""Lossless pictures and masks on disk."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from video2anim.artifacts.arrays import Axes, damage, expect_content, expect_shape
from video2anim.artifacts.stage_files import opened
from video2anim.errors import ArtifactError, InputError
from video2anim.types.checks import annotation

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_MAX_PIXELS = 1 << 27
"""Larger pictures (11,585 px square) are refused before they are unpacked."""


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


def read_png(path: Path, dtype: np.dtype, *, hint: Any = np.ndarray, axes: Axes | None = None) -> np.ndarray:
    """Read what `write_png` wrote or a paint program saved over it.

    A mask (bool) is where the picture is at least half bright and at least half opaque, at 8 or 16 bits per channel,
    gray or color. Other pictures have 8 bits per channel and are opaque; gray becomes RGB where RGB is wanted.

    Args:
        path: of the picture.
        dtype: bool or uint8.
        hint: annotation that gives the shape and says whether the picture may be empty.
        axes: named lengths that the shape must have.

    Raises:
        ArtifactError: not a readable picture, or not of that size and depth.
    """
    with opened(path) as stream:
        data = stream.read()
    if data[:8] != _SIGNATURE or data[12:16] != b"IHDR" or len(data) < 33:
        raise ArtifactError(f"want a PNG, got unreadable bytes at {path}")
    width, height = struct.unpack(">II", data[16:24])
    if width * height > _MAX_PIXELS:
        raise ArtifactError(f"{path.name}: want at most {_MAX_PIXELS} pixels, got {width} x {height} at {path}")
    kind, marks = annotation(hint)
    axes = {} if axes is None else axes
    in_color = dtype == np.uint8 and kind is not np.ndarray and len(kind.dim_str.split()) == 3
    if kind is not np.ndarray:  # before the pixels are unpacked
        expect_shape((height, width, 3) if in_color else (height, width), dtype, hint, axes, path.name, path)
    with damage(path):
        image = _decoded(data, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ArtifactError(f"want a PNG, got unreadable bytes at {path}")
    half = 1 << (8 * image.itemsize - 1)
    if dtype == np.bool_:
        picture = (image if image.ndim == 2 else image[..., :3].max(-1)) >= half
        picture &= True if image.shape[2:] != (4,) else image[..., 3] >= half
    elif image.dtype != np.uint8 or (image.shape[2:] == (4,) and image[..., 3].min(initial=255) < 255):
        raise ArtifactError(f"{path.name}: want 8 bits per channel and no transparent pixel, got others at {path}")
    else:
        image = image[..., None].repeat(3, -1) if in_color and image.ndim == 2 else image
        picture = np.ascontiguousarray(image[..., 2::-1]) if image.ndim == 3 else image
    expect_content(picture, marks, axes, path.name, path)
    return picture


def _decoded(data: bytes, flags: int) -> np.ndarray | None:
    """Pixels as OpenCV reads them; damage is told by None, not by lines of OpenCV's own."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    finally:
        cv2.utils.logging.setLogLevel(level)


def read_picture(path: Path) -> np.ndarray:
    """A photograph of any common format as uint8 RGB (H, W, 3), upright by its EXIF orientation.

    Raises:
        InputError: missing, or not a picture that can be read.
    """
    if not path.is_file():
        raise InputError(f"pictures: want an image file, found {'a folder' if path.is_dir() else 'nothing'} at {path}")
    try:
        image = _decoded(path.read_bytes(), cv2.IMREAD_COLOR_RGB)
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"pictures: want a JPEG, PNG or other common image, got unreadable bytes at {path}")
    return image
