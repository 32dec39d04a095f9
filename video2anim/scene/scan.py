"""A scan of the room by the user: pose, registration to the video's depth, and distance field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from video2anim.geometry.projection import backproject, transform_points
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.geometry.sampling import surface_samples
from video2anim.geometry.sdf import SdfGrid
from video2anim.scene.field import field_bounds, field_spacing
from video2anim.types.metric import MetricDepth
from video2anim.types.scene import Mesh

_SAMPLE_M = 0.04
_NEAREST = 8
"""Surface samples that vote on the sign of a point."""
_MAX_SAMPLES = 400_000
_POINTS = 3000
_ROUNDS = 150
_CELL_M = 0.1
"""One point is drawn per cell of this size, so that near surfaces do not dominate."""
_KEPT = 0.85
"""Share of the points with the smallest distances that are used: people and moved objects are not in the scan."""
_TURNED = np.linalg.qr(np.array([[0.6, -0.5, 0.62], [0.7, 0.7, -0.1], [-0.38, 0.5, 0.78]]))[0]
"""Rotation of the points in k-d trees, which are slow where many points share a coordinate, as on walls."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Pose of a scan in the video's world."""

    T_world_scan: Float[np.ndarray, "4 4"]
    before_m: float
    """Mean distance of the video's points to the scan, the farthest 15 % left out; before and after."""
    after_m: float


def scan_pose(up: Literal["y", "z"], yaw_deg: float, shift_m: Sequence[float]) -> Float[np.ndarray, "4 4"]:
    """T_world_scan by the scan's upward axis, a rotation about the vertical, and a translation after it."""
    T_world_scan = np.eye(4)
    T_world_scan[:3, :3] = matrix_from_axis_angle(np.array([0.0, np.deg2rad(yaw_deg), 0.0]))
    if up == "z":
        T_world_scan[:3, :3] = T_world_scan[:3, :3] @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    T_world_scan[:3, 3] = shift_m
    return T_world_scan


def moved_mesh(mesh: Mesh, T: Float[np.ndarray, "4 4"]) -> Mesh:
    """The mesh with its vertices transformed."""
    return replace(mesh, vertices_m=transform_points(T, mesh.vertices_m))


def visible_points(depth: MetricDepth, far_m: float) -> Float[np.ndarray, "points 3"]:
    """World points of the background image's valid depth up to a distance."""
    height, width = depth.background_depth_m.shape
    view = depth.bodies.main_view.resized(width, height)
    known = depth.background_valid & (depth.background_depth_m < far_m)
    camera_m = backproject(depth.background_depth_m.astype(np.float64), view.intrinsics)[known]
    return transform_points(view.T_world_camera, camera_m)


def registered(scan: Mesh, points_world_m: Float[np.ndarray, "points 3"], rng: np.random.Generator) -> Registration:
    """Yaw and horizontal shift, with a small lift, that bring the scan to points of the video (trimmed ICP, Chetverikov
    et al. 2005). The scan must be roughly in place: within about a meter and 30 degrees.

    Raises:
        ValueError: no points or no faces.
    """
    if not len(points_world_m) or not len(scan.faces):
        raise ValueError(f"registered: want points and faces, got {len(points_world_m)} and {len(scan.faces)}")
    samples_m, _ = _samples(scan)
    tree = KDTree(samples_m @ _TURNED)
    points_m = points_world_m[rng.permutation(len(points_world_m))]
    _, first = np.unique(np.floor(points_m / _CELL_M).astype(int), axis=0, return_index=True)
    points_m = points_m[rng.permutation(first)[:_POINTS]]
    before_m = _trimmed_mean(np.asarray(tree.query(points_m @ _TURNED)[0]))
    best, best_cost = np.eye(4), np.inf
    for turn in np.deg2rad([0.0, -20.0, 20.0]):
        # Points of the video are moved to the scan; the pose of the scan is the inverse.
        T_scan_world = _about(_turned(turn), points_m.mean(0))
        cost = np.inf
        for _ in range(_ROUNDS):
            moved = transform_points(T_scan_world, points_m)
            gap_m, nearest = (np.asarray(found) for found in tree.query(moved @ _TURNED))
            kept = gap_m <= np.quantile(gap_m, _KEPT)
            reached = _trimmed_mean(gap_m)
            if reached < best_cost:
                best, best_cost = T_scan_world, reached
            if cost - reached < 1e-6:
                break
            cost = reached
            T_scan_world = _rigid_upright(moved[kept], samples_m[nearest[kept]]) @ T_scan_world
    if best_cost >= before_m:
        return Registration(np.eye(4), before_m, before_m)
    return Registration(np.linalg.inv(best), before_m, best_cost)


def _trimmed_mean(gap_m: np.ndarray) -> float:
    return float(gap_m[gap_m <= np.quantile(gap_m, _KEPT)].mean())


def _turned(yaw_rad: float) -> np.ndarray:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])


def _about(T: np.ndarray, place: np.ndarray) -> np.ndarray:
    there, back = np.eye(4), np.eye(4)
    there[:3, 3], back[:3, 3] = place, -place
    return there @ T @ back


def _rigid_upright(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Yaw and shift of least squares that bring source points to target points."""
    a, b = source.mean(0), target.mean(0)
    p, q = source - a, target - b
    yaw = np.arctan2((p[:, 2] * q[:, 0] - p[:, 0] * q[:, 2]).sum(), (p[:, 0] * q[:, 0] + p[:, 2] * q[:, 2]).sum())
    T = _turned(float(yaw))
    T[:3, 3] = b - T[:3, :3] @ a
    return T


def field_around(
    scan: Mesh, motion_m: Float[np.ndarray, "2 3"], margin_m: float, spacing_m: float, max_nodes: int
) -> SdfGrid:
    """`scan_field` around the lowest and highest corner of the motion, with at most so many nodes."""
    bounds_m = field_bounds(motion_m, (), margin_m, 0.0)
    return scan_field(scan, bounds_m, field_spacing(bounds_m, spacing_m, max_nodes))


def scan_field(scan: Mesh, bounds_m: Float[np.ndarray, "2 3"], spacing_m: float, floor_y_m: float = 0.0) -> SdfGrid:
    """Signed distance to an open surface whose triangles face the free side, and to the floor.

    The side is that on which most of the nearest samples' normals see a node; distance is to samples 4 cm apart, so it
    is too large by at most 2 cm on the surface and by less off it.
    """
    low_m, high_m = np.asarray(bounds_m, np.float64)
    shape = np.ceil((high_m - low_m) / spacing_m - 1e-9).astype(int) + 1
    axes = [low_m[a] + spacing_m * np.arange(shape[a]) for a in range(3)]
    nodes_m = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    samples_m, normals = _samples(scan)
    tree = KDTree(samples_m @ _TURNED, leafsize=32)
    gap_m, nearest = tree.query(nodes_m @ _TURNED, k=min(_NEAREST, len(samples_m)), workers=-1)
    gap_m, nearest = gap_m.reshape(len(nodes_m), -1), nearest.reshape(len(nodes_m), -1)
    away = nodes_m[:, None] - samples_m[nearest]
    above = np.einsum("nkd,nkd->nk", away, normals[nearest])
    weight = 1.0 / np.maximum(gap_m, 1e-3)
    side = np.sign((np.sign(above) * weight).sum(1))
    signed = np.where(side < 0, -gap_m[:, 0], gap_m[:, 0])
    return SdfGrid(
        np.minimum(signed, nodes_m[:, 1] - floor_y_m).reshape(tuple(shape)).astype(np.float32), low_m, spacing_m
    )


def _samples(scan: Mesh) -> tuple[Float[np.ndarray, "samples 3"], Float[np.ndarray, "samples 3"]]:
    """Points on the surface and the normals of their triangles."""
    triangles_m = scan.vertices_m.astype(np.float64)[scan.faces]
    normal = np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])
    area = np.linalg.norm(normal, axis=-1)
    triangles_m, normal, area = (
        triangles_m[area > 0],
        normal[area > 0],
        area[area > 0],
    )  # samples of degenerate ones never end
    step_m = max(_SAMPLE_M, float(np.sqrt(0.5 * area.sum() / _MAX_SAMPLES)))
    samples_m, owner = surface_samples(triangles_m, step_m)
    return samples_m, (normal / np.maximum(area, 1e-12)[:, None])[owner]
