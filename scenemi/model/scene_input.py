"""What a denoiser is told of a window's body, and the paper's of its surroundings: voxels and anchor offsets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scenemi.data.adults import adult_with
from scenemi.features import body_lengths, lengths_of_skeleton
from scenemi.model.config import PaperConfig
from scenemi.prior import KeyframeWindow
from scenemi.scene.basis_points import anchor_vertices, bps
from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.voxels import GridSpec, occupancy
from video2anim.body.shaped_body import ShapedBody
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics


@dataclass(frozen=True, slots=True, eq=False)
class SceneInput:
    """The scene of one window, in its canonical frame."""

    occupancy: Bool[np.ndarray, "x y z"] | None
    """None = no scene known."""
    local_m: Float[np.ndarray, "frames anchors 3"]
    """Anchor to nearest solid point at keyframes; zero elsewhere and without a scene."""


class SceneReader:
    """Makes `SceneInput`s; keeps the last scene's search structure, since windows of a motion share their scene."""

    def __init__(self) -> None:
        self._scene: SdfGrid | None = None
        self._geometry: SceneGeometry | None = None

    def read(
        self, window: KeyframeWindow, T_world_canonical: Float[np.ndarray, "4 4"], config: PaperConfig
    ) -> SceneInput:
        """Occupancy and local offsets of a window."""
        body = window.body or adult_like(window.rest_joints_m)
        local_m = np.zeros((len(window.is_keyframe), config.bps_anchors, 3), np.float32)
        geometry = self.geometry(window)
        if geometry is None:
            return SceneInput(None, local_m)
        keys = window.is_keyframe
        joints_m, R_world_joint = forward_kinematics(
            window.R_parent_joint[keys], window.translation_world_m[keys], window.rest_joints_m
        )
        anchors_m = body.vertices(R_world_joint, joints_m, anchor_vertices(body, config.bps_anchors))
        local_m[keys] = bps(geometry, anchors_m.astype(np.float64), T_world_canonical[:3, :3])
        voxels = occupancy(geometry, T_world_canonical, GridSpec(config.grid, config.voxel_m))
        return SceneInput(voxels, local_m)

    def geometry(self, window: KeyframeWindow) -> SceneGeometry | None:
        """The window's scene as something to find nearest points of."""
        if window.scene is None or isinstance(window.scene, SceneGeometry):
            return window.scene
        if self._geometry is None or self._scene is not window.scene:
            self._scene, self._geometry = window.scene, SceneGeometry.from_sdf(window.scene)
        return self._geometry


def lengths_of(window: KeyframeWindow) -> Float[np.ndarray, "7"]:
    """Body lengths of a window (m): of its body, else of its skeleton and an adult as tall."""
    lengths_m = body_lengths(window.body or adult_like(window.rest_joints_m))
    if window.body is None:
        lengths_m[:5] = lengths_of_skeleton(window.rest_joints_m)
    return lengths_m


def adult_like(rest_joints_m: Float[np.ndarray, "22 3"]) -> ShapedBody:
    """The average adult build whose skeleton is about as tall as this one."""
    return adult_with(_span_m, _span_m(rest_joints_m))


def _span_m(rest_joints_m: Float[np.ndarray, "22 3"]) -> float:
    """Head joint above the ball of the foot."""
    return float(rest_joints_m[JOINT_INDEX["head"], 1] - rest_joints_m[JOINT_INDEX["left_foot"], 1])
