"""Person segmentation: which pixels show a person.

The log odds of two sources are added: the person model's mask, which is coarse, and the difference from the background
image, which is sharp but also shows shadows and other changes. Where the background image is unknown the mask decides
alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from video2anim.types.people import PersonTrack

_MAX_PROBABILITY = 0.98
"""No value of the mask is taken as more certain than this."""
_UNDECIDED = 0.5
"""A mask whose probability stays below this everywhere holds no person; the landmark box, with this probability, takes
its place."""
_NEUTRAL_NOISE = 3.0
"""Difference, in noise levels, that is evidence neither for a person nor against one."""
_EVIDENCE_GAIN = 2.0
"""Log odds per natural logarithm of the difference."""
_EVIDENCE_LIMIT = 2.5
"""Largest log odds that the difference may add."""
_NOISE_FLOOR_LAB = 1.5
"""Least noise level of the difference, in CIE Lab."""
_NOISE_BLUR_PX = 20.0
"""Scale of the regions over which noise is averaged, in reduced pixels."""
_LUMINANCE_WEIGHT = 0.5
"""Weight of luminance in the difference: cast shadows change it most."""
_MIN_PART = 0.03
"""Connected regions below this share of the largest one are dropped."""


@dataclass(frozen=True, slots=True)
class Raster:
    """A reduced picture of a clip, and the map between their pixels."""

    width_px: int
    height_px: int
    scale_x: float
    scale_y: float

    @classmethod
    def of_clip(cls, width_px: int, height_px: int, long_side_px: int) -> Raster:
        """The clip's picture with its longer side reduced to `long_side_px`; never enlarged."""
        scale = min(1.0, long_side_px / max(width_px, height_px))
        small_width, small_height = max(1, round(width_px * scale)), max(1, round(height_px * scale))
        return cls(small_width, small_height, small_width / width_px, small_height / height_px)

    @property
    def T_small_image(self) -> Float[np.ndarray, "3 3"]:
        """Clip pixels to reduced pixels; pixel centers keep their meaning."""
        return np.array(
            [
                [self.scale_x, 0, 0.5 * self.scale_x - 0.5],
                [0, self.scale_y, 0.5 * self.scale_y - 0.5],
                [0, 0, 1.0],
            ]
        )

    def reduce(self, rgb: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "small_height small_width 3"]:
        """A picture of the clip, reduced."""
        return cv2.resize(rgb, (self.width_px, self.height_px), interpolation=cv2.INTER_AREA)


def person_probability(
    track: PersonTrack, frame: int, raster: Raster
) -> Float32[np.ndarray, "small_height small_width"]:
    """The person model's mask of one frame, on the reduced picture; 0 where the person is not tracked.

    Where the mask is empty although the person is tracked, the landmark box has probability 0.5.
    """
    size = (raster.width_px, raster.height_px)
    row = track.row(int(frame))
    if row is None:
        return np.zeros((raster.height_px, raster.width_px), np.float32)
    crop = track.mask_crop[row]
    if crop.max() >= 255 * _UNDECIDED:
        side = crop.shape[0]
        T_crop_mask = np.array([[1 / side, 0, 0.5 / side], [0, 1 / side, 0.5 / side], [0, 0, 1]])
        T_image_crop = np.vstack([track.T_image_crop[row], [0, 0, 1]])
        T_small_mask = raster.T_small_image @ T_image_crop @ T_crop_mask
        return cv2.warpAffine(crop.astype(np.float32) / 255, T_small_mask[:2], size, flags=cv2.INTER_LINEAR)
    probability = np.zeros((raster.height_px, raster.width_px), np.float32)
    corners = np.c_[track.box_px[row].reshape(2, 2), np.ones(2)] @ raster.T_small_image.T
    (x0, y0), (x1, y1) = np.floor(corners[:, :2]).clip(0).astype(int)
    probability[y0 : y1 + 1, x0 : x1 + 1] = _UNDECIDED
    return probability


def lab_difference(
    picture: UInt8[np.ndarray, "small_height small_width 3"],
    background: UInt8[np.ndarray, "small_height small_width 3"],
) -> Float32[np.ndarray, "small_height small_width"]:
    """Distance of two RGB pictures in CIE Lab, luminance counting half."""
    a, b = (cv2.cvtColor(p.astype(np.float32) / 255, cv2.COLOR_RGB2LAB) for p in (picture, background))
    delta = cv2.GaussianBlur(a - b, (0, 0), 0.8)
    delta[..., 0] *= _LUMINANCE_WEIGHT
    return np.linalg.norm(delta, axis=-1)


def refine_mask(
    probability: Float32[np.ndarray, "small_height small_width"],
    difference: Float32[np.ndarray, "small_height small_width"],
    background_known: Bool[np.ndarray, "small_height small_width"],
) -> Bool[np.ndarray, "small_height small_width"]:
    """Pixels that show a person.

    Args:
        probability: Of a person, from the person model.
        difference: From the background image, as `lab_difference` gives it.
        background_known: Where the background image shows real background.
    """
    if not probability.any():
        return np.zeros(probability.shape, bool)
    bounded = np.clip(probability, 1 - _MAX_PROBABILITY, _MAX_PROBABILITY)
    log_odds = np.log(bounded / (1 - bounded))
    # Noise of the sensor, of compression and of changing light, measured on the background nearby.
    ground = ((probability < 1 - _MAX_PROBABILITY) & background_known).astype(np.float32)
    total = cv2.GaussianBlur(ground, (0, 0), _NOISE_BLUR_PX)
    usual = cv2.GaussianBlur(np.minimum(difference, 30.0) * ground, (0, 0), _NOISE_BLUR_PX)
    noise_lab = np.maximum(usual / np.maximum(total, 1e-4), _NOISE_FLOOR_LAB)
    evidence = _EVIDENCE_GAIN * np.log(np.maximum(difference, 1e-3) / (_NEUTRAL_NOISE * noise_lab))
    evidence = np.clip(evidence, -_EVIDENCE_LIMIT, _EVIDENCE_LIMIT)
    mask = log_odds + np.where(background_known, evidence, 0.0) > 0
    return _without_small_regions(mask)


def _without_small_regions(mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    if count <= 1:
        return closed.astype(bool)
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    keep = area >= _MIN_PART * area.max()
    keep[0] = False
    return keep[labels]
