"""Signed distance and the way out at points near the body: what the denoiser asks the scene, frame by frame.

Two forms of one question: boxes and a floor (training scenes, exact, a batch at a time) and grids (any scene, sampled
once around the path).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from video2anim.geometry.sdf import SdfGrid

REACH_M = 0.6
"""Solids farther from a point than this (an arm's length) are as good as none."""


class SceneField(Protocol):
    """Solids around each window of a batch, in the canonical frame of the window."""

    def query(
        self, points_m: Float[Tensor, "batch points 3"]
    ) -> tuple[Float[Tensor, "batch points"], Float[Tensor, "batch points 3"]]:
        """Signed distance (m, negative inside, at most `REACH_M`) and the unit direction in which it grows fastest."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class BoxField:
    """Upright boxes on the floor y = 0 around some windows of a batch; the others have no scene."""

    rows: Int[Tensor, "scenes"]
    """Windows with a scene, those with most boxes first."""
    boxes: Float[Tensor, "scenes boxes 7"]
    """Center, half extent, yaw about +Y; boxes before the rows of zeros that fill up."""
    count: tuple[int, ...]
    """For each column of `boxes`, how many windows have so many."""

    @classmethod
    def of(cls, boxes: Float[Tensor, "batch boxes 7"], known: Float[Tensor, "batch"]) -> BoxField:
        """Of the windows where `known` is 1."""
        counts = torch.where(known > 0, (boxes[..., 3] > 0).sum(1), -1)
        order = torch.argsort(counts, descending=True, stable=True)[: int((known > 0).sum())]
        most = max(int(counts.max()), 0)
        return cls(order, boxes[order, :most], tuple(int((counts > k).sum()) for k in range(most)))

    def query(
        self, points_m: Float[Tensor, "batch points 3"]
    ) -> tuple[Float[Tensor, "batch points"], Float[Tensor, "batch points 3"]]:
        """See `SceneField`."""
        distance_m = points_m.new_full(points_m.shape[:2], REACH_M)
        out = torch.zeros_like(points_m)
        if not len(self.rows):
            return distance_m, out
        points = points_m[self.rows]
        best = points[..., 1].clamp(max=REACH_M)
        away = torch.zeros_like(points)
        away[..., 1] = (best < REACH_M).to(points)
        for k, n in enumerate(self.count):
            local, over = self._local(points[:n], k)
            beyond = over.clamp(min=0)
            outside, inside = beyond.norm(dim=-1), over.amax(-1)
            distance = torch.where(inside > 0, outside, inside)
            # Outside, away from the nearest point of the box; inside, through the nearest face.
            face = functional.one_hot(over.argmax(-1), 3).to(over)
            way = torch.where((inside > 0)[..., None], beyond / outside.clamp(min=1e-6)[..., None], face)
            nearer = distance < best[:n]
            best[:n] = torch.where(nearer, distance, best[:n])
            away[:n] = torch.where(nearer[..., None], self._turned_back(way * local.sign(), k), away[:n])
        distance_m[self.rows], out[self.rows] = best, away
        return distance_m, out

    def distance_m(self, points_m: Float[Tensor, "batch points 3"]) -> Float[Tensor, "scenes points"]:
        """Signed distances alone, differentiable, for the windows `rows`."""
        points = points_m[self.rows]
        best = points[..., 1].clamp(max=REACH_M)
        for k, n in enumerate(self.count):
            _, over = self._local(points[:n], k)
            distance = (over.clamp(min=0).square().sum(-1) + 1e-12).sqrt() + over.amax(-1).clamp(max=0)
            best = torch.cat([torch.minimum(best[:n], distance), best[n:]])
        return best

    def _local(self, points: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """Points in the frame of each window's k-th box, and how far they lie over its faces."""
        box = self.boxes[: len(points), None, k]
        x, y, z = (points - box[..., :3]).unbind(-1)
        cos, sin = box[..., 6].cos(), box[..., 6].sin()
        local = torch.stack([x * cos - z * sin, y, x * sin + z * cos], -1)
        return local, local.abs() - box[..., 3:6]

    def _turned_back(self, local: Tensor, k: int) -> Tensor:
        u, y, w = local.unbind(-1)
        yaw = self.boxes[: len(local), None, k, 6]
        cos, sin = yaw.cos(), yaw.sin()
        return torch.stack([u * cos + w * sin, y, w * cos - u * sin], -1)


@dataclass(frozen=True, slots=True, eq=False)
class GridField:
    """A grid of signed distances, in its canonical frame, for each window that has a scene."""

    grids: tuple[SdfGrid | None, ...]

    def query(
        self, points_m: Float[Tensor, "batch points 3"]
    ) -> tuple[Float[Tensor, "batch points"], Float[Tensor, "batch points 3"]]:
        """See `SceneField`. The direction is read off over one spacing of the grid."""
        distance_m = points_m.new_full(points_m.shape[:2], REACH_M)
        out = torch.zeros_like(points_m)
        for row, grid in enumerate(self.grids):
            if grid is None:
                continue
            steps = 0.5 * grid.spacing_m * torch.eye(3, dtype=points_m.dtype, device=points_m.device)
            points = points_m[row]
            distance_m[row] = grid.sample(points).clamp(max=REACH_M)
            ends = grid.sample(torch.stack([points[:, None] + steps, points[:, None] - steps]))
            out[row] = functional.normalize(ends[0] - ends[1], dim=-1, eps=1e-6)
        return distance_m, torch.where((distance_m < REACH_M)[..., None], out, 0.0)
