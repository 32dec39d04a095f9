"""Points that a traveling camera has passed: the fit finds the length of its path, and the distances of objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evidence_cases import HONEST, Thing, World

from video2anim.calibration.evidence import FLOOR, ROOM, Evidence, PixelEvidence, PointEvidence
from video2anim.calibration.fit import calibrate

PATH_LOG_SIGMA = 0.3
KINDS = pytest.mark.parametrize(("kind", "offset"), [("depth", 0.3), ("disparity", 0.05)])


def passed(
    world: World, places_m: list[tuple[int, np.ndarray, float]], path_log: float, rng: np.random.Generator
) -> PointEvidence:
    """Points of surfaces (index, places, how much nearer the network sees them), with a path that is too short."""
    point_m = np.concatenate([place_m for _, place_m, _ in places_m])
    value = np.concatenate([world.coded(place_m[:, 2], nearer_log) for _, place_m, nearer_log in places_m])
    surface = np.concatenate([np.full(len(place_m), number) for number, place_m, _ in places_m])
    sigma = np.full(len(point_m), 0.04)
    depth_m = point_m[:, 2] * np.exp(-path_log + sigma * rng.normal(size=len(sigma))) / world.size[0]
    return PointEvidence(PixelEvidence(world.ray(point_m), value), depth_m, sigma, surface)


def ground(world: World, rng: np.random.Generator, slope_rad: float = 0.0) -> np.ndarray:
    """Points of the ground, 2 to 12 m away, which may rise."""
    away_m = np.exp(rng.uniform(np.log(2.0), np.log(12.0), 40))
    return world.on_floor(rng.uniform(-0.3, 0.3, 40) * away_m, away_m, slope_rad * away_m)


def cabinet(world: World, rng: np.random.Generator) -> np.ndarray:
    """The front of a cabinet, 4 m away."""
    return world.on_floor(rng.uniform(0.2, 1.0, 15), np.full(15, 4.0), rng.uniform(0.2, 1.5, 15))


def with_passed(world: World, evidence: Evidence, path_log: float, seed: int = 0) -> Evidence:
    rng = np.random.default_rng(seed)
    places_m = [(FLOOR, ground(world, rng), 0.0), (0, cabinet(world, rng), 0.3)]
    return replace(evidence, path_log_sigma=PATH_LOG_SIGMA, points=passed(world, places_m, path_log, rng))


@KINDS
@pytest.mark.parametrize("path_log", [-0.4, 0.0, 0.4])
def test_the_ground_tells_how_long_the_path_is(kind: str, offset: float, path_log: float) -> None:
    world = World(kind=kind, offset=offset, objects=(Thing("object", (0.5, 4.0), 1.5, 0.3, is_cut=True),))
    without = calibrate(world.evidence())
    found = calibrate(with_passed(world, world.evidence(), path_log))
    assert without.path_ratio == pytest.approx(1.0)
    assert np.log(found.path_ratio) == pytest.approx(path_log, abs=0.05)
    assert found.path_log_sigma < 0.1 < PATH_LOG_SIGMA
    assert found.camera_height_m == pytest.approx(world.height_m, rel=0.02), "people alone tell the scale"


@KINDS
def test_points_tell_how_far_an_object_is(kind: str, offset: float) -> None:
    """The network sees it nearer by 30 %, and its lower end is cut off."""
    world = World(kind=kind, offset=offset, objects=(Thing("object", (0.5, 4.0), 1.5, 0.3, is_cut=True),))
    (without,) = calibrate(world.evidence()).object_depth_log
    (found,) = calibrate(with_passed(world, world.evidence(), 0.2)).object_depth_log
    assert without == pytest.approx(0.0, abs=0.05)
    assert found == pytest.approx(0.3, abs=0.08)


def test_ground_that_rises_says_little_far_away() -> None:
    """By 1.5 degrees: what is 12 m away and 7.6 degrees below the horizon is nearer by a fifth."""
    world = World()
    rng = np.random.default_rng(0)
    rises_m = ground(world, rng, np.deg2rad(1.5))
    found = calibrate(
        replace(
            world.evidence(), path_log_sigma=PATH_LOG_SIGMA, points=passed(world, [(FLOOR, rises_m, 0.0)], 0.0, rng)
        )
    )
    assert np.log(found.path_ratio) == pytest.approx(0.0, abs=0.12)
    assert abs(np.log(found.path_ratio)) < 2 * found.path_log_sigma


def test_points_on_what_moves_or_is_no_floor_do_not_pull() -> None:
    """A fifth of the floor's points is on somebody who stands before it."""
    world, rng = World(), np.random.default_rng(0)
    places_m = [(FLOOR, ground(world, rng), 0.0), (FLOOR, 0.4 * ground(world, rng)[:10], 0.0)]
    found = calibrate(
        replace(world.evidence(), path_log_sigma=PATH_LOG_SIGMA, points=passed(world, places_m, 0.3, rng))
    )
    assert np.log(found.path_ratio) == pytest.approx(0.3, abs=0.06)


def test_the_path_is_as_sure_as_it_says() -> None:
    """Root mean square of 30 draws within a factor of 2 of what is claimed."""
    off = []
    for seed in range(30):
        rng = np.random.default_rng(2000 + seed)
        world = World(noise=HONEST, seed=seed, size=(float(np.exp(0.05 * rng.normal())),))
        wall_m = world.on_floor(rng.uniform(-2, 2, 40), np.full(40, 6.0), rng.uniform(0.2, 2.0, 40))
        places_m = [
            (FLOOR, ground(world, rng, np.deg2rad(1.5) * rng.normal()), 0.0),
            (ROOM, wall_m, 0.12 * rng.normal()),
        ]
        path_log = PATH_LOG_SIGMA * rng.normal()
        found = calibrate(
            replace(world.evidence(), path_log_sigma=PATH_LOG_SIGMA, points=passed(world, places_m, path_log, rng))
        )
        off.append((np.log(found.path_ratio) - path_log) / found.path_log_sigma)
    assert 0.5 < float(np.sqrt(np.mean(np.square(off)))) < 2.0


def test_support_moves_with_the_path_of_a_camera_that_rises() -> None:
    """By a meter in all, of which stage humans sees 0.6: the person seems to sink, until the ground tells the path."""
    world, rng = World(), np.random.default_rng(0)
    evidence = world.evidence()
    (person,) = evidence.people
    risen_m = np.linspace(0.0, 1.0, len(person.support_m))[:, None] * world.up
    seen = replace(person, support_m=person.support_m - 0.4 * risen_m, camera_m=0.6 * risen_m)
    points = passed(world, [(FLOOR, ground(world, rng), 0.0)], float(np.log(1 / 0.6)), rng)
    found = calibrate(replace(evidence, people=(seen,), path_log_sigma=PATH_LOG_SIGMA, points=points))
    assert found.path_ratio == pytest.approx(1 / 0.6, rel=0.05)
    assert found.camera_height_m == pytest.approx(world.height_m, rel=0.03)
