"""Appearance of people: color histograms of the clothes on the upper and the lower body."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.networks.landmarks import BLAZEPOSE_OF_KEYPOINT

_MAX_PX = 64
"""Longer side of a part's picture, whose pixels are counted. Not measured, like the limits below."""
_PARTS = tuple(
    [BLAZEPOSE_OF_KEYPOINT[f"{side}_{joint}"] for side, joint in corners]
    for corners in (
        (("left", "shoulder"), ("right", "shoulder"), ("right", "hip"), ("left", "hip")),
        (("left", "hip"), ("right", "hip"), ("right", "knee"), ("left", "knee")),
    )
)
"""Corners of the trunk and of the thighs among the landmarks."""
_WIDER = 0.15
"""Margin of the clothes beyond the joints, as a share of the body's width."""
_SEEN = 0.5
"""Visibility of a part's corners from which it is seen."""
_MIN_PIXELS = 40
"""A part with fewer pixels has no histogram."""
_BINS = (6, 12, 12)
"""Of lightness, and of the two color axes of CIE Lab."""
_RANGES = [0.0, 256.0, 68.0, 188.0, 68.0, 188.0]
"""8-bit Lab; the colors of clothes are in the middle of the color axes."""
PARTS = len(_PARTS)


def clothing_histogram(
    image: UInt8[np.ndarray, "height width 3"],
    landmarks_px: Float[np.ndarray, "33 2"],
    visibility: Float[np.ndarray, "33"],
) -> Float[np.ndarray, "2 bins"]:
    """Color histograms of trunk and thighs, each of sum 1; zeros where the part is not seen.

    Bins are blurred, so that a small change of the light changes the histogram little.

    Args:
        image: RGB picture.
        landmarks_px: BlazePose landmarks of the person in it.
        visibility: of the landmarks.
    """
    histograms = np.zeros((PARTS, int(np.prod(_BINS))))
    height, width = image.shape[:2]
    for number, corners in enumerate(_PARTS):
        if visibility[corners].min() < _SEEN:
            continue
        quad = landmarks_px[corners]
        across = 0.5 * ((quad[0] - quad[1]) + (quad[3] - quad[2]))
        quad = quad + _WIDER * np.stack([across, -across, -across, across])
        x0, y0 = (max(int(v), 0) for v in np.floor(quad.min(0)))
        x1, y1 = (min(int(v) + 1, limit) for v, limit in zip(np.ceil(quad.max(0)), (width, height), strict=True))
        if x1 - x0 < 2 or y1 - y0 < 2:
            continue
        piece = image[y0:y1, x0:x1]
        scale = min(1.0, _MAX_PX / max(piece.shape[:2]))
        size = (max(round(scale * (x1 - x0)), 1), max(round(scale * (y1 - y0)), 1))
        lab = cv2.cvtColor(cv2.resize(piece, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2LAB)
        area = np.zeros(lab.shape[:2], np.uint8)
        corners_px = np.rint(scale * (quad - (x0, y0))).astype(np.int32)
        cv2.fillConvexPoly(area, cv2.convexHull(corners_px), 255)
        if np.count_nonzero(area) < _MIN_PIXELS:
            continue
        raw = cv2.calcHist([lab], [0, 1, 2], area, list(_BINS), _RANGES)
        if raw.sum() > 0:
            histograms[number] = _blurred(raw).ravel() / raw.sum()
    return histograms


def _blurred(histogram: np.ndarray) -> np.ndarray:
    """[1 2 1] / 4 along each axis, with edge padding."""
    for axis in range(histogram.ndim):
        padded = np.pad(histogram, [(1, 1) if a == axis else (0, 0) for a in range(histogram.ndim)], mode="edge")
        low, center, high = (np.take(padded, np.arange(s, s + histogram.shape[axis]), axis) for s in (0, 1, 2))
        histogram = 0.25 * low + 0.5 * center + 0.25 * high
    return histogram


@dataclass(slots=True, eq=False)
class AppearanceDescriptor:
    """Colors of a person's clothes, over the frames seen so far."""

    histograms: Float[np.ndarray, "2 bins"] = field(default_factory=lambda: np.zeros((PARTS, int(np.prod(_BINS)))))
    """Sums over frames."""

    def add(self, seen: Float[np.ndarray, "2 bins"]) -> None:
        """Take another frame's `clothing_histogram`."""
        self.histograms = self.histograms + seen

    def distance(self, other: AppearanceDescriptor) -> float:
        """Hellinger distance of the colors, 0 (equal) to 1, mean over the parts seen of both; NaN if there are none."""
        found = []
        for mine, theirs in zip(self.histograms, other.histograms, strict=True):
            if mine.sum() > 0 and theirs.sum() > 0:
                overlap = np.sqrt(mine / mine.sum() * theirs / theirs.sum()).sum()
                found.append(np.sqrt(max(1.0 - overlap, 0.0)))
        return float(np.mean(found)) if found else float("nan")
