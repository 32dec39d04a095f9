"""Outlines of random blobs with holes, and their triangles."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from video2anim.scene.polygons import outlines, signed_area, triangulated

SHAPE = (90, 140)


def blobs(seed: int) -> np.ndarray:
    """Positive in and around blobs, with holes."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=SHAPE), (0, 0), 5 + seed)
    return noise / noise.std() + 0.4


@pytest.mark.parametrize("seed", range(6))
def test_triangles_cover_the_region_once(seed: int) -> None:
    field = blobs(seed)
    rings = outlines(field)
    points, faces = triangulated(rings)
    a, b, c = points[faces].transpose(1, 0, 2)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert (area > 0).all()
    assert area.sum() == pytest.approx(sum(map(signed_area, rings)), rel=1e-9)
    covered = np.zeros(SHAPE, np.uint8)
    for triangle in points[faces]:
        cv2.fillConvexPoly(covered, np.round(triangle * 16).astype(np.int32), 1, shift=4)
    assert ((covered > 0) != (field > 0)).mean() < 0.06
    edges = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])
    assert len(np.unique(edges, axis=0)) == len(edges)


def test_all_of_a_raster_is_a_rectangle_and_nothing_is_none() -> None:
    (ring,) = outlines(np.full((5, 8), 0.5))
    assert {tuple(corner) for corner in ring.tolist()} == {(0.0, 0.0), (7.0, 0.0), (7.0, 4.0), (0.0, 4.0)}
    assert signed_area(ring) == pytest.approx(28.0)
    assert outlines(np.full((5, 8), -0.5)) == []
    points, faces = triangulated([])
    assert len(points) == len(faces) == 0


def test_a_hole_stays_open() -> None:
    field = np.full((20, 20), 0.5)
    field[6:12, 5:15] = -0.5
    outer, hole = sorted(outlines(field), key=signed_area, reverse=True)
    assert len(outer) == len(hole) == 4
    # Within half a cell on every side, but for its corners.
    assert signed_area(hole) == pytest.approx(-55, abs=5)
    points, faces = triangulated([outer, hole])
    assert len(faces) == 8
    center = points[faces].mean(1)
    assert not ((center > [5, 6]) & (center < [14, 11])).all(1).any()
