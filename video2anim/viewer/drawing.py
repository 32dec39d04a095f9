"""Drawing the parts of a scene onto a canvas: static meshes, bodies, floor grid, camera frustum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from video2anim.geometry.projection import transform_points
from video2anim.geometry.scene_mesh import colored, with_vertex_colors, world_mesh
from video2anim.types import Mesh, PlacedObject, SceneModel, View
from video2anim.viewer.raster import Canvas, Light, draw_lines, draw_mesh
from video2anim.viewer.shadows import contact_shaded
from video2anim.viewer.viewpoint import Viewpoint

_GRID_RGB = (176, 182, 190)
_FRUSTUM_RGB = (40, 70, 160)
_GRID_STEP_M = 1.0
_GRID_PIECES = 5
"""Pieces of a line between two others: it ends to one piece where the floor ends."""
_GRID_LIMIT = 60
"""Lines per direction at most; the step grows for larger floors. The number of pieces grows with its square."""


def world_vertices(placed: PlacedObject, frame: int = 0) -> Float[np.ndarray, "vertices 3"]:
    """Vertices of a placed object in the world, at a frame of the clip."""
    return transform_points(np.asarray(placed.pose(frame)), placed.scale * np.asarray(placed.mesh.vertices_m))


def drawable_mesh(placed: PlacedObject, frame: int = 0) -> Mesh:
    """A placed object in the world with a color per vertex, at a frame of the clip."""
    return world_mesh(with_vertex_colors(placed.mesh, placed.textures), placed.pose(frame), placed.scale)


def objects_stay(scene: SceneModel, frame: int) -> bool:
    """Whether every object stands at a frame where it stood in the one before."""
    return all(np.array_equal(one.pose(frame - 1), one.pose(frame)) for one in scene.objects if one.path)


def draw_static(
    canvas: Canvas,
    viewpoint: Viewpoint,
    scene: SceneModel,
    *,
    background: bool,
    objects: bool,
    frame: int = 0,
    bodies_m: Sequence[Float[np.ndarray, "vertices 3"]] = (),
) -> None:
    """Draw the floor with a meter grid, and on demand the room surface and the objects where they are at a frame, which
    shade the floor that they stand on; so do the bodies given, which are not drawn."""
    placed = [drawable_mesh(one, frame) for one in scene.objects] if objects else []
    floor = colored(scene.floor)
    shaded = contact_shaded(floor, [*(mesh.vertices_m for mesh in placed), *bodies_m])
    floor = replace(floor, vertex_rgb=shaded)
    _draw(canvas, viewpoint, floor, np.asarray(floor.vertices_m), light="none")
    if len(floor.vertices_m):
        _draw_grid(canvas, viewpoint, np.asarray(floor.vertices_m))
    for mesh in map(colored, scene.background if background else ()):
        _draw(canvas, viewpoint, mesh, mesh.vertices_m, light="none", closed=True)
    for mesh in placed:
        _draw(canvas, viewpoint, mesh, mesh.vertices_m, light="flat")


def draw_body(
    canvas: Canvas,
    viewpoint: Viewpoint,
    vertices_world_m: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    rgb: UInt8[np.ndarray, "vertices 3"],
) -> None:
    """Draw a skinned body."""
    corners_m = viewpoint.to_camera(vertices_world_m)
    draw_mesh(canvas, corners_m, faces, rgb, viewpoint.intrinsics, closed=True, light="smooth")


def draw_frustum(canvas: Canvas, viewpoint: Viewpoint, camera: View) -> None:
    """Draw the clip's camera as a pyramid."""
    apex_m, corners_m = frustum(camera)
    starts_m = np.concatenate([np.repeat(apex_m[None], 4, 0), corners_m])
    ends_m = np.concatenate([corners_m, np.roll(corners_m, -1, 0)])
    draw_lines(canvas, viewpoint.to_camera(starts_m), viewpoint.to_camera(ends_m), _FRUSTUM_RGB, viewpoint.intrinsics)


def frustum(camera: View, depth_m: float = 0.35) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4 3"]]:
    """Camera center and the four image corners at `depth_m`, in the world."""
    T_world_camera, lens = camera.T_world_camera, camera.intrinsics
    right_px, bottom_px = lens.width_px - 1, lens.height_px - 1
    pixels = np.array([[0, 0], [right_px, 0], [right_px, bottom_px], [0, bottom_px]])
    rays = np.ones((4, 3))
    rays[:, 0] = (pixels[:, 0] - lens.cx_px) / lens.fx_px
    rays[:, 1] = (pixels[:, 1] - lens.cy_px) / lens.fy_px
    return T_world_camera[:3, 3], transform_points(T_world_camera, depth_m * rays)


def _draw(
    canvas: Canvas,
    viewpoint: Viewpoint,
    mesh: Mesh,
    vertices_world_m: np.ndarray,
    *,
    light: Light,
    closed: bool = False,
) -> None:
    if len(mesh.faces):
        corners_m = viewpoint.to_camera(vertices_world_m)
        faces = np.asarray(mesh.faces)
        draw_mesh(canvas, corners_m, faces, mesh.vertex_rgb, viewpoint.intrinsics, closed=closed, light=light)


def _draw_grid(canvas: Canvas, viewpoint: Viewpoint, floor_m: np.ndarray) -> None:
    """Lines every meter, or wider on large floors, where there is floor."""
    from scipy.spatial import KDTree

    flat_m = floor_m[:, [0, 2]]
    low, high = flat_m.min(0), flat_m.max(0)
    step_m = _GRID_STEP_M * max(1.0, np.ceil((high - low).max() / _GRID_LIMIT))
    piece_m = step_m / _GRID_PIECES
    starts, ends = [], []
    for axis in (0, 1):
        at = np.arange(np.ceil(low[axis] / step_m), np.floor(high[axis] / step_m) + 1) * step_m
        along = np.arange(low[1 - axis], high[1 - axis], piece_m)
        line, begin = (field.ravel() for field in np.meshgrid(at, along, indexing="ij"))
        for side, store in ((begin, starts), (np.minimum(begin + piece_m, high[1 - axis]), ends)):
            points = np.zeros((len(line), 3))
            points[:, 2 * axis] = line
            points[:, 2 - 2 * axis] = side
            store.append(points)
    start_m, end_m = np.concatenate(starts), np.concatenate(ends)
    gap_m = KDTree(flat_m).query(0.5 * (start_m + end_m)[:, [0, 2]])[0]
    on_floor = gap_m < 0.5 * piece_m
    draw_lines(
        canvas,
        viewpoint.to_camera(start_m[on_floor]),
        viewpoint.to_camera(end_m[on_floor]),
        _GRID_RGB,
        viewpoint.intrinsics,
    )
