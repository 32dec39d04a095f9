"""Volumes of coarse distances against the boxes they were filled from."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scenemi.model.config import PaperConfig
from scenemi.scene.boxes import Boxes
from scenemi.scene.field import VolumeField
from scenemi.scene.rows import BoxRows, VolumeRows
from scenemi.scene.voxels import GridSpec

REACH_M = 0.6
"""An arm's length, at which the field ends."""
VOLUME_STEP_M = REACH_M / 127
"""Signed 8-bit steps, as stored pools have them."""

LOW_M, STEP_M, NODES = (-1.6, 0.0, -1.4), (0.05, 0.06, 0.07), (64, 32, 48)
BOX = [[0.4, 0.5, 0.3, 0.3, 0.5, 0.2, 0.4], [-0.6, 1.2, -0.2, 0.4, 0.1, 0.3, 0.0]]


def rows() -> tuple[BoxRows, VolumeRows]:
    """Two windows in one scene of two boxes."""
    boxes = np.array(BOX)
    nodes = np.stack(np.meshgrid(*map(np.arange, NODES), indexing="ij"), -1) * STEP_M + LOW_M
    rooted = boxes + np.array([[0, -1.5, 0, 0, 1.5, 0, 0], [0] * 7])
    distance_m = Boxes(rooted[:, :3], rooted[:, 3:6], rooted[:, 6]).signed_distance(nodes)
    values = np.rint(np.clip(distance_m, -REACH_M, REACH_M) / VOLUME_STEP_M).astype(np.int8)
    place = torch.tensor([*LOW_M, *STEP_M]).repeat(2, 1)
    return BoxRows(torch.tensor([BOX, BOX])), VolumeRows(torch.from_numpy(np.stack([values] * 2)), place)


def points(count: int = 3000) -> torch.Tensor:
    rng = np.random.default_rng(0)
    inside = rng.uniform([-1.5, 0.0, -1.3], [1.4, 1.8, 1.7], (2, count, 3))
    return torch.from_numpy(inside.astype(np.float32))


def test_distances_and_ways_out_are_those_of_the_boxes() -> None:
    boxes, volumes = rows()
    known = torch.tensor([0.0, 1.0])
    exact_m, exact_out = boxes.field(known).query(points())
    distance_m, out = volumes.field(known).query(points())
    assert (distance_m[0] == REACH_M).all()
    assert not out[0].any(), "the first window is not shown its scene"
    assert float((distance_m[1] - exact_m[1]).abs().max()) < 0.04
    assert float((distance_m[1] - exact_m[1]).abs().mean()) < 0.004
    clear = (exact_m[1] < 0.4) & (exact_m[1] > 0.05)
    agreement = (out[1] * exact_out[1]).sum(-1)[clear]
    assert float((agreement > 0.98).float().mean()) > 0.9
    assert (distance_m[1] < -0.05).any()
    np.testing.assert_allclose(out[1].norm(dim=-1)[distance_m[1] < REACH_M - 0.01], 1.0, atol=1e-4)


def test_the_floor_is_exact_and_solids_alone_have_none() -> None:
    _, volumes = rows()
    field = volumes.field(torch.ones(2))
    low = torch.tensor([[[1.3, 0.013, 1.5], [1.3, -0.2, 1.5]]]).repeat(2, 1, 1)
    distance_m, out = field.query(low)
    np.testing.assert_allclose(distance_m, [[0.013, -0.2]] * 2, atol=1e-6)
    np.testing.assert_array_equal(out, np.broadcast_to([0.0, 1.0, 0.0], (2, 2, 3)))
    assert (field.solids_m(low) > 0.5).all()


def test_the_gradient_leads_out() -> None:
    _, volumes = rows()
    field = volumes.field(torch.ones(2))
    inside = points().requires_grad_()
    distance_m = field.distance_m(inside)
    np.testing.assert_allclose(distance_m.detach(), field.query(inside.detach())[0], atol=1e-6)
    (slope,) = torch.autograd.grad(distance_m.sum(), inside)
    out = field.query(inside.detach())[1]
    near = (distance_m < 0.3) & (distance_m > -0.1)
    along = (torch.nn.functional.normalize(slope, dim=-1) * out).sum(-1)[near]
    assert float((along > 0.9).float().mean()) > 0.9


def test_around_the_volume_is_as_on_its_border() -> None:
    _, volumes = rows()
    field = volumes.field(torch.ones(2))
    far = torch.tensor([[[9.0, 0.4, 0.3], [-1.61, 1.2, -0.2]]]).repeat(2, 1, 1)
    edge = torch.tensor([[[1.55, 0.4, 0.3], [-1.6, 1.2, -0.2]]]).repeat(2, 1, 1)
    torch.testing.assert_close(field.solids_m(far), field.solids_m(edge))


def test_no_shown_window_is_no_scene() -> None:
    _, volumes = rows()
    field = volumes.field(torch.zeros(2))
    assert isinstance(field, VolumeField)
    assert not len(field.rows)
    assert (field.query(points())[0] == REACH_M).all()


def test_mirrored_volumes_are_those_of_mirrored_boxes() -> None:
    boxes, volumes = rows()
    chosen, known = torch.tensor([True, False]), torch.ones(2)
    here = points()
    there = torch.where(chosen[:, None, None], here * torch.tensor([-1.0, 1.0, 1.0]), here)
    before, after = volumes.field(known).query(here), volumes.mirrored(chosen).field(known).query(there)
    torch.testing.assert_close(after[0], before[0], atol=1e-5, rtol=0)
    exact_m = boxes.mirrored(chosen).field(known).distance_m(there)
    assert float((after[0] - exact_m).abs().mean()) < 0.004
    near = before[0][0] < REACH_M - 0.01
    turned = (after[1][0, near] - before[1][0, near] * torch.tensor([-1.0, 1.0, 1.0])).abs().amax(-1)
    assert float((turned < 1e-3).float().mean()) > 0.99
    assert (volumes.filled == boxes.filled).all()


@pytest.mark.parametrize("row", [0, 1])
def test_the_papers_descriptors_are_nearly_those_of_the_boxes(row: int) -> None:
    boxes, volumes = rows()
    grid = GridSpec((24, 12, 24), PaperConfig().voxel_m)
    a, b = boxes.occupancy(row, grid)[:, 1:], volumes.occupancy(row, grid)[:, 1:]
    assert (a & b).sum() / (a | b).sum() > 0.85
    near = points()[row, :400].numpy()
    exact, found = boxes.offsets(row, near.astype(np.float64)), volumes.offsets(row, near)
    close = (np.linalg.norm(exact, axis=1) < 0.3) & (near[:, 1] < 1.0)
    assert np.median(np.linalg.norm(exact - found, axis=1)[close]) < 0.02
