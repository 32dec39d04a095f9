"""Objects from votes for their middles, on pictures whose objects are known."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.networks.instance_grouping import Group, InstanceOffsets, grouped

ROWS, COLUMNS = 96, 128
Y, X = np.mgrid[:ROWS, :COLUMNS].astype(np.float64)


def rectangle(top: int, left: int, height: int, width: int) -> np.ndarray:
    mask = np.zeros((ROWS, COLUMNS), bool)
    mask[top : top + height, left : left + width] = True
    return mask


def heads_of(objects: list[np.ndarray], heights: list[float] | None = None, miss_px: float = 0.0) -> InstanceOffsets:
    """What a perfect network says; `miss_px` moves every vote to the right."""
    center, offset = np.zeros((ROWS, COLUMNS)), np.zeros((ROWS, COLUMNS, 2))
    for mask, height in zip(objects, heights or [1.0] * len(objects), strict=True):
        x, y = round(X[mask].mean()), round(Y[mask].mean())
        center = np.maximum(center, height * np.exp(-0.5 * ((X - x) ** 2 + (Y - y) ** 2) / (0.03 * ROWS) ** 2))
        offset[mask] = np.stack([x + miss_px - X[mask], y - Y[mask]], -1) / ROWS
    return InstanceOffsets(center, offset, np.zeros((ROWS, COLUMNS)))


def overlap(group: Group, mask: np.ndarray) -> float:
    return float((group.mask & mask).sum() / (group.mask | mask).sum())


def test_touching_things_are_told_apart_by_their_votes() -> None:
    objects = [rectangle(30, 10, 40, 30), rectangle(30, 40, 40, 30), rectangle(10, 90, 20, 20)]
    groups = grouped(heads_of(objects), np.any(objects, axis=0))
    assert len(groups) == 3
    for obj in objects:
        assert sum(np.array_equal(group.mask, obj) for group in groups) == 1
    for group in groups:
        assert group.mask.dtype == bool
        assert group.score == pytest.approx(1.0, abs=0.01), "clear middles, every pixel agrees"
        assert group.share.dtype == np.float32
        assert np.array_equal(group.share, group.mask.astype(np.float32))


def test_one_thing_in_two_parts_stays_one() -> None:
    """A table seen to both sides of a person: both parts vote for the same middle."""
    table = rectangle(40, 20, 20, 70) & ~rectangle(0, 45, ROWS, 12)
    (group,) = grouped(heads_of([table]), table)
    assert np.array_equal(group.mask, table)


def test_only_wanted_pixels_are_split() -> None:
    """Half of an object is wanted; an object that is not wanted at all has no group, though its middle is clear."""
    objects = [rectangle(30, 10, 40, 30), rectangle(30, 80, 40, 30)]
    wanted = rectangle(30, 10, 20, 30)
    (group,) = grouped(heads_of(objects), wanted)
    assert np.array_equal(group.mask, wanted)


def test_best_score_first_and_the_score_by_hand() -> None:
    """Middles of height 0.4, 0.9 and 0.6; the score is the root of the height where all pixels agree."""
    objects = [rectangle(5, 5, 20, 20), rectangle(40, 50, 20, 20), rectangle(60, 100, 20, 20)]
    groups = grouped(heads_of(objects, [0.4, 0.9, 0.6]), np.any(objects, axis=0))
    assert [overlap(group, objects[n]) for group, n in zip(groups, (1, 2, 0), strict=True)] == [1.0, 1.0, 1.0]
    np.testing.assert_allclose([group.score for group in groups], np.sqrt([0.9, 0.6, 0.4]), rtol=1e-6)


def test_disagreement_lowers_the_score() -> None:
    obj = rectangle(30, 40, 30, 30)
    scores = [grouped(heads_of([obj], miss_px=miss_px), obj)[0].score for miss_px in (0.0, 4.0, 12.0)]
    assert scores[0] > scores[1] > scores[2] > 0.0


def test_pixels_that_vote_for_nowhere_belong_to_nothing() -> None:
    """Votes more than 0.35 heights (34 pixels) from every middle."""
    obj, stray = rectangle(30, 20, 30, 20), rectangle(30, 90, 30, 20)
    heads = heads_of([obj])
    (group,) = grouped(heads, obj | stray)  # the stray pixels vote for their own places
    assert np.array_equal(group.mask, obj)
    near = rectangle(40, 45, 10, 10)
    (group,) = grouped(heads, obj | near)
    assert np.array_equal(group.mask, obj | near), "a vote for near a middle counts"


def test_small_things_are_left_out() -> None:
    """64 pixels are 0.52 % of the picture."""
    large, small = rectangle(30, 10, 40, 30), rectangle(30, 80, 8, 8)
    heads, wanted = heads_of([large, small]), large | small
    assert len(grouped(heads, wanted, min_ratio=0.005)) == 2
    (group,) = grouped(heads, wanted, min_ratio=0.0055)
    assert np.array_equal(group.mask, large)


def test_without_middles_or_wanted_pixels_there_is_nothing() -> None:
    obj = rectangle(30, 10, 40, 30)
    assert grouped(heads_of([obj]), np.zeros((ROWS, COLUMNS), bool)) == []
    assert grouped(heads_of([obj], [0.05]), obj) == [], "faint middles are none"
    far = heads_of([rectangle(0, 118, 10, 10)])
    assert grouped(far, obj) == [], "a middle far from all that is wanted"


def test_faint_noise_beside_a_middle_makes_no_things() -> None:
    rng = np.random.default_rng(0)
    objects = [rectangle(30, 10, 40, 40), rectangle(20, 70, 50, 40)]
    heads = heads_of(objects)
    noisy = InstanceOffsets(
        np.clip(heads.center + rng.uniform(0, 0.1, heads.center.shape), 0, 1),
        heads.offset + rng.normal(0, 0.02, heads.offset.shape),
        heads.boundary,
    )
    groups = grouped(noisy, np.any(objects, axis=0))
    assert len(groups) == 2
    for obj in objects:
        assert max(overlap(group, obj) for group in groups) > 0.98


def test_a_flat_top_is_one_middle() -> None:
    """A network that is sure of every pixel around a middle: no two middles are nearer than 0.06 picture heights."""
    obj = rectangle(20, 20, 60, 60)
    heads = heads_of([obj])
    flat = InstanceOffsets(np.where(rectangle(44, 44, 12, 12), 1.0, 0.0), 0.3 * heads.offset, heads.boundary)
    (group,) = grouped(flat, obj)
    assert np.array_equal(group.mask, obj)


def test_unlikely_things_score_less() -> None:
    """Equally clear middles; of one object the network is half sure that it is any."""
    sure, unsure = rectangle(30, 10, 40, 30), rectangle(30, 80, 40, 30)
    probability = np.where(unsure, 0.5, 1.0)
    first, second = grouped(heads_of([unsure, sure]), sure | unsure, probability)
    assert np.array_equal(first.mask, sure)
    assert second.score == pytest.approx(0.5 * first.score, rel=0.01)
