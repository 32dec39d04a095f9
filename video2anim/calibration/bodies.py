"""Bodies and their camera under the result of the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import root_scalar

from video2anim.body.anny_body import anny_model
from video2anim.calibration.fit import Calibration, under_lens
from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.humans.ground import level_frame
from video2anim.types import BodyMotion, BodyTracks, Intrinsics
from video2anim.types.motion import BodyShape, main_person


def calibrated(bodies: BodyTracks, found: Calibration) -> BodyTracks:
    """People at the sizes, under the focal length and above the floor of the fit (+Y up, floor at y = 0, origin below
    the main person's first valid root). Each keeps its position and size in the image."""
    main = bodies.main
    k = main.intrinsics
    lens = found.focal_px / k.fx_px
    intrinsics = Intrinsics(found.focal_px, k.fy_px * lens, k.cx_px, k.cy_px, k.width_px, k.height_px)
    # The main person sets the scale of a moving camera's path.
    T_world_camera = invert_rigid(main.T_world_camera[0]) @ main.T_world_camera
    T_world_camera[:, :3, 3] *= found.body_height_ratio[0]
    T_world_camera[:, :3] = level_frame(found.up_camera) @ T_world_camera[:, :3]
    T_world_camera[:, 1, 3] += found.camera_height_m
    people = [
        _moved(body, float(ratio), lens, intrinsics, T_world_camera)
        for body, ratio in zip(bodies.people, found.body_height_ratio, strict=True)
    ]
    first = main_person(people).measured_joints_m[0, 0]
    away_m = -first * np.array([1.0, 0.0, 1.0])
    T_world_camera[:, :3, 3] += away_m
    people = [
        replace(body, T_world_camera=T_world_camera).with_pose(
            translation_world_m=body.T_world_root[:, :3, 3] + away_m, R_parent_joint=body.R_parent_joint
        )
        for body in people
    ]
    return BodyTracks(tuple(people), bodies.quality)


def _moved(
    body: BodyMotion, ratio: float, lens: float, intrinsics: Intrinsics, T_world_camera: Float[np.ndarray, "frames 4 4"]
) -> BodyMotion:
    """One person under another focal length and of another size, as far as the body model's range of heights goes."""
    shape, rest_joints_m, reached = resized(body.shape, body.rest_joints_m, ratio)
    T_camera_world = invert_rigid(body.T_world_camera)
    root_m = transform_points(T_camera_world, body.T_world_root[:, None, :3, 3])[:, 0]
    at_m, turn = under_lens(root_m, lens)
    R_parent_joint = body.R_parent_joint.copy()
    R_parent_joint[:, 0] = T_world_camera[:, :3, :3] @ turn @ T_camera_world[:, :3, :3] @ R_parent_joint[:, 0]
    same = replace(body, shape=shape, rest_joints_m=rest_joints_m, intrinsics=intrinsics, T_world_camera=T_world_camera)
    world_m = transform_points(T_world_camera, reached * at_m[:, None])[:, 0]
    return same.with_pose(translation_world_m=world_m, R_parent_joint=R_parent_joint)


def resized(
    shape: BodyShape, rest_joints_m: Float[np.ndarray, "22 3"], ratio: float
) -> tuple[BodyShape, Float[np.ndarray, "22 3"], float]:
    """Shape and rest joints of the body model at another body height (phenotype `height`), and the ratio reached."""
    parameters = {name: float(value) for name, value in shape.parameters.items()}

    def skeleton(height: float) -> tuple[float, np.ndarray]:
        with torch.no_grad():
            rest = anny_model().rest_skeleton(
                {name: torch.tensor(v) for name, v in (parameters | {"height": height}).items()}
            )
        return float(rest.body_height_m), rest.rest_joints_m.numpy().astype(np.float64)

    if shape.model != "anny" or abs(ratio - 1) < 1e-3:
        return shape, rest_joints_m, 1.0
    now_m, _ = skeleton(parameters["height"])
    low_m, high_m = skeleton(0.0)[0], skeleton(1.0)[0]
    wanted_m = float(np.clip(ratio * now_m, low_m, high_m))
    height = root_scalar(lambda height: skeleton(height)[0] - wanted_m, bracket=(0.0, 1.0)).root
    reached_m, joints_m = skeleton(height)
    return replace(shape, parameters=parameters | {"height": height}), joints_m, reached_m / now_m
