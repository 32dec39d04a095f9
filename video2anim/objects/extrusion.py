"""The outline of an object as a form: a polygon with a thickness, whose corners are among its sizes."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.projection import invert_rigid
from video2anim.objects.evidence import SeenObject
from video2anim.objects.form_fit import FitSigmas
from video2anim.objects.furniture import Form, Size, Sizes, place
from video2anim.objects.shapes import Prism, triangulated
from video2anim.objects.solids import Solids
from video2anim.objects.upright_box import UprightBox

OUTLINE = "outline"
"""Name of the form."""
_CORNERS = 12
"""More cost more than they explain: each counts as two sizes."""
_POLYGONS = 2.3
"""So many times more simple polygons go through each more of random points: 1, 1.7, 3.9, 8.3, 21 and 86 for 3 to 8
(counted for 40 draws each, of 8 points 6)."""


def outline_form(
    seen: SeenObject, box: UprightBox, base_m: float, sigmas: FitSigmas
) -> tuple[Form, Float[np.ndarray, "values"]] | None:
    """The completed outline, laid onto the front of the box of the depth points, with the values it has there; None
    where it has no area.

    A wall of the box's yaw: perspective is removed there. Corners that the noise of the outline explains are left out.
    """
    k, T_camera_world = seen.evidence.intrinsics, seen.evidence.T_camera_world
    away_m = float(np.median((seen.points_m @ T_camera_world[:3, :3].T + T_camera_world[:3, 3])[:, 2]))
    noise_px = np.hypot(sigmas.outline_px, sigmas.form_m * k.fx_px / away_m)
    corners_px = _polygon(seen.outline, float(noise_px))
    if corners_px is None:
        return None
    local = np.stack([*((corners_px - [k.cx_px, k.cy_px]) / [k.fx_px, k.fy_px]).T, np.ones(len(corners_px))], -1)
    ray = local @ invert_rigid(T_camera_world)[:3, :3].T @ box.R_world_box
    eye_m = seen.evidence.camera_m @ box.R_world_box
    along = (box.high_m[2] - eye_m[2]) / ray[:, 2]
    if (along <= 0).any():
        return None
    flat_m = (eye_m + along[:, None] * ray)[:, :2]
    flat_m[:, 1] = np.maximum(flat_m[:, 1], base_m)
    low_m, high_m = flat_m.min(0), flat_m.max(0)
    width_m, height_m = high_m[0] - low_m[0], high_m[1] - base_m
    depth_m = max(float(box.size_m[2]), sigmas.form_m)
    corners = 2 * (flat_m - low_m) / np.maximum(high_m - low_m, sigmas.form_m) - 1
    form = extruded(corners)
    if form is None:
        return None
    x, _, z = box.R_world_box @ [0.5 * (low_m + high_m)[0], 0.0, box.high_m[2] - 0.5 * depth_m]
    yaw = float(np.arctan2(box.R_world_box[0, 2], box.R_world_box[2, 2]))
    relief = seen.evidence.depth_errors.relief
    start = [x, z, yaw, base_m, 0.0, relief - 1, *np.log([width_m, depth_m, height_m]), *np.zeros(corners.size)]
    return form, np.array(start)


def extruded(corners: Float[np.ndarray, "corners 2"]) -> Form | None:
    """A polygon that fills the square from -1 to 1, counter-clockwise, with a thickness. Its corners can move.

    None where all corners are on one line, as where the outline is below what the object rests on.
    """
    triangles = triangulated(corners)
    if not len(triangles):
        return None

    def build(s: Sizes) -> tuple[tuple[str, ...], Solids]:
        w, d, h = s[:, :3].T
        moved = corners + np.log(s[:, 3:]).reshape(len(s), -1, 2)
        low, high = moved.min(1, keepdims=True), moved.max(1, keepdims=True)
        filling = 2 * (moved - low) / np.maximum(high - low, 1e-3) - 1
        half = 0.5 * np.stack([w, h, d], -1)[:, None]
        center = half * [0.0, 1.0, 0.0]
        return ("body",), Solids(center, half, np.zeros((len(s), 1)), (Prism(filling, triangles),))

    sides = (Size("width", 0.6, 0.8), Size("depth", 0.6, 0.8), Size("height", 0.6, 0.8))
    places = tuple(place(f"corner {k} {axis}") for k in range(len(corners)) for axis in "xy")
    # Corners have no order: a polygon is found once for each that they could have.
    orders = math.factorial(len(corners)) / _POLYGONS ** (len(corners) - 3)
    return Form(OUTLINE, sides + places, build, turns=1, stands=False, share=orders)


def _polygon(mask: Bool[np.ndarray, "height width"], noise_px: float) -> Float[np.ndarray, "corners 2"] | None:
    """The largest piece's outline with the fewest corners that its noise allows, counter-clockwise with y upwards."""
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not found:
        return None
    contour = max(found, key=cv2.contourArea)
    corners = cv2.approxPolyDP(contour, 2 * noise_px, closed=True)[:, 0]
    while len(corners) > _CORNERS:
        noise_px *= 1.2
        corners = cv2.approxPolyDP(contour, 2 * noise_px, closed=True)[:, 0]
    if len(corners) < 3:
        return None
    turn = cv2.contourArea(corners.astype(np.float32), oriented=True)
    return (corners if turn < 0 else corners[::-1]).astype(np.float64)
