"""Runs the lifter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.humans.initial import ray_pitch
from video2anim.humans.lifter_input import LiftedBody, lifted_body, lifter_input
from video2anim.humans.problem import Observations

Network = Callable[[Float[np.ndarray, "frames features"]], Float[np.ndarray, "frames outputs"]]
_PITCH_SHARE = 0.8
"""Part of the pitch of the lifter's own up direction against gravity that is an error of the body's pitch
(`benchmarks/landmark_axes.py`)."""


def lift(observed: Observations, network: Network) -> LiftedBody:
    """Bodies of consecutive frames.

    An image shows how far a body leans to its sides, but hardly how far it leans toward the camera. Gravity, which
    the network is not given, tells that: bodies are turned about the horizontal axis across the viewing ray, by the
    median over the frames of what the network's own up direction is off.

    Args:
        observed: all frames of a clip, in order of time, at `FPS` as every clip after ingest.
        network: features -> outputs, at `FPS`.
    """
    given = lifter_input(observed)
    body = lifted_body(network(given.features), given)
    R_camera_ray = given.R_camera_ray
    pitch_rad, across = ray_pitch(observed.up_camera, R_camera_ray)
    off_rad = pitch_rad - ray_pitch(body.up_camera, R_camera_ray)[0]
    turn_rad = _PITCH_SHARE * np.median(off_rad[observed.valid]) if observed.valid.any() else 0.0
    turn = R_camera_ray @ matrix_from_axis_angle(turn_rad * across) @ np.swapaxes(R_camera_ray, -1, -2)
    R_parent_joint = body.R_parent_joint.copy()
    R_parent_joint[:, 0] = turn @ R_parent_joint[:, 0]
    return replace(body, R_parent_joint=R_parent_joint)
