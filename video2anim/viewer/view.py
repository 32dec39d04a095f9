"""Entry points of the viewer: a window to play in, and single pictures."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Literal

from video2anim.errors import InputError, UsageError
from video2anim.types import BodyMotion
from video2anim.types.motion import main_person
from video2anim.viewer.scene_view import SceneView

Renderer = Literal["software", "open3d"]


def view(view_of: SceneView, *, title: str = "video2anim", frame: int = 0, stage: str | None = None) -> None:
    """Open the open3d window; returns when it is closed.

    Args:
        view_of: motions and scene.
        title: of the window.
        frame: to open at, paused; 0 = play from the start.
        stage: `raw`, `keyframes` or `refined`; None for the last one made.

    Raises:
        UsageError: no such frame or stage; or open3d, its system libraries or a display are missing, and the message
            names what to install.
    """
    from video2anim.viewer.window import run_window

    _expect_frame(view_of.people(stage), frame)
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UsageError(
            "view: want a display for the window, got neither DISPLAY nor WAYLAND_DISPLAY; "
            "use `video2anim view DIR --screenshot out.png`, or run under Xvfb"
        )
    run_window(view_of, title, frame, stage)


def screenshot(
    view_of: SceneView,
    frame: int,
    out_png: Path,
    *,
    stage: str | None = None,
    renderer: Renderer = "software",
    width_px: int = 1280,
    height_px: int = 720,
    timeout_s: float = 60.0,
) -> None:
    """Render one frame of the scene, seen obliquely, without a window on the screen.

    Args:
        view_of: Motions and scene.
        frame: Frame number, from 0.
        out_png: File to make.
        stage: `raw`, `keyframes` or `refined`; None for the last one made.
        renderer: `software` (numpy, needs nothing) or `open3d` (a hidden window, on a virtual display where there
            is none; needs open3d, its libraries and Xvfb).
        width_px: Width of the picture.
        height_px: Height of the picture.
        timeout_s: Limit for the open3d renderer, which runs in a process of its own.

    Raises:
        UsageError: no such frame or stage, or the renderer's requirements are missing.
        InputError: the picture cannot be written.
    """
    people = view_of.people(stage)
    _expect_frame(people, frame)
    if renderer == "open3d":
        from video2anim.viewer.bodies import PosedBodies
        from video2anim.viewer.offscreen import render_open3d

        posed = PosedBodies(people, view_of.contacts_of(stage))
        render_open3d(posed, view_of.scene, frame, out_png, width_px, height_px, timeout_s)
        return
    from video2anim.artifacts.images import write_png
    from video2anim.viewer.software import render_software

    if out_png.suffix.lower() != ".png":
        raise UsageError(f"screenshot: want a file that ends in .png, got {out_png}")
    picture = render_software(people, view_of.scene, frame, width_px, height_px, view_of.contacts_of(stage))
    try:
        write_png(out_png, picture)
    except OSError as error:
        raise InputError(f"cannot write picture {out_png}: {error}; choose a writable .png path") from error


def _expect_frame(people: tuple[BodyMotion, ...], frame: int) -> None:
    count = main_person(people).frame_count
    if not 0 <= frame < count:
        raise UsageError(f"frame: want 0 to {count - 1}, got {frame}")
