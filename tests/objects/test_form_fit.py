"""Forms laid onto rendered furniture: sizes, place, what hides and touches it, and how sure the fit is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from furnished import EYE_M, Furnished, chair, convex, furnished, moved, turned_by, yaw_of
from seen_boxes import FLOOR, LENS, Block, Piece, about_y, table

from video2anim.geometry.projection import invert_rigid, pixel_rays
from video2anim.objects.form_fit import FitSigmas, FormFit, FormProblem, _tops
from video2anim.objects.furniture import FORMS, Form
from video2anim.objects.observed import DepthErrors
from video2anim.objects.recognize import log_prior, recognized, rested_on_one
from video2anim.objects.shapes import CUBE
from video2anim.objects.solids import Solids


def form(name: str, variant: str = "") -> Form:
    return next(one for one in FORMS if (one.name, one.variant) == (name, variant))


def fitted(room: Furnished, name: str, variant: str = "") -> FormFit:
    """The one form's fit."""
    found, *_ = recognized(room.seen, {name: 0.0}, forms=[form(name, variant)])
    return found


def size(fit: FormFit, name: str) -> float:
    return float(fit.sizes_m[[one.name for one in fit.form.sizes].index(name)])


def crate(yaw_rad: float) -> list[Block]:
    return [Block((0.2, 0.25, -3.0), (0.7, 0.5, 0.4), yaw_rad)]


@pytest.mark.parametrize("yaw_rad", [0.0, 0.4, 2.2])
def test_a_box_is_found_again(yaw_rad: float) -> None:
    """Which of its sides is the width may change with a quarter turn."""
    fit = fitted(furnished(crate(yaw_rad)), "box")
    turn = yaw_of(fit.T_world_object)
    assert turned_by(turn, yaw_rad, np.pi / 2) < 0.05
    swapped = turned_by(turn, yaw_rad, np.pi) > np.pi / 4
    np.testing.assert_allclose(fit.sizes_m, (0.4, 0.7, 0.5) if swapped else (0.7, 0.4, 0.5), atol=0.03)
    np.testing.assert_allclose(fit.T_world_object[:3, 3], [0.2, 0, -3.0], atol=0.03)
    assert fit.chamfer_m < 0.02
    np.testing.assert_allclose(fit.values[4:6], 0, atol=0.02)


@pytest.mark.parametrize("yaw_rad", [0.3, 1.3, 2.8, -1.8])
def test_a_chair_is_found_again_from_every_side(yaw_rad: float) -> None:
    """Width, depth, seat and back; backs of the form lean by 7 degrees, that of the room does not."""
    room = furnished(moved(chair(0.48, 0.42, 0.44, 0.5), (0.2, -2.8), yaw_rad))
    fit = fitted(room, "chair")
    assert turned_by(yaw_of(fit.T_world_object), yaw_rad) < 0.06
    np.testing.assert_allclose(fit.sizes_m, (0.48, 0.42, 0.44, 0.5), atol=0.035)
    np.testing.assert_allclose(fit.T_world_object[:3, 3], [0.2, 0, -2.8], atol=0.035)


@pytest.mark.parametrize(("yaw_rad", "height_m"), [(0.5, 0.74), (-0.2, 0.78)])
def test_a_table_is_found_again(yaw_rad: float, height_m: float) -> None:
    fit = fitted(furnished(table(1.3, height_m, 0.8, (0.1, -3.2), yaw_rad)), "table")
    turn = yaw_of(fit.T_world_object)
    assert turned_by(turn, yaw_rad, np.pi) < 0.04
    np.testing.assert_allclose(fit.sizes_m[[0, 2]], (1.3, height_m), atol=0.06)
    assert size(fit, "depth") == pytest.approx(0.8, abs=0.13), "its legs, and those of the form, differ in place"
    np.testing.assert_allclose(fit.T_world_object[:3, 3], [0.1, 0, -3.2], atol=0.05)


def test_turning_the_room_turns_the_fit() -> None:
    """About the camera; where the search for the first yaw starts is no multiple of the turn."""
    fits = []
    for angle in (0.0, 0.7):
        parts = [part.turned(angle) for part in moved(chair(), (0.2, -2.8), 0.3)]
        x, _, z = about_y(angle) @ (0.2, 0.4, -2.8)
        fits.append(fitted(furnished(parts, target_m=(x, 0.4, z)), "chair"))
    np.testing.assert_allclose(fits[0].sizes_m, fits[1].sizes_m, atol=0.015)
    expected = about_y(0.7) @ fits[0].T_world_object[:3, 3]
    np.testing.assert_allclose(fits[1].T_world_object[:3, 3], expected, atol=0.015)
    assert turned_by(yaw_of(fits[1].T_world_object), yaw_of(fits[0].T_world_object) + 0.7) < 0.02


def test_pose_sizes_and_solids_belong_together() -> None:
    """Solids of the fit, in the world, contain what the camera saw."""
    room = furnished(moved(chair(), (0.2, -2.8), 0.3))
    fit = fitted(room, "chair")
    names, solids = fit.solids()
    assert names[:2] == ("seat", "back")
    R, at_m = fit.T_world_object[:3, :3], fit.T_world_object[:3, 3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    own_m = (room.seen.points_m - at_m) @ R
    assert np.abs(solids.distance_m(own_m[None])[0].min(0)).mean() < 0.02


def test_a_chair_whose_lower_part_is_hidden_stands_on_the_floor() -> None:
    """A chest before it hides its legs and the front of its seat; the seat is as high as it is."""
    chest = Block((0.2, 0.28, -2.1), (1.6, 0.56, 0.3))
    room = furnished(moved(chair(), (0.2, -2.8), 0.3), [chest])
    own = room.seen.own
    assert room.shot.world_m[own][:, 1].min() > 0.2, "nothing is seen below"
    fit = fitted(room, "chair")
    assert fit.T_world_object[1, 3] == pytest.approx(0, abs=0.01)
    assert size(fit, "seat height") == pytest.approx(0.46, abs=0.04)
    np.testing.assert_allclose(fit.T_world_object[[0, 2], 3], [0.2, -2.8], atol=0.06)


def test_open_furniture_is_nearer_than_its_mixed_depth_says() -> None:
    """A chair that a network sees 12 % too far, since the wall shows between its parts; a cabinet is seen as it is."""
    distance_m = {}
    for bias in (0.0, 0.12):
        errors = DepthErrors(0.04, 1.0, 0.1, open_bias=bias)
        for name, parts in (
            ("chair", moved(chair(), (0.2, -2.8), 0.3)),
            ("cabinet", [Block((0.2, 0.5, -2.8), (1.0, 1.0, 0.45))]),
        ):
            factor = 1.12 if name == "chair" else 1.0
            room = furnished(parts, errors=errors, depth_factor=factor, distance_sigma=0.05)
            at_m = fitted(room, name).T_world_object[:3, 3] - room.seen.evidence.camera_m
            distance_m[name, bias] = float(np.linalg.norm(at_m[[0, 2]]))
    true_m = float(np.linalg.norm(np.array((0.2, -2.8)) - np.array(EYE_M)[[0, 2]]))
    assert abs(distance_m["chair", 0.12] - true_m) < abs(distance_m["chair", 0.0] - true_m)
    assert distance_m["cabinet", 0.12] == distance_m["cabinet", 0.0]


@pytest.mark.parametrize("skin_m", [0.40, 0.43, 0.49, 0.52])
def test_a_seat_is_where_skin_rested(skin_m: float) -> None:
    """Depth and legs say 0.46 m; of the 3 and 6 cm by which skin says otherwise at least half are followed."""
    parts = moved(chair(), (0.2, -2.8), 0.3)
    flat = np.random.default_rng(0).uniform(-0.12, 0.12, (40, 2))
    skin = np.stack([flat[:, 0], np.full(40, skin_m), flat[:, 1]], -1) @ about_y(0.3).T + [0.2, 0, -2.8]
    before, after = (
        size(fitted(furnished(parts, rested_m=points), "chair"), "seat height") for points in (skin[:0], skin)
    )
    assert before == pytest.approx(0.46, abs=0.015)
    assert abs(after - skin_m) < 0.5 * abs(before - skin_m)


def test_tops_of_boxes_are_where_they_are_also_if_they_lean() -> None:
    """Middle and corners of the upper face of a box about the origin that leans by 30 degrees towards -z."""
    tilt, half_m = np.pi / 6, np.array([0.3, 0.5, 0.1])
    box = Solids(np.zeros((1, 1, 3)), half_m[None, None], np.array([[tilt]]), (CUBE,))
    across, upward, ahead = np.eye(3)[0], np.array([0, np.cos(tilt), -np.sin(tilt)]), [0, np.sin(tilt), np.cos(tilt)]
    corners = np.array([(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)])
    face_m = half_m[1] * upward + corners[:, :1] * half_m[0] * across + corners[:, 1:] * half_m[2] * np.array(ahead)
    np.testing.assert_allclose(box.distance_m(face_m[None]), 0, atol=1e-12)
    np.testing.assert_allclose(_tops(box).distance_m(face_m[None]), 0, atol=1e-12)
    np.testing.assert_allclose(_tops(box).distance_m(np.zeros((1, 1, 3))), half_m[1], atol=1e-12)


def test_who_sits_behind_a_table_does_not_sit_on_it() -> None:
    """0.15 m behind its rear edge and 0.25 m below its top."""
    parts = table(1.4, 0.74, 0.7, (0.2, -2.8), 0.0)
    flat = np.random.default_rng(0).uniform(-0.12, 0.12, (40, 2))
    skin = np.stack([flat[:, 0] + 0.2, np.full(40, 0.48), flat[:, 1] - 3.3], -1)
    near = furnished(parts, rested_m=skin).seen
    assert len(near.evidence.rested) == 40
    assert not len(rested_on_one({1: near}, {1: "table"})[1].seen.evidence.rested)


def test_nobody_sits_on_the_top_of_a_back() -> None:
    """A hand may rest there."""
    parts = moved(chair(), (0.2, -2.8), 0.3)
    across = np.linspace(-0.15, 0.15, 40)
    skin = np.stack([across, np.full(40, 0.9), np.full(40, -0.22)], -1) @ about_y(0.3).T + [0.2, 0, -2.8]
    evidence = furnished(parts, rested_m=skin).seen.evidence
    values = fitted(furnished(parts), "chair").values[None]
    rested = [replace(evidence.rested, bears=np.full(40, bears)) for bears in (True, False)]
    sits, holds = (
        FormProblem(form("chair"), replace(evidence, rested=one), 0.0, FitSigmas(), 3).residuals(values).cost()[0]
        for one in rested
    )  # fmt: skip
    assert evidence.rested.bears.all()
    assert sits > holds + 20


@pytest.mark.parametrize(("name", "nats"), [("chair", 4.0), ("stool", 0.0)])
def test_who_sits_looks_away_from_the_back(name: str, nats: float) -> None:
    """A stool has none."""
    parts, yaw_rad = moved(chair(), (0.2, -2.8), 0.3), 0.3
    skin_m = np.tile([0.2, 0.46, -2.8], (40, 1))
    values = fitted(furnished(parts), name).values[None].copy()
    values[:, 2], ahead = yaw_rad, np.array([np.sin(yaw_rad), 0.0, np.cos(yaw_rad)])
    forward, astride, unknown = (
        FormProblem(form(name), furnished(parts, rested_m=skin_m, ahead=one).seen.evidence, 0.0, FitSigmas(), 3)
        .residuals(values).cost()[0]
        for one in (ahead, -ahead, 0 * ahead)
    )  # fmt: skip
    assert astride - forward == pytest.approx(nats)
    assert unknown == pytest.approx(forward)


def test_bodies_are_not_inside() -> None:
    """Of a cabinet the front alone is seen; somebody was 0.25 m behind it, so it is not as deep as cabinets are."""
    front, eye_m = [Block((0, 0.6, -3.0), (1.0, 1.2, 0.45))], (0.0, 0.8, 0.0)
    rng = np.random.default_rng(0)
    joints_m = rng.uniform([-0.3, 0.3, -3.15], [0.3, 1.0, -3.03], (40, 3))
    free, stopped = (
        fitted(furnished(front, eye_m=eye_m, target_m=(0, 0.6, -3), body_m=points), "cabinet")
        for points in (joints_m[:0], joints_m)
    )
    assert size(free, "depth") > 0.35
    assert free.T_world_object[2, 3] + 0.5 * size(free, "depth") == pytest.approx(-2.775, abs=0.03)
    deep_m = joints_m[:, 2] - (stopped.T_world_object[2, 3] - 0.5 * size(stopped, "depth"))
    assert np.mean(np.maximum(deep_m, 0)) < 0.03, "joints behind the rear, or hardly inside"
    assert stopped.T_world_object[2, 3] + 0.5 * size(stopped, "depth") == pytest.approx(-2.775, abs=0.05)


def drawn_m(fit: FormFit, T_world_camera: np.ndarray) -> np.ndarray:
    """Depth of the form in every pixel, infinite beside it."""
    T_object_camera = invert_rigid(fit.T_world_object) @ T_world_camera
    ray = pixel_rays(LENS).reshape(-1, 3) @ T_object_camera[:3, :3].T
    return fit.solids()[1].first_hit(T_object_camera[None, :3, 3], ray[None])[0].reshape(LENS.height_px, LENS.width_px)


def test_bodies_count_wherever_a_hidden_part_may_reach() -> None:
    """The crate's right side is at x = 0.55."""
    body_m = np.array([[1.35, 0.4, -3.0], [3.0, 0.4, -3.0]])
    evidence = furnished(crate(0.0), body_m=body_m, rested_m=body_m).seen.evidence
    np.testing.assert_array_equal(evidence.body_m, body_m[:1])
    assert not len(evidence.rested.point_m), "nothing rested so far from what is seen"


def test_what_is_seen_free_stays_free() -> None:
    """A table in a mask without gaps: between its legs the camera sees the floor and the wall. Nothing is put before
    them, and forms that are closed there have less evidence."""
    parts = table(1.3, 0.74, 0.8, (0.1, -3.0), 0.5)
    own = furnished(parts).seen.own
    hull = convex(own)
    room = furnished(parts, own=hull)
    gap = hull & ~own & (cv2.distanceTransform((hull & ~own).astype(np.uint8), cv2.DIST_L2, 5) > 3)
    assert gap.sum() > 500
    before = drawn_m(fitted(room, "table"), room.shot.T_world_camera) < 0.9 * room.shot.depth_m
    assert before[gap].mean() < 0.1
    fits = [fitted(room, name, variant) for name, variant in (("table", ""), ("table", "panels"), ("box", ""))]
    evidence = [fit.log_evidence for fit in fits]
    assert evidence[0] > max(evidence[1:]) + 1


def test_a_form_covers_what_is_seen_of_the_object_and_not_more() -> None:
    room = furnished(moved(chair(), (0.2, -2.8), 0.3))
    drawn = np.isfinite(drawn_m(fitted(room, "chair"), room.shot.T_world_camera))
    own = room.seen.own
    assert (drawn & own).sum() > 0.93 * own.sum()
    assert (drawn & ~own).sum() < 0.12 * own.sum()


def test_feet_that_masks_lose_do_not_count_against_a_form() -> None:
    """A bar table seen from above; its mask is its top alone, as of a photograph."""
    at_m = np.array([0.2, 0.0, -2.4])
    parts = []
    for low_m, high_m, across_m in ((0.0, 0.03, 0.5), (0.0, 1.05, 0.06), (1.05, 1.08, 0.62)):
        drum = trimesh.creation.cylinder(0.5 * across_m, high_m - low_m, sections=48)
        middle = drum.vertices[:, [1, 2, 0]] + at_m + [0.0, 0.5 * (low_m + high_m), 0.0]
        parts.append(Piece(trimesh.Trimesh(middle, drum.faces, process=False)))
    eye_m, target_m = (0.0, 2.0, 0.0), (0.2, 0.7, -2.4)
    whole = furnished(parts, eye_m=eye_m, target_m=target_m)
    room = furnished(parts, eye_m=eye_m, target_m=target_m, own=whole.shot.mask(2))
    best = recognized(room.seen, log_prior("table"))[0]
    assert (best.form.name, best.form.variant) == ("table", "round")
    assert size(best, "width") == pytest.approx(0.62, rel=0.06)
    assert size(best, "height") == pytest.approx(1.08, rel=0.03)
    np.testing.assert_allclose(best.T_world_object[[0, 2], 3], at_m[[0, 2]], atol=0.05)


def smooth(seed: int, sigma: float) -> np.ndarray:
    """A factor on depth that changes slowly over the picture, as errors of networks do."""
    field = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(LENS.height_px, LENS.width_px)), (0, 0), 8)
    return np.exp(field * sigma / field.std())


def errors_in_sigmas(
    parts: Sequence[Block], truth_m: tuple[float, ...], name: str, turns: int, seeds: range
) -> np.ndarray:
    """Errors of x, z, yaw and sizes over their standard deviations, for noise of the size that the fit is told."""
    found = []
    for seed in seeds:
        rng = np.random.default_rng(100 + seed)
        at_m, yaw_rad = (rng.uniform(-0.4, 0.4), rng.uniform(-3.3, -2.6)), rng.uniform(-3, 3)
        factor = smooth(seed, 0.04) * np.exp(rng.normal(0, 0.01))
        room = furnished(moved(parts, at_m, yaw_rad), depth_factor=factor, distance_sigma=0.01, seed=seed)
        fit = fitted(room, name)
        turn, truth = fit.values[2] - yaw_rad, np.array(truth_m)
        if turns == 2:
            quarters = round(turn / (np.pi / 2))
            turn -= quarters * np.pi / 2
            truth[:2] = truth[:2][:: -1 if quarters % 2 else 1]
        error = np.array([
            *(fit.values[:2] - at_m), (turn + np.pi) % (2 * np.pi) - np.pi, *np.log(fit.sizes_m / truth)
        ])  # fmt: skip
        found.append(error / np.concatenate([fit.sigma[:3], fit.sigma[6:]]))
    return np.array(found)


@pytest.mark.parametrize("name", ["chair", "box"])
def test_standard_deviations_are_honest(name: str) -> None:
    """Errors are as large as they say, within a factor of three, overall and of every value on its own."""
    parts, truth_m, turns = {
        "chair": (chair(), (0.44, 0.44, 0.46, 0.44), 1),
        "box": ([Block((0, 0.25, 0), (0.7, 0.5, 0.4))], (0.7, 0.4, 0.5), 2),
    }[name]
    errors = errors_in_sigmas(parts, truth_m, name, turns, range(8))
    rms = np.sqrt((errors**2).mean())
    assert 1 / 3 < rms < 3
    np.testing.assert_array_less(np.sqrt((errors**2).mean(0)), 4.5)


def test_less_is_known_of_what_is_hidden() -> None:
    """The depth of a box of which the front alone is seen; its width is known."""
    box = [Block((0, 0.6, -3.0), (1.0, 1.2, 0.45))]

    def along_and_across(eye_m: tuple[float, float, float]) -> np.ndarray:
        fit = fitted(furnished(box, eye_m=eye_m, target_m=(0, 0.6, -3)), "box")
        turned = turned_by(yaw_of(fit.T_world_object), 0, np.pi) > np.pi / 4
        return fit.sigma[6:8][:: -1 if turned else 1]

    front, above = along_and_across((0.0, 0.8, 0.0)), along_and_across((1.2, 2.2, 0.0))
    assert front[1] > 3 * front[0]
    assert above[1] < 0.6 * front[1]


def test_a_thing_without_depth_is_known_by_its_outline_alone() -> None:
    """Only ten pixels have depth; the box is still as wide and high as its outline says."""
    room = furnished(crate(0.4))
    few = np.argwhere(room.seen.own)[:: room.seen.own.sum() // 10]
    known = ~room.seen.own
    known[tuple(few.T)] = True
    fit = fitted(furnished(crate(0.4), known=known), "box")
    assert size(fit, "height") == pytest.approx(0.5, abs=0.08)
    np.testing.assert_allclose(fit.T_world_object[[0, 2], 3], [0.2, -3.0], atol=0.15)


def test_the_floor_is_seen_in_these_rooms() -> None:
    room = furnished(crate(0.0))
    assert (room.shot.shown == FLOOR).mean() > 0.3
    np.testing.assert_allclose(room.seen.evidence.camera_m, EYE_M)
