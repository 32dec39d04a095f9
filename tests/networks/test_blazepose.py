"""Decoding, crops and landmarks: by hand, by law, and with the real weights on a real picture."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from video2anim.errors import ModelMissingError
from video2anim.networks import blazepose, blazepose_detector, load_model
from video2anim.networks.landmarks import BODY_HALVES, MIRROR_LANDMARK
from video2anim.networks.roi import SquareRoi
from video2anim.tracking import person_detection

LIMBS = (11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28)


@pytest.fixture(scope="module")
def pose() -> blazepose.BlazePose:
    try:
        return load_model("blazepose-heavy")
    except ModelMissingError as error:
        pytest.skip(f"weights are neither in the cache nor to be had: {error}")


@pytest.fixture(scope="module")
def lab(shared_media: Path) -> np.ndarray:
    """First frame of Pose2Sim camera 2, RGB 1920 x 1080."""
    ok, bgr = cv2.VideoCapture(str(shared_media / "videos" / "pose2sim_single_cam02.mp4")).read()
    assert ok
    return np.ascontiguousarray(bgr[:, :, ::-1])


def test_anchor_layout() -> None:
    centers = blazepose_detector.anchor_centers()
    assert centers.shape == (2254, 2)
    np.testing.assert_array_equal(centers[[0, 1, 2]], [[4, 4], [4, 4], [12, 4]])
    np.testing.assert_array_equal(centers[28 * 28 * 2], [8, 8])
    np.testing.assert_array_equal(centers[-1], [208, 208])


def test_decode_by_hand() -> None:
    values, logits = np.zeros((2254, 12)), np.full(2254, -20.0)
    values[5, :4], values[5, 4:6] = (3.0, -2.0, 40.0, 20.0), (1.0, 60.0)
    logits[5], logits[9] = math.log(4.0), -math.log(4.0)
    found = blazepose_detector.decode(values, logits, blazepose_detector.anchor_centers(), 0.5)
    np.testing.assert_allclose(found.score, [0.8])
    # Anchor 5 is the second of the third cell: center (20, 4).
    np.testing.assert_allclose(found.face_box_px, [[3.0, -8.0, 43.0, 12.0]])
    np.testing.assert_allclose(found.keypoints_px[0, :2], [[21.0, 64.0], [20.0, 4.0]])


def test_suppression_blends_by_score_and_keeps_the_distant() -> None:
    box = np.array([[0.0, 0, 10, 10], [1.0, 0, 11, 10], [50.0, 0, 60, 10]])
    points = box[:, :2][:, None].repeat(4, axis=1)
    kept = blazepose_detector.suppress_weighted(blazepose_detector.Detections(np.array([0.9, 0.6, 0.5]), box, points))
    np.testing.assert_allclose(kept.score, [0.9, 0.5])
    np.testing.assert_allclose(kept.face_box_px, [[0.4, 0, 10.4, 10], [50, 0, 60, 10]])


@pytest.mark.parametrize("rotation_rad", [0.0, 0.7, -2.0, math.pi])
def test_roi_of_a_circle_puts_centre_and_rim_where_they_belong(rotation_rad: float) -> None:
    center = np.array([300.0, 200.0])
    rim = center + 80.0 * np.array([math.sin(rotation_rad), -math.cos(rotation_rad)])
    roi = SquareRoi.from_circle(center, rim)
    assert roi.side_px == pytest.approx(200.0)
    np.testing.assert_allclose(roi.to_crop(np.array([center, rim])), [[0.5, 0.5], [0.5, 0.1]], atol=1e-12)
    points = np.array([[0.1, 0.2], [0.9, 0.4]])
    np.testing.assert_allclose(roi.to_crop(roi.to_pixels(points)), points, atol=1e-12)


@pytest.mark.parametrize("side_px", [64.0, 128.0, 200.0])
def test_crop_pixels_sit_where_the_affine_map_says(side_px: float) -> None:
    x, y = np.meshgrid(np.arange(240), np.arange(240))
    image = np.stack([x, y, np.zeros_like(x)], axis=-1).astype(np.uint8)
    roi = SquareRoi(119.5, 119.5, side_px, math.radians(30.0))
    crop = roi.crop(image, 64)
    rows, columns = (axis.ravel() for axis in np.meshgrid(np.arange(8, 56), np.arange(8, 56), indexing="ij"))
    expected = roi.to_pixels((np.column_stack([columns, rows]) + 0.5) / 64)
    difference_px = crop[rows, columns, :2] - expected
    # Colors are rounded twice, halves upwards (bias of up to 1/8); half a crop pixel would be 0.5 to 1.6.
    assert np.abs(difference_px).max() < 1.0
    np.testing.assert_allclose(difference_px.mean(axis=0), 0.0, atol=0.25)


def test_world_landmarks_turn_with_the_crop() -> None:
    # A crop turned a quarter clockwise shows as 'up' (-y) what lies to the right (+x) in the picture.
    turned = blazepose.turn_world(np.array([[0.0, -1.0, 0.3]]), math.pi / 2)
    np.testing.assert_allclose(turned, [[1.0, 0.0, 0.3]], atol=1e-12)


def test_heat_map_moves_a_landmark_to_its_peak_only_where_sure() -> None:
    points = np.full((39, 2), 0.5)
    heatmaps = np.full((64, 64, 39), -60.0)
    heatmaps[33, 34, 0] = 4.0
    heatmaps[33, 34, 1] = -1.0
    refined = blazepose.refine_by_heatmap(points, heatmaps)
    np.testing.assert_allclose(refined[0], [34 / 64, 33 / 64], atol=1e-6)
    np.testing.assert_array_equal(refined[1:], points[1:])


def test_subject_and_bystander_are_found_and_the_skeleton_is_not(pose: blazepose.BlazePose, lab: np.ndarray) -> None:
    candidates = person_detection.scan(pose, lab, min_score=0.5)
    confirmed = [found for roi in candidates if (found := person_detection.confirm(pose, lab, roi)) is not None]
    people: list[blazepose.PoseEstimate] = []
    for found in confirmed:
        if not any(person_detection.same_person(found, other) for other in people):
            people.append(found)
    heights = sorted(float(found.box_px()[3] - found.box_px()[1]) for found in people)
    assert len(people) == 2
    assert 300 < heights[0] < 420
    assert 600 < heights[1] < 800


def test_landmarks_agree_with_the_reference_picture(
    pose: blazepose.BlazePose, lab: np.ndarray, shared_media: Path
) -> None:
    reference = np.load(shared_media / "reference" / "pose2sim_single_cam02_joints.npz")
    found = person_detection.confirm(pose, lab, person_detection.scan(pose, lab, min_score=0.5)[0])
    assert found is not None
    limbs = list(LIMBS)
    error_px = np.linalg.norm(found.landmarks_px[limbs] - reference["landmarks_2d_px"][0, limbs], axis=1)
    # The body is 650 px tall; the reference's own scatter between views is 4 px.
    assert np.nanmedian(error_px) < 8.0
    truth_m = reference["landmarks_camera_m"][0]
    truth_m = truth_m[limbs] - truth_m[[23, 24]].mean(axis=0)
    error_m = np.linalg.norm(found.landmarks_m[limbs] - truth_m, axis=1)
    assert np.nanmean(error_m) < 0.15


def test_mirrored_picture_gives_mirrored_landmarks(pose: blazepose.BlazePose, lab: np.ndarray) -> None:
    """The network is asked about both."""
    found = person_detection.confirm(pose, lab, person_detection.scan(pose, lab, min_score=0.5)[0])
    assert found is not None
    width, roi = lab.shape[1], found.roi
    mirrored_roi = SquareRoi(width - 1 - roi.center_x_px, roi.center_y_px, roi.side_px, -roi.rotation_rad)
    mirrored = pose.estimate(np.ascontiguousarray(lab[:, ::-1]), mirrored_roi)
    back_px = mirrored.landmarks_px[MIRROR_LANDMARK]
    np.testing.assert_allclose(width - 1 - back_px[:, 0], found.landmarks_px[:, 0], atol=1.0)
    np.testing.assert_allclose(back_px[:, 1], found.landmarks_px[:, 1], atol=1.0)
    back_m = mirrored.landmarks_m[MIRROR_LANDMARK] * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(back_m, found.landmarks_m, atol=0.01)


def test_heat_maps_have_no_bias_to_a_side(pose: blazepose.BlazePose, lab: np.ndarray) -> None:
    """A convention off by half a heat-map cell (1/128 of the crop) would show twice between a crop and the mirrored
    one."""
    roi = person_detection.scan(pose, lab, min_score=0.5)[0]
    found = person_detection.confirm(pose, lab, roi)
    assert found is not None
    crop = found.roi.crop(lab, 256).astype(np.float32) / 255.0
    own, other = pose.answer(crop), pose.answer(np.ascontiguousarray(crop[:, ::-1])).mirrored()
    shift = own.points_crop[list(LIMBS), 0] - other.points_crop[list(LIMBS), 0]
    assert abs(float(np.median(shift))) < 1 / 256
    assert 0.0 < float(np.abs(own.world_m - other.world_m)[:33].mean()) < 0.05, "alike, but not the same"


def test_disagreement_of_both_answers_tells_people_from_background(pose: blazepose.BlazePose, lab: np.ndarray) -> None:
    roi = person_detection.scan(pose, lab, min_score=0.5)[0]
    person = person_detection.converged(pose, lab, roi)
    assert person is not None
    assert not person_detection.is_doubtful(person)
    noise = np.random.default_rng(0).integers(0, 255, (60, 34, 3)).astype(np.uint8)
    nobody = pose.estimate(cv2.resize(noise, lab.shape[1::-1]), roi)
    assert person_detection.is_doubtful(nobody)
    assert person_detection.is_doubtful(pose.estimate(lab, replace(person.roi, side_px=0.2 * person.roi.side_px)))
    crop = person.roi.crop(lab, 256).astype(np.float32) / 255.0
    own, other = pose.answer(crop), pose.answer(np.ascontiguousarray(crop[:, ::-1])).mirrored()
    apart = np.linalg.norm(own.points_crop - other.points_crop, axis=1)
    np.testing.assert_allclose(person.disagreement, apart[:33])


def answer(left_x: float, visibility: float, hips_left_x: float | None = None) -> blazepose.CropAnswer:
    """A torso whose left side is at `left_x`, the right one mirrored at the axis of the crop; its hips may differ."""
    points, lower_x = np.full((39, 2), 0.5), left_x if hips_left_x is None else hips_left_x
    points[[11, 12]], points[[23, 24]] = [[left_x, 0.4], [1 - left_x, 0.4]], [[lower_x, 0.6], [1 - lower_x, 0.6]]
    return blazepose.CropAnswer(1.0, points, np.full(39, visibility), np.zeros((39, 3)), np.zeros((64, 64)))


def test_answers_that_agree_are_averaged() -> None:
    one, other = answer(0.6, 0.9), answer(0.7, 0.7)
    assert blazepose.facing_alike(one, other, None) == (one, other)
    found = one.joined(other)
    assert found.points_crop[11, 0] == pytest.approx(0.65)
    assert found.visibility[0] == pytest.approx(0.8)


@pytest.mark.parametrize(("before_x", "left_x"), [(None, 0.275), (0.6, 0.725), (0.4, 0.275)])
def test_front_and_back_are_not_averaged(before_x: float | None, left_x: float) -> None:
    """The mean of both would have the torso on its axis. What was seen before decides, otherwise what is more
    visible."""
    before = None if before_x is None else answer(before_x, 1.0).points_crop[:33]
    for one, other in ((answer(0.7, 0.7), answer(0.25, 0.9)), (answer(0.25, 0.9), answer(0.7, 0.7))):
        alike = blazepose.facing_alike(one, other, before)
        assert alike[0].joined(alike[1]).points_crop[11, 0] == pytest.approx(left_x)


@pytest.mark.parametrize("before_x", [0.6, 0.4])
def test_hips_that_contradict_do_not_depend_on_the_shoulders(before_x: float) -> None:
    before = answer(0.6, 1.0, before_x).points_crop[:33]
    for one, other in ((answer(0.7, 0.7), answer(0.8, 0.9, 0.3)), (answer(0.8, 0.9, 0.3), answer(0.7, 0.7))):
        alike = blazepose.facing_alike(one, other, before)
        found = alike[0].joined(alike[1]).points_crop
        assert found[11, 0] == pytest.approx(0.75)
        assert found[23, 0] == pytest.approx(0.7 if before_x > 0.5 else 0.3)


def test_who_faces_the_other_way_has_near_and_far_exchanged() -> None:
    """A body and its answer that takes the front for the back: seen from afar the same outline."""
    one = answer(0.7, 0.9)._replace(world_m=np.random.default_rng(0).normal(size=(39, 3)))
    other = one
    for half in BODY_HALVES:
        other = other.exchanged(half)
    np.testing.assert_allclose(other.world_m[11], one.world_m[12] * [1, 1, -1])
    alike = blazepose.facing_alike(one, other, one.points_crop[:33])
    np.testing.assert_allclose(alike[1].world_m, one.world_m)
    np.testing.assert_allclose(alike[1].points_crop, one.points_crop)


def test_turned_picture_gives_the_same_body(pose: blazepose.BlazePose, lab: np.ndarray) -> None:
    """World landmarks are in the picture's axes whatever the crop's rotation."""
    found = person_detection.confirm(pose, lab, person_detection.scan(pose, lab, min_score=0.5)[0])
    assert found is not None
    turned_lab = np.ascontiguousarray(np.rot90(lab, k=-1))
    height = lab.shape[0]
    roi = found.roi
    turned_roi = SquareRoi(height - 1 - roi.center_y_px, roi.center_x_px, roi.side_px, roi.rotation_rad + math.pi / 2)
    turned = pose.estimate(turned_lab, turned_roi)
    x, y, z = found.landmarks_m.T
    np.testing.assert_allclose(turned.landmarks_m, np.column_stack([-y, x, z]), atol=0.02)
