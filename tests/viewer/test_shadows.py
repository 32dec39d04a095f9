"""Contact shadows on the floor."""

from __future__ import annotations

import numpy as np

from video2anim.types import Mesh
from video2anim.viewer.shadows import contact_shaded


def floor() -> Mesh:
    x, z = np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41))
    vertices_m = np.stack([x, 0 * x, z], -1).reshape(-1, 3).astype(np.float32)
    return Mesh(vertices_m, np.array([[0, 41, 1]]), np.full((len(vertices_m), 3), 200, np.uint8))


def brightness(rgb: np.ndarray, x_m: float, z_m: float) -> float:
    away = np.hypot(floor().vertices_m[:, 0] - x_m, floor().vertices_m[:, 2] - z_m)
    return float(rgb[away.argmin()].mean())


def background(y_m: float) -> np.ndarray:
    x, z = np.meshgrid(np.linspace(-0.2, 0.2, 21), np.linspace(-0.2, 0.2, 21))
    return np.stack([x, np.full_like(x, y_m), z], -1).reshape(-1, 3)


def test_it_is_dark_under_what_touches_and_bright_beside_it() -> None:
    rgb = contact_shaded(floor(), [background(0.0)])
    assert brightness(rgb, 0, 0) < 100
    assert brightness(rgb, 0.8, 0.8) == 200


def test_the_higher_a_thing_is_the_fainter_is_its_shadow() -> None:
    found = [brightness(contact_shaded(floor(), [background(y)]), 0, 0) for y in (0.0, 0.15, 0.3, 1.0)]
    assert found == sorted(found)
    assert found[0] < found[1] < found[3] == 200


def test_nothing_above_changes_nothing() -> None:
    assert (contact_shaded(floor(), []) == 200).all()
