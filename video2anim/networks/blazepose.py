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
from jaxtyping import Float, UInt8

from video2anim.errors import ModelMissingError
from video2anim.networks.blazepose_detector import BlazePoseDetector, Detections
from video2anim.networks.landmarks import LANDMARKS, LEFT_TORSO, MIRROR_LANDMARK, RIGHT_TORSO
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
    """Distance between the landmarks of the crop's and of the mirrored crop's answer, as a share of the crop's side:
    how far the network errs."""

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

    @property
    def sides(self) -> Float[np.ndarray, "2"]:
        """From the right to the left of the torso: its sign tells the front from the back."""
        return (self.points_crop[LEFT_TORSO] - self.points_crop[RIGHT_TORSO]).sum(0)

    def joined(self, other: CropAnswer, sides: Float[np.ndarray, "2"] | None) -> CropAnswer:
        """The mean of two answers for one body. If one takes the front for the back, a mean would have all of the
        torso on its axis: then the landmarks are those of the one which has its sides as the body had them before, or
        which is more visible if that is not known."""
        points_crop, world_m = 0.5 * (self.points_crop + other.points_crop), 0.5 * (self.world_m + other.world_m)
        if self.sides @ other.sides < 0:
            better = max((self, other), key=lambda one: one.visibility.sum() if sides is None else one.sides @ sides)
            # The next crop stays that of the mean: it is about the body, whichever way that faces.
            points_crop[:LANDMARKS], world_m = better.points_crop[:LANDMARKS], better.world_m
        return CropAnswer(
            0.5 * (self.presence + other.presence), points_crop, 0.5 * (self.visibility + other.visibility), world_m,
            0.5 * (self.mask + other.mask),
        )  # fmt: skip


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
        points = None if before is None else roi.to_crop(before.landmarks_px)
        sides = None if points is None else (points[LEFT_TORSO] - points[RIGHT_TORSO]).sum(0)
        own, other = self.answer(crop), self.answer(crop[:, ::-1]).mirrored()
        found = own.joined(other, sides)
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
