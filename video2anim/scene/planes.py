"""Planes of a room by voting: walls and ceilings that explain the depth of an image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from video2anim.scene.view import Look

DEPTH_SIGMA = 0.05
"""Standard deviation of the logarithm of a network's depth on a wall, without the error of scale: 0.03 to 0.10 on
renders of furnished rooms."""
INLIER_SIGMAS = 2.5
_HEADINGS = 120
"""Headings of walls that are tested: every 3 degrees."""
BIN = 0.6 * DEPTH_SIGMA
"""Width of a bin of the logarithm of a plane's distance."""
_GRAZING = 0.1
"""Minimum cosine between ray and normal: planes seen at a flatter angle have no depth in the image."""
_FACING = 0.75
"""Minimum cosine between the normal of the depth and that of the plane."""
_MIN_SHARE = 0.015
"""Minimum share of the image that a plane explains."""
_LOSS = 0.5
"""Walls are rotated to the heading of the image's edges unless they then explain this share fewer pixels: slopes of
networks' depth are off by 5 to 20 degrees."""
_REACH_RAD = np.deg2rad(22.5)
"""Walls this close to a multiple of a right angle from the heading are rotated to it. The heading is that of the
image's edges, or of the first wall."""
_UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """normal . (x - camera) = distance."""

    kind: str
    """`wall`, `ceiling`, `level` (a flat object below the eye), `card` (upright, for what is no plane), `backdrop`."""
    normal: Float[np.ndarray, "3"]
    """Unit vector away from the camera, in world axes."""
    distance_m: float

    def depth_m(self, direction: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
        """Depth at which the plane is met along directions of a `Look`; infinite where it is not."""
        along = direction @ self.normal
        met = along > _GRAZING * np.linalg.norm(direction, axis=-1)
        return np.where(met, self.distance_m / np.where(met, along, 1.0), np.inf)

    def off(self, view: Look) -> Float[np.ndarray, "height width"]:
        """Logarithm of the seen depth over the plane's, in `DEPTH_SIGMA`; infinite where the plane is not met."""
        plane_m = self.depth_m(view.direction)
        met = np.isfinite(plane_m)
        return np.where(met, np.log(view.depth_m / np.where(met, plane_m, 1.0)) / DEPTH_SIGMA, np.inf)

    def pushed(self, ratio: float) -> Plane:
        """The same in the picture, at `ratio` times the distance."""
        return replace(self, distance_m=self.distance_m * ratio)


def room_planes(view: Look, open_to: Bool[np.ndarray, "height width"], heading_rad: float | None) -> list[Plane]:
    """Planes that explain pixels of `open_to`, the one that explains most first.

    Args:
        heading_rad: of the room's walls by the image's edges, which are more accurate than slopes of depth. None:
            walls are rotated to the first wall.
    """
    normals, left, found, square = view.normals(), open_to.copy(), [], heading_rad
    while True:
        plane = _voted(view, normals, left)
        if plane is None:
            break
        if plane.kind == "wall":
            plane = _refined(plane, view, normals, left)
            square = _heading(plane) if square is None else square
            turned = _squared(plane, square, view, normals, left)
            before, after = ((left & supporting(one, view, normals)).sum() for one in (plane, turned))
            plane = turned if after >= (1 - _LOSS) * before else plane
        explained = left & supporting(plane, view, normals)
        if explained.sum() < _MIN_SHARE * left.size:
            break
        found.append(plane)
        # Remove all pixels within its noise, whatever their slope, so that no second plane is found beside it.
        left &= np.abs(plane.off(view)) > INLIER_SIGMAS
    return found


def supporting(
    plane: Plane, view: Look, normals: Float[np.ndarray, "height width 3"]
) -> Bool[np.ndarray, "height width"]:
    """Pixels whose depth and slope agree with the plane."""
    return (np.abs(plane.off(view)) < INLIER_SIGMAS) & (-normals @ plane.normal > _FACING)


def _voted(view: Look, normals: np.ndarray, left: np.ndarray) -> Plane | None:
    """The plane with most votes among all headings and distances, and both level ones."""
    offset_m, normal = view.offset_m[left], normals[left]
    if len(offset_m) < _MIN_SHARE * left.size:
        return None
    turn = np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
    candidates = np.concatenate([np.stack([np.cos(turn), 0 * turn, np.sin(turn)], 1), [_UP, -_UP]])
    length = np.linalg.norm(offset_m, axis=1)
    edges = np.arange(np.log(_GRAZING * length.min()), np.log(length.max()) + 2 * BIN, BIN)
    kernel = np.exp(-0.5 * (np.arange(-4, 5) * BIN / DEPTH_SIGMA) ** 2)
    best = (0.0, 0, 0)
    for index, candidate in enumerate(candidates):
        along = offset_m @ candidate
        vote = (along > _GRAZING * length) & (-normal @ candidate > _FACING)
        count, _ = np.histogram(np.log(along[vote]), edges)
        smooth = np.convolve(count, kernel, "same")
        top = int(smooth.argmax())
        best = max(best, (float(smooth[top]), index, top))
    _, index, top = best
    kind = "wall" if index < _HEADINGS else ("ceiling" if index == _HEADINGS else "level")
    return Plane(kind, candidates[index], float(np.exp(edges[top] + 0.5 * BIN)))


def _refined(plane: Plane, view: Look, normals: np.ndarray, left: np.ndarray) -> Plane:
    """Heading and distance by reweighted least squares over the supporting pixels."""
    for _ in range(6):
        chosen = left & supporting(plane, view, normals)
        if chosen.sum() < 8:
            return plane
        flat = view.direction[chosen][:, [0, 2]] * view.depth_m[chosen][:, None]
        weight = (1 - (plane.off(view)[chosen] / INLIER_SIGMAS) ** 2) ** 2
        # Inverse depth is linear in the parameters of a plane; multiplied by depth, residuals are relative.
        across = np.linalg.lstsq(flat * weight[:, None], weight, rcond=None)[0]
        size = float(np.hypot(*across))
        if not np.isfinite(size) or size < 1e-6:
            return plane
        plane = Plane("wall", np.array([across[0], 0.0, across[1]]) / size, 1 / size)
    return plane


def _heading(plane: Plane) -> float:
    return float(np.arctan2(plane.normal[2], plane.normal[0]))


def _squared(plane: Plane, square_rad: float, view: Look, normals: np.ndarray, left: np.ndarray) -> Plane:
    """The wall rotated to the nearest right angle from a heading, at the median distance of its pixels; unchanged where
    the rotation would exceed `_REACH_RAD`."""
    own = _heading(plane)
    square = square_rad + np.round((own - square_rad) / (np.pi / 2)) * np.pi / 2
    if abs(own - square) > _REACH_RAD:
        return plane
    normal = np.array([np.cos(square), 0.0, np.sin(square)])
    along = view.offset_m[left & supporting(plane, view, normals)] @ normal
    along = along[along > 0]
    return Plane("wall", normal, float(np.exp(np.median(np.log(along))))) if len(along) else plane
