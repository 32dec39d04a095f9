"""Every person in one image: detections at several zooms, each confirmed by the landmark network.

BlazePose's detector wants a face or a torso; Objectron's detector also finds people from behind and in blur. Both also
fire on chairs and trees. The landmark network confirms a person by high presence, two answers that agree, and a crop
that converges when it is refitted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from video2anim.networks.blazepose import BlazePose, PoseEstimate, roi_of_detection
from video2anim.networks.blazepose_detector import INPUT_PX, Detections, concatenate
from video2anim.networks.landmarks import BLAZEPOSE_OF_KEYPOINT
from video2anim.networks.roi import CROP_MARGIN, SquareRoi
from video2anim.networks.tiles import square_tiles

if TYPE_CHECKING:
    from video2anim.networks.objectron import ObjectFinder

MIN_PRESENCE_NEW = 0.9
"""Probability that a crop shows a person, for somebody who is not tracked yet. Not measured, nor are the limits below
that name no measurement."""
MIN_PRESENCE_KEPT = 0.5
"""The same for somebody who was there in the frame before: more likely there than not."""
MAX_DISAGREEMENT = 0.02
"""Median disagreement of the landmark network's two answers above which it does not know the body. Of 108 crops with a
presence of somebody new, 94 of people, also from behind, have up to 0.012; 14 of background, blurs and people who are
mostly hidden have at least 0.021 (`benchmarks/person_detection.py`)."""
MIN_VISIBILITY_KEPT = 0.35
"""The same for somebody who was there in the frame before and may be half hidden."""
MIN_OBJECT_SCORE = 0.4
"""Of a person found by Objectron's detector. From 0.2 on nearly all that are confirmed are people, but most are hidden
or blurred, and their tracks pass from one to the next (docs/benchmarks.md)."""
_MAX_FITS = 4
"""Most fits of a crop until it stays."""
_SETTLED = 0.1
"""A crop stays if its shift and growth (shares of its side) and its turn (radians) are all below this."""
_MIN_TILE_PX = INPUT_PX // 2
"""Smaller tiles would only be magnified."""
_SAME_SIZE = 1.5
"""Crops whose sides differ by less may be of the same body."""
_WHOLE = 1.5
"""Of two estimates of one body, one whose mask is larger by this is of the whole body, the other of a part: hair or a
coat seen from behind and taken for somebody small has masks of 0.07 to 0.61 of the body's (`intel_table`)."""
_WIDER = 1.6
"""Crops that may show more of a body are larger by this: more than those of one body differ (`_SAME_SIZE`)."""
_SAME_DISTANCE = 0.25
"""Distance of two torsos, in body radii, below which they are of one body."""
_SAME_MASK_SHARE = 0.6
"""Share of a mask that lies in another's from which both are of one body."""
_MASK_ON = np.iinfo(np.uint8).max // 2
"""Mask values above are more likely of the person than not."""
_HIPS = [BLAZEPOSE_OF_KEYPOINT[name] for name in ("left_hip", "right_hip")]
_TORSO = [BLAZEPOSE_OF_KEYPOINT[name] for name in ("left_shoulder", "right_shoulder")] + _HIPS


def scan(
    pose: BlazePose,
    image: UInt8[np.ndarray, "height width 3"],
    *,
    min_score: float,
    objects: ObjectFinder | None = None,
) -> list[SquareRoi]:
    """Crops that may hold a person, best first, without duplicates: of the image and of square tiles at two zooms.

    Args:
        pose: BlazePose's detector, whose crops come first.
        image: RGB picture.
        min_score: Least score of its detections.
        objects: Objectron's detector; None to do without.
    """
    height, width = image.shape[:2]
    parts = [pose.detect(image, min_score=min_score)]
    for x0, y0, side in square_tiles(width, height, min_px=_MIN_TILE_PX):
        tile = image[y0 : y0 + side, x0 : x0 + side]
        parts.append(pose.detect(tile, min_score=min_score).shifted(x0, y0))
    rois = _distinct(concatenate(parts))
    if objects is not None:
        for item in objects.find(image, min_score=MIN_OBJECT_SCORE):
            roi = roi_of_box(item.box_px)
            if item.label == "person" and not any(overlaps(roi, other) for other in rois):
                rois.append(roi)
    return rois


def roi_of_box(box_px: Float[np.ndarray, "4"]) -> SquareRoi:
    """First crop of a person in a box x0, y0, x1, y1: upright, about its middle."""
    middle, size = 0.5 * (box_px[:2] + box_px[2:]), box_px[2:] - box_px[:2]
    return SquareRoi(float(middle[0]), float(middle[1]), CROP_MARGIN * float(max(size)), 0.0)


def scan_near(
    pose: BlazePose, image: UInt8[np.ndarray, "height width 3"], roi: SquareRoi, *, min_score: float
) -> list[SquareRoi]:
    """The same in one tile around the place where a person was lost."""
    reach = max(roi.side_px, _MIN_TILE_PX / 2)
    height, width = image.shape[:2]
    x0, x1 = (int(np.clip(roi.center_x_px + d * reach, 0, width)) for d in (-1, 1))
    y0, y1 = (int(np.clip(roi.center_y_px + d * reach, 0, height)) for d in (-1, 1))
    if min(x1 - x0, y1 - y0) < _MIN_TILE_PX // 4:
        return []
    return _distinct(pose.detect(image[y0:y1, x0:x1], min_score=min_score).shifted(x0, y0))


def whole(
    pose: BlazePose, image: UInt8[np.ndarray, "height width 3"], found: PoseEstimate, others: Sequence[PoseEstimate]
) -> PoseEstimate:
    """The estimate of a larger crop where it shows a whole body and the given one a part: a crop that has slid onto a
    part follows it. Where the larger one would show somebody else too, the given estimate stays."""
    roi = replace(found.next_roi, side_px=_WIDER * found.next_roi.side_px)
    corners_px = roi.to_pixels(np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]))
    box_px = np.concatenate([corners_px.min(0), corners_px.max(0)])
    if any(boxes_meet(box_px, other.box_px()) for other in others):
        return found
    wide = pose.estimate(image, roi)
    is_same = _is_sure(wide) and same_person(wide, found)
    return wide if is_same and is_whole(wide, found) else found


def confirm(pose: BlazePose, image: UInt8[np.ndarray, "height width 3"], roi: SquareRoi) -> PoseEstimate | None:
    """The person of a crop refitted until it converges; None where no person is confirmed."""
    found = converged(pose, image, roi)
    return found if found is not None and _is_sure(found) else None


def _is_sure(found: PoseEstimate) -> bool:
    """Whether a crop shows somebody, known before or not."""
    return found.presence >= MIN_PRESENCE_NEW and not is_doubtful(found)


def is_doubtful(found: PoseEstimate) -> bool:
    """Whether the landmark network contradicts itself about a body."""
    return found.doubt > MAX_DISAGREEMENT


def converged(pose: BlazePose, image: UInt8[np.ndarray, "height width 3"], roi: SquareRoi) -> PoseEstimate | None:
    """Refit a crop to what it shows until it stays; None where it does not, or shows less than a followed person."""
    for _ in range(_MAX_FITS):
        found = pose.estimate(image, roi)
        if not _is_seen(found):
            return None
        if _settled(roi, found.next_roi):
            return found
        roi = found.next_roi
    return None


def follow(pose: BlazePose, image: UInt8[np.ndarray, "height width 3"], last: PoseEstimate) -> PoseEstimate | None:
    """A known person in the next image; None where it is lost."""
    roi = last.next_roi
    found = pose.estimate(image, roi, last)
    if not (_is_seen(found) and _continuous(roi, found.next_roi)):
        return None
    return surest_turn(pose, image, found, last) if is_doubtful(found) else found


def surest_turn(
    pose: BlazePose, image: UInt8[np.ndarray, "height width 3"], doubtful: PoseEstimate, last: PoseEstimate
) -> PoseEstimate:
    """The estimate of the same body of which the network is surest, of crops turned by quarters; the given one where
    none is better.

    The network knows best who is upright in the crop, but the crop's turn is its own guess in the frame before. An
    eighth of a turn off it still knows them; half a turn off it may be sure of a body that is the other way up.
    """
    roi = doubtful.roi
    quarters = [replace(roi, rotation_rad=roi.rotation_rad + 0.5 * math.pi * k) for k in (1, 2, 3)]
    tried = [pose.estimate(image, quarter, last) for quarter in quarters]
    same = [
        one for one in tried
        if _is_sure(one) and same_person(one, doubtful) and not is_whole(doubtful, one)
        and (is_doubtful(last) or math.cos(one.next_roi.rotation_rad - last.next_roi.rotation_rad) > 0)
    ]  # fmt: skip
    return min(same, key=lambda one: one.doubt, default=doubtful)


def _is_seen(found: PoseEstimate) -> bool:
    """Whether a crop shows somebody who was there in the frame before."""
    return found.presence >= MIN_PRESENCE_KEPT and bool(found.visibility.mean() >= MIN_VISIBILITY_KEPT)


def same_person(first: PoseEstimate, second: PoseEstimate) -> bool:
    """Whether two estimates in one image are of the same body.

    Their torsos coincide, or one mask lies mostly in the other: a crop of the wrong size gives a small false body
    inside the true one, while masks of two people exclude each other even under occlusion.
    """
    if not boxes_meet(first.box_px(), second.box_px()):
        return False
    return torso_distance(first, second) < _SAME_DISTANCE or (
        max(mask_share(first, second), mask_share(second, first)) > _SAME_MASK_SHARE
    )


def is_better(second: PoseEstimate, first: PoseEstimate) -> bool:
    """Whether the second of two estimates of one body replaces the first: the network is sure of it, and it is of the
    whole body where the first is of a part, or the first is doubtful and not of more of the body."""
    if is_doubtful(second) or is_whole(first, second):
        return False
    return is_doubtful(first) or is_whole(second, first)


def is_whole(one: PoseEstimate, other: PoseEstimate) -> bool:
    """Whether one of two estimates of a body is of the whole, and the other of a part."""
    return _mask_area_px2(one) > _WHOLE * max(_mask_area_px2(other), 1.0)


def _mask_area_px2(found: PoseEstimate) -> float:
    return float((found.mask_crop > _MASK_ON).mean()) * found.roi.side_px**2


def torso_distance(first: PoseEstimate, second: PoseEstimate) -> float:
    """Median distance of shoulders and hips, left and right exchangeable, as a share of the smaller body's radius."""
    mine, theirs = first.landmarks_px[_TORSO], second.landmarks_px[_TORSO]
    gap_px = np.linalg.norm(mine - theirs, axis=1)
    # Each row of the other body, shoulders and hips, with its sides exchanged.
    crossed_px = np.linalg.norm(mine - theirs[[1, 0, 3, 2]], axis=1)
    radius_px = min(first.next_roi.radius_px, second.next_roi.radius_px)
    return float(min(np.median(gap_px), np.median(crossed_px)) / radius_px)


def mask_share(inner: PoseEstimate, outer: PoseEstimate) -> float:
    """Share of one person's mask that lies in another's; 0 for an empty mask."""
    rows, columns = np.nonzero(inner.mask_crop > _MASK_ON)
    if not len(rows):
        return 0.0
    size = inner.mask_crop.shape[0]
    points_px = inner.roi.to_pixels((np.column_stack([columns, rows]) + 0.5) / size)
    column, row = np.floor(outer.roi.to_crop(points_px) * size).astype(int).T
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    return float((outer.mask_crop[row[inside], column[inside]] > _MASK_ON).sum() / len(rows))


def hips_px(found: PoseEstimate) -> Float[np.ndarray, "2"]:
    """Middle of the hips in pixels."""
    return found.landmarks_px[_HIPS].mean(axis=0)


def _distinct(found: Detections) -> list[SquareRoi]:
    """Detections without those of the same body with a lower score, from another tile."""
    kept: list[SquareRoi] = []
    for index in np.argsort(-found.score, kind="stable"):
        roi = roi_of_detection(found, int(index))
        if roi.side_px > 0.0 and not any(overlaps(roi, other) for other in kept):
            kept.append(roi)
    return kept


def overlaps(roi: SquareRoi, other: SquareRoi) -> bool:
    """Whether two crops are of the same body: near each other and of similar size."""
    small, large = sorted((roi.side_px, other.side_px))
    gap_px = math.hypot(roi.center_x_px - other.center_x_px, roi.center_y_px - other.center_y_px)
    return gap_px < 0.2 * large and large < _SAME_SIZE * small


def boxes_meet(box: Float[np.ndarray, "4"], other: Float[np.ndarray, "4"]) -> bool:
    """Whether two boxes x0, y0, x1, y1 overlap."""
    return bool(np.all(np.minimum(box[2:], other[2:]) > np.maximum(box[:2], other[:2])))


def _settled(roi: SquareRoi, fitted: SquareRoi) -> bool:
    shift, scale, turn = _change(roi, fitted)
    return max(shift, scale, turn) < _SETTLED


def _continuous(roi: SquareRoi, fitted: SquareRoi) -> bool:
    shift, scale, _ = _change(roi, fitted)
    return shift < 0.35 and scale < math.log(1.7)


def _change(roi: SquareRoi, fitted: SquareRoi) -> tuple[float, float, float]:
    shift_px = math.hypot(fitted.center_x_px - roi.center_x_px, fitted.center_y_px - roi.center_y_px)
    turn_rad = abs(math.remainder(fitted.rotation_rad - roi.rotation_rad, 2.0 * math.pi))
    scale = abs(math.log(max(fitted.side_px, 1e-6) / max(roi.side_px, 1e-6)))
    return shift_px / max(roi.side_px, 1e-6), scale, turn_rad
