"""Objects that run into each other are parted, raised objects come to rest on what is below them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from video2anim.objects.collisions import PlacedSolid, ResolvedPlacement, resolve_collisions
from video2anim.types import Mesh

TABLE_TOP_M = 0.75
MAX_SHIFT_M = 0.3


def block(size_m: tuple[float, float, float], x_m: float, low_m: float, z_m: float) -> trimesh.Trimesh:
    shape = trimesh.creation.box(size_m)
    shape.apply_translation((x_m, low_m + 0.5 * size_m[1], z_m))
    return shape


def standing(*parts: trimesh.Trimesh, sigma_m: float = 0.1, raised: bool = False) -> PlacedSolid:
    """One object made of these parts."""
    shape = trimesh.util.concatenate(parts)
    assert isinstance(shape, trimesh.Trimesh)
    rgb = np.zeros((len(shape.vertices), 3), np.uint8)
    return PlacedSolid(Mesh(np.asarray(shape.vertices), np.asarray(shape.faces), rgb), sigma_m, raised)


def sideboard(z_m: float, sigma_m: float = 0.1) -> PlacedSolid:
    """3 m long and 0.8 m deep."""
    return standing(block((3.0, 0.5, 0.8), 0.0, 0.0, z_m), sigma_m=sigma_m)


def legs(length_m: float, height_m: float, depth_m: float, z_m: float = 0.0) -> list[trimesh.Trimesh]:
    x, z, size = 0.5 * length_m - 0.05, 0.5 * depth_m - 0.05, (0.1, height_m, 0.1)
    return [block(size, a * x, 0.0, z_m + b * z) for a in (-1, 1) for b in (-1, 1)]


def table(sigma_m: float = 0.1) -> PlacedSolid:
    """2.4 m long, 1 m deep, hollow below its top."""
    thick_m = 0.1
    under_m = TABLE_TOP_M - thick_m
    return standing(block((2.4, thick_m, 1.0), 0.0, under_m, 0.0), *legs(2.4, under_m, 1.0), sigma_m=sigma_m)


def vase(low_m: float, x_m: float = 0.4, *, raised: bool = True) -> PlacedSolid:
    return standing(block((0.15, 0.3, 0.15), x_m, low_m, 0.1), raised=raised)


def untouched(state: ResolvedPlacement) -> bool:
    return not state.shift_m.any() and state.rests_on is None and state.inside_of is None


@pytest.mark.parametrize(
    ("sigmas_m", "first_share"), [((0.1, 0.3), 0.1), ((0.2, 0.2), 0.5), ((0.0, 0.2), 0.0), ((0.0, 0.0), 0.5)]
)
def test_overlapping_things_are_parted_by_their_variances(sigmas_m: tuple[float, float], first_share: float) -> None:
    """0.2 m deep in each other along z; with thrice the standard deviation one moves nine times as far."""
    first, second = resolve_collisions([sideboard(0.0, sigmas_m[0]), sideboard(0.6, sigmas_m[1])])
    assert first.overlap_before_m == pytest.approx(0.2, abs=0.01)
    assert second.overlap_before_m == first.overlap_before_m
    for state in (first, second):
        np.testing.assert_allclose(state.shift_m[:2], 0.0, atol=1e-3)
        assert state.rests_on is None
        assert state.inside_of is None
        assert state.overlap_after_m == 0.0
    parted_m = second.shift_m[2] - first.shift_m[2]
    assert 0.2 - 0.03 <= parted_m + 1e-6 < 0.25, "out of each other but for the tolerance, and hardly farther"
    assert -first.shift_m[2] == pytest.approx(first_share * parted_m, abs=2e-3)


def test_a_small_tolerance_parts_what_a_large_one_leaves() -> None:
    objects = [sideboard(0.0), sideboard(0.78)]
    assert all(untouched(state) for state in resolve_collisions(objects))
    first, second = resolve_collisions(objects, tolerance_m=0.005)
    assert second.shift_m[2] - first.shift_m[2] >= 0.0149
    assert second.shift_m[2] > 0 > first.shift_m[2]


def test_a_hopeless_overlap_is_reported() -> None:
    """A small box in the middle of a large one, 1.2 m from its nearest side: 0.3 m would not help, so both stay."""
    large, small, other = resolve_collisions([
        standing(block((3.0, 0.5, 2.7), 0.0, 0.0, 0.0)),
        standing(block((0.3, 0.3, 0.3), 0.1, 0.0, 0.05)),
        standing(block((0.5, 0.5, 0.5), 0.0, 0.0, 4.0)),
    ])  # fmt: skip
    for state, partner in ((large, 1), (small, 0)):
        assert not state.shift_m.any()
        assert state.inside_of == partner
        assert state.overlap_before_m == pytest.approx(0.25, abs=0.04), "half the height of the large one"
        assert state.overlap_after_m == pytest.approx(0.25, abs=0.04)
    assert untouched(other)


def test_things_apart_stay_exactly_where_they_are() -> None:
    """A hand's breadth apart, touching, a little in each other, and one over the other."""
    states = resolve_collisions(
        [sideboard(0.0, 0.0), sideboard(0.9, 1.0), sideboard(1.7, 1.0), sideboard(2.48), vase(0.6)]
    )
    assert all(untouched(state) for state in states[:4])
    assert [state.overlap_after_m for state in states] == [0.0] * 5
    assert resolve_collisions([]) == []


def test_nothing_has_no_place_in_the_way() -> None:
    """A mesh without faces is neither moved nor in anybody's way, raised or not."""
    none = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8))
    objects = [PlacedSolid(none, 0.1), PlacedSolid(none, 0.1, raised=True), sideboard(0.0)]
    assert all(untouched(state) for state in resolve_collisions(objects))


def bench(back_top_m: float) -> PlacedSolid:
    """A bench, most of it under the table, with a thick back at the edge of the top."""
    return standing(
        block((1.6, 0.05, 0.5), 0.0, 0.42, 0.25),
        block((1.6, back_top_m - 0.47, 0.2), 0.0, 0.47, 0.5),
        *legs(1.6, 0.42, 0.5, 0.25),
    )


def test_a_seat_pushed_under_a_hollow_table_stays() -> None:
    """Their boxes overlap, they do not; with a higher back, which meets the top, they are parted."""
    fits = resolve_collisions([table(), bench(0.62)])
    assert all(untouched(state) and state.overlap_before_m == 0.0 for state in fits)
    under, too_high = resolve_collisions([table(0.0), bench(0.85)])
    assert not under.shift_m.any()
    assert too_high.overlap_before_m > 0.03
    assert too_high.shift_m[2] > 0.05
    assert abs(too_high.shift_m[0]) < 0.02


@pytest.mark.parametrize("low_m", [0.55, 0.7, 0.75, 0.8, 0.95])
def test_a_raised_vase_is_put_on_the_table_under_it(low_m: float) -> None:
    """Sunk into the top or hovering over it by up to 0.2 m; a table that is farther away is not meant."""
    away = standing(block((1.0, 0.8, 1.0), 5.0, 0.0, 0.0))
    found = resolve_collisions([away, vase(low_m), table()])
    assert untouched(found[0])
    assert untouched(found[2])
    np.testing.assert_allclose(found[1].shift_m, [0.0, TABLE_TOP_M - low_m, 0.0], atol=1e-6)
    assert found[1].rests_on == 2
    assert found[1].inside_of is None
    assert found[1].overlap_after_m == 0.0


def test_the_highest_surface_under_a_vase_carries_it() -> None:
    tray = standing(block((0.6, 0.06, 0.4), 0.4, TABLE_TOP_M + 0.001, 0.1))
    found = resolve_collisions([table(), vase(0.85), tray])
    np.testing.assert_allclose(found[1].shift_m, [0.0, -0.039, 0.0], atol=1e-6)
    assert found[1].rests_on == 2


def test_a_raised_thing_with_nothing_under_it_stays() -> None:
    """A lamp beside the table, one far above it, one beside its edge, and one with a corner over a corner of it."""
    corner = standing(block((0.6, 0.2, 0.6), -1.32, 0.8, -0.62), raised=True)
    lamps = [vase(0.8, 3.0), vase(1.3, -0.4), vase(0.8, 1.29), corner]
    assert all(untouched(state) for state in resolve_collisions([table(), *lamps]))


def test_only_raised_things_are_put_down() -> None:
    assert all(untouched(state) for state in resolve_collisions([table(), vase(0.85, raised=False)]))


def test_a_deeply_sunk_vase_is_not_put_inside_the_top() -> None:
    """Its lower end is 0.01 m below the lower side of the top; the top's upper side is 0.14 m too high to be meant."""
    _, state = resolve_collisions([table(), vase(TABLE_TOP_M - 0.28)])
    assert state.rests_on is None
    assert state.shift_m[1] == 0


def test_a_stack_is_put_down_from_below() -> None:
    crate = standing(block((0.4, 0.3, 0.4), 0.4, 0.65, 0.1), raised=True)
    _, below, above = resolve_collisions([table(), crate, vase(0.95)])
    assert (below.rests_on, above.rests_on) == (0, 1)
    np.testing.assert_allclose(below.shift_m, [0.0, 0.1, 0.0], atol=1e-6)
    np.testing.assert_allclose(above.shift_m, [0.0, 0.1, 0.0], atol=1e-6)


def test_a_thing_pushed_into_a_third_one_is_seen() -> None:
    """Three in a row, the middle one unsure: 0.2 m in the first, 0.05 m from the last."""
    states = resolve_collisions([sideboard(0.0, 0.001), sideboard(0.6, 1.0), sideboard(1.45, 0.001)])
    center_m = 0.6 + states[1].shift_m[2]
    gap_m = (1.45 + states[2].shift_m[2]) - center_m - 0.8
    assert gap_m > -0.03 or states[2].inside_of == 1


def test_a_thing_through_the_edge_of_a_top_finds_its_way_out() -> None:
    """A block through the table, three quarters of its 0.2 m within the top: it would be out after 0.15 m."""
    under, through = resolve_collisions([table(0.0), standing(block((1.6, 0.85, 0.2), 0.0, 0.0, 0.45))])
    assert not under.shift_m.any()
    assert through.overlap_after_m == 0.0


def test_two_things_in_the_same_place_are_seen() -> None:
    """One object found twice, 0.02 m apart."""
    states = resolve_collisions([sideboard(0.0), sideboard(0.02)])
    assert max(state.overlap_before_m for state in states) > 0.1


def test_a_small_thing_found_twice_stays_and_is_told() -> None:
    """A stool that could be pushed out of itself; another one that stands half in it is pushed out."""
    stool = standing(block((0.4, 0.45, 0.4), 0.0, 0.0, 0.0))
    twice = resolve_collisions([stool, standing(block((0.4, 0.45, 0.4), 0.03, 0.0, 0.02))])
    assert [state.inside_of for state in twice] == [1, 0]
    assert all(state.overlap_after_m > 0.1 and not state.shift_m.any() for state in twice)
    beside = resolve_collisions([stool, standing(block((0.4, 0.45, 0.4), 0.25, 0.0, 0.0))])
    assert [state.inside_of for state in beside] == [None, None]
    assert beside[0].shift_m[0] < 0 < beside[1].shift_m[0]
