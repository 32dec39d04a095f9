"""Which of several objects somebody sat on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from furnished import Furnished, chair, furnished, moved
from seen_boxes import Block

from video2anim.objects.observed import DepthErrors
from video2anim.objects.recognize import Recognition, rested_on_one
from video2anim.types import CompletedObject
from video2anim.types.contact import RestedSkin

AT_M = (0.2, -2.6)
CHAIR = chair(0.37, 0.37, 0.39, 0.37)
BEHIND = Block((-0.55, 0.3, -3.6), (0.5, 0.6, 0.5))
LABELS = {1: "chair", 2: "box"}
NO_PICTURE = np.zeros((1, 1, 3), np.uint8)


@pytest.fixture(scope="module")
def room() -> Furnished:
    """A chair, a box behind it, and who sat on the chair. Its legs were always hidden, its depth is 1.3 times the true
    one."""
    flat, parts = np.random.default_rng(0).uniform(-0.12, 0.12, (40, 2)), moved(CHAIR, AT_M, 0.3)
    skin_m = np.stack([flat[:, 0] + AT_M[0], np.full(40, 0.39), flat[:, 1] + AT_M[1]], -1)
    shot = furnished(parts, [BEHIND]).shot
    own, legs = shot.mask(0, 1), shot.mask(*range(2, len(parts)))
    return furnished(
        parts, [BEHIND], rested_m=skin_m, own=own, known=~legs, unseen=legs, depth_factor=1.3, distance_sigma=0.06,
        errors=DepthErrors(0.03, 1.0, 0.1, 0.1),
    )  # fmt: skip


def test_a_seat_that_is_seen_too_far_away_comes_under_who_sat_on_it(room: Furnished) -> None:
    """By 0.8 m."""
    (alone, *_), _ = Recognition(room.seen.rested_at(()), "chair").fits()
    (found, *_), _ = Recognition(room.seen, "chair").fits()
    off_m = [float(np.hypot(*(fit.values[:2] - AT_M))) for fit in (alone, found)]
    assert off_m[0] > 0.5
    assert off_m[1] < 0.08


def test_of_two_objects_the_one_that_need_not_move_so_far_was_sat_on(room: Furnished) -> None:
    mask = room.shot.mask(len(CHAIR))
    behind = room.views.object(CompletedObject(2, "box", mask, NO_PICTURE), np.random.default_rng(2))
    assert behind is not None
    assert rested_on_one({1: room.seen, 2: behind}, LABELS)[1].seen.evidence.rested.place.tolist() == [0] * 40
    own = room.seen.evidence
    touched = replace(behind.evidence, rested=own.rested)
    found = rested_on_one({1: room.seen, 2: replace(behind, evidence=touched)}, LABELS)
    assert len(found[1].seen.evidence.rested) == 40
    assert len(found[2].seen.evidence.rested) == 0


def test_a_hand_on_the_own_knee_does_not_take_the_seat_from_the_chair(room: Furnished) -> None:
    seat = room.seen.evidence.rested
    skin_m = seat.point_m[:30] + np.array([0.0, 0.35, 0.45])
    hand = RestedSkin(skin_m, np.ones(30, int), np.zeros(30, bool), np.zeros((30, 3)))
    both = replace(room.seen, evidence=replace(room.seen.evidence, rested=RestedSkin.joined([seat, hand])))
    assert set(rested_on_one({1: both}, LABELS)[1].seen.evidence.rested.place.tolist()) == {0}
