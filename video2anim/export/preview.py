"""The preview video: the body over the input on the left, the scene from the side on the right. Software rendered."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.export.sound import finish_video
from video2anim.geometry.sdf import SdfGrid
from video2anim.types import BodyMotion, SceneModel, VideoClip
from video2anim.types.motion import main_person
from video2anim.video import FrameWriter, read_frame, read_frames
from video2anim.viewer.bodies import PosedBodies
from video2anim.viewer.drawing import draw_frustum, draw_static, objects_stay
from video2anim.viewer.raster import Canvas
from video2anim.viewer.software import ELEVATION_RAD, ROOM_M, framed_points
from video2anim.viewer.viewpoint import Viewpoint, fit_viewpoint, looking

_BODY_OPACITY = 0.8
"""Of bodies over the input."""
_SIDE_VIEWS = (*((side, times * ELEVATION_RAD) for times in (1, 2) for side in (1, -1)), (1, math.pi / 2))
"""Candidates of the side view in order of preference: side (+1 or -1) and elevation in radians, at last from above."""
_HIDDEN_SHARE = 0.15
"""A view from the side shows motion best: it is taken while it hides at most this share of the joints. Not measured."""
_CHECKED_FRAMES = 40
"""Frames in which it is tested whether objects hide the bodies; so few bound the memory of long clips."""
_AROUND_M = tuple(np.array([x, 0.0, z]) for x in (-ROOM_M, ROOM_M) for z in (-ROOM_M, ROOM_M))
"""Room left around a body in a close view."""


def write_preview(
    path: Path,
    clip: VideoClip,
    people: tuple[BodyMotion, ...],
    scene: SceneModel,
    height_px: int,
    on_progress: Callable[[int, int], None] | None = None,
    *,
    sound_from: Path | None = None,
) -> None:
    """Write `preview.mp4` at the clip's rate, all frames, with the clip's sound; it plays while it loads.

    People are shown from their first to their last measured frame, gray where they are not measured in between.

    Args:
        path: File to make.
        clip: The input; its pictures are the left panel.
        people: Motions to show, main person first.
        scene: Floor and objects of the side view.
        height_px: Height of both panels; the left one keeps the shape of the video, the right one is as wide or square.
        on_progress: Called with frames done and in all.
        sound_from: The file that the clip was made from, whose sound is added where it has any.

    Raises:
        InputError: the clip cannot be read or the disk is full.
        StageError: the file cannot be written.
    """
    bodies = PosedBodies(people)
    width_px, height_px = _panel_size(clip, height_px)
    side_width_px = max(width_px, height_px)
    main = main_person(people)
    side = side_viewpoint(people, scene, side_width_px, height_px)
    side_empty = _empty_scene(scene, side, 0)
    total = min(clip.frame_count, main.frame_count)
    silent = path.with_name(f".silent-{path.name}")
    with FrameWriter(
        silent, width_px=width_px + side_width_px, height_px=height_px, fps=round(clip.fps), crf=20
    ) as writer:
        for frame, (picture, meshes) in enumerate(
            zip(read_frames(clip, 0, total), bodies.frames(0, total), strict=True)
        ):
            small = cv2.resize(picture, (width_px, height_px), interpolation=cv2.INTER_AREA)
            left = _overlay(small, bodies, meshes, frame)
            if frame and not objects_stay(scene, frame):
                side_empty = _empty_scene(scene, side, frame)
            right = side_empty.copy()
            draw_frustum(right, side, main.view(frame))
            bodies.draw(right, side, meshes, frame, bodies.present(frame))
            both = np.concatenate([left, right.rgb], axis=1)
            label = f"{frame}  {clip.frame_time_s[frame]:.2f} s"
            cv2.putText(both, label, (width_px + 10, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
            writer.write(both)
            if on_progress is not None:
                on_progress(frame + 1, total)
    finish_video(path, silent, sound_from, float(clip.source_time_s[0]))
    silent.unlink()


def overlay_frame(
    clip: VideoClip, people: tuple[BodyMotion, ...], frame: int, height_px: int = 360
) -> UInt8[np.ndarray, "height width 3"]:
    """One frame of the input with the bodies drawn over it."""
    bodies = PosedBodies(people)
    width_px, height_px = _panel_size(clip, height_px)
    small = cv2.resize(read_frame(clip, frame), (width_px, height_px), interpolation=cv2.INTER_AREA)
    (meshes,) = bodies.frames(frame, frame + 1)
    return _overlay(small, bodies, meshes, frame)


def moment_picture(
    clip: VideoClip, raw: BodyMotion, refined: BodyMotion, scene: SceneModel, frame: int, height_px: int = 300
) -> UInt8[np.ndarray, "height width 3"]:
    """One frame of one person: refined over the input, and raw and refined from the side, near by."""
    panels = [overlay_frame(clip, (refined,), frame, height_px)]
    sideways = np.cross([0.0, 1.0, 0.0], refined.view(frame).forward)
    around = [motion.joints_world_m[frame] for motion in (raw, refined)]
    points_m = np.concatenate([a + shift for a in around for shift in _AROUND_M])
    size_px = panels[0].shape[0]
    viewpoint = _clear_viewpoint(points_m, np.concatenate(around), sideways, scene, size_px, size_px)
    for motion in (raw, refined):
        canvas = Canvas.blank(size_px, size_px)
        draw_static(canvas, viewpoint, scene, background=False, objects=True, frame=frame)
        bodies = PosedBodies((motion,))
        (meshes,) = bodies.frames(frame, frame + 1)
        bodies.draw(canvas, viewpoint, meshes, frame)
        panels.append(canvas.rgb)
    return np.concatenate(panels, axis=1)


def _empty_scene(scene: SceneModel, viewpoint: Viewpoint, frame: int) -> Canvas:
    """Floor and objects of a frame, without people."""
    canvas = Canvas.blank(viewpoint.intrinsics.width_px, viewpoint.intrinsics.height_px)
    draw_static(canvas, viewpoint, scene, background=False, objects=True, frame=frame)
    return canvas


def side_viewpoint(people: tuple[BodyMotion, ...], scene: SceneModel, width_px: int, height_px: int) -> Viewpoint:
    """A camera at right angles to the filming one that sees all bodies and the objects near them. Where objects would
    hide the bodies from there, it looks from the other side, or from higher up."""
    joints_m = [body.joints_world_m[body.valid] for body in people]
    checked_m = [own[:: max(1, len(own) // _CHECKED_FRAMES)].reshape(-1, 3) for own in joints_m]
    sideways = np.cross([0.0, 1.0, 0.0], main_person(people).view().forward)
    return _clear_viewpoint(
        framed_points(people, scene), np.concatenate(checked_m), sideways, scene, width_px, height_px
    )


def _clear_viewpoint(
    points_m: Float[np.ndarray, "points 3"],
    checked_m: Float[np.ndarray, "checked 3"],
    sideways: Float[np.ndarray, "3"],
    scene: SceneModel,
    width_px: int,
    height_px: int,
) -> Viewpoint:
    """The first candidate that hides few of the checked points, else the one that hides the fewest."""
    found = []
    for side, elevation_rad in _SIDE_VIEWS:
        R_world_camera = looking(side * sideways, elevation_rad)
        viewpoint = fit_viewpoint(points_m, R_world_camera, width_px=width_px, height_px=height_px)
        found.append((hidden_share(checked_m, viewpoint, scene), viewpoint))
        if found[-1][0] <= _HIDDEN_SHARE:
            return viewpoint
    return min(found, key=lambda one: one[0])[1]


def hidden_share(points_m: Float[np.ndarray, "points 3"], viewpoint: Viewpoint, scene: SceneModel) -> float:
    """Share of points, in the world, with a solid between them and the camera; 0 for none."""
    if not len(points_m):
        return 0.0
    grid = SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)
    # Without the last 5 %: the seat of a body does not hide it.
    camera_m = viewpoint.T_world_camera[:3, 3]
    longest_m = np.linalg.norm(points_m - camera_m, axis=1).max()
    along = np.linspace(0.0, 0.95, 1 + int(np.ceil(longest_m / scene.sdf_spacing_m)))[:, None]
    sights_m = camera_m + along * (points_m[:, None] - camera_m)
    return float((grid.sample(sights_m) < 0).any(1).mean())


def _overlay(
    picture: UInt8[np.ndarray, "height width 3"], bodies: PosedBodies, meshes: tuple[np.ndarray, ...], frame: int
) -> UInt8[np.ndarray, "height width 3"]:
    canvas = Canvas.over(picture)
    height_px, width_px = picture.shape[:2]
    camera = main_person(bodies.people).view(frame).resized(width_px, height_px)
    bodies.draw(canvas, Viewpoint(camera.T_world_camera, camera.intrinsics), meshes, frame, bodies.present(frame))
    return cv2.addWeighted(canvas.rgb, _BODY_OPACITY, picture, 1.0 - _BODY_OPACITY, 0.0)


def _panel_size(clip: VideoClip, height_px: int) -> tuple[int, int]:
    """Even panel size of the clip's shape."""
    even_height_px = 2 * (height_px // 2)
    return max(2, 2 * round(0.5 * even_height_px * clip.width_px / clip.height_px)), even_height_px
