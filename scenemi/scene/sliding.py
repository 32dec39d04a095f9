"""Where furniture can stand so that nothing of a moving body is in it: free places along a line, by interval.

A piece keeps its turn and its sideways place and slides along its own z axis. Each sphere of the swept body blocks an
interval of that line for each box of the piece; what no interval covers is free. This is exact for spheres and boxes
and needs no rejection: a piece is pushed to the place that leaves the clearance asked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scenemi.scene.boxes import Boxes
from scenemi.scene.furniture import Piece

_STEP_M = 0.01
"""From place to place on a line."""
_REACH_M = 5.0
"""Of a line to each side: walks of a window are shorter."""
_BINS = round(2 * _REACH_M / _STEP_M)
_PIECES_APART_M = 2 * _STEP_M
"""Between pieces of furniture."""


@dataclass(frozen=True, slots=True, eq=False)
class SweptBody:
    """Spheres of all frames in the canonical frame."""

    center_m: Float[np.ndarray, "3 frames spheres"]
    radius_m: Float[np.ndarray, "spheres"]

    def bottom_m(self, spheres: Bool[np.ndarray, "spheres"]) -> Float[np.ndarray, "frames"]:
        """Lowest point of some spheres in each frame."""
        return (self.center_m[1][:, spheres] - self.radius_m[spheres]).min(axis=1)


class Slide:
    """The lines along one direction (yaw) in one swept body."""

    def __init__(self, body: SweptBody, yaw_rad: float) -> None:
        self.yaw_rad = yaw_rad
        self._cos, self._sin = np.float32(np.cos(yaw_rad)), np.float32(np.sin(yaw_rad))
        x, y, z = body.center_m.reshape(3, -1)
        self._u, self._v = x * self._cos - z * self._sin, x * self._sin + z * self._cos
        self._y, self._radius_m = y, np.broadcast_to(body.radius_m, body.center_m.shape[1:]).ravel()

    def local(self, point_m: Float[np.ndarray, "3"]) -> tuple[float, float]:
        """Sideways and along coordinates of a canonical point."""
        x, z = float(point_m[0]), float(point_m[2])
        return x * float(self._cos) - z * float(self._sin), x * float(self._sin) + z * float(self._cos)

    def free(self, piece: Piece, sideways_m: float, clearance_m: float, others: Boxes) -> Bool[np.ndarray, "places"]:
        """Whether the piece can have its front at each place of the line, see `places_m`."""
        change = np.zeros(_BINS + 1, np.int64)
        reach_m = self._radius_m + np.float32(clearance_m)
        low_m, high_m = piece.low_m, piece.high_m
        side = np.abs(self._u - np.float32(sideways_m + 0.5 * (low_m[:, 0].min() + high_m[:, 0].max())))
        rows = np.flatnonzero(side < reach_m + np.float32(0.5 * (high_m[:, 0].max() - low_m[:, 0].min())))
        u, v, y, reach_m = self._u[rows] - np.float32(sideways_m), self._v[rows], self._y[rows], reach_m[rows]
        for low, high in zip(low_m.astype(np.float32), high_m.astype(np.float32), strict=True):
            gap_u = np.maximum(np.maximum(low[0] - u, u - high[0]), np.float32(0))
            gap_y = np.maximum(np.maximum(low[1] - y, y - high[1]), np.float32(0))
            left = reach_m * reach_m - gap_u * gap_u - gap_y * gap_y
            hit = np.flatnonzero(left > 0)
            half = np.sqrt(left[hit])
            _block(change, v[hit] - half - high[2], v[hit] + half - low[2])
        self._block_others(change, piece, sideways_m, others)
        return np.cumsum(change[:-1]) == 0

    def _block_others(self, change: np.ndarray, piece: Piece, sideways_m: float, others: Boxes) -> None:
        """Other furniture, by its bounds along the axes of this line."""
        if not len(others):
            return
        turn = others.yaw_rad - self.yaw_rad
        cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
        half = np.stack([cos * others.half_m[:, 0] + sin * others.half_m[:, 2], others.half_m[:, 1]], -1)
        along = sin * others.half_m[:, 0] + cos * others.half_m[:, 2] + _PIECES_APART_M
        x, y, z = others.center_m.T
        u, v = x * self._cos - z * self._sin, x * self._sin + z * self._cos
        for low, high in zip(piece.low_m, piece.high_m, strict=True):
            hit = (u + half[:, 0] > sideways_m + low[0]) & (u - half[:, 0] < sideways_m + high[0])
            hit &= (y + half[:, 1] > low[1]) & (y - half[:, 1] < high[1])
            _block(change, (v - along)[hit] - high[2], (v + along)[hit] - low[2])

    def placed(self, piece: Piece, sideways_m: float, along_m: float) -> Boxes:
        """The piece's boxes in the canonical frame, its front middle at that place."""
        center, half = 0.5 * (piece.low_m + piece.high_m), 0.5 * (piece.high_m - piece.low_m)
        u, v = center[:, 0] + sideways_m, center[:, 2] + along_m
        cos, sin = float(self._cos), float(self._sin)
        center_m = np.stack([u * cos + v * sin, center[:, 1], v * cos - u * sin], -1)
        return Boxes(center_m, half, np.full(len(half), self.yaw_rad))


def places_m() -> Float[np.ndarray, "places"]:
    """Coordinates along a line at which `Slide.free` answers."""
    return _PLACES_M


_PLACES_M = _STEP_M * (np.arange(_BINS) + 0.5) - _REACH_M
"""Middles of the steps."""


def _block(change: np.ndarray, start_m: np.ndarray, stop_m: np.ndarray) -> None:
    """Count the places between as blocked (as first differences, in place)."""
    start = np.clip(np.floor((start_m + _REACH_M) / _STEP_M - 0.5), 0, _BINS).astype(np.int64)
    stop = np.clip(np.ceil((stop_m + _REACH_M) / _STEP_M + 0.5), 0, _BINS).astype(np.int64)
    change += np.bincount(start, minlength=_BINS + 1)
    change -= np.bincount(stop, minlength=_BINS + 1)


def nearest_free(free: Bool[np.ndarray, "places"], wish_m: float, within_m: float) -> float | None:
    """The free place nearest to a wish, None where there is none so near."""
    places = _PLACES_M[free]
    if not len(places):
        return None
    best = float(places[np.abs(places - wish_m).argmin()])
    return best if abs(best - wish_m) <= within_m else None
