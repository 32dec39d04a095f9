"""The renderer: renders a shot frame by frame on the CPU.

With a static camera the room is traced and lit once; each frame then traces only the moving objects inside their
rectangle, and their shadows on the room. With a moving camera every frame is traced and lit completely.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from video2anim.errors import UsageError
from video2anim.lab.synth.render import tone
from video2anim.lab.synth.render.blur import camera_blur, shutter_shifts, steps_for
from video2anim.lab.synth.render.caster import RayCaster
from video2anim.lab.synth.render.moving import MovingLayer, draw_moving
from video2anim.lab.synth.render.people import MovingSurfaces
from video2anim.lab.synth.render.picture import Picture
from video2anim.lab.synth.render.surfaces import Surfaces, surfaces_of_object, surfaces_of_objects
from video2anim.lab.synth.render.view import Components, Eye, GBuffer, Lamps, room_components, trace_gbuffer
from video2anim.lab.synth.world import PERSON_ID, Shot
from video2anim.types.clip import FPS

STILL_RAYS = (8, 12)
"""Rays per pixel for each light and for the hemisphere, for a room that is lit once for the clip."""
MOVING_RAYS = (2, 4)
"""The same for every frame of a moving camera, and for moving objects."""


@dataclass(frozen=True, slots=True, eq=False)
class RoomView:
    """The finished rendering of the room from one camera pose."""

    eye: Eye
    gbuffer: GBuffer
    components: Components
    radiance: np.ndarray
    """(pixels, 3) before exposure."""


class Renderer:
    """Renders one shot. Frames may be rendered in any order; the same shot gives the same bytes."""

    def __init__(self, shot: Shot) -> None:
        self._shot = shot
        self._room = surfaces_of_objects(shot.room.objects)
        self._caster = self._room.caster()
        self._opaque = self._room.caster(self._room.opaque())
        self._cast = MovingSurfaces(shot)
        self._still = Lamps(shot.room.lights, shot.room.ambient_rgb, STILL_RAYS)
        self._quick = replace(self._still, rays=MOVING_RAYS)
        self._kept: tuple[int, RoomView] | None = None
        self._exposure: float | None = None
        self._alone: dict[int, RayCaster] = {}

    @property
    def exposure(self) -> float:
        """Factor from radiance to exposed light, from the room in the first frame."""
        if self._exposure is None:
            self._exposure = tone.auto_exposure(self._view(0).radiance)
        return self._exposure

    def background(self, t: int = 0) -> Picture:
        """The room without people and carried objects, from the camera of frame t."""
        view = self._view(t)
        return self._picture(view, self._rgb(view.radiance), None)

    def frame(self, t: int) -> Picture:
        """Frame t of the clip."""
        view = self._view(self._expect_frame(t))
        surfaces = self._cast.surfaces(t)
        if not len(surfaces.faces):
            return self._picture(view, self._rgb(self._camera_blurred(view, None, t)), None)
        moments = self._moments(view.eye, surfaces, t)
        layer = draw_moving(
            view.eye, view.gbuffer, view.components, view.radiance, surfaces, self._opaque, self._quick, moments
        )
        return self._picture(view, self._rgb(self._camera_blurred(view, layer, t)), layer)

    def _moments(self, eye: Eye, surfaces: Surfaces, t: int) -> list[Surfaces]:
        """The moving surfaces at times within the shutter time; empty if their blur would not be visible."""
        shutter = self._shot.sensor.blur_s * FPS
        if shutter <= 0:
            return []
        first, last = (self._cast.vertices_m(t, share * shutter) for share in (-0.5, 0.5))
        near = np.maximum((surfaces.vertices_m - eye.origin_m) @ eye.T_world_camera[:3, 2], 0.1)
        step = np.abs(last - first).max(1) / (near * eye.pixel_angle)
        steps = steps_for(float(step.max()))
        if steps == 1:
            return []
        shifts = shutter_shifts(shutter, steps)
        return [self._cast.surfaces(t, shift) if shift else surfaces for shift in shifts]

    def _camera_blurred(self, view: RoomView, layer: MovingLayer | None, t: int) -> np.ndarray:
        """(pixels, 3) radiance of a finished frame, blurred by the camera's own motion."""
        radiance = view.radiance if layer is None else layer.radiance
        shutter = self._shot.sensor.blur_s * FPS
        if shutter <= 0 or self._shot.is_static:
            return radiance
        position = view.gbuffer.position_m
        if layer is not None:
            position, shown = position.copy(), np.isfinite(layer.gbuffer.depth_m)
            position[layer.gbuffer.rows, layer.gbuffer.columns][shown] = layer.gbuffer.position_m[shown]
        before, after = max(t - 1, 0), min(t + 1, self._shot.frame_count - 1)
        image = radiance.reshape(*view.gbuffer.shape, 3)
        blurred = camera_blur(image, position, self._eye(before), self._eye(after), after - before, shutter)
        return blurred.reshape(-1, 3)

    def amodal(self, object_id: int, t: int = 0) -> Bool[np.ndarray, "height width"]:
        """Amodal mask of an object or person (`PERSON_ID` + person_id): its pixels if nothing occluded it.

        Raises:
            UsageError: the shot has no object or person with this number.
        """
        eye = self._eye(self._expect_frame(t))
        caster = self._alone.get(object_id)
        if caster is None:
            surfaces, is_still = self._surfaces_of(object_id, t)
            caster = surfaces.caster()
            if is_still:
                self._alone[object_id] = caster
        height, width = eye.intrinsics.height_px, eye.intrinsics.width_px
        directions = eye.directions(np.arange(height * width))
        hits = caster.first_hits(np.broadcast_to(eye.origin_m, directions.shape), directions)
        return (hits.face >= 0).reshape(height, width)

    def _surfaces_of(self, object_id: int, t: int) -> tuple[Surfaces, bool]:
        for obj in self._shot.room.objects:
            if obj.object_id == object_id:
                return surfaces_of_object(obj), True
        for number, actor in enumerate(self._shot.actors):
            if PERSON_ID + actor.motion.person_id == object_id:
                return self._cast.actor_surfaces(number, t), False
        for moving in self._shot.moving:
            if moving.scene_object.object_id == object_id:
                return surfaces_of_object(moving.scene_object, moving.T_world_object[t]), False
        raise UsageError(f"shot {self._shot.name!r}: no object {object_id} in it")

    def _expect_frame(self, t: int) -> int:
        if not 0 <= t < self._shot.frame_count:
            raise UsageError(f"shot {self._shot.name!r}: frame {t} of 0 to {self._shot.frame_count - 1}")
        return t

    def _eye(self, t: int) -> Eye:
        sensor = self._shot.sensor
        pose = self._shot.T_world_camera[0 if self._shot.is_static else t]
        return Eye(self._shot.intrinsics, pose, sensor.k1, sensor.k2)

    def _view(self, t: int) -> RoomView:
        t = 0 if self._shot.is_static else t
        if self._kept is None or self._kept[0] != t:
            self._kept = (t, self._new_view(t))
        return self._kept[1]

    def _new_view(self, t: int) -> RoomView:
        eye = self._eye(t)
        whole = slice(0, eye.intrinsics.height_px), slice(0, eye.intrinsics.width_px)
        gbuffer = trace_gbuffer(eye, self._room, self._caster, *whole)
        lamps = self._still if self._shot.is_static else self._quick
        components = room_components(eye, self._room, self._caster, self._opaque, lamps, gbuffer)
        return RoomView(eye, gbuffer, components, components.radiance())

    def _rgb(self, radiance: np.ndarray) -> np.ndarray:
        return tone.encode(radiance * np.float32(self.exposure))

    def _picture(self, view: RoomView, rgb: np.ndarray, layer: MovingLayer | None) -> Picture:
        depth, normal, instance = view.gbuffer.depth_m, view.gbuffer.normal, view.gbuffer.object_id
        if layer is not None:
            depth, normal, instance = depth.copy(), normal.copy(), instance.copy()
            box = layer.gbuffer.rows, layer.gbuffer.columns
            shown = np.isfinite(layer.gbuffer.depth_m)
            depth[box][shown] = layer.gbuffer.depth_m[shown]
            normal[box][shown] = layer.gbuffer.normal[shown]
            instance[box][shown] = layer.gbuffer.object_id[shown]
        R_world_camera = view.eye.T_world_camera[:3, :3].astype(np.float32)
        return Picture(
            rgb.reshape(*view.gbuffer.shape, 3),
            np.where(np.isfinite(depth), depth, 0).astype(np.float32),
            (normal.reshape(-1, 3) @ R_world_camera).reshape(normal.shape),
            instance.astype(np.uint16),
        )
