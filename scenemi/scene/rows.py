"""Scenes of the windows of a training batch, as they are stored: made-up boxes, or volumes of captured scenes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from scenemi.scene.boxes import Boxes
from scenemi.scene.field import VOLUME_LEVELS, BoxField, VolumeField
from scenemi.scene.voxels import GridSpec

_MIRRORED_BOX = torch.tensor([-1.0, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0])


class SceneRows(Protocol):
    """One scene for each window, in its canonical frame, without the floor y = 0."""

    def to(self, device: torch.device, non_blocking: bool = False) -> SceneRows:
        """On a device."""
        ...

    @property
    def filled(self) -> Bool[np.ndarray, "batch"]:
        """Windows with any solid."""
        ...

    def columns(self) -> dict[str, Tensor]:
        """The tensors of a batch that hold these scenes."""
        ...

    def mirrored(self, chosen: Bool[Tensor, "batch"]) -> SceneRows:
        """With chosen windows reflected in the plane x = 0."""
        ...

    def field(self, known: Float[Tensor, "batch"]) -> BoxField | VolumeField:
        """The scenes with their floor, where `known` is 1."""
        ...

    def occupancy(self, row: int, grid: GridSpec) -> Bool[np.ndarray, "x y z"]:
        """Voxels of one window with something in them; the lowest layer is the floor."""
        ...

    def offsets(self, row: int, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """From points to the nearest solid of one window, the floor among them."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class BoxRows:
    """See `SceneRows`."""

    boxes: Float[Tensor, "batch boxes 7"]
    """Center, half extent, yaw about +Y; rows of zeros fill up."""

    def to(self, device: torch.device, non_blocking: bool = False) -> BoxRows:
        """See `SceneRows`."""
        return BoxRows(self.boxes.to(device, non_blocking=non_blocking))

    @property
    def filled(self) -> Bool[np.ndarray, "batch"]:
        """See `SceneRows`."""
        return (self.boxes[:, 0, 3] > 0).numpy()

    def columns(self) -> dict[str, Tensor]:
        """See `SceneRows`."""
        return {"boxes": self.boxes}

    def mirrored(self, chosen: Bool[Tensor, "batch"]) -> BoxRows:
        """See `SceneRows`."""
        return BoxRows(torch.where(chosen[:, None, None], self.boxes * _MIRRORED_BOX.to(self.boxes), self.boxes))

    def field(self, known: Float[Tensor, "batch"]) -> BoxField:
        """See `SceneRows`."""
        return BoxField.of(self.boxes, known)

    def occupancy(self, row: int, grid: GridSpec) -> Bool[np.ndarray, "x y z"]:
        """See `SceneRows`."""
        wide_m = grid.voxel_m * max(grid.shape)
        floor = Boxes(np.array([[0.0, -1.0, 0.0]]), np.array([[wide_m, 1.0, wide_m]]), np.zeros(1))
        return Boxes.joined([self._boxes(row), floor]).occupancy(grid)

    def offsets(self, row: int, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """See `SceneRows`."""
        return self._boxes(row).offsets(np.ascontiguousarray(points_m.T), 0.0)[0].T

    def _boxes(self, row: int) -> Boxes:
        rows = self.boxes[row][self.boxes[row, :, 3] > 0].cpu().double().numpy()
        return Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6])


@dataclass(frozen=True, slots=True, eq=False)
class VolumeRows:
    """See `SceneRows`; described by `VolumeField`."""

    values: Int8[Tensor, "batch x y z"]
    place: Float[Tensor, "batch 6"]
    """First node and steps of the nodes, m."""

    def to(self, device: torch.device, non_blocking: bool = False) -> VolumeRows:
        """See `SceneRows`."""
        return VolumeRows(
            self.values.to(device, non_blocking=non_blocking), self.place.to(device, non_blocking=non_blocking)
        )

    @property
    def filled(self) -> Bool[np.ndarray, "batch"]:
        """See `SceneRows`."""
        return (self.values.flatten(1).amin(1) < VOLUME_LEVELS).numpy()

    def columns(self) -> dict[str, Tensor]:
        """See `SceneRows`."""
        return {"boxes": torch.zeros(len(self.values), 0, 7), "values": self.values, "place": self.place}

    def mirrored(self, chosen: Bool[Tensor, "batch"]) -> VolumeRows:
        """See `SceneRows`."""
        values, place = self.values.clone(), self.place.clone()
        values[chosen] = values[chosen].flip(1)
        last_m = place[:, 0] + place[:, 3] * (values.shape[1] - 1)
        place[:, 0] = torch.where(chosen, -last_m, place[:, 0])
        return VolumeRows(values, place)

    def field(self, known: Float[Tensor, "batch"]) -> VolumeField:
        """See `SceneRows`."""
        return VolumeField.of(self.values, self.place, known)

    def occupancy(self, row: int, grid: GridSpec) -> Bool[np.ndarray, "x y z"]:
        """See `SceneRows`."""
        return self._asked(row, grid.centers_m().reshape(-1, 3))[0].reshape(grid.shape) <= grid.within_m

    def offsets(self, row: int, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """See `SceneRows`; a point inside a solid is its own nearest point, and so is one that is far from all."""
        distance_m, out = self._asked(row, points_m)
        return -np.maximum(distance_m, 0.0)[:, None] * out

    def _asked(self, row: int, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        one = VolumeField.of(self.values[row : row + 1], self.place[row : row + 1], self.place.new_ones(1))
        distance, out = one.query(torch.from_numpy(np.asarray(points_m, np.float32)).to(self.place.device)[None])
        return distance[0].cpu().numpy(), out[0].cpu().numpy()
