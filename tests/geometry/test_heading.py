"""Headings of rooms and of single objects, in drawings of boxes."""

from __future__ import annotations

import numpy as np
import pytest
from seen_boxes import Block, drawn, edges_of, looking, shoot

from video2anim.geometry.heading import Heading

FROM = looking((0.0, 1.6, 0.0), (0.0, 0.6, -3.0))


def off_deg(found: Heading | None, yaw_rad: float) -> float:
    assert found is not None
    return float(np.rad2deg(abs((found.yaw_rad - yaw_rad + np.pi / 4) % (np.pi / 2) - np.pi / 4)))


@pytest.mark.parametrize("yaws_deg", [(10.0, 60.0), (-25.0, 5.0), (40.0, 75.0)])
def test_every_object_has_the_heading_of_its_own_edges(yaws_deg: tuple[float, float]) -> None:
    yaws_rad = np.deg2rad(yaws_deg)
    blocks = [
        Block((-0.8, 0.3, -3.0), (0.9, 0.6, 0.5), yaws_rad[0]), Block((0.9, 0.4, -3.2), (0.6, 0.8, 0.8), yaws_rad[1])
    ]  # fmt: skip
    edges, shot = drawn([line for block in blocks for line in edges_of(block)], FROM), shoot(blocks, FROM)
    for number, yaw_rad in enumerate(yaws_rad):
        found = edges.within(shot.mask(number))
        assert off_deg(found, yaw_rad) < 1.5
        assert found is not None
        assert found.sigma_rad < np.deg2rad(5)


def test_round_objects_and_pictures_without_edges_have_none() -> None:
    """Rims of a drum are seen as many short edges that run all ways."""
    turn = np.linspace(0, 2 * np.pi, 200)
    rims = [np.stack([0.4 * np.cos(turn), 0 * turn + up_m, 0.4 * np.sin(turn) - 3], -1) for up_m in (0.0, 0.4, 0.8)]
    mask = shoot([Block((0.0, 0.4, -3.0), (0.9, 0.9, 0.9))], FROM).mask(0)
    assert drawn(rims, FROM).within(mask) is None
    blank = drawn([], FROM)
    assert blank.of_room() is None
    assert blank.within(mask) is None


def test_a_front_at_the_height_of_the_eye_has_a_heading_that_is_less_sure() -> None:
    """Near the horizon a turn hardly moves the edges."""
    blocks = [Block((0.0, up_m, -3.0), (2.0, 0.3, 0.02), 0.2) for up_m in (0.2, 1.5)]
    sure, unsure = (drawn(edges_of(block), FROM).within(shoot([block], FROM).mask(0)) for block in blocks)
    assert off_deg(sure, 0.2) < 1.5
    assert sure is not None
    assert unsure is None or unsure.sigma_rad > 2 * sure.sigma_rad
