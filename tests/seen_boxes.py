"""Upright boxes and closed meshes on a floor as one pinhole camera sees them: exact depth, normals, and what a pixel
shows."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh

from video2anim.geometry.heading import EdgeHeadings
from video2anim.geometry.projection import pixel_rays, project
from video2anim.objects.upright_box import UprightBox
from video2anim.types.camera import Intrinsics, View

LENS = Intrinsics.centered(300.0, 320, 240)
FLOOR = -1
SKY = -2
DRAWN_PX = (960, 720)
"""Size of drawings."""


def about_y(angle_rad: float) -> np.ndarray:
    """Turn that takes +z to (sin, 0, cos)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


@dataclass(frozen=True)
class Block:
    """A box that is turned about +y."""

    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    yaw_rad: float = 0.0

    @property
    def R_world_block(self) -> np.ndarray:
        return about_y(self.yaw_rad)

    def holds(self, points_world_m: np.ndarray, margin_m: float = 0.0) -> np.ndarray:
        """Points inside the block, grown by the margin."""
        own_m = (points_world_m - self.center_m) @ self.R_world_block
        return np.all(np.abs(own_m) <= 0.5 * np.array(self.size_m) + margin_m, axis=-1)

    def turned(self, angle_rad: float) -> Block:
        """The block after the whole room turned about the world's +y."""
        x, y, z = about_y(angle_rad) @ self.center_m
        return Block((x, y, z), self.size_m, self.yaw_rad + angle_rad)


@dataclass(frozen=True, eq=False)
class Piece:
    """A closed mesh."""

    mesh: trimesh.Trimesh

    @property
    def center_m(self) -> np.ndarray:
        return np.asarray(self.mesh.bounds.mean(0))


@dataclass(frozen=True, eq=False)
class Shot:
    """What the camera sees. Depth of the sky is 0."""

    depth_m: np.ndarray
    shown: np.ndarray
    """Number of the block in each pixel, or FLOOR or SKY."""
    world_m: np.ndarray
    normal: np.ndarray
    T_world_camera: np.ndarray

    def mask(self, *numbers: int) -> np.ndarray:
        return np.isin(self.shown, numbers)


def looking(eye_m: tuple[float, float, float], target_m: tuple[float, float, float]) -> np.ndarray:
    """T_world_camera of a camera without roll."""
    forward = np.subtract(target_m, eye_m)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
    T_world_camera[:3, 3] = eye_m
    return T_world_camera


def shoot(blocks: Sequence[Block | Piece], T_world_camera: np.ndarray) -> Shot:
    """Rays through all pixels meet blocks and the floor y = 0."""
    ray = pixel_rays(LENS) @ T_world_camera[:3, :3].T
    eye_m = T_world_camera[:3, 3]
    with np.errstate(divide="ignore"):
        depth_m = np.where(ray[..., 1] < -1e-9, -eye_m[1] / ray[..., 1], np.inf)
    shown = np.where(np.isfinite(depth_m), FLOOR, SKY)
    normal = np.tile([0.0, 1.0, 0.0], (*shown.shape, 1))
    for number, block in enumerate(blocks):
        if isinstance(block, Piece):
            near, side = _first_face(block.mesh, eye_m, ray)
            hit = near < depth_m
            depth_m, shown = np.where(hit, near, depth_m), np.where(hit, number, shown)
            normal = np.where(hit[..., None], side, normal)
            continue
        R = block.R_world_block
        start, along = (eye_m - block.center_m) @ R, ray @ R
        along = np.where(np.abs(along) < 1e-12, 1e-12, along)
        half = 0.5 * np.array(block.size_m)
        enter = np.minimum((-half - start) / along, (half - start) / along)
        leave = np.maximum((-half - start) / along, (half - start) / along).min(-1)
        axis, near = enter.argmax(-1), enter.max(-1)
        hit = (near > 0) & (near < leave) & (near < depth_m)
        depth_m, shown = np.where(hit, near, depth_m), np.where(hit, number, shown)
        side = -np.sign(np.take_along_axis(along, axis[..., None], -1)) * np.eye(3)[axis] @ R.T
        normal = np.where(hit[..., None], side, normal)
    depth_m = np.where(shown == SKY, 0.0, depth_m)
    return Shot(depth_m, shown, eye_m + ray * depth_m[..., None], normal, T_world_camera)


def _first_face(mesh: trimesh.Trimesh, eye_m: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays first meet a face (in their lengths), and its normal (Moeller and Trumbore 1997)."""
    nearest, normal = np.full(ray.shape[:-1], np.inf), np.zeros(ray.shape)
    # Only rays that meet the sphere around the mesh.
    middle = mesh.bounds.mean(0) - eye_m
    beside = np.linalg.norm(np.cross(ray, middle), axis=-1) / np.linalg.norm(ray, axis=-1)
    rows, columns = np.nonzero(beside < np.linalg.norm(mesh.vertices - mesh.bounds.mean(0), axis=-1).max())
    some = ray[rows, columns]
    for (a, b, c), side in zip(mesh.triangles, mesh.face_normals, strict=True):
        across = np.cross(some, c - a)
        volume = across @ (b - a)
        volume = np.where(np.abs(volume) < 1e-12, np.inf, volume)
        u = across @ (eye_m - a) / volume
        other = np.cross(eye_m - a, b - a)
        v, at = some @ other / volume, (c - a) @ other / volume
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (at > 0) & (at < nearest[rows, columns])
        nearest[rows[hit], columns[hit]], normal[rows[hit], columns[hit]] = at[hit], side
    return nearest, normal


def yaw_error_rad(box: UprightBox, yaw_rad: float) -> float:
    """Difference of the yaws modulo a quarter turn, at most 45 degrees."""
    yaw = np.arctan2(box.R_world_box[0, 2], box.R_world_box[2, 2])
    return float(abs((yaw - yaw_rad + np.pi / 4) % (np.pi / 2) - np.pi / 4))


def size_along(box: UprightBox, block: Block) -> np.ndarray:
    """The box's size in the order of the block's axes, to which it is nearly parallel."""
    return np.round(np.abs(block.R_world_block.T @ box.R_world_box)) @ box.size_m


def middle_world_m(box: UprightBox) -> np.ndarray:
    return box.R_world_box @ box.center_m


def table(width_m: float, height_m: float, depth_m: float, at_m: tuple[float, float], yaw_rad: float) -> list[Block]:
    """A top 6 cm thick and four legs 6 cm wide at its corners."""
    thick_m = 0.06
    top = Block((at_m[0], height_m - 0.5 * thick_m, at_m[1]), (width_m, thick_m, depth_m), yaw_rad)
    blocks = [top]
    for side, end in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        foot = np.array([side * 0.5 * (width_m - thick_m), 0.0, end * 0.5 * (depth_m - thick_m)])
        x, _, z = top.R_world_block @ foot
        center_m = (at_m[0] + x, 0.5 * (height_m - thick_m), at_m[1] + z)
        blocks.append(Block(center_m, (thick_m, height_m - thick_m, thick_m), yaw_rad))
    return blocks


def drawn(lines_m: Sequence[np.ndarray], T_world_camera: np.ndarray) -> EdgeHeadings:
    """Headings of a picture of lines through points of the world."""
    picture, view = np.full((DRAWN_PX[1], DRAWN_PX[0], 3), 128, np.uint8), View(T_world_camera, LENS.resized(*DRAWN_PX))
    for line_m in lines_m:
        at_px = project((line_m - T_world_camera[:3, 3]) @ T_world_camera[:3, :3], view.intrinsics)
        cv2.polylines(picture, [np.round(16 * at_px).astype(np.int32)], False, (40, 40, 40), 2, cv2.LINE_AA, 4)
    return EdgeHeadings(picture, view)


def edges_of(block: Block) -> list[np.ndarray]:
    """All twelve."""
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    corners_m = block.center_m + (signs * block.size_m) @ block.R_world_block.T
    pairs = [(a, b) for a, b in itertools.combinations(range(8), 2) if (signs[a] != signs[b]).sum() == 1]
    return [corners_m[list(pair)] for pair in pairs]
