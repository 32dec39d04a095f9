"""Draws one request of `offscreen` with open3d and exits. Run as a module: `request.npz picture.png`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from video2anim.errors import UsageError
from video2anim.types import Intrinsics, View
from video2anim.viewer.geometry3d import camera_lines, o3d, triangle_mesh
from video2anim.viewer.viewpoint import Viewpoint
from video2anim.viewer.window import place_camera

_SETTLING_ROUNDS = 3
"""Event rounds before the picture is taken, so that the window has its size and content."""


def draw(request: Path, picture: Path) -> None:
    """Draw a request into a PNG.

    Raises:
        UsageError: no hidden window can be made.
    """
    with np.load(request, allow_pickle=False) as arrays:
        mesh = triangle_mesh(arrays["vertices_m"], arrays["faces"], arrays["rgb"])
        lens = _intrinsics(arrays["view_lens"])
        camera = camera_lines(View(arrays["T_world_camera"], _intrinsics(arrays["camera_lens"])))
        viewpoint = Viewpoint(arrays["T_world_view"], lens)
    visualizer = o3d.visualization.Visualizer()
    if not visualizer.create_window("video2anim", lens.width_px, lens.height_px, visible=False):
        raise UsageError("no OpenGL window on this display")
    visualizer.add_geometry(mesh)
    visualizer.add_geometry(camera)
    visualizer.get_render_option().mesh_show_back_face = True
    place_camera(visualizer, viewpoint)
    for _ in range(_SETTLING_ROUNDS):
        visualizer.poll_events()
        visualizer.update_renderer()
    visualizer.capture_screen_image(picture, do_render=True)
    visualizer.destroy_window()


def _intrinsics(values: np.ndarray) -> Intrinsics:
    fx_px, fy_px, cx_px, cy_px, width_px, height_px = values.tolist()
    return Intrinsics(fx_px, fy_px, cx_px, cy_px, int(width_px), int(height_px))


if __name__ == "__main__":
    try:
        draw(Path(sys.argv[1]), Path(sys.argv[2]))
    except UsageError as error:
        sys.exit(str(error))
