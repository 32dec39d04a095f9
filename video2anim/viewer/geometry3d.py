"""open3d geometry of a scene's parts. Importing this module needs open3d and its system libraries."""

from __future__ import annotations

from typing import Any

import numpy as np

from video2anim.errors import UsageError
from video2anim.geometry.scene_mesh import colored
from video2anim.types import Mesh, SceneModel, View
from video2anim.viewer.drawing import drawable_mesh, frustum

SYSTEM_PACKAGES = "libusb-1.0-0 libgl1 libegl1 libgomp1"

try:
    import open3d as o3d
except (ImportError, OSError) as error:
    raise UsageError(
        f"viewer: open3d could not be imported ({error}); its window needs system libraries, on Debian or Ubuntu "
        f"`apt-get install {SYSTEM_PACKAGES}`; all other commands work without them"
    ) from error


def triangle_mesh(vertices_m: np.ndarray, faces: np.ndarray, rgb: np.ndarray) -> Any:
    """Lit mesh; `rgb` is one color or one per vertex, uint8."""
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(np.asarray(vertices_m, np.float64)),
        o3d.utility.Vector3iVector(np.asarray(faces, np.int32)),
    )
    colors = np.broadcast_to(np.asarray(rgb, np.float64) / 255.0, np.shape(vertices_m))
    mesh.vertex_colors = o3d.utility.Vector3dVector(colors.copy())
    mesh.compute_vertex_normals()
    return mesh


def move_mesh(mesh: Any, vertices_m: np.ndarray, rgb: np.ndarray) -> None:
    """Give a mesh other vertex positions and colors (one per vertex, uint8)."""
    mesh.vertices = o3d.utility.Vector3dVector(np.asarray(vertices_m, np.float64))
    mesh.vertex_colors = o3d.utility.Vector3dVector(np.asarray(rgb, np.float64) / 255.0)
    mesh.compute_vertex_normals()


def scene_meshes(scene: SceneModel | None, frame: int) -> dict[str, list[Any]]:
    """Meshes of a scene at a frame by the group that keys switch: `floor`, `background`, `objects` (those that have
    faces, in their order)."""
    if scene is None:
        return {"floor": [], "background": [], "objects": []}
    floor = colored(scene.floor)
    return {
        "floor": _static(floor, floor.vertices_m),
        "background": [part for mesh in map(colored, scene.background) for part in _static(mesh, mesh.vertices_m)],
        "objects": [
            part
            for mesh in (drawable_mesh(placed, frame) for placed in scene.objects)
            for part in _static(mesh, np.asarray(mesh.vertices_m))
        ],
    }


def camera_lines(camera: View) -> Any:
    """The clip's camera as a pyramid of lines."""
    apex_m, corners_m = frustum(camera)
    lines = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]]
    return o3d.geometry.LineSet(
        o3d.utility.Vector3dVector(np.concatenate([apex_m[None], corners_m])), o3d.utility.Vector2iVector(lines)
    )


def _static(mesh: Mesh, vertices_world_m: np.ndarray) -> list[Any]:
    return [triangle_mesh(vertices_world_m, mesh.faces, mesh.vertex_rgb)] if len(mesh.faces) else []
