"""Focal length: given by the user, read from metadata, or estimated from images."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from video2anim.geometry.perspective_field import FieldCamera
from video2anim.types import VideoClip

FULL_FRAME_DIAGONAL_MM = math.hypot(36, 24)
"""Equivalent focal lengths refer to the full frame of 36 x 24 mm."""
_USUAL_RATIO, _USUAL_LOG_SIGMA = 0.9, 0.3
"""Focal length over the longer image side of phones, webcams and camcorders (24 to 45 mm equivalent): median and
standard deviation of the logarithm."""
_CONTRADICTION_FACTOR = 3.0
"""Metadata that differs from the images by more than this factor is not used: some files give the true 4 mm of a
phone's lens for its equivalent on full frame, which is off by 6."""
_USER_SIGMA, _METADATA_SIGMA = 0.01, 0.05
"""Standard deviations as shares of the focal length. Not measured."""


@dataclass(frozen=True, slots=True)
class FocalEstimate:
    """The focal length of the clip."""

    focal_px: float
    sigma_ratio: float
    """Standard deviation as a share of the focal length."""
    source: str
    """`user`, `metadata`, `picture` or `motion`, as in `CameraEstimate.focal_source`."""
    contradicted_px: float | None = None
    """Focal length by metadata that the images contradict; None where there is no contradiction."""

    @property
    def free_log_sigma(self) -> float:
        """Standard deviation of its logarithm as an unknown of the camera's path; 0 if the user gave it."""
        return 0.0 if self.source == "user" else self.sigma_ratio

    def after_path(self, log_focal: float, log_sigma: float) -> FocalEstimate:
        """The estimate that the path of a moving camera leaves.

        Args:
            log_focal: Logarithm of the focal length over this one.
            log_sigma: Its standard deviation.
        """
        # What the motion tells outweighs what was known where it adds more information than there was.
        source = "motion" if log_sigma < self.sigma_ratio / math.sqrt(2) else self.source
        return replace(self, focal_px=self.focal_px * math.exp(log_focal), sigma_ratio=log_sigma, source=source)


def metadata_focal_px(clip: VideoClip) -> float | None:
    """Focal length by the source's metadata, in pixels; None where there is none."""
    if clip.source.focal_35mm <= 0:
        return None
    return clip.source.focal_35mm * math.hypot(clip.width_px, clip.height_px) / FULL_FRAME_DIAGONAL_MM


def estimate_focal(clip: VideoClip, image: FieldCamera, focal_px: float | None) -> FocalEstimate:
    """Focal length by the user (`focal_px`), else by metadata unless the images contradict it, else by the images and
    usual cameras.

    People are no evidence of it: a body fitted with a free focal length changed that of the images by 0.1 % in the
    median of 14 clips, and the mean error from 2.4 to 2.5 % (docs/calibration.md).
    """
    if focal_px is not None:
        return FocalEstimate(focal_px, _USER_SIGMA, "user")
    usual = math.log(_USUAL_RATIO * max(clip.width_px, clip.height_px))
    seen = math.log(image.focal_ratio * clip.height_px)
    of_usual, of_seen = _USUAL_LOG_SIGMA**-2, image.focal_log_sigma**-2
    estimate_px = math.exp((of_usual * usual + of_seen * seen) / (of_usual + of_seen))
    named_px = metadata_focal_px(clip)
    if named_px is not None and abs(math.log(named_px / estimate_px)) < math.log(_CONTRADICTION_FACTOR):
        return FocalEstimate(named_px, _METADATA_SIGMA, "metadata")
    return FocalEstimate(estimate_px, (of_usual + of_seen) ** -0.5, "picture", named_px)
