"""BlazePose: 33 landmarks in pixels and meters, and a person mask, from a crop around one person.

Tensor contract of pose_landmark_{full,heavy}.tflite: input (1, 256, 256, 3) RGB in [0, 1]; outputs
(1, 195) = 39 x (x, y, z in input pixels, visibility logit, presence logit); (1, 1) probability that a person is there;
(1, 256, 256, 1) mask logits; (1, 64, 64, 39) heat maps; (1, 117) = 39 x (x, y, z) meters, origin between the hips, in
the crop's axes. Landmarks 33 and 34 are the center and the rim of the circle that makes the next crop.
Source: the public pose_landmark graph of MediaPipe.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from video2anim.errors import ModelMissingError
from video2anim.networks.blazepose_detector import BlazePoseDetector, Detections
from video2anim.networks.landmarks import BODY_HALVES, LANDMARKS, MIRROR_LANDMARK
from video2anim.networks.network import sigmoid
from video2anim.networks.roi import SquareRoi
from video2anim.networks.tflite import TfliteNet

_ALL = 39
"""With the points of the next crop."""
_CENTER, _RIM = LANDMARKS, LANDMARKS + 1
_MIRROR = np.concatenate([MIRROR_LANDMARK, np.arange(LANDMARKS, _ALL)])
_HEATMAP_KERNEL = 7
_HEATMAP_MIN = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """Output of the network for one crop."""

    presence: float
    """Probability that the crop shows a person."""
    landmarks_px: Float[np.ndarray, "33 2"]
    """In the picture's pixels."""
    landmarks_m: Float[np.ndarray, "33 3"]
    """Meters, origin between the hips, axes of the picture (x right, y down, z away)."""
    visibility: Float[np.ndarray, "33"]
    """Probability that the landmark is in the picture and not hidden."""
    mask_crop: UInt8[np.ndarray, "64 64"]
    """Person probability x 255 in the crop."""
    roi: SquareRoi
    """The crop."""
    next_roi: SquareRoi
    """The crop that fits the person found."""
    disagreement: Float[np.ndarray, "33"]
    """Distance between the landmarks of the crop's and of the mirrored crop's answer, facing alike, as a share of the
    crop's side: how far the network errs."""

    def box_px(self) -> Float[np.ndarray, "4"]:
        """x0, y0, x1, y1 around the landmarks."""
        return np.concatenate([self.landmarks_px.min(axis=0), self.landmarks_px.max(axis=0)])

    @property
    def doubt(self) -> float:
        """Median disagreement of the landmarks."""
        return float(np.median(self.disagreement))


class CropAnswer(NamedTuple):
    """Output of the network for one crop, in crop coordinates [0, 1] and the crop's axes."""

    presence: float
    points_crop: Float[np.ndarray, "39 2"]
    visibility: Float[np.ndarray, "39"]
    world_m: Float[np.ndarray, "39 3"]
    mask: Float[np.ndarray, "64 64"]

    def mirrored(self) -> CropAnswer:
        """Of the mirrored crop."""
        points_crop, world_m = self.points_crop[_MIRROR], self.world_m[_MIRROR] * [-1.0, 1.0, 1.0]
        points_crop = np.stack([1.0 - points_crop[:, 0], points_crop[:, 1]], -1)
        return CropAnswer(self.presence, points_crop, self.visibility[_MIRROR], world_m, self.mask[:, ::-1])

    def exchanged(self, half: Int[np.ndarray, "part"]) -> CropAnswer:
        """The same outline, of an upper or lower body that faces the other way."""
        source = np.arange(_ALL)
        source[half] = MIRROR_LANDMARK[half]
        world_m = self.world_m[source]
        world_m[half, 2] *= -1.0
        return self._replace(
            points_crop=self.points_crop[source], visibility=self.visibility[source], world_m=world_m
        )  # fmt: skip

    def joined(self, other: CropAnswer) -> CropAnswer:
        """The mean of two answers for one body."""
        return CropAnswer(
            0.5 * (self.presence + other.presence), 0.5 * (self.points_crop + other.points_crop),
            0.5 * (self.visibility + other.visibility), 0.5 * (self.world_m + other.world_m),
            0.5 * (self.mask + other.mask),
        )  # fmt: skip


def facing_alike(
    one: CropAnswer, other: CropAnswer, before_crop: Float[np.ndarray, "33 2"] | None
) -> tuple[CropAnswer, CropAnswer]:
    """Two answers for one body, where one may take the front for the back in the upper or the lower body: there its
    sides are exchanged, since the mean of both would have them in one place.

    Args:
        one: Of a crop.
        other: Of the mirrored crop, mirrored back.
        before_crop: The body in the image before or after, in crop coordinates: who faces that way is right. If it is
            not known, who is more visible.
    """
    for half in BODY_HALVES:
        across = _across(one.points_crop, half)
        if (across * _across(other.points_crop, half)).sum() >= 0:
            continue
        if before_crop is None:
            is_right = one.visibility[half].sum() >= other.visibility[half].sum()
        else:
            is_right = (across * _across(before_crop, half)).sum() >= 0
        one, other = (one, other.exchanged(half)) if is_right else (one.exchanged(half), other)
    return one, other


def _across(points: Float[np.ndarray, "landmarks 2"], half: Int[np.ndarray, "part"]) -> Float[np.ndarray, "part 2"]:
    """To every landmark from its partner on the other side: the sign tells the front from the back."""
    return points[half] - points[MIRROR_LANDMARK[half]]


class BlazePose:
    """Person detector and landmark network."""

    def __init__(self, path: Path, detector_path: Path) -> None:
        """Load the weights of the landmark network and of the detector.

        Raises:
            ModelMissingError: a file is not that network.
        """
        self._net = TfliteNet(path)
        side = self._net.input_size_px
        wanted = (
            (1, _ALL * 5),
            (1, 1),
            (1, side, side, 1),
            (1, side // 4, side // 4, _ALL),
            (1, _ALL * 3),
        )
        if self._net.output_shapes != wanted:
            raise ModelMissingError(f"{path}: want outputs {wanted}, got {self._net.output_shapes}")
        self._detector = BlazePoseDetector(detector_path)

    def detect(self, image: UInt8[np.ndarray, "height width 3"], *, min_score: float = 0.5) -> Detections:
        """People who fill a large part of the image."""
        return self._detector.detect(image, min_score=min_score)

    def estimate(
        self, image: UInt8[np.ndarray, "height width 3"], roi: SquareRoi, before: PoseEstimate | None = None
    ) -> PoseEstimate:
        """Landmarks of the person in the square: the mean of those in the crop and in the mirrored crop, since a part
        of the network's errors differs.

        Args:
            image: RGB image.
            roi: The square.
            before: Of the person in the image before or after, which tells the front from the back if the crops do not.
        """
        crop = roi.crop(image, self._net.input_size_px).astype(np.float32) / 255.0
        before_crop = None if before is None else roi.to_crop(before.landmarks_px)
        own, other = facing_alike(self.answer(crop), self.answer(crop[:, ::-1]).mirrored(), before_crop)
        found = own.joined(other)
        points_px = roi.to_pixels(found.points_crop)
        return PoseEstimate(
            presence=found.presence,
            landmarks_px=points_px[:LANDMARKS],
            landmarks_m=turn_world(found.world_m[:LANDMARKS], roi.rotation_rad),
            visibility=found.visibility[:LANDMARKS],
            mask_crop=np.rint(found.mask * 255.0).astype(np.uint8),
            roi=roi,
            next_roi=SquareRoi.from_circle(points_px[_CENTER], points_px[_RIM]),
            disagreement=np.linalg.norm((own.points_crop - other.points_crop)[:LANDMARKS], axis=1),
        )

    def answer(self, crop: Float[np.ndarray, "side side 3"]) -> CropAnswer:
        """Output of the network for a crop of RGB in [0, 1]."""
        points, presence, mask_logit, heatmaps, world = self._net(crop)
        points_crop, visibility = decode_landmarks(points[0], self._net.input_size_px)
        mask = cv2.resize(sigmoid(mask_logit[0, :, :, 0]), heatmaps.shape[1:3], interpolation=cv2.INTER_AREA)
        return CropAnswer(
            float(presence[0, 0]), refine_by_heatmap(points_crop, heatmaps[0]), visibility,
            world[0].reshape(_ALL, 3).astype(np.float64), mask,
        )  # fmt: skip


def roi_of_detection(found: Detections, index: int) -> SquareRoi:
    """First crop of a detected person: the full-body circle."""
    return SquareRoi.from_circle(found.keypoints_px[index, 0], found.keypoints_px[index, 1])


def decode_landmarks(
    values: Float[np.ndarray, "195"], input_size: int
) -> tuple[Float[np.ndarray, "39 2"], Float[np.ndarray, "39"]]:
    """Landmarks in crop coordinates [0, 1] and their visibility (hidden or outside the picture = 0)."""
    rows = values.astype(np.float64).reshape(_ALL, 5)
    return rows[:, :2] / input_size, sigmoid(rows[:, 3])


def refine_by_heatmap(
    points_crop: Float[np.ndarray, "39 2"], heatmap_logits: Float[np.ndarray, "rows columns 39"]
) -> Float[np.ndarray, "39 2"]:
    """Move each landmark to the center of mass of its heat map nearby, where the map is confident."""
    rows, columns, _ = heatmap_logits.shape
    refined = points_crop.copy()
    reach = _HEATMAP_KERNEL // 2
    for k, (x, y) in enumerate(points_crop):
        column, row = math.floor(x * columns), math.floor(y * rows)
        if not (0 <= column < columns and 0 <= row < rows):
            continue
        r0, r1 = max(0, row - reach), min(rows, row + reach + 1)
        c0, c1 = max(0, column - reach), min(columns, column + reach + 1)
        weight = sigmoid(heatmap_logits[r0:r1, c0:c1, k].astype(np.float64))
        if weight.max() < _HEATMAP_MIN:
            continue
        total = weight.sum()
        refined[k, 0] = weight.sum(axis=0) @ np.arange(c0, c1) / total / columns
        refined[k, 1] = weight.sum(axis=1) @ np.arange(r0, r1) / total / rows
    return refined


def turn_world(landmarks_crop_m: Float[np.ndarray, "n 3"], rotation_rad: float) -> Float[np.ndarray, "n 3"]:
    """World landmarks from the crop's axes to the picture's: turn about the viewing axis."""
    cos, sin = math.cos(rotation_rad), math.sin(rotation_rad)
    R_image_crop = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return landmarks_crop_m.astype(np.float64) @ R_image_crop.T
