"""Resting poses of objects that a hand takes or puts down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.projection import pixel_rays
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.geometry.scene_mesh import world_mesh
from video2anim.objects.hands import UP, HandPath
from video2anim.objects.placed import UNDER_M
from video2anim.types import InstanceMasks, PlacedObject, View

_HAND_SIGMA_M = 0.15
"""Standard deviation of a hand's distance from the camera."""
_FLOOR_SIGMA_M, TOP_SIGMA_M = 0.02, 0.06
"""Standard deviations of the heights of the floor and of objects' tops (`benchmarks/v2a_bench.py`)."""
_SAME_OBJECT = 0.3
"""Minimum share of the smaller outline inside the other for both to be of one object..."""
_LARGER = 3.0
"""...unless the known outline is larger by this factor: objects stand on tables."""
_ALIKE = 0.7
"""Maximum log ratio of the sizes of one object by two outlines: a factor of 2."""


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """An object at rest."""

    T_world_object: Float[np.ndarray, "4 4"]
    size_m: tuple[float, float, float]
    """Width, height and depth in its frame."""

    @classmethod
    def of(cls, item: PlacedObject) -> Rest:
        """Pose and size of an object of the scene."""
        width_m, height_m, depth_m = (item.scale * np.ptp(item.mesh.vertices_m.astype(float), axis=0)).tolist()
        return cls(item.T_world_object, (width_m, height_m, depth_m))

    @property
    def center_m(self) -> Float[np.ndarray, "3"]:
        """Of its box, in the world."""
        return self.T_world_object[:3, 3] + 0.5 * self.size_m[1] * self.T_world_object[:3, 1]

    def alike(self, other: Rest) -> bool:
        """Whether both may be the same object."""
        return bool(np.abs(np.log(np.divide(self.size_m, other.size_m))).max() < _ALIKE)


class SceneAtRest:
    """The static scene, in the images of a fixed camera."""

    def __init__(self, objects: Sequence[PlacedObject], masks: InstanceMasks, view: View) -> None:
        self.objects, self.view = {item.object_id: item for item in objects}, view
        size = (view.intrinsics.width_px, view.intrinsics.height_px)
        self._masks = {
            item.object_id: cv2.resize(item.mask.astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0
            for item in masks.instances
            if item.object_id in self.objects
        }
        self._solids = [world_mesh(item.mesh, item.T_world_object, item.scale) for item in objects]

    def known(self, outline: Bool[np.ndarray, "height width"]) -> PlacedObject | None:
        """The object of the background image to which an outline belongs."""
        best, found = _SAME_OBJECT, None
        for number, mask in self._masks.items():
            shared = (mask & outline).sum() / max(min(mask.sum(), outline.sum()), 1)
            if shared > best and mask.sum() < _LARGER * outline.sum():
                best, found = shared, self.objects[number]
        return found

    def rest(self, mask: Bool[np.ndarray, "height width"], hand: HandPath, frame: int) -> Rest:
        """A box for the object of a change, at the distance of the hand in that frame, on the surface below."""
        rows, columns = np.nonzero(mask)
        depth_m = float(hand.depth_m[frame])
        R, origin_m = self.view.T_world_camera[:3, :3], self.view.T_world_camera[:3, 3]
        lens = self.view.intrinsics
        across_m = (np.ptp(columns) + 1) * depth_m / lens.fx_px
        down_m = (np.ptp(rows) + 1) * depth_m / lens.fy_px
        # A box as deep as wide, seen from above by the camera's pitch, shows its front and its top.
        sine = float(np.clip(-R[1, 2], 0, 0.95))
        height_m = max((down_m - across_m * sine) / np.sqrt(1 - sine**2), 0.25 * across_m)
        low = R @ pixel_rays(lens)[rows.max(), round(columns.mean())]
        front_m = origin_m + depth_m * low
        support_m = self._support_m(front_m)
        if support_m is not None and low[1] < 0:
            # The intersection of ray and support is less certain at flat angles.
            sigma_m = _FLOOR_SIGMA_M if support_m == 0 else TOP_SIGMA_M
            weight = (low[1] * _HAND_SIGMA_M / sigma_m) ** 2
            front_m = origin_m + low * (depth_m + weight * (support_m - origin_m[1]) / low[1]) / (1 + weight)
            front_m[1] = support_m
            nearer = float((front_m - origin_m) @ R[:, 2]) / depth_m
            across_m, height_m = nearer * across_m, nearer * height_m
        ahead = np.array([R[0, 2], 0, R[2, 2]]) / np.hypot(R[0, 2], R[2, 2])
        T = np.eye(4)
        T[:3, :3] = matrix_from_axis_angle(np.arctan2(-ahead[0], -ahead[2]) * UP)
        T[:3, 3] = front_m + 0.5 * across_m * ahead
        return Rest(T, (float(across_m), float(height_m), float(across_m)))

    def lowered(self, rest: Rest) -> Rest:
        """The same object upright on the surface below."""
        T = np.eye(4)
        T[:3, :3] = matrix_from_axis_angle(np.arctan2(rest.T_world_object[0, 2], rest.T_world_object[2, 2]) * UP)
        T[:3, 3] = rest.T_world_object[:3, 3]
        support_m = self._support_m(T[:3, 3])
        T[1, 3] = T[1, 3] if support_m is None else support_m
        return Rest(T, rest.size_m)

    def _support_m(self, bottom_m: Float[np.ndarray, "3"]) -> float | None:
        """Height of the level surface nearest to the bottom of an object; None where none is near."""
        heights = [0.0]
        for solid in self._solids:
            corners = solid.vertices_m[solid.faces]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            level = normal[:, 1] > 0.9 * np.maximum(np.linalg.norm(normal, axis=-1), 1e-12)
            low, high = (
                corners[level][..., [0, 2]].min(1) - TOP_SIGMA_M,
                corners[level][..., [0, 2]].max(1) + TOP_SIGMA_M,
            )
            over = ((low <= bottom_m[[0, 2]]) & (bottom_m[[0, 2]] <= high)).all(1)
            heights += corners[level][over].mean(1)[:, 1].tolist()
        # Below the floor counts as on the floor.
        gap_m = np.abs(np.array(heights) - max(bottom_m[1], 0.0))
        return float(heights[int(gap_m.argmin())]) if gap_m.min() < UNDER_M else None
