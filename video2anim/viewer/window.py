"""The open3d window: play and scrub the motion, switch stages and parts of the scene.

Keys: space play / pause; left, right one frame; up, down ten frames; home first frame; 1 raw, 2 keyframes, 3 refined;
C camera, O objects, B background, F floor; R view from the start; Q close.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from video2anim.errors import UsageError
from video2anim.types.clip import FPS
from video2anim.types.motion import main_person
from video2anim.viewer.bodies import PosedBodies
from video2anim.viewer.drawing import drawable_mesh
from video2anim.viewer.geometry3d import camera_lines, move_mesh, o3d, scene_meshes, triangle_mesh
from video2anim.viewer.scene_view import STAGES, SceneView
from video2anim.viewer.software import oblique_viewpoint
from video2anim.viewer.viewpoint import Viewpoint

_WIDTH_PX, _HEIGHT_PX = 1280, 720
_KEY_LEFT, _KEY_RIGHT, _KEY_UP, _KEY_DOWN, _KEY_HOME = 263, 262, 265, 264, 268
"""GLFW key codes."""


def run_window(view_of: SceneView, title: str, frame: int = 0, stage: str | None = None) -> None:
    """Show the window until it is closed. With a `frame` it opens there, paused; else it plays from the start.

    Raises:
        UsageError: no window can be opened.
    """
    visualizer = o3d.visualization.VisualizerWithKeyCallback()
    if not visualizer.create_window(title, _WIDTH_PX, _HEIGHT_PX):
        raise UsageError(
            "cannot open a window: no display or no OpenGL; use `video2anim view DIR --screenshot out.png`, "
            "or run under `xvfb-run`"
        )
    Player(visualizer, view_of, frame, stage).run()
    visualizer.destroy_window()


def place_camera(visualizer: Any, viewpoint: Viewpoint) -> None:
    """Move the window's own camera."""
    control = visualizer.get_view_control()
    parameters = control.convert_to_pinhole_camera_parameters()
    lens = viewpoint.intrinsics
    parameters.intrinsic = o3d.camera.PinholeCameraIntrinsic(
        lens.width_px, lens.height_px, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px
    )
    parameters.extrinsic = np.linalg.inv(viewpoint.T_world_camera)
    control.convert_from_pinhole_camera_parameters(parameters, allow_arbitrary=True)


class Player:
    """What the window shows now, and what keys do to it."""

    def __init__(self, visualizer: Any, view_of: SceneView, frame: int = 0, stage: str | None = None) -> None:
        self.visualizer = visualizer
        self.view_of = view_of
        self.people = view_of.people(stage)
        self.posed = PosedBodies(self.people, view_of.contacts_of(stage))
        self.frame = frame
        self.playing = frame == 0
        self.shown = {"camera": True, "objects": True, "background": True, "floor": True}
        self.parts = scene_meshes(view_of.scene, frame)
        self.parts["camera"] = [camera_lines(main_person(self.people).view(frame))]
        (meshes,) = self.posed.frames(frame, frame + 1)
        self.bodies = [
            triangle_mesh(vertices_m, body.faces, self.posed.colors(person, frame))
            for person, (body, vertices_m) in enumerate(zip(self.posed.bodies, meshes, strict=True))
        ]
        for geometry in [*self.bodies, *(part for parts in self.parts.values() for part in parts)]:
            visualizer.add_geometry(geometry)
        self.reset_view()
        self._bind_keys()

    def run(self) -> None:
        """Poll events and advance at 30 fps, dropping frames where drawing is slower, until closed."""
        next_s = time.monotonic()
        while self.visualizer.poll_events():
            now_s = time.monotonic()
            if self.playing and now_s >= next_s:
                steps = 1 + int((now_s - next_s) * FPS)
                next_s += steps / FPS
                self.show((self.frame + steps) % self.view_of.frame_count)
            elif not self.playing:
                next_s = now_s
            self.visualizer.update_renderer()

    def show(self, frame: int) -> None:
        """Move bodies, objects and camera to a frame."""
        self.frame, before = int(np.clip(frame, 0, self.view_of.frame_count - 1)), self.frame
        (meshes,) = self.posed.frames(self.frame, self.frame + 1)
        for person, (mesh, vertices_m) in enumerate(zip(self.bodies, meshes, strict=True)):
            move_mesh(mesh, vertices_m, self.posed.colors(person, self.frame))
            self.visualizer.update_geometry(mesh)
        self._move_objects(before)
        (old,) = self.parts["camera"]
        old.points = camera_lines(main_person(self.people).view(self.frame)).points
        if self.shown["camera"]:
            self.visualizer.update_geometry(old)

    def _move_objects(self, before: int) -> None:
        """Put objects that somebody moves where they are, as far as they were elsewhere in the frame shown before."""
        scene = self.view_of.scene
        drawn = [placed for placed in scene.objects if len(placed.mesh.faces)] if scene is not None else []
        for placed, part in zip(drawn, self.parts["objects"], strict=True):
            if np.array_equal(placed.pose(before), placed.pose(self.frame)):
                continue
            mesh = drawable_mesh(placed, self.frame)
            move_mesh(part, mesh.vertices_m, mesh.vertex_rgb)
            if self.shown["objects"]:
                self.visualizer.update_geometry(part)

    def use_stage(self, stage: str) -> None:
        """Show the motion of another stage, if there is one."""
        if stage in self.view_of.motions:
            self.people = self.view_of.people(stage)
            self.posed = PosedBodies(self.people, self.view_of.contacts_of(stage))
            self.show(self.frame)

    def toggle(self, part: str) -> None:
        """Hide or show a part of the scene."""
        self.shown[part] = not self.shown[part]
        change = self.visualizer.add_geometry if self.shown[part] else self.visualizer.remove_geometry
        for geometry in self.parts[part]:
            change(geometry, reset_bounding_box=False)

    def step(self, frames: int) -> None:
        """Pause and move by some frames."""
        self.playing = False
        self.show(self.frame + frames)

    def reset_view(self) -> None:
        """Look at the whole scene obliquely."""
        place_camera(self.visualizer, oblique_viewpoint(self.people, self.view_of.scene, _WIDTH_PX, _HEIGHT_PX))

    def _play_or_pause(self) -> None:
        self.playing = not self.playing

    def _bind_keys(self) -> None:
        actions: dict[int, Callable[[], None]] = {
            ord(" "): self._play_or_pause,
            _KEY_LEFT: lambda: self.step(-1),
            _KEY_RIGHT: lambda: self.step(1),
            _KEY_DOWN: lambda: self.step(-10),
            _KEY_UP: lambda: self.step(10),
            _KEY_HOME: lambda: self.show(0),
            ord("R"): self.reset_view,
        }
        for number, stage in enumerate(STAGES, start=1):
            actions[ord(str(number))] = lambda stage=stage: self.use_stage(stage)
        for part in self.shown:
            actions[ord(part[0].upper())] = lambda part=part: self.toggle(part)
        for key, action in actions.items():
            self.visualizer.register_key_callback(key, lambda _visualizer, action=action: bool(action()))
