"""Evaluation groups of bodies in scenes (collisions, floating), and `space`: the estimated scene against the true
one."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from scenemi import metrics
from video2anim.body.anny_body import shaped_body
from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.geometry.sdf import SdfGrid, sample_sdf
from video2anim.lab.eval.model import Curve, Group, make_group
from video2anim.lab.eval.motion_rows import CommonFrames
from video2anim.lab.eval.truth import Truth
from video2anim.lab.synth.world import NEAR_M
from video2anim.types import BodyMotion, SceneModel
from video2anim.types.quality import Quality
from video2anim.types.skeleton import forward_kinematics

VERTEX_STRIDE = 8
"""Every 8th vertex of the body is tested."""
BODY_GROUPS = {
    "true_scene": "Body in the true scene, by the shared camera",
    "true_scene_laid": "Body in the true scene, laid along the true path on its own floor",
    "own_scene": "Body in the estimated scene",
}
BODY_IN_SCENE = (
    Quality("collision_frames", math.nan, "ratio", "lower"),
    Quality("collision_frames_1cm", math.nan, "ratio", "lower"),
    Quality("collision_vertices", math.nan, "ratio", "lower"),
    Quality("penetration_max", math.nan, "m", "lower"),
    Quality("floating", math.nan, "m", "lower"),
)
SPACE = (
    Quality("occupancy_iou", math.nan, "ratio", "higher"),
    Quality("occupied_recall", math.nan, "ratio", "higher"),
    Quality("occupied_precision", math.nan, "ratio", "higher"),
    Quality("free_recall", math.nan, "ratio", "higher"),
    Quality("sdf_error", math.nan, "m", "lower"),
)
_UNDEFINED = {
    **dict.fromkeys(("occupancy_iou", "occupied_recall"), "nothing stands near the path and in the image"),
    "occupied_precision": "nothing solid was estimated there",
    "free_recall": "no free space in the image",
    "sdf_error": "no point in the image",
}
STEP_M = 0.1
"""Grid on which the scenes are compared."""
REACH_M = 1.5
"""Largest horizontal distance from a true pelvis of points that count as near the path."""
HEIGHTS_M = (0.12, 2.0)
"""Range of heights above the floor; it avoids round heights, at which boards often lie."""
SDF_CAP_M = 0.5
"""Signed distances are clipped to this, since differences far from surfaces do not matter."""
_CAMERA_STEP_FRAMES = 15


def body_points(motion: BodyMotion, rows: np.ndarray) -> Float[np.ndarray, "rows chosen 3"]:
    """Every 8th vertex of the body in some frames, in the world frame of the motion."""
    body = shaped_body(motion.shape)
    joints_m, R_world_joint = forward_kinematics(
        motion.R_parent_joint[rows], motion.T_world_root[rows, :3, 3], motion.rest_joints_m
    )
    return body.vertices(R_world_joint, joints_m, np.arange(0, len(body.rest_vertices_m), VERTEX_STRIDE))


class BodyInScenes:
    """One person after every stage, against the true and the estimated scene."""

    def __init__(
        self,
        stages: Mapping[str, BodyMotion | str],
        truth: BodyMotion,
        common: CommonFrames,
        T_true_estimate: Float[np.ndarray, "4 4"],
        true_field: SdfGrid,
        scene: SceneModel | str,
    ) -> None:
        rows = common.span
        true_rows = common.true_index[rows]
        self._time_s = truth.frame_time_s[true_rows]
        self._distances: dict[str, dict[str, np.ndarray | str]] = {key: {} for key in BODY_GROUPS}
        for name, motion in stages.items():
            if isinstance(motion, str) or not len(rows):
                why = motion if isinstance(motion, str) else "no common frame"
                for distances in self._distances.values():
                    distances[name] = why
                continue
            points_m = body_points(motion, rows).astype(np.float64)
            T_laid = aligned_on_floor(
                motion.joints_world_m[rows, metrics.ROOT], truth.joints_world_m[true_rows, metrics.ROOT]
            )
            self._distances["true_scene"][name] = true_field.sample(transform_points(T_true_estimate, points_m))
            self._distances["true_scene_laid"][name] = true_field.sample(transform_points(T_laid, points_m))
            self._distances["own_scene"][name] = scene if isinstance(scene, str) else _sampled(scene, points_m)
        self._truth = true_field.sample(body_points(truth, true_rows).astype(np.float64)) if len(rows) else None

    def groups(self, person_id: int) -> tuple[Group, ...]:
        """The body in the true scene (aligned in two ways) and in the estimated one."""
        true = None if self._truth is None else _collisions(self._truth)
        return tuple(
            make_group(
                key,
                title,
                BODY_IN_SCENE,
                _columns(self._distances[key]),
                truth=None if key == "own_scene" else true,
                person_id=person_id,
            )
            for key, title in BODY_GROUPS.items()
        )

    def curves(self) -> tuple[Curve, ...]:
        """Signed distance of the nearest (or deepest) vertex to the true scene over time."""
        if self._truth is None:
            return ()
        distances = {"truth": self._truth} | self._distances["true_scene"]
        series = {
            name: tuple(round(float(x), 5) for x in value.min(1))
            for name, value in distances.items()
            if not isinstance(value, str)
        }
        time_s = tuple(float(t) for t in self._time_s)
        return (Curve("Distance of the body to the true scene", "m", time_s, series),)


def aligned_on_floor(
    path_m: Float[np.ndarray, "frames 3"], true_path_m: Float[np.ndarray, "frames 3"]
) -> Float[np.ndarray, "4 4"]:
    """Rotation about +Y and horizontal shift (4, 4) that best align a path with the true one; heights stay."""
    estimated_m, true_m = (p[:, metrics.HORIZONTAL] - p[:, metrics.HORIZONTAL].mean(0) for p in (path_m, true_path_m))
    # Angle from z to x, which is the sense of a rotation about +Y.
    yaw = np.arctan2(
        (estimated_m[:, 1] * true_m[:, 0] - estimated_m[:, 0] * true_m[:, 1]).sum(), (estimated_m * true_m).sum()
    )
    T = np.eye(4)
    T[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    offset_m = true_path_m.mean(0) - T[:3, :3] @ path_m.mean(0)
    T[metrics.HORIZONTAL, 3] = offset_m[metrics.HORIZONTAL]
    return T


def _sampled(scene: SceneModel, points_m: np.ndarray) -> np.ndarray:
    return sample_sdf(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m, points_m)


def _columns(distances: Mapping[str, np.ndarray | str]) -> dict[str, dict[str, float] | str]:
    return {name: value if isinstance(value, str) else _collisions(value) for name, value in distances.items()}


def _collisions(distance_m: Float[np.ndarray, "frames vertices"]) -> dict[str, float]:
    none_m, centimeter_m = metrics.COLLISION_TAUS_M
    return {
        "collision_frames": metrics.collision_frame_ratio(distance_m, none_m),
        "collision_frames_1cm": metrics.collision_frame_ratio(distance_m, centimeter_m),
        "collision_vertices": metrics.collision_vertex_ratio(distance_m, none_m),
        "penetration_max": metrics.penetration_max_m(distance_m),
        "floating": metrics.floating_m(distance_m),
    }


def space_group(
    scene: SceneModel | str, truth: Truth, true_field: SdfGrid, T_true_estimate: Float[np.ndarray, "4 4"] | str
) -> Group:
    """Occupancy and signed distance of the two scenes, at points near the path that are in the picture."""
    if isinstance(scene, str) or isinstance(T_true_estimate, str):
        why = scene if isinstance(scene, str) else str(T_true_estimate)
        return make_group("space", "Scene near the path", SPACE, {"value": why})
    points_m = space_points(truth)
    true_m = true_field.sample(points_m)
    own_m = _sampled(scene, transform_points(invert_rigid(T_true_estimate), points_m))
    numbers = space_numbers(own_m, true_m)
    note = f"{len(points_m)} points, {int((true_m < 0).sum())} of them in true solids."
    return make_group("space", "Scene near the path", SPACE, {"value": numbers}, undefined=_UNDEFINED, note=note)


def space_numbers(own_m: Float[np.ndarray, "points"], true_m: Float[np.ndarray, "points"]) -> dict[str, float]:
    """Agreement of two signed distance fields at the same points."""
    own, true = own_m < 0, true_m < 0
    scores = metrics.binary_scores(own, true)
    either = int((own | true).sum())
    error_m = np.abs(np.clip(own_m, -SDF_CAP_M, SDF_CAP_M) - np.clip(true_m, -SDF_CAP_M, SDF_CAP_M))
    return {
        "occupancy_iou": int((own & true).sum()) / either if either else np.nan,
        "occupied_recall": scores.recall,
        "occupied_precision": scores.precision,
        "free_recall": metrics.binary_scores(~own, ~true).recall,
        "sdf_error": float(error_m.mean()) if len(error_m) else np.nan,
    }


def space_points(truth: Truth) -> Float[np.ndarray, "points 3"]:
    """Grid points (true world) near a true pelvis, inside the room, that are in the picture of some frame."""
    pelvis_m = np.concatenate([person.joints_world_m[:, metrics.ROOT] for person in truth.people])[:, [0, 2]]
    low, high = pelvis_m.min(0) - REACH_M, pelvis_m.max(0) + REACH_M
    low, high = np.maximum(low, truth.room_bounds_m[0::2]), np.minimum(high, truth.room_bounds_m[1::2])
    axes = [np.arange(low[0], high[0], STEP_M), np.arange(*HEIGHTS_M, STEP_M), np.arange(low[1], high[1], STEP_M)]
    grid_m = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    gap_m = np.full(len(grid_m), np.inf)
    for place in np.unique(np.round(pelvis_m / STEP_M), axis=0) * STEP_M:
        gap_m = np.minimum(gap_m, np.linalg.norm(grid_m[:, [0, 2]] - place, axis=-1))
    grid_m = grid_m[gap_m <= REACH_M]
    seen = np.zeros(len(grid_m), bool)
    step = len(truth.frame_time_s) if truth.is_static else _CAMERA_STEP_FRAMES
    lens = truth.intrinsics
    for T_world_camera in truth.main.T_world_camera[::step]:
        camera_m = transform_points(invert_rigid(T_world_camera), grid_m)
        ahead = camera_m[:, 2] > NEAR_M
        camera_m[~ahead] = (0.0, 0.0, 1.0)
        pixel = project(camera_m, lens)
        seen |= ahead & (pixel > -0.5).all(-1) & (pixel < [lens.width_px - 0.5, lens.height_px - 0.5]).all(-1)
    return grid_m[seen]
