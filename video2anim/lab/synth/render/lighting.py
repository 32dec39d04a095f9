"""Visibility of lights from surface points (soft shadows, ambient occlusion) and the radiance that surfaces reflect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from video2anim.export.frames import linear_light
from video2anim.lab.synth.render import sampling
from video2anim.lab.synth.render.caster import RayCaster
from video2anim.lab.synth.render.surfaces import Points
from video2anim.lab.synth.render.texture import albedo
from video2anim.lab.synth.render.vectors import dot, length, unit
from video2anim.lab.synth.world import Light, Material

_LIFT_M = 0.003
"""Shadow rays start this far off the surface."""
_SMOOTH_LIFT_M = 0.007
"""The same where shading normal and face normal differ, so that the shadow's edge does not show the triangles."""
_SUN_REACH_M = 100.0
_SUN_RADIUS = 0.012
"""Angular radius of the sun with its glare, radians."""
AMBIENT_REACH_M = 1.3
"""Objects farther away than this do not occlude ambient light."""
_SMALL_SHARE = 0.03
"""No shadow rays for lights that give a point less than this share of its direct light."""
_UP_SHARE = 0.22
"""Ambient light is larger by this share from above than from the side, and smaller by it from below."""


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """Share of the light that reaches points."""

    lamp: Float[np.ndarray, "points lights"]
    """Visible share of each light."""
    ambient: Float[np.ndarray, "points"]
    """Unoccluded share of the hemisphere."""

    def stacked(self) -> Float[np.ndarray, "points lights+1"]:
        return np.concatenate([self.lamp, self.ambient[:, None]], 1)


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """Radiance that points reflect or emit towards the viewer if nothing occludes the light."""

    lamp: Float[np.ndarray, "points lights 3"]
    ambient: Float[np.ndarray, "points 3"]
    glow: Float[np.ndarray, "points 3"]

    def split(self, count: int) -> tuple[Response, Response]:
        """The first `count` points, and the others."""
        first, second = slice(None, count), slice(count, None)
        return (
            Response(self.lamp[first], self.ambient[first], self.glow[first]),
            Response(self.lamp[second], self.ambient[second], self.glow[second]),
        )

    def lit(self, reach: Float[np.ndarray, "points lights+1"]) -> Float[np.ndarray, "points 3"]:
        """Radiance with the visible share of each light (the last channel is the ambient light)."""
        total = self.glow + self.ambient * reach[:, -1:]
        for number in range(self.lamp.shape[1]):
            total += self.lamp[:, number] * reach[:, number, None]
        return total


def lifted(
    position_m: Float[np.ndarray, "points 3"],
    normal: Float[np.ndarray, "points 3"],
    face_normal: Float[np.ndarray, "points 3"],
) -> Float[np.ndarray, "points 3"]:
    """Origins of shadow rays: points lifted off the surface, meters."""
    curved = dot(normal, face_normal) < 0.9999
    return position_m + normal * np.where(curved, np.float32(_SMOOTH_LIFT_M), np.float32(_LIFT_M))[:, None]


def light_visibility(
    start_m: Float[np.ndarray, "points 3"],
    normal: Float[np.ndarray, "points 3"],
    light: Light,
    tile: Int[np.ndarray, "points"],
    casters: Sequence[RayCaster],
    samples: int,
) -> Float[np.ndarray, "points"]:
    """Visible share of a light from points. It is 1 for points that face away from the light, which get none anyway."""
    toward, radius = _toward(start_m, light)
    facing = np.flatnonzero(dot(toward, normal) > 0)
    start, toward, tile = start_m[facing], toward[facing], tile[facing]
    first, second = sampling.frame_about(unit(toward))
    spots = sampling.disc(sampling.sample_points(samples)) * np.float32(radius)
    seen = np.zeros(len(facing), np.float32)
    for sample in range(samples):
        spot = spots[tile, sample]
        ray = toward + first * spot[:, :1] + second * spot[:, 1:]
        seen += _open(start, ray, 0.999, casters)
    out = np.ones(len(start_m), np.float32)
    out[facing] = seen / samples
    return out


def _arriving(start_m: np.ndarray, normal: np.ndarray, light: Light) -> np.ndarray:
    """Irradiance by an unoccluded light, summed over colors."""
    toward, _ = _toward(start_m, light)
    far2 = np.maximum(dot(toward, toward), 0.04)
    fall = np.maximum(dot(toward, normal), 0) / np.sqrt(far2)
    return fall * np.float32(sum(light.rgb)) / (1 if light.direction is not None else far2)


def _toward(start_m: np.ndarray, light: Light) -> tuple[np.ndarray, float]:
    """Vectors from points to the center of a light, and the light's radius there (meters)."""
    if light.direction is None:
        return np.asarray(light.position_m, np.float32) - start_m, light.radius_m
    back = -np.asarray(light.direction, np.float32) * np.float32(_SUN_REACH_M)
    return np.broadcast_to(back, start_m.shape), _SUN_RADIUS * _SUN_REACH_M


def _open(start: np.ndarray, ray: np.ndarray, reach: float | np.ndarray, casters: Sequence[RayCaster]) -> np.ndarray:
    """1 for rays that hit nothing, else 0."""
    blocked = np.zeros(len(start), bool)
    for caster in casters:
        blocked |= caster.blocked(start, ray, reach)
    return (~blocked).astype(np.float32)


def ambient_visibility(
    start_m: Float[np.ndarray, "points 3"],
    normal: Float[np.ndarray, "points 3"],
    tile: Int[np.ndarray, "points"],
    casters: Sequence[RayCaster],
    samples: int,
) -> Float[np.ndarray, "points"]:
    """Unoccluded share of the hemisphere. Rays have varied lengths, so that near objects count more than far ones."""
    first, second = sampling.frame_about(normal)
    cube = sampling.sample_points(samples)
    lobes, lengths = sampling.cosine_lobe(cube), AMBIENT_REACH_M * (0.06 + 0.94 * cube[..., 2] ** 2.2)
    open_ = np.zeros(len(start_m), np.float32)
    for sample in range(samples):
        lobe = lobes[tile, sample]
        ray = first * lobe[:, :1] + second * lobe[:, 1:2] + normal * lobe[:, 2:]
        open_ += _open(start_m, ray, lengths[tile, sample], casters)
    return open_ / samples


def visibility_of(
    points: Points, tile: np.ndarray, lights: Sequence[Light], casters: Sequence[RayCaster], rays: tuple[int, int]
) -> Visibility:
    """Visibility of all lights and of the ambient light; `rays` = rays per light, rays for the hemisphere."""
    start = lifted(points.position_m, points.normal, points.face_normal)
    arriving = [_arriving(start, points.normal, light) for light in lights]
    enough = _SMALL_SHARE * sum(arriving, np.zeros(len(points), np.float32))
    lamp = np.ones((len(points), len(lights)), np.float32)
    for number, light in enumerate(lights):
        at = np.flatnonzero(arriving[number] > enough)
        lamp[at, number] = light_visibility(start[at], points.normal[at], light, tile[at], casters, rays[0])
    return Visibility(lamp, ambient_visibility(start, points.normal, tile, casters, rays[1]))


def response_of(
    points: Points, materials: tuple[Material, ...], lights: Sequence[Light], ambient_rgb: Sequence[float]
) -> Response:
    """Radiance of points without occlusion: diffuse reflection, highlights of glossy materials, emission."""
    diffuse = albedo(points, materials)
    gloss = np.array([*(m.gloss for m in materials), 0.0], np.float32)[points.material]
    lamp = np.zeros((len(points), len(lights), 3), np.float32)
    for number, light in enumerate(lights):
        lamp[:, number] = _from_light(points, diffuse, gloss, light)
    up = 1 + _UP_SHARE * points.normal[:, 1:2]
    ambient = diffuse * (up * np.asarray(ambient_rgb, np.float32)) / np.float32(np.pi)
    glow = np.zeros_like(diffuse)
    emission = np.array([*(m.emission for m in materials), 0.0], np.float32)[points.material]
    shining = np.flatnonzero(emission > 0)
    if len(shining):
        color = np.array([linear_light(np.asarray(m.rgb)) for m in materials], np.float32)[points.material[shining]]
        screen = np.array([m.kind == "screen" for m in materials])[points.material[shining], None]
        glow[shining] = np.where(screen, diffuse[shining], color) * emission[shining, None]
    return Response(lamp, ambient, glow)


def _from_light(points: Points, diffuse: np.ndarray, gloss: np.ndarray, light: Light) -> np.ndarray:
    toward, _ = _toward(points.position_m, light)
    distance = length(toward)[:, None]
    direction = toward / np.maximum(distance, 1e-6)
    cosine = np.maximum(dot(points.normal, direction), 0)[:, None]
    power = np.asarray(light.rgb, np.float32)
    fall = cosine if light.direction is not None else cosine / np.maximum(distance * distance, 0.04)
    out = diffuse * (fall / np.float32(np.pi)) * power
    shiny = np.flatnonzero(gloss > 0)
    if len(shiny):
        half = unit(direction[shiny] + points.view[shiny])
        sharp = 8 + 160 * gloss[shiny, None]
        lobe = np.maximum(dot(points.normal[shiny], half), 0)[:, None] ** sharp * (sharp + 8) / (8 * np.pi)
        out[shiny] += 0.08 * gloss[shiny, None] * lobe * fall[shiny] * power
    return out
