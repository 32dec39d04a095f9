"""Which plane each pixel of a picture shows."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from video2anim.scene.planes import BIN, DEPTH_SIGMA, INLIER_SIGMAS, Plane
from video2anim.scene.view import Look

FLOOR, HIDDEN = -1, -2
"""Labels besides the numbers of planes: floor, and pixels hidden by objects."""
_CARD_COST = 0.5
"""Minimum cost of a card, so that planes with the same misfit are preferred."""
CARD_SIGMAS = 5.0
"""Thickness of what a card stands for (trees, hedges, clutter), in standard deviations of depth."""
_WORST = 2.0
"""Cost of impossible labels."""
_UNKNOWN_COST = 0.6
"""Cost of all planes where depth is unknown..."""
_FAR_COST = 0.5
"""...and of the backdrop there: small gaps go to the plane around them by smoothing, large ones to the backdrop."""
_SMOOTH_SHARE = 0.025
"""Radius of the guided filter of the costs, over the image's longer side."""
_EDGE_EPSILON = 0.02**2
"""Regularization of the guided filter: variance of colors (0 to 1) at edges."""
_CRUMB, CARD_CRUMB = 0.006, 0.03
"""Minimum share of the image of regions of planes and of cards; smaller ones are merged into their surroundings."""
LOW = 0.2
"""Share of the camera's height below which flat objects are labeled floor: mats, thresholds, slopes, depth errors."""


def cards(view: Look, open_to: Bool[np.ndarray, "height width"], planes: Sequence[Plane]) -> list[Plane]:
    """Upright planes that face the camera, one per distance at which many pixels are not explained by a plane."""
    left = open_to.copy()
    for plane in planes:
        left &= np.abs(plane.off(view)) > CARD_SIGMAS
    ahead = view.T_world_camera[:3, 2] * [1.0, 0.0, 1.0]
    size = float(np.linalg.norm(ahead))
    if size < 0.2:
        return []
    ahead, found = ahead / size, []
    distance_m = view.offset_m @ ahead
    left &= distance_m > 0.3
    half = CARD_SIGMAS * DEPTH_SIGMA
    while left.sum() >= CARD_CRUMB * left.size:
        log_m = np.log(distance_m[left])
        edges = np.arange(log_m.min() - BIN, log_m.max() + 2 * BIN, BIN)
        count = np.convolve(np.histogram(log_m, edges)[0], np.ones(round(2 * half / BIN)), "same")
        center = edges[int(count.argmax())] + 0.5 * BIN
        near = np.abs(log_m - center) < half
        if near.sum() < CARD_CRUMB * left.size:
            break
        card = Plane("card", ahead, float(np.exp(np.median(log_m[near]))))
        found.append(card)
        left &= np.abs(card.off(view)) * DEPTH_SIGMA > half
    return found


def labeled(
    view: Look, open_to: Bool[np.ndarray, "height width"], planes: Sequence[Plane]
) -> Int[np.ndarray, "height width"]:
    """Number of the plane that each pixel shows, or one of the labels above.

    Costs of the planes are smoothed by a guided filter before the minimum is taken, so regions end at image edges.
    """
    costs = [_smooth(cost, open_to, view) for cost in (_floor_cost(view), *(_cost(plane, view) for plane in planes))]
    best = np.argmin(costs, axis=0) - 1
    label = np.where(open_to, best, np.where(view.floor, FLOOR, HIDDEN))
    least = [round((CARD_CRUMB if plane.kind == "card" else _CRUMB) * label.size) for plane in planes]
    return _without_crumbs(label, open_to, [*least, round(_CRUMB * label.size)])


def _cost(plane: Plane, view: Look) -> Float[np.ndarray, "height width"]:
    """0 where a plane explains depth, 1 where it does not."""
    if plane.kind == "backdrop":
        return np.where(view.unsure, 0.0, np.where(view.known, _WORST, _FAR_COST))
    reach = CARD_SIGMAS if plane.kind == "card" else INLIER_SIGMAS
    cost = _misfit(plane.off(view) / reach)
    if plane.kind == "card":
        cost = _CARD_COST + (1 - _CARD_COST) * cost
    return np.where(view.unsure, _WORST, np.where(view.known, cost, _UNKNOWN_COST))


def _misfit(deviations: np.ndarray) -> np.ndarray:
    """Geman-McClure cost (1987), 0 to 1, 0.5 at one deviation: it grows everywhere, so the closest plane wins."""
    square = np.minimum(np.abs(deviations), 1e3) ** 2
    return square / (1 + square)


def _floor_cost(view: Look) -> Float[np.ndarray, "height width"]:
    """0 where depth is that of the floor, also outside the floor's mask."""
    height_m = view.camera_m[1] + view.offset_m[..., 1]
    cost = _misfit(height_m / (LOW * view.eye_m))
    return np.where(view.known & ~view.unsure & (view.direction[..., 1] < 0), cost, _WORST)


def _smooth(cost: np.ndarray, open_to: np.ndarray, view: Look) -> Float[np.ndarray, "height width"]:
    radius = max(2, round(_SMOOTH_SHARE * max(view.shape)))
    guide, weight = view.rgb.astype(np.float32) / 255, open_to.astype(np.float32)
    total, share = (
        cv2.ximgproc.guidedFilter(guide, field.astype(np.float32), radius, _EDGE_EPSILON)
        for field in (cost * weight, weight)
    )
    return np.where(share > 0.05, total / np.maximum(share, 0.05), cost)


def _without_crumbs(label: np.ndarray, open_to: np.ndarray, least: list[int]) -> Int[np.ndarray, "height width"]:
    """Regions of fewer pixels than `least` (by label, floor last) given to the label that most of their border
    touches, or hidden among objects."""
    label = label.copy()
    for _ in range(3):
        changed = False
        for value in np.unique(label[open_to]):
            _, parts = cv2.connectedComponents(((label == value) & open_to).astype(np.uint8), connectivity=4)
            for index, where in enumerate(ndimage.find_objects(parts), 1):
                box = tuple(slice(max(0, s.start - 1), s.stop + 1) for s in where)
                part = parts[box] == index
                if part.sum() >= least[value]:
                    continue
                rim = ndimage.binary_dilation(part) & ~part
                around = label[box][rim]
                values, count = np.unique(around[around != HIDDEN], return_counts=True)
                label[box][part] = values[count.argmax()] if len(values) else HIDDEN
                changed = True
        if not changed:
            break
    return label
