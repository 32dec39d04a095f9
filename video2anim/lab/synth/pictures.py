"""Single labeled images of one composed room, each with its own camera, time, materials and lights.

A share of the images has random materials and lights (domain randomization, Tobin et al. 2017), and some rooms have no
ceiling or walls, so that a network does not rely on the usual look of rooms.
"""

from __future__ import annotations

import colorsys
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from video2anim.errors import InputError
from video2anim.lab.synth.cameras import look_rotation
from video2anim.lab.synth.compose import ComposeOptions, compose, draw_sensor
from video2anim.lab.synth.presets import ClipSpec
from video2anim.lab.synth.render import Sensor, tone
from video2anim.lab.synth.render.caster import RayCaster
from video2anim.lab.synth.render.moving import draw_moving
from video2anim.lab.synth.render.people import MovingSurfaces
from video2anim.lab.synth.render.renderer import MOVING_RAYS
from video2anim.lab.synth.render.surfaces import Surfaces, surfaces_of_objects
from video2anim.lab.synth.render.view import Eye, Lamps, room_components, trace_gbuffer
from video2anim.lab.synth.store import depth_code, normal_code
from video2anim.lab.synth.world import LABELS, PERSON_ID, Light, Material, Room, Shot
from video2anim.types import Intrinsics

_PAINTS = ("plain", "plaster", "wood", "planks", "tiles", "carpet", "fabric", "stripes", "checks", "leather", "metal",
           "brick", "picture", "paper")  # fmt: skip
_MOMENT_S = (2.0, 4.0)
"""Range of the length of the motion from which frames are drawn."""
_FOV_Y_RAD = (float(np.deg2rad(24)), float(np.deg2rad(100)))
_TRIES = 40
_ROOMS_TRIED = 4
_SKIN_STRIDE = 7
_COARSE = (12, 16)
"""Rows and columns of the rays by which a view is scored."""


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """A composed room, ready to be rendered from any camera pose."""

    shot: Shot
    surfaces: Surfaces
    caster: RayCaster
    opaque: RayCaster
    cast: MovingSurfaces
    names: np.ndarray
    """Class number for each object number."""


def room_pictures(spec: ClipSpec, options: ComposeOptions, count: int) -> Iterator[dict[str, np.ndarray]]:
    """Yields images of one room with their labels, as the arrays of a shard (see `video2anim.lab.synth.frames`).

    Raises:
        InputError: no room can be composed for the specification.
    """
    rng = spec.rng("pictures")
    quick = replace(options, skin_stride=_SKIN_STRIDE)
    shot = _composed(replace(spec, duration_s=_MOMENT_S, camera="static"), quick)
    room = _opened(shot.room, rng)
    surfaces = surfaces_of_objects(room.objects)
    names = np.zeros(int(surfaces.object_id.max()) + 1, np.uint8)
    for obj in room.objects:
        names[obj.object_id] = LABELS.index(obj.label)
    shot = replace(shot, room=room)
    scene = _Scene(shot, surfaces, surfaces.caster(), surfaces.caster(surfaces.opaque()), MovingSurfaces(shot), names)
    for number in range(count):
        yield _picture(scene, spec.rng(f"picture {number}"), spec, options)


def _composed(spec: ClipSpec, options: ComposeOptions) -> Shot:
    """A shot of the specification; if it has no suitable room, of the same one with another seed."""
    for again in range(1, _ROOMS_TRIED):
        try:
            return compose(spec, options)
        except InputError:
            spec = replace(spec, index=spec.index + again * 500_000)
    return compose(spec, options)


def _picture(scene: _Scene, rng: np.random.Generator, spec: ClipSpec, options: ComposeOptions) -> dict[str, np.ndarray]:
    shot = scene.shot
    people = scene.cast.surfaces(int(rng.integers(0, shot.frame_count)))
    if rng.random() < 0.15:
        people = MovingSurfaces(replace(shot, actors=(), moving=())).surfaces(0)
    lens, pose = _view(rng, scene, people, options)
    sensor = draw_sensor(rng, replace(spec, harsh=True), lens)
    wild = float(rng.choice([0.0, 0.25, 1.0], p=[0.4, 0.35, 0.25]))
    surfaces = replace(scene.surfaces, materials=repainted(scene.surfaces.materials, wild, rng))
    lamps = _lamps(shot.room, rng)
    eye = Eye(lens, pose, sensor.k1, sensor.k2)
    whole = slice(0, lens.height_px), slice(0, lens.width_px)
    gbuffer = trace_gbuffer(eye, surfaces, scene.caster, *whole)
    components = room_components(eye, surfaces, scene.caster, scene.opaque, lamps, gbuffer)
    radiance = components.radiance()
    depth, normal, instance = gbuffer.depth_m, gbuffer.normal, gbuffer.object_id
    if len(people.faces):
        layer = draw_moving(eye, gbuffer, components, radiance, people, scene.opaque, lamps)
        radiance, box = layer.radiance, (layer.gbuffer.rows, layer.gbuffer.columns)
        shown = np.isfinite(layer.gbuffer.depth_m)
        for whole_map, part in (
            (depth, layer.gbuffer.depth_m),
            (normal, layer.gbuffer.normal),
            (instance, layer.gbuffer.object_id),
        ):
            whole_map[box][shown] = part[shown]
    rgb = tone.encode(radiance * np.float32(tone.auto_exposure(radiance))).reshape(*depth.shape, 3)
    rgb = _with_sky(rgb, np.isinf(depth), rng)
    label = np.where(instance >= PERSON_ID, LABELS.index("person"), 0).astype(np.uint8)
    still = instance < len(scene.names)
    label[still] = scene.names[instance[still]]
    for carried in shot.moving:
        label[instance == carried.scene_object.object_id] = LABELS.index(carried.scene_object.label)
    R = pose[:3, :3].astype(np.float32)
    return {
        "rgb": Sensor(sensor, rng).apply(rgb, 0),
        "depth_mm": depth_code(np.where(np.isfinite(depth), depth, 0)),
        "normal_camera": normal_code((normal.reshape(-1, 3) @ R).reshape(normal.shape)),
        "instance": instance.astype(np.uint16),
        "label": label,
        "intrinsics": np.array([lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px]),
        "distortion": np.array([sensor.k1, sensor.k2]),
        "up_camera": pose[1, :3],
        "camera_height_m": pose[1, 3],
    }


def repainted(materials: tuple[Material, ...], share: float, rng: np.random.Generator) -> tuple[Material, ...]:
    """The same materials, a share of them with another pattern and other colors; emission is kept."""
    out = []
    for material in materials:
        if rng.random() >= share:
            out.append(material)
            continue
        first = _random_color(rng)
        second = (
            _random_color(rng)
            if rng.random() < 0.5
            else tuple(min(0.97, c * float(rng.uniform(0.6, 1.2))) for c in first)
        )
        keep = rng.random() < 0.3 or material.kind in ("leaf", "screen")
        out.append(
            replace(
                material, kind=material.kind if keep else str(rng.choice(_PAINTS)), rgb=first, rgb2=second,
                scale_m=float(np.exp(rng.uniform(np.log(0.02), np.log(0.8)))),
                gloss=float(rng.uniform(0, 0.6)) if rng.random() < 0.4 else 0.0,
                stain=float(rng.uniform(0, 0.8)), seed=int(rng.integers(2**31)),
            )
        )  # fmt: skip
    return tuple(out)


def _random_color(rng: np.random.Generator) -> tuple[float, float, float]:
    saturation = float(rng.beta(1.2, 3.0))
    r, g, b = colorsys.hsv_to_rgb(float(rng.random()), saturation, float(rng.uniform(0.08, 0.97)))
    return r, g, b


def _lamps(room: Room, rng: np.random.Generator) -> Lamps:
    """The room's own lights with other strengths, or other lights anywhere below the ceiling."""
    ambient = np.asarray(room.ambient_rgb) * np.exp(rng.normal(0, 0.5)) * np.exp(rng.normal(0, 0.08, 3))
    if rng.random() < 0.5:
        chosen = [light for light in room.lights if rng.random() < 0.8][:4]
        lights = [replace(light, rgb=_scaled(light.rgb, float(np.exp(rng.normal(0, 0.5))))) for light in chosen]
    else:
        x0, x1, z0, z1 = room.bounds_m
        lights = []
        for _ in range(int(rng.integers(1, 4))):
            place = (
                float(rng.uniform(x0, x1)),
                float(rng.uniform(0.55, 0.97)) * room.height_m,
                float(rng.uniform(z0, z1)),
            )
            power = np.exp(rng.normal(1.6, 0.6)) * np.exp(rng.normal(0, 0.15, 3))
            lights.append(
                Light(place, (float(power[0]), float(power[1]), float(power[2])), float(rng.uniform(0.03, 0.5)))
            )
    return Lamps(tuple(lights), (float(ambient[0]), float(ambient[1]), float(ambient[2])), MOVING_RAYS)


def _scaled(rgb: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    return rgb[0] * factor, rgb[1] * factor, rgb[2] * factor


def _opened(room: Room, rng: np.random.Generator) -> Room:
    """The room, sometimes without its ceiling, rarely without most of its walls."""
    draw = rng.random()
    if draw > 0.18:
        return room
    dropped = {"ceiling"} if draw > 0.08 else {"ceiling", "picture", "window", "door", "skirting"}
    kept = []
    for obj in room.structure:
        gone = obj.label in dropped or (draw < 0.08 and obj.label == "wall" and rng.random() < 0.7)
        if not gone:
            kept.append(obj)
    return replace(room, structure=tuple(kept))


def _with_sky(rgb: np.ndarray, empty: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The image with a sky (vertical gradient and soft clouds) where no ray hit anything."""
    if not empty.any():
        return rgb
    import cv2

    height, width = empty.shape
    top, low = (np.asarray(_random_color(rng)) * 0.5 + np.array([0.25, 0.3, 0.4]) for _ in range(2))
    share = np.linspace(0, 1, height)[:, None, None]
    clouds = cv2.resize(rng.random((4, 6)).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    sky = (1 - share) * top + share * low + 0.15 * (clouds[..., None] - 0.5)
    return np.where(empty[..., None], np.clip(255 * sky, 0, 255).astype(np.uint8), rgb)


def _view(
    rng: np.random.Generator, scene: _Scene, people: Surfaces, options: ComposeOptions
) -> tuple[Intrinsics, Float[np.ndarray, "4 4"]]:
    """A camera in the room with a varied view and nothing right in front of it: the best of up to 40 draws."""
    figures = people.caster() if len(people.faces) else None
    best: tuple[float, Intrinsics, np.ndarray] | None = None
    for _ in range(_TRIES):
        lens, pose = _draw_camera(rng, scene, people, options)
        score = _view_score(lens, pose, scene, figures)
        if best is None or score > best[0]:
            best = (score, lens, pose)
        if score >= 1:
            break
    assert best is not None
    return best[1], best[2]


def _draw_camera(
    rng: np.random.Generator, scene: _Scene, people: Surfaces, options: ComposeOptions
) -> tuple[Intrinsics, Float[np.ndarray, "4 4"]]:
    room = scene.shot.room
    fov_y = float(np.clip(np.exp(rng.normal(np.log(np.deg2rad(52)), 0.38)), *_FOV_Y_RAD))
    x0, x1, z0, z1 = room.bounds_m
    low, high = ((0.9, 2.0), (0.25, 1.0), (1.8, 3.2))[int(rng.choice(3, p=[0.6, 0.18, 0.22]))]
    height = min(float(rng.uniform(low, high)), room.height_m - 0.12)
    at = np.array([rng.uniform(x0 + 0.15, x1 - 0.15), height, rng.uniform(z0 + 0.15, z1 - 0.15)])
    if len(people.faces) and rng.random() < 0.55:
        goal = people.vertices_m[int(rng.integers(len(people.vertices_m)))].astype(float)
    else:
        goal = np.array([rng.uniform(x0, x1), rng.uniform(0.1, 1.9), rng.uniform(z0, z1)])
    way = goal - at
    pitch = float(np.arctan2(way[1], np.hypot(way[0], way[2])) + rng.normal(0, np.deg2rad(9)))
    if rng.random() < 0.25:
        pitch = float(rng.normal(0, np.deg2rad(4)))
    roll = float(rng.normal(0, np.deg2rad(2.5 if rng.random() < 0.75 else 10)))
    pose = np.eye(4)
    pose[:3, :3] = look_rotation(
        float(np.arctan2(way[0], way[2]) + rng.normal(0, 0.2)), float(np.clip(pitch, -1.2, 0.7)), roll
    )
    pose[:3, 3] = at
    focal = 0.5 * options.height_px / np.tan(0.5 * fov_y)
    return Intrinsics.centered(float(focal), options.width_px, options.height_px), pose


def _view_score(lens: Intrinsics, pose: np.ndarray, scene: _Scene, figures: RayCaster | None) -> float:
    """Score of a view: 1 if it has depth and several objects, else less."""
    rows, columns = _COARSE
    y, x = np.meshgrid(
        (np.arange(rows) + 0.5) * lens.height_px / rows,
        (np.arange(columns) + 0.5) * lens.width_px / columns,
        indexing="ij",
    )
    pixel = (y.astype(int) * lens.width_px + x.astype(int)).reshape(-1)
    directions = Eye(lens, pose).directions(pixel)
    origins = np.broadcast_to(pose[:3, 3].astype(np.float32), directions.shape)
    hits = scene.caster.first_hits(origins, directions)
    depth = hits.distance
    if figures is not None:
        depth = np.minimum(depth, figures.first_hits(origins, directions).distance)
    seen = len(np.unique(scene.surfaces.object_id[hits.face[hits.face >= 0]]))
    if np.isinf(depth).mean() > 0.6:
        return 0.0
    near, center = np.percentile(np.where(np.isfinite(depth), depth, 50), [4, 50])
    return min(near / 0.45, 1.0) * min(center / 1.1, 1.0) * min(seen / 4, 1.0)
