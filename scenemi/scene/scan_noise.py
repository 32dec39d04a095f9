"""How scans differ from the objects they show: holes, specks, a floor that is a little off, noise in the distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scenemi.scene.boxes import Boxes
from scenemi.scene.voxels import GridSpec

_BLOB = 4
"""Holes are made of cubes of this many voxels."""


@dataclass(frozen=True, slots=True)
class ScanNoise:
    """Share of noisy scenes and the most that happens in one."""

    share: float = 0.4
    hole_share: float = 0.25
    """Largest share of the space that holes take."""
    loss_share: float = 0.2
    """Largest share of single voxels lost."""
    speck_share: float = 0.004
    """Largest share of voxels filled by nothing."""
    floor_m: float = 0.02
    """Largest error of the floor's height; a floor too low leaves the lowest layer of voxels free."""
    offset_m: float = 0.01
    """Largest standard deviation of the offsets."""

    @classmethod
    def none(cls) -> ScanNoise:
        """Scenes as they are."""
        return cls(share=0.0)


def scanned(
    rng: np.random.Generator,
    noise: ScanNoise,
    boxes: Boxes,
    anchors_m: Float[np.ndarray, "frames anchors 3"],
    frames: Bool[np.ndarray, "frames"] | None,
    grid: GridSpec,
    hollow: bool,
) -> tuple[Bool[np.ndarray, "x y z"], Float[np.ndarray, "frames anchors 3"]]:
    """Voxels and offsets of boxes on a floor at y = 0, some of the time noisy."""
    noisy = rng.random() < noise.share
    floor_y_m = float(rng.uniform(-noise.floor_m, noise.floor_m)) if noisy and rng.random() < 0.5 else 0.0
    voxels = boxes.occupancy(grid, hollow=hollow)
    under = grid.axes_m()[1] - floor_y_m <= grid.within_m
    voxels[:, under] = True
    frames = np.ones(len(anchors_m), bool) if frames is None else frames
    points_m = np.ascontiguousarray(np.moveaxis(np.asarray(anchors_m[frames], np.float32), -1, 0))
    found_m, _ = boxes.offsets(points_m.reshape(3, -1), floor_y_m)
    offsets_m = np.zeros(anchors_m.shape, np.float32)
    offsets_m[frames] = np.moveaxis(found_m.reshape(points_m.shape), 0, -1)
    if noisy:
        voxels = _torn(rng, noise, voxels)
        spread_m = np.float32(rng.uniform(0.0, noise.offset_m))
        offsets_m[frames] += spread_m * rng.standard_normal(offsets_m[frames].shape, np.float32)
    return voxels, offsets_m


def _torn(rng: np.random.Generator, noise: ScanNoise, voxels: np.ndarray) -> Bool[np.ndarray, "x y z"]:
    """Voxels with holes, losses and specks."""
    blobs = rng.random([-(-n // _BLOB) for n in voxels.shape], np.float32) < rng.uniform(0.0, noise.hole_share)
    holes = np.kron(blobs, np.ones((_BLOB, _BLOB, _BLOB), bool))[tuple(slice(n) for n in voxels.shape)]
    chance = rng.random(voxels.shape, np.float32)
    kept = voxels & ~holes & (chance >= rng.uniform(0.0, noise.loss_share))
    return kept | (chance > 1.0 - rng.uniform(0.0, noise.speck_share))
