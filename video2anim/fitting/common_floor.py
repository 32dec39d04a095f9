"""People in one room stand on one floor: what that says of everybody's size.

A video of one camera shows somebody small and near as it shows somebody large and far away, so each fitted body has a
scale of its own, which the prior on statures knows to 5 %. All their feet being as far below the camera tells how the
scales relate, and the mean of several statures is known better than one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from video2anim.body.anny_body import anny_model
from video2anim.fitting.optimize import reposed
from video2anim.fitting.problem import FittedBody, Observations

SOLE_SIGMA_M = 0.03
"""Error of a floor found from one person's soles."""
_GATE = 3.0
"""Floors farther apart than so many standard deviations are two floors, or somebody is a child."""
_HALVINGS = 30


def shared_scales(
    below_m: Float[np.ndarray, "persons"],
    distance_m: Float[np.ndarray, "persons"],
    *,
    up_sigma_rad: float,
    stature_sigma_ratio: Float[np.ndarray, "persons"],
) -> tuple[Float[np.ndarray, "persons"], Bool[np.ndarray, "persons"]]:
    """Factors that bring people onto one floor, and who stands on the first person's.

    Maximum of the posterior of log scales with normal priors, given floors that are `below_m` under the camera
    to within what a tilted up vector and soles put them off.

    Args:
        below_m: how far under the camera each person's floor is.
        distance_m: of each person from the camera, along the floor.
        up_sigma_rad: uncertainty of the up vector.
        stature_sigma_ratio: deviation to which each scale is known by itself.

    Returns:
        Factors, 1 for people on other floors and where the camera lies too low to tell; and who shares the floor.
    """
    scales, shares = np.ones(len(below_m)), np.zeros(len(below_m), bool)
    if below_m[0] < SOLE_SIGMA_M:
        return scales, shares
    usable = np.maximum(below_m, SOLE_SIGMA_M)
    noise = np.hypot(up_sigma_rad * distance_m, SOLE_SIGMA_M) / usable
    variance = stature_sigma_ratio**2 + noise**2
    off = np.log(usable / usable[0])
    shares = (np.abs(off) <= _GATE * np.sqrt(variance + variance[0])) & (below_m > SOLE_SIGMA_M)
    floor = (off / variance)[shares].sum() / (1 / variance)[shares].sum()
    # What of the gap to the common floor is the person's size, and what a tilt or a sole.
    scales[shares] = np.exp(stature_sigma_ratio[shares] ** 2 / variance[shares] * (floor - off[shares]))
    return scales, shares


def grown(observed: Observations, fit: FittedBody, factor: float) -> FittedBody:
    """The body made larger and moved away by one factor, so that the picture stays the same.

    Size follows the body model's phenotype `height`; where that ends, so does growth.
    """
    parameters = {name: float(value) for name, value in fit.shape.parameters.items()}

    def with_height(value: float) -> dict[str, torch.Tensor]:
        return {name: torch.tensor(v) for name, v in (parameters | {"height": value}).items()}

    def stature_m(value: float) -> float:
        with torch.no_grad():
            return float(anny_model().rest_skeleton(with_height(value)).stature_m)

    now_m = stature_m(parameters["height"])
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stature_m(middle) < factor * now_m else (low, middle)
    height = 0.5 * (low + high)
    with torch.no_grad():
        rest_m = anny_model().rest_skeleton(with_height(height)).rest_joints_m.numpy().astype(np.float64)
    reached = stature_m(height) / now_m
    root_m = fit.translation_camera_m + fit.rest_joints_m[0]
    larger = replace(fit, shape=replace(fit.shape, parameters=parameters | {"height": height}), rest_joints_m=rest_m)
    return reposed(observed, larger, fit.R_parent_joint, reached * root_m - rest_m[0])
