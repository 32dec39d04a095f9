"""Renders moving objects over a finished room: their own pixels, and their shadows on the room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from video2anim.lab.synth.render import sampling
from video2anim.lab.synth.render.caster import RayCaster
from video2anim.lab.synth.render.denoise import smooth_tiles
from video2anim.lab.synth.render.lens import project_distorted
from video2anim.lab.synth.render.lighting import (
    AMBIENT_REACH_M,
    ambient_visibility,
    lifted,
    light_visibility,
    response_of,
    visibility_of,
)
from video2anim.lab.synth.render.surfaces import Surfaces
from video2anim.lab.synth.render.view import (
    SUBPIXELS,
    Components,
    Eye,
    GBuffer,
    Lamps,
    borrowed_visibility,
    gbuffer_visibility,
    rectangle_pixels,
    subpixel_points,
    trace_gbuffer,
)
from video2anim.lab.synth.world import NEAR_M, Light

_COARSE = 4
"""Shadow regions are found on every fourth pixel per axis."""
_STRIDE = 2
"""Shadows are sampled on every second pixel per axis, and on every pixel near their borders."""


@dataclass(frozen=True, slots=True, eq=False)
class MovingLayer:
    """Moving objects over a room."""

    gbuffer: GBuffer
    """The rectangle around them; it shows only pixels where they are in front of the room."""
    radiance: Float[np.ndarray, "pixels 3"]
    """Radiance of the whole picture, before exposure."""


def draw_moving(
    eye: Eye,
    room: GBuffer,
    components: Components,
    radiance: np.ndarray,
    surfaces: Surfaces,
    room_opaque: RayCaster,
    lamps: Lamps,
    blurred: Sequence[Surfaces] = (),
) -> MovingLayer:
    """Render moving surfaces over the room.

    Args:
        eye: The camera.
        room: G-buffer of the room.
        components: Light components of the room.
        radiance: Finished radiance of the room, (pixels, 3).
        surfaces: The moving surfaces at the frame's time; labels and shadows on the room are theirs.
        room_opaque: Ray caster of the room's faces that cast shadows.
        lamps: Lights of the room.
        blurred: The moving surfaces at times within the shutter time, of which one may be `surfaces`; colors are the
            mean of their renderings.
    """
    caster = surfaces.caster()
    rows, columns = rectangle_of(surfaces, eye)
    gbuffer = trace_gbuffer(eye, surfaces, caster, rows, columns, nearer_than=room.depth_m[rows, columns])
    wanted = np.ones(room.shape, bool)
    if not blurred:
        wanted[rows, columns] = cv2.erode(np.isfinite(gbuffer.depth_m).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
    empty = shadowed_room(room, components, radiance, surfaces, caster, lamps, wanted)
    if not blurred:
        if len(gbuffer.seen):
            _draw_over(empty, eye, room, gbuffer, surfaces, caster, room_opaque, lamps)
        return MovingLayer(gbuffer, empty)
    total = np.zeros_like(empty)
    for moment in blurred:
        there, part, out = caster, gbuffer, empty.copy()
        if moment is not surfaces:
            box = rectangle_of(moment, eye)
            there = moment.caster()
            part = trace_gbuffer(eye, moment, there, *box, nearer_than=room.depth_m[box])
        if len(part.seen):
            _draw_over(out, eye, room, part, moment, there, room_opaque, lamps)
        total += out
    return MovingLayer(gbuffer, total / len(blurred))


def rectangle_of(surfaces: Surfaces, eye: Eye) -> tuple[slice, slice]:
    """Rows and columns that can show the surfaces; the whole picture if they come close to the camera."""
    height, width = eye.intrinsics.height_px, eye.intrinsics.width_px
    R, origin = eye.T_world_camera[:3, :3], eye.T_world_camera[:3, 3]
    camera = (surfaces.vertices_m - origin) @ R
    if (camera[:, 2] < NEAR_M).any():
        return slice(0, height), slice(0, width)
    pixels = project_distorted(camera, eye.intrinsics, eye.k1, eye.k2)
    low = np.clip(np.floor(pixels.min(0)).astype(int) - 2, 0, [width - 1, height - 1])
    high = np.clip(np.ceil(pixels.max(0)).astype(int) + 3, low + 1, [width, height])
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def shadowed_room(
    room: GBuffer,
    components: Components,
    radiance: np.ndarray,
    surfaces: Surfaces,
    caster: RayCaster,
    lamps: Lamps,
    wanted: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "pixels 3"]:
    """Radiance of the room with shadows and ambient occlusion by moving objects."""
    low, high = surfaces.vertices_m.min(0), surfaces.vertices_m.max(0)
    lit = _ShadowedVisibility(room, caster, lamps)
    channels = len(lamps.lights) + 1
    reach = np.ones((channels, *room.shape), np.float32)
    for channel in range(channels):
        if channel < len(lamps.lights):
            region = _shadow_region(room, lamps.lights[channel], low, high)
            region &= components.matters[channel].reshape(room.shape)
        else:
            region = _ambient_region(room, low, high)
        lit.fill(reach[channel], region & wanted, channel)
    out = radiance.copy()
    shadowed = np.asarray((reach < 1).any(0), np.uint8)
    touched = cv2.dilate(shadowed, np.ones((5, 5), np.uint8)) > 0
    if not touched.any():
        return out
    box = _bounds(touched)
    smooth = smooth_tiles(np.moveaxis(reach[:, *box], 0, -1), room.links.cropped(*box))
    changed = touched[box]
    pixel = rectangle_pixels(*box, room.shape[1]).reshape(changed.shape)[changed]
    out[pixel] = components.shaded(pixel, smooth[changed])
    return out


class _ShadowedVisibility:
    """Visibility of the lights from the room's pixels past moving objects, by channel (lights, then ambient)."""

    def __init__(self, room: GBuffer, caster: RayCaster, lamps: Lamps) -> None:
        self._room, self._caster, self._lamps = room, caster, lamps
        self._row_of = np.full(room.shape[0] * room.shape[1], -1)
        self._row_of[room.seen] = np.arange(len(room.seen))

    def fill(self, reach: Float[np.ndarray, "height width"], region: np.ndarray, channel: int) -> None:
        """Write the visibility in a region: every second pixel first, then the pixels around which those differ."""
        coarse = np.zeros_like(region)
        coarse[::_STRIDE, ::_STRIDE] = region[::_STRIDE, ::_STRIDE]
        self._sample(reach, coarse, channel)
        seen = reach[::_STRIDE, ::_STRIDE]
        around = np.ones((3, 3), np.uint8)
        least, most = cv2.erode(seen, around), cv2.dilate(seen, around)
        same = np.where(least == most, least, np.float32(-1))
        fine = np.repeat(np.repeat(same, _STRIDE, 0), _STRIDE, 1)[: region.shape[0], : region.shape[1]]
        np.copyto(reach, fine, where=region & (fine >= 0))
        self._sample(reach, region & (fine < 0) & ~coarse, channel)

    def _sample(self, reach: np.ndarray, chosen: np.ndarray, channel: int) -> None:
        pixel = np.flatnonzero(chosen.reshape(-1) & (self._row_of >= 0))
        if not len(pixel):
            return
        rows, points, lamps = self._row_of[pixel], self._room.points, self._lamps
        normal, tile = points.normal[rows], sampling.tile_of(pixel, self._room.shape[1])
        start = lifted(points.position_m[rows], normal, points.face_normal[rows])
        if channel < len(lamps.lights):
            light = lamps.lights[channel]
            found = light_visibility(start, normal, light, tile, [self._caster], lamps.rays[0])
        else:
            found = ambient_visibility(start, normal, tile, [self._caster], lamps.rays[1])
        reach.reshape(-1)[pixel] = found


def _shadow_region(room: GBuffer, light: Light, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Pixels whose rays to a light can pass through a box: slab test on a coarse grid, dilated by a cell."""
    at = room.position_m[::_COARSE, ::_COARSE]
    margin = 0.05 + (0.02 if light.direction is not None else light.radius_m)
    if light.direction is None:
        toward = np.asarray(light.position_m, np.float32) - at
    else:
        toward = np.broadcast_to(-20 * np.asarray(light.direction, np.float32), at.shape)
    step = np.where(np.abs(toward) < 1e-6, np.float32(1e-6), toward)
    first, second = (low - margin - at) / step, (high + margin - at) / step
    enter = np.minimum(first, second).max(-1)
    leave = np.maximum(first, second).min(-1)
    return _widened((enter <= leave) & (leave > 0) & (enter < 1), room.shape)


def _ambient_region(room: GBuffer, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Pixels near enough to a box for ambient occlusion."""
    at = room.position_m[::_COARSE, ::_COARSE]
    off = np.maximum(np.maximum(low - at, at - high), 0)
    return _widened((off * off).sum(-1) < (0.6 * AMBIENT_REACH_M) ** 2, room.shape)


def _widened(coarse: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    wide = cv2.dilate(coarse.astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.repeat(np.repeat(wide, _COARSE, 0), _COARSE, 1)[: shape[0], : shape[1]] > 0


def _bounds(mask: np.ndarray) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _draw_over(
    out: np.ndarray,
    eye: Eye,
    room: GBuffer,
    gbuffer: GBuffer,
    surfaces: Surfaces,
    caster: RayCaster,
    room_opaque: RayCaster,
    lamps: Lamps,
) -> None:
    """Add the radiance of moving objects to `out`; edges are blended with the room by pixel coverage."""
    width = room.shape[1]
    casters = [room_opaque, caster]
    reach = gbuffer_visibility(gbuffer, lamps, casters, width)
    response = response_of(gbuffer.points, surfaces.materials, lamps.lights, lamps.ambient_rgb)
    color = response.lit(reach.reshape(-1, reach.shape[-1])[gbuffer.seen])
    pixel = rectangle_pixels(gbuffer.rows, gbuffer.columns, width)
    behind = out[pixel]
    out[pixel[gbuffer.seen]] = color
    shown = cv2.dilate(np.isfinite(gbuffer.depth_m).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    edge = np.flatnonzero(gbuffer.links.edges() & shown)
    if not len(edge):
        return
    depth = room.depth_m[gbuffer.rows, gbuffer.columns].reshape(-1)[edge]
    points, ray = subpixel_points(eye, surfaces, caster, pixel[edge], depth)
    borrowed, found = borrowed_visibility(points, edge[ray % len(edge)], gbuffer, reach)
    lost = np.flatnonzero(~found)
    if len(lost):
        tile = sampling.tile_of(pixel[edge[ray[lost] % len(edge)]], width)
        borrowed[lost] = visibility_of(points.chosen(lost), tile, lamps.lights, casters, lamps.rays).stacked()
    mixed = np.tile(behind[edge], (len(SUBPIXELS), 1))
    mixed[ray] = response_of(points, surfaces.materials, lamps.lights, lamps.ambient_rgb).lit(borrowed)
    out[pixel[edge]] = mixed.reshape(len(SUBPIXELS), -1, 3).mean(0)
