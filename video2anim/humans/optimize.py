"""The body fit: initial values, optimization, result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import median_filter

from video2anim.body.anny_body import PEOPLES_LENGTHS, RestSkeleton, anny_model, height_phenotype
from video2anim.errors import StageError
from video2anim.geometry.rotations import axis_angle_from_matrix, rot6d_from_matrix
from video2anim.geometry.torch_threads import one_thread
from video2anim.humans.landmarks import with_landmarks
from video2anim.humans.lifter_input import LiftedBody
from video2anim.humans.objective import PERSON, SHAPE_PARAMETERS, FitConfig, Objective, Parameters
from video2anim.humans.problem import FittedBody, Observations
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import forward_kinematics

_USUAL_FRAMES = 31
"""Distances of the start are medians over so many frames: within half a second few people come much nearer.
Not measured."""
_MIN_WEIGHT = 0.05
"""Of landmarks that are not seen, as in the lifter's input: where nothing is seen, their guess is all there is."""
_MIN_DEPTH_M = 0.1
"""Nobody is nearer to the camera."""


@one_thread()
def fit_body(
    observed: Observations,
    lifted: LiftedBody,
    *,
    fit_shape: bool = True,
    shape: dict[str, float] | None = None,
    config: FitConfig | None = None,
    iterations: int = 250,
    on_step: Callable[[int, int], None] | None = None,
) -> FittedBody:
    """Fit rotations, translation and shape to landmarks over time.

    Args:
        observed: landmarks; with the intrinsics of the camera.
        lifted: output of the lifter for the same frames, as initial values and as evidence.
        fit_shape: treat the shape as unknown; else it stays `shape`.
        shape: Anny parameters to start from (default: `PERSON`, at the height of `config` if that is known).

    Raises:
        StageError: fewer than one valid frame.
    """
    if not observed.valid.any():
        raise StageError("body fit: want at least one frame with landmarks, got none")
    base = dict.fromkeys(PEOPLES_LENGTHS, 0.0) | shape if shape else dict(PERSON)
    config = config or FitConfig()
    if not shape and config.body_height_m != FitConfig.body_height_m:
        base["height"] = height_phenotype(base, config.body_height_m)
    objective = Objective(observed, anny_model(), base, config, lifted)
    parameters = _start(observed, lifted, objective.start_rest)
    leaves = [parameters.root_rot6d, parameters.angles_rad, parameters.translation_m]
    rates = [0.02, 0.02, 0.02]
    if fit_shape:
        leaves.append(parameters.shape_offset)
        rates.append(0.01)
    for leaf in leaves:
        leaf.requires_grad_(True)
    groups = [{"params": [leaf], "lr": rate} for leaf, rate in zip(leaves, rates, strict=True)]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.98))
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, max_lr=[2 * r for r in rates], total_steps=iterations, pct_start=0.15, cycle_momentum=False
    )
    for step in range(iterations):
        optimizer.zero_grad()
        cost = objective.cost(parameters)
        cost.backward()
        optimizer.step()
        schedule.step()
        if on_step is not None:
            on_step(step + 1, iterations)
    return _finish(objective, parameters, base)


def reposed(
    observed: Observations,
    fit: FittedBody,
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"],
    translation_camera_m: Float[np.ndarray, "frames 3"],
) -> FittedBody:
    """The fitted body in other poses, with their joints and reprojection errors."""
    joints_m, R = forward_kinematics(R_parent_joint, translation_camera_m, fit.rest_joints_m)
    with torch.no_grad():
        shape = {k: torch.tensor(float(v)) for k, v in fit.shape.parameters.items()}
        rest = with_landmarks(anny_model().rest_skeleton(shape))
        points_m = rest.keypoints_m(torch.from_numpy(joints_m).float(), torch.from_numpy(R).float()).numpy()
    k = observed.intrinsics
    shown_px = k.fx_px * points_m[..., :2] / np.maximum(points_m[..., 2:], 0.1) + (k.cx_px, k.cy_px)
    error_px = np.linalg.norm(shown_px - observed.keypoints_px, axis=-1)
    return replace(
        fit, R_parent_joint=R_parent_joint, translation_camera_m=translation_camera_m, joints_camera_m=joints_m,
        reprojection_px=np.where(observed.weight > 0, error_px, np.nan),
    )  # fmt: skip


def _start(observed: Observations, lifted: LiftedBody, rest: RestSkeleton) -> Parameters:
    """The poses of the lifter, where their landmarks meet those of the image; frames without a person are as the
    nearest one with."""
    valid = np.flatnonzero(observed.valid)
    nearest = valid[np.abs(np.arange(len(observed.valid))[:, None] - valid[None]).argmin(1)]
    R = lifted.R_parent_joint[nearest]
    joints_m, R_joint = forward_kinematics(_leaf(R), torch.zeros(len(R), 3), rest.rest_joints_m)
    points_m = rest.keypoints_m(joints_m, R_joint).numpy().astype(np.float64)
    translation_m = _meeting_m(observed, points_m, nearest)
    return Parameters(
        _leaf(rot6d_from_matrix(R[:, 0])), _leaf(axis_angle_from_matrix(R[:, 1:])), _leaf(translation_m),
        torch.zeros(len(SHAPE_PARAMETERS)),
    )  # fmt: skip


def _meeting_m(
    observed: Observations, points_m: Float[np.ndarray, "frames keypoints 3"], rows: Int[np.ndarray, "frames"]
) -> Float[np.ndarray, "frames 3"]:
    """Translations that bring points onto the landmarks of these rows: linear least squares across the image.

    The distance is found from the size of the person in the image, so it is as good as the lens and the body's shape.
    That of single frames may be far off, where little is seen of the person, so it is the median over time.
    """
    k = observed.intrinsics
    ray = (np.nan_to_num(observed.keypoints_px[rows]) - [k.cx_px, k.cy_px]) / k.fx_px
    zero, one = np.zeros(ray.shape[:2]), np.ones(ray.shape[:2])
    weight = np.maximum(observed.weight[rows], _MIN_WEIGHT)[..., None]
    slope = np.stack([np.stack([one, zero, -ray[..., 0]], -1), np.stack([zero, one, -ray[..., 1]], -1)], 2)
    goal = ray * points_m[..., 2:] - points_m[..., :2]
    across = (slope * weight[..., None]).reshape(len(rows), -1, 3).swapaxes(1, 2)
    curvature = across @ slope.reshape(len(rows), -1, 3) + 1e-9 * np.eye(3)
    depth_m = np.linalg.solve(curvature, across @ goal.reshape(len(rows), -1, 1))[:, 2, 0]
    depth_m = np.maximum(median_filter(depth_m, _USUAL_FRAMES, mode="nearest"), _MIN_DEPTH_M)
    center_m = (weight * (goal + ray * depth_m[:, None, None])).sum(1) / weight.sum(1)
    return np.concatenate([center_m, depth_m[:, None]], 1)


def _leaf(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).float()


def _finish(objective: Objective, parameters: Parameters, base: dict[str, float]) -> FittedBody:
    with torch.no_grad():
        prediction = objective.predict(parameters)
        error = objective.residual_px(prediction).norm(dim=-1).numpy().astype(np.float64)
        translation = objective.translation_m(parameters, prediction.body_height_m).numpy().astype(np.float64)
        shape = {name: float(value) for name, value in objective.shape(parameters).items()}
    return FittedBody(
        prediction.R_parent_joint.numpy().astype(np.float64),
        translation,
        prediction.joints_m.numpy().astype(np.float64),
        prediction.rest_joints_m.numpy().astype(np.float64),
        BodyShape("anny", base | shape),
        np.where(objective.observed.weight > 0, error, np.nan),
    )
