"""Clips of which a part of the person is not seen: below the picture, or behind a board."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.video.container import open_video
from video2anim.video.encode import FrameWriter

CUT, BELOW, BESIDE = "cut", "below", "beside"
KINDS = (CUT, BELOW, BESIDE)
"""The picture ends there; a board hides what is below; a board as high as the picture hides a side."""
_SEEN_SHARE = 0.35, 0.85
"""Part of the person's height above the cut or the board: from below the chest to the middle of the shins."""
_BESIDE_WIDTHS = 0.25, 0.6
"""Width of an upright board, in widths of the person's box."""


def hide(
    source: Path, target: Path, box_px: Float[np.ndarray, "frames 4"], kind: str, rng: np.random.Generator
) -> None:
    """Write a video in which a part of a person is hidden all the time.

    Args:
        source: video.
        target: video to write.
        box_px: x0, y0, x1, y1 around the person, not finite where there is none.
        kind: one of `KINDS`.
        rng: random numbers for place and look.
    """
    with open_video(source) as container:
        images = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    height, width = images[0].shape[:2]
    x0, y0, x1, y1 = np.nanmedian(box_px, axis=0)
    row = int(np.clip(y0 + rng.uniform(*_SEEN_SHARE) * (y1 - y0), 2, height)) // 2 * 2
    if kind == CUT:
        images = [image[:row] for image in images]
    else:
        left, right = int(np.nanmin(box_px[:, 0]) - 0.3 * (x1 - x0)), int(np.nanmax(box_px[:, 2]) + 0.3 * (x1 - x0))
        if kind == BESIDE:
            wide = int((x1 - x0) * rng.uniform(*_BESIDE_WIDTHS))
            left, row = int(rng.uniform(x0 - 0.5 * wide, x1 - 0.5 * wide)), 0
            right = left + wide
        left, right = max(left, 0), max(min(right, width), 1)
        look = board(rng, height - row, right - left)
        for image in images:
            image[row:, left:right] = look
    aside = target.with_suffix(".part")
    with FrameWriter(aside, width_px=width, height_px=len(images[0])) as writer:
        for image in images:
            writer.write(image)
    aside.replace(target)


def board(rng: np.random.Generator, height: int, width: int) -> UInt8[np.ndarray, "height width 3"]:
    """A picture of a board: random color, grain and shading."""
    grain = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), rng.uniform(1, 4), sigmaY=rng.uniform(1, 40))
    shade = np.linspace(1.15, 0.85, height)[:, None] * (1 + 0.08 * grain / max(float(grain.std()), 1e-6))
    return np.clip(rng.uniform(30, 230, 3) * shade[..., None], 0, 255).astype(np.uint8)
