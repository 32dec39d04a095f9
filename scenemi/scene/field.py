"""Signed distance and the way out at points near the body: what the denoiser asks the scene, frame by frame.

Three forms of one question: boxes and a floor (made-up training scenes, exact, a batch at a time), volumes of coarse
distances (captured training scenes, a batch at a time) and grids (any scene, sampled once around the path).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float, Int, Int8
from torch import Tensor
from torch.nn import functional

from scenemi.scene.grid import REACH_M
from video2anim.geometry.sdf import SdfGrid

_ON_FLOOR_M, _BELOW_M = 0.02, 3.0
"""Boxes whose bottom is lower than this stand on the floor, and go on so far below it."""
VOLUME_LEVELS = torch.iinfo(torch.int8).max
VOLUME_STEP_M = REACH_M / VOLUME_LEVELS
"""Of distances stored as 8-bit integers."""


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
        return cls(order, rooted_boxes(boxes[order, :most]), tuple(int((counts > k).sum()) for k in range(most)))

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
        nearest = torch.full(best.shape, -1, dtype=torch.long, device=best.device)
        for k, n in enumerate(self.count):
            distance = signed_distance(points[:n], self.boxes[:n, None, k])
            nearest[:n].masked_fill_(distance < best[:n], k)
            best[:n] = torch.minimum(best[:n], distance)
        up = torch.zeros_like(points)
        up[..., 1] = (best < REACH_M).to(points)
        if self.count:
            box = self.boxes.gather(1, nearest.clamp(min=0)[..., None].expand(-1, -1, 7))
            up = torch.where((nearest < 0)[..., None], up, way_out(points, box))
        distance_m[self.rows], out[self.rows] = best, up
        return distance_m, out

    def distance_m(self, points_m: Float[Tensor, "batch points 3"]) -> Float[Tensor, "scenes points"]:
        """Signed distances alone, differentiable, for the windows `rows`."""
        points = points_m[self.rows]
        best = points[..., 1].clamp(max=REACH_M)
        for k, n in enumerate(self.count):
            distance = signed_distance(points[:n], self.boxes[:n, None, k])
            best = torch.cat([torch.minimum(best[:n], distance), best[n:]])
        return best


def rooted_boxes(boxes: Float[Tensor, "scenes boxes 7"]) -> Float[Tensor, "scenes boxes 7"]:
    """Boxes that stand on the floor, going on below it: nobody leaves them through their bottom."""
    low, top = boxes[..., 1] - boxes[..., 4], boxes[..., 1] + boxes[..., 4]
    low = torch.where((low < _ON_FLOOR_M) & (boxes[..., 3] > 0), low - _BELOW_M, low)
    rooted = boxes.clone()
    rooted[..., 1], rooted[..., 4] = (top + low) / 2, (top - low) / 2
    return rooted


def _local(
    points: Float[Tensor, "... 3"], box: Float[Tensor, "... 7"]
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Coordinates of points in the frame of boxes, and how far they lie over the faces."""
    x, y, z = (points - box[..., :3]).unbind(-1)
    cos, sin = box[..., 6].cos(), box[..., 6].sin()
    local = (x * cos - z * sin, y, x * sin + z * cos)
    return local, tuple(part.abs() - half for part, half in zip(local, box[..., 3:6].unbind(-1), strict=True))


def _signed(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Signed distance to a box from how far a point lies over its faces."""
    outside = x.clamp(min=0).square() + y.clamp(min=0).square() + z.clamp(min=0).square()
    return (outside + 1e-12).sqrt() + torch.maximum(torch.maximum(x, y), z).clamp(max=0)


def signed_distance(points: Float[Tensor, "... 3"], boxes: Float[Tensor, "... 7"]) -> Float[Tensor, "..."]:
    """Signed distance of points to boxes."""
    return _signed(*_local(points, boxes)[1])


def way_out(points: Float[Tensor, "... 3"], box: Float[Tensor, "... 7"]) -> Float[Tensor, "... 3"]:
    """Unit direction away from the nearest point of the box; inside, through the nearest face."""
    local, over = (torch.stack(part, -1) for part in _local(points, box))
    deepest = over.amax(-1, keepdim=True)
    way = torch.where(deepest > 0, over.clamp(min=0), (over == deepest).to(over)) * local.sign()
    u, y, w = functional.normalize(way, dim=-1, eps=1e-6).unbind(-1)
    cos, sin = box[..., 6].cos(), box[..., 6].sin()
    return torch.stack([u * cos + w * sin, y, w * cos - u * sin], -1)


@dataclass(frozen=True, slots=True, eq=False)
class VolumeField:
    """Solids as distances at the nodes of a box around each window, on the floor y = 0; some windows have no scene."""

    rows: Int[Tensor, "scenes"]
    """Windows with a scene."""
    distances_m: Float[Tensor, "scenes 1 x y z"]
    """Without the floor."""
    low_m: Float[Tensor, "scenes 1 3"]
    """Place of the first node."""
    step_m: Float[Tensor, "scenes 1 3"]
    """Between nodes along each axis."""

    @classmethod
    def of(
        cls,
        values: Int8[Tensor, "batch x y z"],
        place: Float[Tensor, "batch 6"],
        known: Float[Tensor, "batch"],
    ) -> VolumeField:
        """Of the windows where `known` is 1.

        Args:
            values: distances in steps of `VOLUME_STEP_M`.
            place: first node and steps of the nodes, m.
            known: 1 or 0.
        """
        rows = torch.nonzero(known > 0)[:, 0]
        low_m, step_m = place[rows][:, None].split(3, -1)
        return cls(rows, VOLUME_STEP_M * values[rows][:, None].float(), low_m, step_m)

    def query(
        self, points_m: Float[Tensor, "batch points 3"]
    ) -> tuple[Float[Tensor, "batch points"], Float[Tensor, "batch points 3"]]:
        """See `SceneField`. The direction is read off over one step of the nodes."""
        distance_m = points_m.new_full(points_m.shape[:2], REACH_M)
        out = torch.zeros_like(points_m)
        if not len(self.rows):
            return distance_m, out
        points = points_m[self.rows]
        half = 0.5 * torch.diag_embed(self.step_m[:, 0])[:, :, None]
        tried = torch.cat([points[:, None], points[:, None] + half, points[:, None] - half], 1)
        found = self.solids_m(tried.flatten(1, 2)).unflatten(1, (7, -1))
        slope = ((found[:, 1:4] - found[:, 4:]) / self.step_m[:, 0, :, None]).movedim(1, -1)
        height, solid = points[..., 1].clamp(max=REACH_M), found[:, 0]
        best = torch.minimum(height, solid)
        up = torch.zeros_like(points)
        up[..., 1] = 1.0
        away = torch.where((solid < height)[..., None], functional.normalize(slope, dim=-1, eps=1e-6), up)
        distance_m[self.rows] = best.to(distance_m)
        out[self.rows] = torch.where((best < REACH_M)[..., None], away, 0.0).to(out)
        return distance_m, out

    def distance_m(self, points_m: Float[Tensor, "batch points 3"]) -> Float[Tensor, "scenes points"]:
        """Signed distances alone, differentiable, for the windows `rows`."""
        points = points_m[self.rows]
        return torch.minimum(points[..., 1].clamp(max=REACH_M), self.solids_m(points))

    def solids_m(self, points: Float[Tensor, "scenes points 3"]) -> Float[Tensor, "scenes points"]:
        """Distances to solids other than the floor, trilinear; around the box as on its border."""
        last = points.new_tensor(self.distances_m.shape[2:]) - 1
        place = 2 * (points - self.low_m) / (self.step_m * last) - 1
        # Along the last axis of the nodes (z) goes the first coordinate of `grid_sample`.
        place = place.flip(-1)[:, None, None].to(self.distances_m)
        found = functional.grid_sample(self.distances_m, place, padding_mode="border", align_corners=True)
        return found[:, 0, 0, 0]


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
