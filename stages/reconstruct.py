"""Stage reconstruct: a closed, colored mesh of every object.

Method `extrusion`: the completed outline on an upright front plane, with the relief that the depth shows, carried back
by a thickness. The thickness is measured where the object's side is seen, and otherwise assumed from its width.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, UInt8

from video2anim.errors import StageError
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BackgroundPlate,
    BodyMotion,
    BodyTracks,
    CompletedObject,
    CompletedObjects,
    InstanceMasks,
    Mesh,
    MetricDepth,
    ObjectMesh,
    ObjectMeshes,
)

if TYPE_CHECKING:
    from video2anim.geometry.prism_mesh import FrontPlane, Prism


@dataclass(frozen=True)
class ReconstructConfig:
    """Detail of the meshes, and what is assumed of hidden sides."""

    most_faces: int = 4000
    """Upper limit of faces per object."""
    thickness_ratio: float = 0.6
    """Assumed thickness as a share of the width, where no side is seen."""
    thickest_m: float = 1.5
    """Largest assumed thickness."""
    least_points: int = 30
    """Objects with fewer reliable depth pixels are dropped."""
    relief: bool = True
    """Whether the depth's relief shapes the front."""


def reconstruct_objects(
    completed: CompletedObjects,
    masks: InstanceMasks,
    depth: MetricDepth,
    plate: BackgroundPlate,
    bodies: BodyTracks,
    config: ReconstructConfig,
    ctx: StageContext,
) -> ObjectMeshes:
    """Meshes in their own frames (+Y up, resting on y = 0, centered) with a first pose.

    Raises:
        StageError: there is no body (its camera lifts pixels into the world).
    """
    if not bodies.people:
        raise StageError("reconstruct: want at least one fitted body, got none; check stage humans")
    visible = {instance.object_id: instance.mask for instance in masks.instances}
    meshes = []
    for done, found in enumerate(completed.objects):
        mesh = _object_mesh(found, visible[found.object_id], depth, plate, bodies.people[0], config)
        if mesh is None:
            ctx.warn(f"reconstruct: object {found.object_id} has too little reliable depth and is dropped")
        else:
            meshes.append(mesh)
        ctx.progress(done + 1, len(completed.objects))
    ctx.quality("meshes", len(meshes), "objects")
    ctx.quality("dropped", len(completed.objects) - len(meshes), "objects", "lower")
    ctx.quality("most_faces", max((len(m.mesh.faces) for m in meshes), default=0), "faces")
    return ObjectMeshes(tuple(meshes))


def _object_mesh(
    found: CompletedObject,
    visible: Bool[np.ndarray, "height width"],
    depth: MetricDepth,
    plate: BackgroundPlate,
    body: BodyMotion,
    config: ReconstructConfig,
) -> ObjectMesh | None:
    from video2anim.geometry.prism_mesh import (
        cell_relief,
        front_plane,
        outline_cells,
        pixel_outline,
        prism_of_outline,
    )

    T_world_camera = body.T_world_camera[0]
    points_m = _visible_points(visible, depth, body)
    if len(points_m) < config.least_points:
        return None
    plane = front_plane(points_m, T_world_camera[:3, 3])
    rays = _mask_rays(found.amodal_mask, body)
    outline_m = pixel_outline(rays, T_world_camera[:3, 3], plane)
    if np.isfinite(outline_m).all(1).sum() < config.least_points:
        return None
    # A cell costs 4 triangles, and each of its rim edges 2 more.
    outline = outline_cells(outline_m, most_cells=max(config.most_faces // 6, 4))
    in_front = (points_m - plane.origin_world_m) @ plane.R_world_front
    width_m = float(outline.cells.any(0).sum() * outline.size_m[0])
    depth_range_m = float(np.ptp(np.percentile(in_front[:, 2], [5, 95])))
    seen_side = depth_range_m > 0.3 * width_m
    thickness_m = depth_range_m if seen_side else min(config.thickness_ratio * width_m, config.thickest_m)
    relief_m = cell_relief(outline, in_front[:, :2], in_front[:, 2]) if config.relief else None
    prism = prism_of_outline(outline, thickness_m, relief_m)
    rgb = _vertex_colors(prism, plane, found, plate, body)
    method = "extrusion, measured thickness" if seen_side else "extrusion, assumed thickness"
    return _in_own_frame(found, prism, plane, rgb, method)


def _visible_points(
    visible: Bool[np.ndarray, "height width"], depth: MetricDepth, body: BodyMotion
) -> Float[np.ndarray, "points 3"]:
    """Reliable plate depth of the object in the world, without the outline's border, where depths mix."""
    import cv2

    from video2anim.geometry.projection import backproject, transform_points

    height, width = depth.background_depth_m.shape
    share = cv2.resize(visible.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    inner = cv2.erode((share > 0.5).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    chosen = (inner if inner.sum() >= 30 else share > 0.5) & depth.background_valid
    points = backproject(depth.background_depth_m.astype(np.float64), body.intrinsics.resized(width, height))[chosen]
    return transform_points(body.T_world_camera[0], points)


def _mask_rays(mask: Bool[np.ndarray, "height width"], body: BodyMotion) -> Float[np.ndarray, "pixels 3"]:
    """World rays through the mask's pixels, thinned to about 40 000."""
    rows, columns = np.nonzero(mask)
    step = max(1, int(np.sqrt(len(rows) / 40_000)))
    kept = (rows % step == 0) & (columns % step == 0)
    k = body.intrinsics
    x, y = (columns[kept] - k.cx_px) / k.fx_px, (rows[kept] - k.cy_px) / k.fy_px
    return np.stack([x, y, np.ones(kept.sum())], -1) @ body.T_world_camera[0, :3, :3].T


def _vertex_colors(
    prism: Prism, plane: FrontPlane, found: CompletedObject, plate: BackgroundPlate, body: BodyMotion
) -> UInt8[np.ndarray, "vertices 3"]:
    """Colors of the completed picture under the front's vertices; the back has the front's."""
    import cv2

    from video2anim.geometry.projection import invert_rigid, project, transform_points

    front = prism.vertices_m[: len(prism.vertices_m) // 2]
    world_m = front @ plane.R_world_front.T + plane.origin_world_m
    camera_m = transform_points(invert_rigid(body.T_world_camera[0]), world_m)
    camera_m[:, 2] = np.maximum(camera_m[:, 2], 0.05)
    picture = plate.plate_rgb.copy()
    (x, y), (h, w) = found.crop_xy_px, found.image_rgb.shape[:2]
    crop_mask = found.amodal_mask[y : y + h, x : x + w]
    picture[y : y + h, x : x + w][crop_mask] = found.image_rgb[crop_mask]
    pixels = project(camera_m, body.intrinsics)
    # Colors right at the outline mix with the background.
    inner = cv2.erode(found.amodal_mask.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    trusted = inner if inner.any() else found.amodal_mask
    rows, columns = np.nonzero(trusted)
    # Vertices on the outline may fall just outside it: they take the nearest color inside its box.
    u = np.clip(np.round(pixels[:, 0]), columns.min(), columns.max()).astype(int)
    v = np.clip(np.round(pixels[:, 1]), rows.min(), rows.max()).astype(int)
    u, v = _pulled_inside(trusted, u, v)
    return np.concatenate([picture[v, u]] * 2)


def _pulled_inside(mask: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import KDTree

    outside = ~mask[v, u]
    if outside.any():
        inside = np.argwhere(mask)
        _, nearest = KDTree(inside).query(np.stack([v[outside], u[outside]], -1))
        v[outside], u[outside] = inside[nearest].T
    return u, v


def _in_own_frame(
    found: CompletedObject, prism: Prism, plane: FrontPlane, rgb: UInt8[np.ndarray, "vertices 3"], method: str
) -> ObjectMesh:
    low, high = prism.vertices_m.min(0), prism.vertices_m.max(0)
    base = np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
    T_world_object = np.eye(4)
    T_world_object[:3, :3] = plane.R_world_front
    center = plane.R_world_front @ np.array([base[0], 0.0, base[2]]) + plane.origin_world_m
    T_world_object[:3, 3] = (center[0], 0.0, center[2])
    mesh = Mesh((prism.vertices_m - base).astype(np.float32), prism.faces, rgb)
    return ObjectMesh(found.object_id, found.label, method, mesh, T_world_object)


STAGE = StageSpec("reconstruct", reconstruct_objects, version=1)
