"""The ground that a traveling camera passes tells where up is."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.camera.ground_plane import ground_up

PITCH_RAD = np.radians(6.0)
UP = np.array([0.0, -np.cos(PITCH_RAD), -np.sin(PITCH_RAD)])
"""Of a camera that looks down by 6 degrees."""
GUESS = np.array([0.0, -np.cos(0.25), -np.sin(0.25)])
"""By other sources: 8 degrees off."""


def points(ground: int, others: int, below: int = 0) -> np.ndarray:
    """Points on level ground 1.6 m below the camera, and others above and beneath it, known to 0.3 %."""
    rng = np.random.default_rng(3)
    along = np.stack([rng.uniform(-4, 4, ground), np.full(ground, 1.6), rng.uniform(3, 15, ground)], 1)
    above = np.stack([rng.uniform(-6, 6, others), rng.uniform(-4, 1.2, others), rng.uniform(4, 20, others)], 1)
    under = np.stack([rng.uniform(-4, 4, below), rng.uniform(2.5, 4, below), rng.uniform(4, 15, below)], 1)
    level = np.concatenate([along, above, under])
    c, s = np.cos(PITCH_RAD), np.sin(PITCH_RAD)
    seen = level @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T
    return seen * (1 + rng.normal(0, 0.003, (len(seen), 1)))


def test_the_ground_is_level() -> None:
    found = ground_up(points(200, 150), GUESS)
    assert found is not None
    assert np.degrees(np.arccos(found @ UP)) < 0.5


@pytest.mark.parametrize(
    ("ground", "others", "below"), [(0, 0, 0), (2, 0, 0), (60, 300, 0), (200, 0, 150)],
    ids=["nothing", "too few", "mostly other things", "things beneath it"],
)  # fmt: skip
def test_without_ground_nothing_is_told(ground: int, others: int, below: int) -> None:
    assert ground_up(points(ground, others, below), GUESS) is None


def test_a_wall_is_no_ground() -> None:
    wall = points(200, 0)[:, [1, 0, 2]]
    assert ground_up(wall, GUESS) is None
