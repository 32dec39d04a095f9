"""Registration of the background of frames to the first frame, by which camera motion is measured.

People need not be known: the background is what most SIFT matches agree on, by a robust homography whose inliers must
be spread over the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

STATIC_DRIFT_RATIO = 0.005
"""A camera is static if its background drifts by at most this share of the image width."""
_WORK_SIDE_PX = 960
"""Long side of the image in which features are detected."""
_FEATURES = 1500
"""Features per frame, the strongest first; bounds the time of matching."""
_MATCH_RATIO = 0.75
"""Lowe's ratio test (Lowe 2004, section 7.1: 0.8)."""
_INLIER_PX = (1.5, 5.0)
"""Inlier thresholds at the working resolution, tried in turn; the larger one is for a camera that travels, whose
background has parallax."""
_MIN_INLIERS = 16
"""Four times the matches that determine a homography."""
_GRID = 4
"""Inliers must lie in at least so many cells of a grid of so many by so many; in fewer they are one object, not the
background."""
_MOTION_SAMPLES = 20
"""Frames, spread over the clip, at which camera motion is measured."""


def motion_samples(frame_count: int) -> frozenset[int]:
    """Frames of a clip at which the motion of its camera is measured, the first and last among them."""
    return frozenset(np.linspace(0, frame_count - 1, _MOTION_SAMPLES + 1).round().astype(int).tolist())


@dataclass(frozen=True, slots=True)
class Registration:
    """Where the background of a frame is in the reference frame."""

    H_reference_frame: Float[np.ndarray, "3 3"]
    """Homography from the frame's pixels to those of the reference, both at full resolution."""
    background_px: Float[np.ndarray, "points 2"]
    """Inliers, in the frame, at full resolution."""


@dataclass(frozen=True, slots=True)
class _Features:
    points_px: Float[np.ndarray, "points 2"]
    """At the working resolution."""
    descriptors: Float[np.ndarray, "points 128"]


class BackgroundRegistration:
    """Registers frames of one clip to its first frame.

    Where a frame does not overlap the first one, it is registered through the last frame that was, so frames should
    come in order.
    """

    def __init__(
        self,
        reference_rgb: UInt8[np.ndarray, "height width 3"],
        background: UInt8[np.ndarray, "height width"] | None = None,
    ) -> None:
        """Take the first frame; features are detected where `background` is not 0, everywhere by default."""
        self._height_px, self._width_px = reference_rgb.shape[:2]
        self._scale = min(1.0, _WORK_SIDE_PX / max(self._height_px, self._width_px))
        self._detector = cv2.SIFT.create(nfeatures=_FEATURES, contrastThreshold=0.02)
        self._reference = self._features(reference_rgb, background)
        self._link = self._reference
        self._H_reference_link = np.eye(3)

    def register(
        self,
        rgb: UInt8[np.ndarray, "height width 3"],
        background: UInt8[np.ndarray, "height width"] | None = None,
    ) -> Registration | None:
        """Registration of a frame; None where too few background features agree.

        Args:
            rgb: The frame, as large as the reference.
            background: Features are detected where it is not 0; everywhere by default.
        """
        features = self._features(rgb, background)
        direct = self._fit(features, self._reference)
        if direct is not None:
            self._link, self._H_reference_link = features, direct.H_reference_frame
            return direct
        linked = self._fit(features, self._link)
        if linked is None:
            return None
        H_reference_frame = self._H_reference_link @ linked.H_reference_frame
        self._link, self._H_reference_link = features, H_reference_frame
        return Registration(H_reference_frame, linked.background_px)

    def drift_ratio(self, registration: Registration) -> float:
        """Mean displacement of the inliers, as a share of the image width.

        The image corners would be no measure: where all inliers are on one side, the homography is undetermined on the
        other.
        """
        seen_px = registration.background_px
        homogeneous = np.c_[seen_px, np.ones(len(seen_px))] @ registration.H_reference_frame.T
        moved_px = homogeneous[:, :2] / homogeneous[:, 2:]
        return float(np.linalg.norm(moved_px - seen_px, axis=1).mean() / self._width_px)

    def _features(
        self, rgb: UInt8[np.ndarray, "height width 3"], background: UInt8[np.ndarray, "height width"] | None = None
    ) -> _Features:
        size = (round(self._width_px * self._scale), round(self._height_px * self._scale))
        gray = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        mask = None if background is None else cv2.resize(background, size, interpolation=cv2.INTER_NEAREST)
        keypoints, descriptors = self._detector.detectAndCompute(gray, mask)
        if descriptors is None:
            return _Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
        return _Features(np.array([k.pt for k in keypoints]).reshape(-1, 2), descriptors)

    def _fit(self, frame: _Features, reference: _Features) -> Registration | None:
        if min(len(frame.points_px), len(reference.points_px)) < _MIN_INLIERS:
            return None
        pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(frame.descriptors, reference.descriptors, k=2)
        good = [best for best, second in pairs if best.distance < _MATCH_RATIO * second.distance]
        if len(good) < _MIN_INLIERS:
            return None
        frame_px = frame.points_px[[m.queryIdx for m in good]]
        reference_px = reference.points_px[[m.trainIdx for m in good]]
        for band_px in _INLIER_PX:
            inlier = _agreeing(frame_px, reference_px, band_px)
            if inlier is not None and self._spread(frame_px[inlier]):
                return self._refit(frame_px[inlier], reference_px[inlier])
        return None

    def _refit(
        self, frame_px: Float[np.ndarray, "points 2"], reference_px: Float[np.ndarray, "points 2"]
    ) -> Registration | None:
        """Least-squares homography of the inliers, at full resolution."""
        H, _ = cv2.findHomography(frame_px, reference_px, 0)
        if H is None or not np.all(np.isfinite(H)):
            return None
        # Pixel centers: x_work = scale * (x + 0.5) - 0.5.
        to_work = np.array(
            [[self._scale, 0, 0.5 * self._scale - 0.5], [0, self._scale, 0.5 * self._scale - 0.5], [0, 0, 1.0]]
        )
        H_full = np.linalg.inv(to_work) @ H @ to_work
        return Registration(H_full / H_full[2, 2], (frame_px + 0.5) / self._scale - 0.5)

    def _spread(self, points_px: Float[np.ndarray, "points 2"]) -> bool:
        size_px = np.array([self._width_px, self._height_px]) * self._scale
        cells = np.clip((points_px / size_px * _GRID).astype(int), 0, _GRID - 1)
        return len(np.unique(cells @ [1, _GRID])) >= _GRID


def _agreeing(
    frame_px: Float[np.ndarray, "points 2"], reference_px: Float[np.ndarray, "points 2"], band_px: float
) -> Bool[np.ndarray, "points"] | None:
    """Matches that share one homography (MAGSAC with a fixed seed); None where too few do."""
    parameters = cv2.UsacParams()
    parameters.threshold = band_px
    parameters.confidence = 0.999
    parameters.maxIterations = 5000
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.sampler = cv2.SAMPLING_UNIFORM
    parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
    parameters.randomGeneratorState = 0
    H, inlier = cv2.findHomography(frame_px, reference_px, parameters)
    if H is None or int(inlier.sum()) < _MIN_INLIERS:
        return None
    return inlier.ravel().astype(bool)


class CameraMotion:
    """Largest background drift over the sampled frames of a clip; add frames in order."""

    def __init__(self) -> None:
        self._registration: BackgroundRegistration | None = None
        self._drift_ratios: list[float] = []
        self.sampled = 0
        """Frames compared with the first one."""

    def add(self, rgb: UInt8[np.ndarray, "height width 3"]) -> None:
        """Take a sampled frame; the first one is the reference."""
        if self._registration is None:
            self._registration = BackgroundRegistration(rgb)
            return
        self.sampled += 1
        registration = self._registration.register(rgb)
        if registration is not None:
            self._drift_ratios.append(self._registration.drift_ratio(registration))

    @property
    def drift_ratio(self) -> float:
        """Largest drift as a share of the image width.

        NaN where it is unknown: fewer than half of the samples could be registered, and none of those drifted.
        """
        largest = max(self._drift_ratios, default=0.0)
        if 2 * len(self._drift_ratios) < self.sampled and largest <= STATIC_DRIFT_RATIO:
            return float("nan")
        return largest
