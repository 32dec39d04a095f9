"""Scenes around evaluation windows: the same for a window whatever else is evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from scenemi.evaluation.windows import EvaluationWindow, KeyframeProtocol, give_keyframes, window_seed
from scenemi.metrics import CLOSE_PROXIMITY_M, INSIDE_M
from scenemi.prior import InterpolationPrior
from scenemi.scene.basis_points import anchor_vertices
from scenemi.scene.boxes import Boxes
from scenemi.scene.geometry import HalfSpace, SceneGeometry
from scenemi.scene.pseudo import SyntheticSceneConfig, SyntheticScenes
from video2anim.types.skeleton import forward_kinematics

SCENE_SEED = 20_251
"""Any number: another one makes other scenes, and numbers that do not compare with those published."""
EVALUATION_SCENES = SyntheticSceneConfig(empty_share=0.0)
"""Scenes of training, but never empty: a window without anything to hit tells nothing of collisions."""


@dataclass(frozen=True, slots=True, eq=False)
class Obstacles:
    """A random scene without its floor."""

    boxes: Boxes

    def signed_distance(self, points_m: Float[np.ndarray, "frames skin 3"]) -> Float[np.ndarray, "frames skin"]:
        """See `ObstacleField`; at most `CLOSE_PROXIMITY_M`."""
        distance_m = np.full(points_m.shape[:2], CLOSE_PROXIMITY_M)
        low_m, high_m = points_m.min(axis=1) - CLOSE_PROXIMITY_M, points_m.max(axis=1) + CLOSE_PROXIMITY_M
        for number in range(len(self.boxes)):
            center_m, half_m = self.boxes.center_m[number], self.boxes.half_m[number]
            # Bounds that hold for any turn about the vertical.
            across_m = float(np.hypot(half_m[0], half_m[2]))
            reach_m = np.array([across_m, half_m[1], across_m])
            near = ((center_m - reach_m < high_m) & (center_m + reach_m > low_m)).all(axis=1)
            if near.any():
                one = Boxes(center_m[None], half_m[None], self.boxes.yaw_rad[[number]])
                distance_m[near] = np.minimum(distance_m[near], one.signed_distance(points_m[near]))
        return distance_m


def with_synthetic_scenes(
    windows: Sequence[EvaluationWindow], *, seed: int = SCENE_SEED, config: SyntheticSceneConfig = EVALUATION_SCENES
) -> tuple[EvaluationWindow, ...]:
    """The windows, each in a scene in which its true motion could have happened, with solids where the interpolation of
    keyframes every 60 frames would go and the true body does not.

    Windows of clips on ground that was not captured get one too: they are few and keep the set whole.
    """
    scenes = SyntheticScenes(config)
    found = []
    for window in windows:
        joints_m, R_world_joint = forward_kinematics(
            window.R_parent_joint, window.translation_m, window.body.rest_joints_m
        )
        anchors_m = window.body.vertices(R_world_joint, joints_m, anchor_vertices(window.body))
        rng = np.random.default_rng(window_seed(window.name, seed))
        blind_m = blind_joints(window)
        named = scenes.solids(rng, joints_m, R_world_joint, anchors_m, window.contact, blind_m=blind_m)
        boxes = Boxes.joined(box for _, box in named)
        found.append(replace(window, obstacles=Obstacles(boxes), scene=SceneGeometry.of(boxes, HalfSpace(0.0))))
    return tuple(found)


def blind_joints(window: EvaluationWindow) -> Float[np.ndarray, "frames 22 3"]:
    """Joints of the interpolation that sees no scene."""
    filled = InterpolationPrior().fill(give_keyframes(window, KeyframeProtocol()).keyframes)
    joints_m, _ = forward_kinematics(filled.R_parent_joint, filled.translation_world_m, window.body.rest_joints_m)
    return joints_m


def telling_share(windows: Sequence[EvaluationWindow]) -> float:
    """Share of the windows with solids in which that interpolation has a joint more than 1 cm inside."""
    inside = [
        float(window.obstacles.signed_distance(blind_joints(window)).min()) < -INSIDE_M
        for window in windows
        if window.obstacles is not None
    ]
    return float(np.mean(inside)) if inside else float("nan")
