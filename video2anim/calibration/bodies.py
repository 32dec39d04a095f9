"""Bodies and their camera under the result of the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from video2anim.body.anny_body import height_phenotype, rest_of
from video2anim.calibration.fit import Calibration
from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.types import BodyMotion, BodyTracks
from video2anim.types.motion import BodyShape, main_person


def calibrated(bodies: BodyTracks, found: Calibration) -> BodyTracks:
    """People at the sizes and above the floor of the fit (+Y up, floor at y = 0, origin below the main person's first
    valid root). Each keeps its position and size in the image."""
    before = bodies.main.T_world_camera
    T_world_camera = before.copy()
    # The main person sets the scale of a moving camera's path.
    ratio = found.body_height_ratio[0] * found.path_ratio
    T_world_camera[:, :3, 3] = ratio * (before[:, :3, 3] - before[0, :3, 3])
    T_world_camera[:, 1, 3] += found.camera_height_m
    people = [
        _resized_body(body, float(ratio), T_world_camera)
        for body, ratio in zip(bodies.people, found.body_height_ratio, strict=True)
    ]
    away_m = -main_person(people).measured_joints_m[0, 0] * np.array([1.0, 0.0, 1.0])
    T_world_camera[:, :3, 3] += away_m
    people = [
        replace(body, T_world_camera=T_world_camera).with_pose(
            translation_world_m=body.T_world_root[:, :3, 3] + away_m, R_parent_joint=body.R_parent_joint
        )
        for body in people
    ]
    return BodyTracks(tuple(people), bodies.quality, found.path_log_sigma)


def _resized_body(body: BodyMotion, ratio: float, T_world_camera: Float[np.ndarray, "frames 4 4"]) -> BodyMotion:
    """One person of another size, as far as the body model's range of heights goes."""
    shape, rest_joints_m, reached = resized(body.shape, body.rest_joints_m, ratio)
    root_m = transform_points(invert_rigid(body.T_world_camera), body.T_world_root[:, None, :3, 3])
    same = replace(body, shape=shape, rest_joints_m=rest_joints_m, T_world_camera=T_world_camera)
    world_m = transform_points(T_world_camera, reached * root_m)[:, 0]
    return same.with_pose(translation_world_m=world_m, R_parent_joint=body.R_parent_joint)


def resized(
    shape: BodyShape, rest_joints_m: Float[np.ndarray, "22 3"], ratio: float
) -> tuple[BodyShape, Float[np.ndarray, "22 3"], float]:
    """Shape and rest joints of the body model at another body height (phenotype `height`), and the ratio reached."""
    parameters = {name: float(value) for name, value in shape.parameters.items()}
    if shape.model != "anny" or abs(ratio - 1) < 1e-3:
        return shape, rest_joints_m, 1.0
    now = rest_of(parameters)
    parameters["height"] = height_phenotype(parameters, ratio * float(now.body_height_m))
    then = rest_of(parameters)
    joints_m = then.rest_joints_m.numpy().astype(np.float64)
    return replace(shape, parameters=parameters), joints_m, float(then.body_height_m / now.body_height_m)
