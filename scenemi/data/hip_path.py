"""The path of the hips: scaled to the body, then raised or lowered smoothly for feet, reach and floor."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from scenemi.data.body_measure import BodyMeasure
from scenemi.data.fading import bridged, envelope
from scenemi.data.foot_mesh import PartHull
from scenemi.data.foot_plant import FootPose
from scenemi.data.hinge_limb import hip_drop
from video2anim.body.legs import LEGS
from video2anim.body.shaped_body import ShapedBody
from video2anim.types.skeleton import JOINT_INDEX

HIPS = (JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"])
_NEAR_FLOOR_M = 0.3
"""Body parts with joints higher than this cannot touch the floor."""


def scaled_path(named_m: np.ndarray, relative_m: np.ndarray, body: ShapedBody) -> Float[np.ndarray, "frames 3"]:
    """Pelvis path such that the middle of the hips follows the source's, scaled by leg length."""
    scale = leg_ratio(named_m, body.rest_joints_m)
    return scale * named_m[:, HIPS].mean(axis=1) - relative_m[:, HIPS].mean(axis=1)


def leg_ratio(named_m: Float[np.ndarray, "frames 22 3"], rest_joints_m: Float[np.ndarray, "22 3"]) -> float:
    """Length of a body's legs over those of the source whose joints these are."""
    own = sum(np.linalg.norm(rest_joints_m[leg.ankle] - rest_joints_m[leg.hip]) for leg in LEGS)
    theirs = 0.0
    for leg in LEGS:
        for a, b in ((leg.hip, leg.knee), (leg.knee, leg.ankle)):
            theirs += float(np.linalg.norm(named_m[0, b] - named_m[0, a]))
    return float(own / theirs)


def height_correction(
    root_m: np.ndarray, relative_m: np.ndarray, feet: list[FootPose], sigma_frames: float
) -> Float[np.ndarray, "frames"]:
    """What the hips must rise so that standing soles are on the floor, smooth in time."""
    soles_m = [root_m[:, 1] + relative_m[:, leg.ankle, 1] + f.lowest_m for f, leg in zip(feet, LEGS, strict=True)]
    standing = np.stack([foot.stance for foot in feet])
    if not standing.any():
        return np.full(len(root_m), -np.percentile(np.minimum(*soles_m), 5))
    count = standing.sum(axis=0)
    total = -np.where(standing, np.stack(soles_m), 0.0).sum(axis=0)
    rise_m = bridged(total / np.maximum(count, 1), np.asarray(count > 0))
    return gaussian_filter1d(rise_m, sigma_frames, mode="nearest")


def reach_drop(
    root_m: np.ndarray,
    relative_m: np.ndarray,
    feet: list[FootPose],
    ankles_m: list[np.ndarray],
    measure: BodyMeasure,
    radius: int,
) -> Float[np.ndarray, "frames"]:
    """How far the hips go down so that standing legs reach, smooth in time."""
    drops_m = [
        np.where(foot.stance, hip_drop(root_m + relative_m[:, leg.hip], ankle_m, bones), 0.0)
        for foot, leg, ankle_m, bones in zip(feet, LEGS, ankles_m, measure.legs, strict=True)
    ]
    return envelope(np.maximum(*drops_m), radius)


def out_of_floor(
    root_m: np.ndarray,
    relative_m: np.ndarray,
    R_world: np.ndarray,
    hull: PartHull,
    radius: int,
) -> Float[np.ndarray, "frames"]:
    """Smooth upward shift that keeps some body parts out of the floor."""
    joints_m = root_m[:, None] + relative_m
    near = joints_m[:, np.unique(hull.joint), 1].min(axis=1) < _NEAR_FLOOR_M
    sunk = np.zeros(len(root_m))
    if near.any():
        sunk[near] = np.maximum(0.0, -hull.lowest_m(joints_m[near], R_world[near]))
    return envelope(sunk, radius)
