"""The calibration fit on rooms of known truth: what it finds, how sure it is, and that units do not matter."""

from __future__ import annotations

import functools
from dataclasses import fields, replace

import numpy as np
import pytest
from evidence_cases import HONEST, Thing, World, times, up_of

from video2anim.calibration.evidence import Evidence, PixelEvidence, SkinEvidence
from video2anim.calibration.fit import Calibration, calibrate
from video2anim.calibration.line import metric_depth

FAR_M = np.linspace(2.3, 6.5, 20)
NOTHING = PixelEvidence(np.zeros((0, 3)), np.zeros(0))
KINDS = pytest.mark.parametrize(("kind", "offset"), [("depth", 0.3), ("disparity", 0.05)])


def depth_ratio(world: World, found: Calibration) -> np.ndarray:
    """Found over true depth at distances that the floor has."""
    return metric_depth(world.kind, world.coded(FAR_M), found.scale, found.offset) / FAR_M


@KINDS
def test_a_start_at_the_truth_stays(kind: str, offset: float) -> None:
    world = World(kind=kind, offset=offset, nearer_log=0.0)
    found = calibrate(world.evidence())
    assert found.camera_height_m == pytest.approx(world.height_m, rel=0.002)
    np.testing.assert_allclose(found.body_height_ratio, 1.0, atol=0.002)
    np.testing.assert_allclose(depth_ratio(world, found), 1.0, atol=0.005)
    assert found.person_depth_log == pytest.approx(0.0, abs=0.005)


@KINDS
def test_things_come_to_their_feet(kind: str, offset: float) -> None:
    """Seen too far by 10 %: they stand on the floor, but for what the network is believed. Seen too near by 10 %: they
    may be nearer than their feet by 8 %, since a lower edge that is off the floor looks so. The cut one may be nearer
    by any amount, but not farther."""
    objects = (
        Thing("object", (0.5, 4.0), 0.7, -0.1), Thing("object", (-0.5, 3.0), 0.7, 0.1),
        Thing("object", (0.8, 4.5), 0.7),
        Thing("object", (-0.7, 3.5), 0.7, 0.25, is_cut=True), Thing("object", (0.2, 5.0), 0.7, -0.2, is_cut=True),
    )  # fmt: skip
    world = World(kind=kind, offset=offset, objects=objects)
    found = calibrate(world.evidence())
    np.testing.assert_allclose(found.object_depth_log, [-0.1, 0.02, 0.0, 0.0, -0.2], atol=0.035)
    assert (found.object_depth_log_sigma[[0, 1, 4]] < 0.06).all(), "feet tell"
    assert found.object_depth_log_sigma[3] > 0.1, "where feet say nothing, the prior is all there is"


@KINDS
@pytest.mark.parametrize(("high_m", "nearer_log", "left_log"), [
    (0.5, 0.15, 0.0), (0.5, -0.15, 0.0), (2.2, 0.15, 0.15), (2.2, -0.15, 0.0),
])  # fmt: skip
def test_soles_tell_the_distance_of_what_they_stood_on(
    kind: str, offset: float, high_m: float, nearer_log: float, left_log: float
) -> None:
    """On a roof above the camera they are behind the edge that is seen: it may be nearer, but not farther."""
    world = World(kind=kind, offset=offset, objects=(Thing("object", (0.5, 4.0), high_m, nearer_log),))
    evidence = world.evidence()
    soles_m = world.on_floor(np.linspace(0.3, 0.7, 5), np.full(5, 4.0), high_m)
    stood = SkinEvidence(soles_m, world.ray(soles_m), world.coded(soles_m[:, 2], nearer_log))
    (one,) = evidence.objects
    found = calibrate(replace(evidence, objects=(replace(one, foot=None, top=None, under_feet=stood),)))
    assert found.object_depth_log[0] == pytest.approx(nearer_log - left_log, abs=0.05)


@pytest.mark.parametrize("nearer_log", [-0.15, 0.15])
def test_people_seen_too_near_or_far_leave_the_floor_where_it_is(nearer_log: float) -> None:
    world = World(nearer_log=nearer_log)
    found = calibrate(world.evidence())
    assert found.person_depth_log == pytest.approx(nearer_log, abs=0.05)
    assert found.camera_height_m == pytest.approx(world.height_m, rel=0.02)
    np.testing.assert_allclose(depth_ratio(world, found), 1.0, atol=0.07)
    assert np.median(np.abs(depth_ratio(world, found) - 1)) < 0.04


@KINDS
@pytest.mark.parametrize("factor", [1e-9, 0.2, 7.0, 1e9])
def test_units_of_relative_depth_do_not_matter(kind: str, offset: float, factor: float) -> None:
    world = World(kind=kind, offset=offset, noise=HONEST, objects=(Thing("table", (0.5, 4.0), 0.74, -0.1),))
    as_it_is, other = calibrate(world.evidence()), calibrate(times(world.evidence(), factor))
    assert other.scale * factor == pytest.approx(as_it_is.scale, rel=1e-3)
    assert other.scale_log_sigma == pytest.approx(as_it_is.scale_log_sigma, rel=0.01)
    for name in ("camera_height_m", "body_height_ratio", "offset", "object_depth_log"):
        np.testing.assert_allclose(getattr(other, name), getattr(as_it_is, name), rtol=1e-3, atol=1e-4, err_msg=name)


@pytest.mark.parametrize("offset", [0.05, 0.25, 0.36, 0.42])
def test_the_zero_of_disparity_is_free(offset: float) -> None:
    """Up to scale and offset: values may be zero or less in the middle of the picture, and the room is the same."""
    world = World(kind="disparity", scale=0.1, offset=offset)
    evidence = replace(world.evidence(), usual_offset=0.5, usual_offset_sigma=1.0)
    np.testing.assert_allclose(depth_ratio(world, calibrate(evidence)), 1.0, atol=0.03)


# Whether it is as sure as it says.

SEEDS = 30
NEARER_SIGMA, STATURE_SIGMA = 0.12, 0.05


def drawn(seed: int) -> tuple[World, Evidence]:
    """A room drawn from the priors, with noise of the size that the fit takes it to have."""
    rng = np.random.default_rng(1000 + seed)
    world = World(
        size=tuple(np.exp(STATURE_SIGMA * rng.normal(size=2))),
        body_height_sigma=(STATURE_SIGMA, STATURE_SIGMA),
        step_m=(0.0, 0.0),
        nearer_log=NEARER_SIGMA * rng.normal(),
        objects=tuple(Thing("object", at_m, 0.8, NEARER_SIGMA * rng.normal()) for at_m in ((0.5, 3.5), (-1.0, 4.5))),
        noise=HONEST,
        seed=seed,
    )
    evidence = world.evidence(frames=4)
    return world, replace(evidence, usual_offset=evidence.usual_offset + 0.5 * rng.normal())


@functools.cache
def deviations() -> dict[str, np.ndarray]:
    """Errors over claimed standard deviations; rows are seeds."""
    rows: dict[str, list[np.ndarray]] = {}
    for seed in range(SEEDS):
        world, evidence = drawn(seed)
        found = calibrate(evidence)
        objects = found.object_depth_log - [obj.nearer_log for obj in world.objects]
        for name, error, sigma in (
            ("height", found.camera_height_m - world.height_m, found.camera_height_sigma_m),
            ("scale", np.log(found.scale / world.scale), found.scale_log_sigma),
            ("offset", found.offset - world.offset, found.offset_sigma),
            ("statures", np.log(found.body_height_ratio / world.size), found.body_height_log_sigma),
            ("objects", objects, found.object_depth_log_sigma),
        ):
            rows.setdefault(name, []).append(np.atleast_1d(error / sigma))
    return {name: np.array(row) for name, row in rows.items()}


@pytest.mark.parametrize("name", ["height", "scale", "offset", "statures", "objects"])
def test_it_is_as_sure_as_it_says(name: str) -> None:
    """Root mean square of 30 draws within a factor of 2 of what is claimed. Objects are the worst: those at the edge of
    what a lower edge off the floor explains may be 8 % nearer than they stand, which their deviation does not hold."""
    off = deviations()[name]
    assert 0.5 < np.sqrt((off**2).mean()) < 2.0
    assert (np.abs(off) < 2).mean() >= (0.75 if name == "objects" else 0.9)
    assert np.abs(off).max() < (5 if name == "objects" else 4)


@pytest.mark.parametrize("name", ["height", "statures"])
def test_noise_moves_it_to_either_side(name: str) -> None:
    """The mean over draws is within three of its standard errors. Scale and offset trade against each other and lean by
    two thirds of a deviation to a flatter room; objects' feet have the dead zone of lower edges."""
    off = deviations()[name].reshape(SEEDS, -1)
    assert (np.abs(off.mean(0)) < 3 * off.std(0) / SEEDS**0.5).all()


# Little evidence.


def one_window(evidence: Evidence) -> Evidence:
    """Somebody who is seen for half a second, sitting."""
    person = evidence.people[0]
    some = replace(person, support_m=person.support_m[:1], camera_m=person.camera_m[:1])
    return replace(evidence, people=(some,))


ROOM = World(noise=HONEST, objects=(Thing("table", (0.5, 4.0), 0.74),)).evidence()
LOW = World(height_m=0.03, up=up_of(0.3), noise=HONEST)
LITTLE = {
    "no floor": replace(ROOM, floor=NOTHING),
    "no skin": replace(ROOM, skin=()),
    "neither": replace(ROOM, floor=NOTHING, skin=(), objects=()),
    "one window": one_window(ROOM),
    "one window alone": replace(one_window(ROOM), floor=NOTHING, skin=(), objects=()),
    "camera at floor height": LOW.evidence(),
    "one floor pixel": replace(ROOM, floor=PixelEvidence(ROOM.floor.ray[:1], ROOM.floor.value[:1])),
    "one skin pixel": replace(ROOM, skin=tuple(
        replace(one, skin_m=one.skin_m[:1], ray=one.ray[:1], value=one.value[:1]) for one in ROOM.skin[:1]
    )),
    "floor above the horizon": replace(
        ROOM, floor=PixelEvidence(ROOM.floor.ray * [1, -1, 1], ROOM.floor.value)
    ),
    "flat depth": replace(
        ROOM, floor=PixelEvidence(ROOM.floor.ray, np.ones_like(ROOM.floor.value)),
        skin=tuple(replace(one, value=np.ones_like(one.value)) for one in ROOM.skin),
    ),
    "values that fall where they should rise": times(ROOM, -1.0),
}  # fmt: skip


@pytest.mark.parametrize("case", LITTLE)
def test_little_evidence_gives_finite_numbers(case: str) -> None:
    """Without warnings, which are errors here."""
    evidence = LITTLE[case]
    found = calibrate(replace(evidence, median_value=abs(evidence.median_value)))
    numbers = {field.name: getattr(found, field.name) for field in fields(found)}
    del numbers["residuals"], numbers["chamfer_before_m"], numbers["chamfer_after_m"]
    assert all(np.isfinite(value).all() for value in numbers.values()), numbers
    assert all(np.isfinite(off) for off in found.residuals.values())
    assert np.isfinite([found.chamfer_before_m, found.chamfer_after_m]).all() == bool(evidence.skin)
    assert found.scale > 0
    assert found.camera_height_m > 0


def test_a_camera_at_floor_height_is_found_there() -> None:
    found = calibrate(LOW.evidence())
    assert found.camera_height_m < 0.1


def test_what_nothing_speaks_of_is_not_sure() -> None:
    found = calibrate(LITTLE["neither"])
    assert found.scale_log_sigma > 1
    assert found.body_height_log_sigma[0] == pytest.approx(0.05, rel=0.1)


def test_nobody_is_refused() -> None:
    with pytest.raises(ValueError, match="want a person"):
        calibrate(replace(ROOM, people=()))
