"""Watertight, colored meshes of carved solids."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import KDTree

from video2anim.geometry.carving import ObjectView, Voxels
from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.geometry.upright_box import UprightBox

_SMOOTHING_ROUNDS = 6
"""Rounds of Taubin smoothing, which takes the stairs off and keeps the volume."""


def mesh_of_voxels(
    voxels: Voxels, most_faces: int
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Closed surface around the filled cubes, in axes of the box (marching cubes, smoothed, simplified).

    Raises:
        ValueError: no cube is filled.
    """
    import trimesh
    from skimage.measure import marching_cubes

    if not voxels.filled.any():
        raise ValueError("mesh_of_voxels: want at least one filled cube, got none")
    low = voxels.origin_m
    high = low + voxels.spacing_m * np.array(voxels.filled.shape)
    filled, spacing_m = voxels.filled, voxels.spacing_m
    while True:
        found = marching_cubes(np.pad(without_pinches(filled), 1).astype(np.float32), 0.5)
        mesh = trimesh.Trimesh((found[0] - 0.5) * spacing_m + low, found[1], process=True)
        trimesh.smoothing.filter_taubin(mesh, iterations=_SMOOTHING_ROUNDS)
        vertices, faces = simplified(np.asarray(mesh.vertices), np.asarray(mesh.faces), most_faces)
        if len(faces) <= most_faces or max(filled.shape) <= 4:
            return np.clip(vertices, low, high), outward(vertices, faces)
        # No simplification keeps it closed: fewer cubes have fewer faces.
        filled, spacing_m = _halved(filled), 2 * spacing_m


def without_pinches(filled: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Cubes that touch at an edge alone get a third one beside them: four faces at one edge bound no solid."""
    filled = filled.copy()
    while True:
        before = int(filled.sum())
        for axis in range(3):
            block = np.moveaxis(filled, axis, 0)
            a, b, c, d = block[:, :-1, :-1], block[:, :-1, 1:], block[:, 1:, :-1], block[:, 1:, 1:]
            falling, rising = a & d & ~b & ~c, b & c & ~a & ~d
            b |= falling
            a |= rising
        if int(filled.sum()) == before:
            return filled


def _halved(filled: np.ndarray) -> Bool[np.ndarray, "x y z"]:
    """Cubes of twice the size, filled where any of their eight is."""
    padded = np.pad(filled, [(0, n % 2) for n in filled.shape])
    x, y, z = (n // 2 for n in padded.shape)
    return np.asarray(padded.reshape(x, 2, y, 2, z, 2).any((1, 3, 5)), bool)


def simplified(
    vertices_m: np.ndarray, faces: np.ndarray, most_faces: int, *, keep_closed: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Fewer faces by quadric error; as it was where that would tear a closed surface that is to be kept closed."""
    import fast_simplification
    import trimesh

    if len(faces) <= most_faces:
        return vertices_m, faces
    closed = keep_closed and trimesh.Trimesh(vertices_m, faces, process=False).is_watertight
    # Single precision around the middle, not around the world's origin.
    middle = vertices_m.mean(0)
    for share, eagerness in ((1.0, 3), (1.0, 5), (0.85, 5), (0.6, 5), (0.6, 7), (0.4, 7)):
        fewer = fast_simplification.simplify(
            (vertices_m - middle).astype(np.float32), faces.astype(np.int32), target_count=int(share * most_faces),
            agg=eagerness,
        )  # fmt: skip
        kept = trimesh.Trimesh(fewer[0] + middle, fewer[1], process=True)
        if len(kept.faces) <= most_faces and (kept.is_watertight or not closed):
            return np.asarray(kept.vertices, np.float64), np.asarray(kept.faces, np.int64)
    return vertices_m, faces


def outward(vertices_m: np.ndarray, faces: np.ndarray) -> Int[np.ndarray, "faces 3"]:
    """Faces turned so that the enclosed volume is positive."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    volume = np.einsum("nd,nd->n", a, np.cross(b, c)).sum()
    return (faces if volume >= 0 else faces[:, ::-1]).astype(np.int64)


def box_surface(
    low_m: Float[np.ndarray, "3"], high_m: Float[np.ndarray, "3"], most_faces: int, finest_m: float = 0.02
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Closed box whose sides are divided into cells, so that vertices can hold colors; at least 12 faces."""
    size = high_m - low_m
    cell_m = max(float(np.sqrt(4 * (size * np.roll(size, 1)).sum() / most_faces)), finest_m)
    counts = np.maximum(np.round(size / cell_m).astype(int), 1)
    while 4 * (counts * np.roll(counts, 1)).sum() > most_faces and counts.max() > 1:
        cell_m *= 1.02
        counts = np.maximum(np.round(size / cell_m).astype(int), 1)
    axes = [np.linspace(low_m[a], high_m[a], counts[a] + 1) for a in range(3)]
    shape = tuple(len(axis) for axis in axes)
    number = np.arange(np.prod(shape)).reshape(shape)
    quads = []
    for axis in range(3):
        for side, turned in ((0, True), (-1, False)):
            sheet = np.take(number, side, axis=axis)
            # The remaining axes in order: their cross product points along +axis for axes 0 and 2.
            corners = np.stack([sheet[:-1, :-1], sheet[1:, :-1], sheet[1:, 1:], sheet[:-1, 1:]], -1).reshape(-1, 4)
            quads.append(corners[:, ::-1] if turned != (axis == 1) else corners)
    quad = np.concatenate(quads)
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    used, faces = np.unique(faces, return_inverse=True)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return grid[used], faces.reshape(-1, 3)


def surface_colors(
    vertices_world_m: Float[np.ndarray, "vertices 3"],
    picture_rgb: UInt8[np.ndarray, "rows columns 3"],
    view: ObjectView,
    box: UprightBox,
    mirrored: tuple[str, ...],
    tolerance_m: float,
) -> UInt8[np.ndarray, "vertices 3"]:
    """Colors of the picture where the camera sees the vertex; elsewhere of its mirror image, or of the nearest vertex.

    Args:
        vertices_world_m: Of the mesh.
        picture_rgb: Of any size; the thing with its hidden parts inpainted.
        view: What the camera sees, with its pixel size.
        box: Whose middle planes mirror.
        mirrored: Axes about which the thing is symmetric.
        tolerance_m: A vertex may lie so far behind the seen surface and still be seen.
    """
    camera_m = transform_points(invert_rigid(view.T_world_camera), vertices_world_m)
    pixels = project(np.column_stack([camera_m[:, :2], np.maximum(camera_m[:, 2], 0.05)]), view.intrinsics)
    seen = _seen(camera_m[:, 2], pixels, view, tolerance_m)
    scale = picture_rgb.shape[1] / view.depth_m.shape[1], picture_rgb.shape[0] / view.depth_m.shape[0]
    u = np.clip(np.round((pixels[:, 0] + 0.5) * scale[0] - 0.5), 0, picture_rgb.shape[1] - 1).astype(int)
    v = np.clip(np.round((pixels[:, 1] + 0.5) * scale[1] - 0.5), 0, picture_rgb.shape[0] - 1).astype(int)
    colors = picture_rgb[v, u].copy()
    if not seen.any():
        return np.full_like(colors, 127)
    own = box.to_box(vertices_world_m)
    places, from_ = [own[seen]], [np.flatnonzero(seen)]
    for axis, name in ((0, "x"), (2, "z")):
        if name in mirrored:
            image = own[seen].copy()
            image[:, axis] = 2 * box.middle_m[axis] - image[:, axis]
            places.append(image)
            from_.append(from_[0])
    _, nearest = KDTree(np.concatenate(places)).query(own[~seen])
    colors[~seen] = colors[np.concatenate(from_)[nearest]]
    return colors


def _seen(z_m: np.ndarray, pixels: np.ndarray, view: ObjectView, tolerance_m: float) -> Bool[np.ndarray, "vertices"]:
    """Vertices whose pixel is the thing's and whose depth is the surface's."""
    height, width = view.depth_m.shape
    index = np.round(pixels).astype(int)
    inside = (z_m > 0.05) & (index >= 0).all(1) & (index < [width, height]).all(1)
    seen = np.zeros(len(z_m), bool)
    column, row = index[inside].T
    seen[inside] = view.own[row, column] & (np.abs(z_m[inside] - view.depth_m[row, column]) < tolerance_m)
    return seen
