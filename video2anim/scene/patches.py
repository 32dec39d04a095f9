"""Rectangles on planes as textured pieces of a room, cut to a field over their nodes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from video2anim.geometry.harmonic import harmonic_fill
from video2anim.scene.polygons import outlines, triangulated
from video2anim.scene.view import Look
from video2anim.types.scene import Mesh, RoomPiece, Texture

SMOOTH_PX = 3
"""Radius of the smoothing of outlines, in pixels of the view."""
_MAX_TEXELS = 1024
"""Along the longer side of a texture."""
_MAX_NODES = 300
"""Nodes along the longer side of the grid for outlines."""
_FILL_TEXELS = 96
"""Resolution at which colors of unseen areas are filled in."""
_OPENING_IOU = 0.8
"""IoU of a hole with its bounding rectangle from which it becomes that rectangle."""


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A rectangle of a plane: origin + a * across + b * upward, for a and b from low to high."""

    origin_m: Float[np.ndarray, "3"]
    across: Float[np.ndarray, "3"]
    """Unit vectors in the world; across x upward is the side that triangles face."""
    upward: Float[np.ndarray, "3"]
    low_m: Float[np.ndarray, "2"]
    """Least a and b."""
    high_m: Float[np.ndarray, "2"]

    @property
    def extent_m(self) -> Float[np.ndarray, "2"]:
        return np.maximum(self.high_m - self.low_m, 1e-3)

    def points(self, share: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points 3"]:
        """Points of the world at shares, 0 to 1, of both sides."""
        on_plane = self.low_m + share * self.extent_m
        return self.origin_m + on_plane[..., :1] * self.across + on_plane[..., 1:] * self.upward

    def grid(self, cell_m: float = np.inf) -> Float[np.ndarray, "rows columns 3"]:
        """Nodes about `cell_m` apart, corners included; a along columns, b along rows."""
        cell_m = max(cell_m, float(self.extent_m.max()) / _MAX_NODES)
        columns, rows = (max(2, int(np.ceil(e / cell_m)) + 1) for e in self.extent_m)
        share = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
        return self.points(np.stack(share, -1))


def tidy(kept: Bool[np.ndarray, "rows columns"], radius: int) -> Bool[np.ndarray, "rows columns"]:
    """Closing and opening by a disk of this radius (in nodes), with edge padding."""
    size = 2 * radius + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    padded = np.pad(kept.astype(np.uint8), 2 * size, mode="edge")
    smooth = cv2.morphologyEx(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disk), cv2.MORPH_OPEN, disk)
    return smooth[2 * size : -2 * size, 2 * size : -2 * size] > 0


def smooth_field(kept: Bool[np.ndarray, "rows columns"], radius: int) -> Float[np.ndarray, "rows columns"]:
    """Positive where nodes are kept and zero on a smooth line around them."""
    return cv2.GaussianBlur(kept.astype(np.float32), (0, 0), 0.5 * radius, borderType=cv2.BORDER_REPLICATE) - 0.5


def squared(
    kept: Bool[np.ndarray, "rows columns"], radius: int
) -> tuple[Float[np.ndarray, "rows columns"], tuple[Float[np.ndarray, "4 2"], ...]]:
    """A smooth field with rectangular holes and cuts, and the rectangles that are openings.

    Missing regions that match their bounding rectangle become that rectangle; other holes are filled. An opening has
    parts of the piece on both sides and above. Its corners are shares of the piece's sides.
    """
    whole, openings = kept.copy(), []
    _, cut = cv2.connectedComponents((~kept).astype(np.uint8), connectivity=4)
    last = np.array(kept.shape) - 1
    for index, where in enumerate(ndimage.find_objects(cut), 1):
        inside = all(s.start > 0 and s.stop <= n for s, n in zip(where, last, strict=True))
        if (cut[where] == index).mean() < _OPENING_IOU:
            whole[where] |= inside & (cut[where] == index)
            continue
        whole[where] = True
        (b0, b1), (a0, a1) = ((max(s.start - 0.5, 0), min(s.stop - 0.5, n)) for s, n in zip(where, last, strict=True))
        if a0 > 0 and a1 < last[1] and b1 < last[0]:
            openings.append(np.array([[a0, b0], [a1, b0], [a1, b1], [a0, b1]]) / last[::-1])
        cut[where] = -1
    return np.where(cut == -1, -0.5, smooth_field(whole, radius)), tuple(openings)


def room_piece(
    name: str,
    patch: Patch,
    field: Float[np.ndarray, "rows columns"],
    view: Look,
    shown: Bool[np.ndarray, "height width"],
    background_rgb: UInt8[np.ndarray, "background_height background_width 3"],
    openings: tuple[Float[np.ndarray, "4 2"], ...] = (),
) -> RoomPiece:
    """The part of a rectangle where a field over its nodes is positive, textured from the background image.

    Args:
        patch: the rectangle.
        field: over the nodes of the rectangle.
        view: that shows it.
        shown: pixels of the view that show it; the rest gets a harmonic fill of the colors around.
        background_rgb: the image of the view, of any size.
        openings: corners as shares of the rectangle's sides.
    """
    last = np.array(field.shape[::-1]) - 1
    share, faces = triangulated(outlines(field))
    # Outlines cut corners by half a cell.
    for corner in np.reshape(openings, (-1, 2)) * last:
        gap = np.linalg.norm(share - corner, axis=1)
        share[gap.argmin()] = corner if gap.min() < 1 else share[gap.argmin()]
    share = share / last
    image = _painted(patch, view, shown, background_rgb)
    uv = np.stack([share[:, 0], 1 - share[:, 1]], -1)
    at = np.clip(uv * image.shape[1::-1], 0, np.array(image.shape[1::-1]) - 1).astype(int)
    mesh = Mesh(patch.points(share).astype(np.float32), faces, image[at[:, 1], at[:, 0]])
    texture = Texture(image, uv[faces].astype(np.float32))
    return RoomPiece(name, mesh, (texture,), tuple(patch.points(one) for one in openings))


def _painted(
    patch: Patch,
    view: Look,
    shown: Bool[np.ndarray, "height width"],
    background_rgb: UInt8[np.ndarray, "background_height background_width 3"],
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Texture of a rectangle, upper row first, at the resolution of the image where it is seen."""
    larger = np.array([background_rgb.shape[1] / view.shape[1], background_rgb.shape[0] / view.shape[0]])
    texel_m = float(np.sqrt(patch.extent_m.prod() / max(shown.sum() * larger.prod(), 1.0)))
    texel_m = max(texel_m, float(patch.extent_m.max()) / _MAX_TEXELS)
    columns, rows = np.maximum(np.round(patch.extent_m / texel_m), 1).astype(int)
    center = np.meshgrid((np.arange(columns) + 0.5) / columns, 1 - (np.arange(rows) + 0.5) / rows)
    points_m = patch.points(np.stack(center, -1))
    told = view.sampled(shown, points_m, False)
    if not told.any():
        usual = np.median(view.rgb[shown], axis=0) if shown.any() else np.full(3, 128)
        return np.broadcast_to(usual.astype(np.uint8), (1, 1, 3)).copy()
    pixel, _, _ = view.pixels(points_m.reshape(-1, 3))
    at = ((pixel + 0.5) * larger - 0.5).astype(np.float32).reshape(rows, columns, 2)
    color = cv2.remap(background_rgb, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(told[..., None], color, _blend(color, told))


def _blend(
    color: UInt8[np.ndarray, "rows columns 3"], told: Bool[np.ndarray, "rows columns"]
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Harmonic fill of the colors that are not known."""
    if told.all():
        return color
    shrink = min(1.0, _FILL_TEXELS / max(told.shape))
    size = (max(1, round(told.shape[1] * shrink)), max(1, round(told.shape[0] * shrink)))
    weight = cv2.resize(told.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(color.astype(np.float32) * told[..., None], size, interpolation=cv2.INTER_AREA)
    filled = harmonic_fill((total / np.maximum(weight, 1e-6)[..., None]).astype(np.float64), weight > 0)
    smooth = cv2.resize(filled.astype(np.float32), told.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.clip(np.round(smooth), 0, 255).astype(np.uint8)


def clear(mask: Bool[np.ndarray, "height width"], by_px: int = 2) -> Bool[np.ndarray, "height width"]:
    """The mask eroded by the pixels at its outline, whose colors are mixed; the image border is no outline."""
    padded = np.pad(mask, by_px, mode="edge").astype(np.uint8)
    return cv2.erode(padded, np.ones((2 * by_px + 1,) * 2))[by_px:-by_px, by_px:-by_px].astype(bool)
