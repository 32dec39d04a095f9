"""One picture by open3d's own renderer in a hidden window, in a process that may be given up on.

Graphics drivers can hang or abort; the caller must survive that. Where there is no display, a virtual one (Xvfb) is
started for the time of the picture.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from video2anim.errors import UsageError
from video2anim.geometry.scene_mesh import colored
from video2anim.types import SceneModel
from video2anim.types.motion import main_person
from video2anim.viewer.bodies import PosedBodies
from video2anim.viewer.drawing import drawable_mesh
from video2anim.viewer.software import oblique_viewpoint

_XVFB_PACKAGE = "xvfb"
_STARTUP_S = 10.0


def render_open3d(
    posed: PosedBodies,
    scene: SceneModel | None,
    frame: int,
    out_png: Path,
    width_px: int,
    height_px: int,
    timeout_s: float,
) -> None:
    """Render one frame to a PNG.

    Raises:
        UsageError: open3d, a display and Xvfb, or OpenGL are missing, or the renderer failed or took too long.
    """
    with tempfile.TemporaryDirectory(prefix="video2anim-view-") as folder, _display() as display:
        request = Path(folder) / "request.npz"
        picture = Path(folder) / "picture.png"
        _write_request(request, posed, scene, frame, width_px, height_px)
        command = [sys.executable, "-m", "video2anim.viewer.offscreen_worker", str(request), str(picture)]
        try:
            done = subprocess.run(
                command, env={**os.environ, "DISPLAY": display}, capture_output=True, text=True, timeout=timeout_s
            )
        except subprocess.TimeoutExpired as error:
            raise UsageError(
                f"open3d drew nothing within {timeout_s:.0f} s; use the software renderer instead"
            ) from error
        if done.returncode != 0 or not picture.is_file():
            reason = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
            raise UsageError(f"open3d could not draw: {reason}; use the software renderer instead")
        shutil.copyfile(picture, out_png)


@contextmanager
def _display() -> Iterator[str]:
    """A display to draw on: the user's, or a virtual one that ends with the block."""
    if os.environ.get("DISPLAY"):
        yield os.environ["DISPLAY"]
        return
    program = shutil.which("Xvfb")
    if program is None:
        raise UsageError(
            f"open3d needs a display: none is set and Xvfb is not installed; run `apt-get install {_XVFB_PACKAGE}` "
            "or use the software renderer"
        )
    reading, writing = os.pipe()
    server = subprocess.Popen(
        [program, "-displayfd", str(writing), "-screen", "0", "1920x1200x24", "-nolisten", "tcp"],
        pass_fds=(writing,),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    try:
        with os.fdopen(reading) as pipe:
            number = pipe.readline().strip()
        if not number:
            raise UsageError("Xvfb did not start; use the software renderer")
        yield f":{number}"
    finally:
        server.terminate()
        server.wait(timeout=_STARTUP_S)


def _write_request(
    path: Path, posed: PosedBodies, scene: SceneModel | None, frame: int, width_px: int, height_px: int
) -> None:
    """All triangles with their colors, the view, and the filming camera, for the worker."""
    people = posed.people
    (meshes,) = posed.frames(frame, frame + 1)
    vertices, faces, colors = [], [], []
    for person, (body, vertices_m) in enumerate(zip(posed.bodies, meshes, strict=True)):
        vertices.append(vertices_m)
        faces.append(body.faces)
        colors.append(posed.colors(person, frame))
    if scene is not None:
        placed = [drawable_mesh(part, frame) for part in scene.objects]
        for mesh in (*map(colored, (scene.floor, *scene.background)), *placed):
            vertices.append(np.asarray(mesh.vertices_m))
            faces.append(np.asarray(mesh.faces))
            colors.append(mesh.vertex_rgb)
    starts = np.cumsum([0, *(len(part) for part in vertices)])[:-1]
    viewpoint = oblique_viewpoint(people, scene, width_px, height_px)
    camera = main_person(people).view(frame)
    np.savez(
        path,
        vertices_m=np.concatenate(vertices),
        faces=np.concatenate([part + start for part, start in zip(faces, starts, strict=True)]),
        rgb=np.concatenate(colors),
        T_world_view=viewpoint.T_world_camera,
        view_lens=dataclasses.astuple(viewpoint.intrinsics),
        T_world_camera=camera.T_world_camera,
        camera_lens=dataclasses.astuple(camera.intrinsics),
    )
