"""Evidence that is wrong altogether counts little and is named; people and objects of other sizes find one floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evidence_cases import HONEST, Noise, Thing, World

from video2anim.calibration.evidence import Evidence, PixelEvidence
from video2anim.calibration.fit import calibrate

CONFLICT = 3.0
"""Standard deviations from which stage metric warns."""


def on_a_step(world: World, height_m: float) -> Evidence:
    """The farthest third of the main person's soles is higher than the floor."""
    evidence = world.evidence()
    person = evidence.people[0]
    far = np.argsort(person.support_m[:, 2])[-(len(person.support_m) // 3) :]
    up_m = np.zeros_like(person.support_m)
    up_m[far] = height_m * world.up
    person = replace(person, support_m=person.support_m + up_m)
    return replace(evidence, people=(person,))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("step_m", "named"), [(0.3, False), (0.45, True)])
def test_a_step_does_not_lift_the_floor(step_m: float, named: bool, seed: int) -> None:
    """Noise alone is 4 %. It may hide that a low step is another level."""
    exact, noisy = World(seed=seed), World(noise=HONEST, seed=seed)
    found = calibrate(on_a_step(exact, step_m))
    assert found.camera_height_m == pytest.approx(exact.height_m, rel=0.01)
    assert found.residuals["support on other levels"] > CONFLICT
    found = calibrate(on_a_step(noisy, step_m))
    assert found.camera_height_m == pytest.approx(noisy.height_m, rel=0.04)
    if named:
        assert found.residuals["support on other levels"] > CONFLICT


@pytest.mark.parametrize("seed", range(3))
def test_half_a_floor_that_is_a_wall(seed: int) -> None:
    """What only seems a floor does not outweigh body and true floor."""
    world = World(noise=HONEST if seed else Noise(), seed=seed)
    evidence = world.evidence()
    rng, half = np.random.default_rng(seed), np.arange(len(evidence.floor.value)) % 2 == 0
    ray, value = evidence.floor.ray.copy(), evidence.floor.value.copy()
    ray[half, :2] = rng.uniform((-0.44, -0.28), (0.44, 0.0), (half.sum(), 2))
    value[half] = world.coded(np.array(5.5))
    found = calibrate(replace(evidence, floor=PixelEvidence(ray, value)))
    assert found.camera_height_m == pytest.approx(world.height_m, rel=0.05)
    center_m = found.scale * world.coded(np.array(3.5)) + found.offset
    assert center_m == pytest.approx(3.5, rel=0.08)
    assert found.residuals["floor pixels"] > CONFLICT


def test_agreement_is_no_conflict() -> None:
    world = World(noise=HONEST, objects=(Thing("table", (0.5, 4.0), 0.74),))
    assert max(calibrate(world.evidence()).residuals.values()) < 1.5


@pytest.mark.parametrize("seed", range(3))
def test_furniture_fixes_the_size_of_a_world_whose_people_are_too_large(seed: int) -> None:
    """People 8 % too large, within the spread of statures: heights of two tables and two doors, which are known to 2 %
    together, bring the camera's height and the statures to within 3.5 %."""
    objects = (
        Thing("table", (0.5, 4.0), 0.74), Thing("door", (-0.9, 5.0), 2.03), Thing("desk", (-1.2, 3.0), 0.74),
        Thing("door", (1.5, 4.5), 2.03),
    )  # fmt: skip
    world = World(size=(1 / 1.08,), noise=HONEST if seed else Noise(), seed=seed, objects=objects)
    found, blind = calibrate(world.evidence()), calibrate(replace(world, objects=()).evidence())
    assert blind.body_height_ratio[0] == pytest.approx(1.0, abs=0.01)
    assert found.body_height_ratio[0] == pytest.approx(1 / 1.08, rel=0.035)
    assert found.camera_height_m == pytest.approx(world.height_m, rel=0.035)
    assert found.body_height_log_sigma[0] < 0.6 * blind.body_height_log_sigma[0]


def test_furniture_of_unknown_kinds_has_no_usual_height() -> None:
    world = World(size=(1 / 1.08,), objects=(Thing("object", (0.5, 4.0), 0.74), Thing("plant", (-0.9, 4.0), 2.03)))
    found = calibrate(world.evidence())
    assert "sizes of furniture" not in found.residuals
    assert found.body_height_ratio[0] == pytest.approx(1.0, abs=0.01)


# People.


def people(sizes: tuple[float, ...], steps_m: tuple[float, ...], sigmas: tuple[float, ...], seed: int = 0) -> World:
    return World(size=sizes, step_m=steps_m, body_height_sigma=sigmas, seed=seed)


def test_people_of_two_sizes_meet_on_one_floor() -> None:
    """One supposed 6 % too large, one too small: both reach their size, as neither is surer than the other."""
    world = people((1.06, 1 / 1.06), (0.0, 0.0), (0.055, 0.055))
    found = calibrate(world.evidence())
    np.testing.assert_allclose(found.body_height_ratio, world.size, rtol=0.02)
    assert found.camera_height_m == pytest.approx(world.height_m, rel=0.02)
    assert found.residuals["support on the floor"] < 0.5


def test_a_known_height_is_kept_and_brings_others_to_its_floor() -> None:
    world = people((1.0, 1 / 1.1), (0.0, 0.0), (0.006, 0.055))
    found = calibrate(world.evidence())
    assert found.body_height_ratio[0] == pytest.approx(1.0, abs=0.004)
    assert found.body_height_ratio[1] == pytest.approx(1 / 1.1, rel=0.02)
    assert found.body_height_log_sigma[0] < 0.007


def test_the_more_people_the_better_the_height() -> None:
    claimed = [
        calibrate(people((1.0,) * count, (0.0,) * count, (0.055,) * count).evidence()).camera_height_sigma_m
        for count in (1, 4)
    ]
    assert claimed[1] < 0.65 * claimed[0]


@pytest.mark.parametrize("step_m", [0.6, -0.8])
def test_somebody_on_another_floor_does_not_pull(step_m: float) -> None:
    """A child taken for an adult stands below the others' floor as somebody on a lower one does. Sizes that met would
    be off by 15 % and 30 %; a logarithm still pulls a little."""
    world = people((1.0, 1.0, 1.0), (0.0, 0.0, step_m), (0.055,) * 3)
    found = calibrate(world.evidence())
    np.testing.assert_allclose(found.body_height_ratio[:2], 1.0, atol=0.035)
    assert found.body_height_ratio[2] == pytest.approx(1.0, abs=0.07)
    assert found.camera_height_m == pytest.approx(world.height_m, rel=0.04)
    assert found.residuals["support on other levels"] > CONFLICT
