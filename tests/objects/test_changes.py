"""What leaves or comes for good in a fixed camera's pictures, and when, though people hide the moment."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy import ndimage

from video2anim.objects.changes import Change, lasting_changes

SAMPLES, HEIGHT, WIDTH = 48, 90, 120
MIN_PX = 30
RED = (190, 60, 50)
HERE, THERE = (slice(40, 60), slice(30, 54)), (slice(20, 38), slice(80, 100))
Place = tuple[slice, slice]


def area(place: Place) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[place] = True
    return mask


def backdrop() -> np.ndarray:
    """A picture with some structure."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    wave = np.sin(0.35 * column) * np.cos(0.22 * row + 0.05 * column)
    return np.stack([120 + 12 * wave, 128 + 10 * wave, 110 + 14 * wave + 0.15 * column], -1)


@dataclass
class Film:
    """Pictures that are painted on."""

    color: np.ndarray = field(default_factory=lambda: np.tile(backdrop(), (SAMPLES, 1, 1, 1)))
    hidden: np.ndarray = field(default_factory=lambda: np.zeros((SAMPLES, HEIGHT, WIDTH), bool))

    def object_at(self, place: Place, samples: slice, rgb: tuple[int, int, int] = RED) -> Film:
        """Something striped is there in these samples."""
        stripes = np.where(np.arange(HEIGHT) // 3 % 2, 1.0, 0.85)[place[0], None, None]
        self.color[samples][:, *place] = stripes * np.array(rgb, float)
        return self

    def person(self, place: Place, samples: slice) -> Film:
        """Somebody dark in front of everything."""
        self.color[samples][:, *place] = (35, 40, 70)
        self.hidden[samples][:, *place] = True
        return self

    def light(self, share: np.ndarray) -> Film:
        """Each channel is what it was times a share."""
        self.color *= share
        return self

    def rgb(self, noise: float = 2.0) -> np.ndarray:
        jitter = np.random.default_rng(3).normal(0, noise, self.color.shape)
        return np.clip(self.color + jitter, 0, 255).astype(np.uint8)

    def changes(self, wanted: np.ndarray | None = None, min_px: float = MIN_PX) -> tuple[Change, ...]:
        everywhere = np.ones((HEIGHT, WIDTH), bool)
        return lasting_changes(self.rgb(), self.hidden, everywhere if wanted is None else wanted, min_px)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def soft(place: Place, blur_px: float = 4.0) -> np.ndarray:
    """1 inside, fading to 0."""
    return ndimage.gaussian_filter(area(place).astype(float), blur_px)


@pytest.mark.parametrize("came", [False, True])
def test_what_leaves_or_comes_in_plain_view_is_known_to_the_sample(came: bool) -> None:
    film = Film().object_at(HERE, slice(20, None) if came else slice(0, 20))
    (change,) = film.changes()
    assert (change.first, change.last, change.came) == (19, 20, came)
    assert change.mask.shape == (HEIGHT, WIDTH)
    assert iou(change.mask, area(HERE)) > 0.8
    assert np.median(change.rgb[area(HERE)].astype(int) @ [1, -1, 0]) > 80, "red: the picture with it"


@pytest.mark.parametrize("came", [False, True])
@pytest.mark.parametrize("at", [17, 20, 22])
def test_a_person_in_front_hides_the_moment(came: bool, at: int) -> None:
    film = Film().object_at(HERE, slice(at, None) if came else slice(0, at))
    film.person((slice(10, 80), slice(25, 60)), slice(17, 23))
    (change,) = film.changes()
    assert (change.first, change.last, change.came) == (16, 23, came)
    assert iou(change.mask, area(HERE)) > 0.8
    np.testing.assert_array_equal(change.rgb, film.rgb()[23 if came else 16])


def test_people_who_pass_by_what_stays_change_nothing() -> None:
    film = Film().object_at(HERE, slice(None))
    for k in range(30):
        film.person((slice(10, 80), slice(3 * k, 3 * k + 25)), slice(5 + k, 6 + k))
    assert film.changes() == ()


@pytest.mark.parametrize("whole", [False, True])
def test_what_moves_leaves_one_place_and_comes_to_another(whole: bool) -> None:
    """Without a person and behind one."""
    film = Film().object_at(HERE, slice(0, 16)).object_at(THERE, slice(28, None))
    if whole:
        film.person((slice(5, 85), slice(20, 58)), slice(14, 19)).person((slice(5, 85), slice(75, 110)), slice(26, 31))
    left, came = film.changes()
    assert (left.came, came.came) == (False, True)
    assert (left.first, left.last) == ((13, 19) if whole else (15, 16))
    assert (came.first, came.last) == ((25, 31) if whole else (27, 28))
    assert iou(left.mask, area(HERE)) > 0.8
    assert iou(came.mask, area(THERE)) > 0.8


def test_changes_are_in_order_of_time() -> None:
    places = [(slice(8 + 30 * row, 24 + 30 * row), slice(c, c + 16)) for row in range(2) for c in (10, 50, 90)]
    film, starts = Film(), (33, 12, 24, 18, 30, 15)
    for place, start in zip(places, starts, strict=True):
        film.object_at(place, slice(start, None))
    found = film.changes()
    assert [change.last for change in found] == sorted(starts)
    for change in found:
        assert iou(change.mask, area(places[starts.index(change.last)])) > 0.8


@pytest.mark.parametrize("lasting", [slice(14, 32), slice(20, None)])
def test_a_soft_shadow_is_no_change_but_a_stain_is(lasting: slice) -> None:
    fall = np.ones((SAMPLES, HEIGHT, WIDTH, 3))
    fall[lasting] -= 0.3 * soft(HERE)[..., None]
    assert Film().light(fall).changes() == ()
    fall[lasting, ..., 1:] -= 0.3 * soft(HERE)[..., None]
    assert Film().light(fall).changes(), "green and blue lose more than red"


@pytest.mark.parametrize("lasting", [slice(14, 32), slice(20, None)])
def test_a_colored_shadow_on_planks_is_no_change_but_what_covers_them_is(lasting: slice) -> None:
    planks = np.where(np.arange(WIDTH) // 4 % 2, 1.0, 0.75)[:, None]
    fall = np.ones((SAMPLES, HEIGHT, WIDTH, 3))
    fall[lasting] -= soft(HERE, 1.5)[..., None] * (0.5, 0.6, 0.3)
    assert Film().light(planks).light(fall).changes() == (), "a warm light is hidden, a cold one is not"
    found = Film().light(planks).object_at(HERE, lasting).changes()
    assert len(found) == (2 if lasting.stop else 1)
    assert all(iou(change.mask, area(HERE)) > 0.8 for change in found)


def test_the_shadow_of_what_comes_is_not_a_part_of_it() -> None:
    beside = (slice(56, 72), slice(40, 75))
    fall = np.ones((SAMPLES, HEIGHT, WIDTH, 3))
    fall[20:] -= 0.25 * soft(beside)[..., None]
    (change,) = Film().light(fall).object_at(HERE, slice(20, None)).changes()
    assert iou(change.mask, area(HERE)) > 0.8
    assert change.came


def test_nothing_flicker_and_steady_light_are_no_changes() -> None:
    assert Film().changes() == ()
    flicker = 1 + 0.04 * np.random.default_rng(5).choice([-1, 1], (SAMPLES, 1, 1, 1))
    assert Film().light(flicker).changes() == ()
    assert Film().light(np.linspace(1.0, 0.97, SAMPLES)[:, None, None, None]).changes() == ()


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_what_stays_for_less_than_a_second_is_not_at_rest(samples: int) -> None:
    """Six samples are a second, of which five must look alike."""
    assert Film().object_at(HERE, slice(20, 20 + samples)).changes() == ()


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_what_is_away_for_less_than_a_second_did_not_leave(samples: int) -> None:
    assert Film().object_at(HERE, slice(0, 20)).object_at(HERE, slice(20 + samples, None)).changes() == ()


def test_people_who_hide_a_place_for_long_do_not_hide_what_was_there_before() -> None:
    """Fewer looks than a second's between two people tell nothing of their own."""
    film = Film().object_at(HERE, slice(0, 24))
    aisle = (slice(10, 80), slice(25, 60))
    film.person(aisle, slice(14, 20)).person(aisle, slice(22, 30))
    (change,) = film.changes()
    assert (change.first, change.last, change.came) == (21, 30, False)
    assert iou(change.mask, area(HERE)) > 0.8


@pytest.mark.parametrize("gap_px", [4, 12])
def test_what_is_moved_by_its_own_width_leaves_one_place_and_comes_to_the_next(gap_px: int) -> None:
    beside = (HERE[0], slice(HERE[1].stop + gap_px, HERE[1].stop + gap_px + 24))
    found = Film().object_at(HERE, slice(0, 20)).object_at(beside, slice(22, None)).changes()
    assert [(change.first, change.last, change.came) for change in found] == [(19, 20, False), (21, 22, True)]
    for change, place in zip(found, (HERE, beside), strict=True):
        assert iou(change.mask, area(place)) > 0.8


@pytest.mark.parametrize("samples", [6, 7, 8, 18])
def test_what_comes_and_goes_after_a_second_or_more_came_and_left(samples: int) -> None:
    found = Film().object_at(HERE, slice(14, 14 + samples)).changes()
    end = 14 + samples
    assert [(one.first, one.last, one.came) for one in found] == [(13, 14, True), (end - 1, end, False)]


def test_only_what_is_wanted_and_large_enough_is_looked_for() -> None:
    film = Film().object_at(HERE, slice(20, None)).object_at(THERE, slice(30, None))
    (there,) = film.changes(ndimage.binary_dilation(area(THERE), iterations=6))
    assert iou(there.mask, area(THERE)) > 0.8
    assert film.changes(np.zeros((HEIGHT, WIDTH), bool)) == ()
    (larger,) = film.changes(min_px=0.5 * (area(HERE).sum() + area(THERE).sum()))
    assert iou(larger.mask, area(HERE)) > 0.8


@pytest.mark.parametrize("count", [1, 2, 12])
def test_too_short_a_clip_has_no_before_and_after(count: int) -> None:
    film = Film().object_at(HERE, slice(count // 2, None))
    nobody = np.zeros((count, HEIGHT, WIDTH), bool)
    assert lasting_changes(film.rgb()[:count], nobody, np.ones((HEIGHT, WIDTH), bool), MIN_PX) == ()


def test_colors_near_those_behind_them_are_changes_beyond_the_noise() -> None:
    near = tuple(int(value) + 22 for value in backdrop()[HERE].mean((0, 1)))
    film = Film().object_at(HERE, slice(20, None), (near[0], near[1], near[2] - 40))
    (change,) = film.changes()
    assert (change.first, change.last, change.came) == (19, 20, True)
    assert iou(change.mask, area(HERE)) > 0.8
