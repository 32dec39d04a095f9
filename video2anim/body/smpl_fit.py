"""Puts a motion on a body of the SMPL family from the user's model file; betas are fitted to the bone lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from video2anim.body.smplx_body import SmplModel, users_model
from video2anim.types import BodyMotion, BodyShape
from video2anim.types.skeleton import PARENTS

BETAS = 16
"""Number of shape coefficients, as in AMASS files; 21 bone lengths do not determine more."""
_LENGTH_SIGMA_M = 0.01
"""Standard deviation of a bone length: joints of two body models differ by about this much."""


def on_smpl_body(motion: BodyMotion, model: str) -> BodyMotion:
    """The same joint rotations and pelvis path on the user's SMPL body with the bone lengths of the motion.

    A motion that is already on that model is returned unchanged.

    Args:
        motion: A motion on any body model.
        model: `smpl`, `smplh` or `smplx` (neutral), or one of these with `-male` or `-female`.

    Raises:
        UsageError: unknown model, or no folder of SMPL files is given.
        InputError: the folder or the file is missing, or the file cannot be used.
    """
    if motion.shape.model == model:
        return motion
    body = users_model(model)
    shape = BodyShape(model, named_betas(fit_betas(body, motion.rest_joints_m)))
    fitted = replace(motion, shape=shape, rest_joints_m=body.shaped(shape).rest_joints_m)
    pelvis_m = motion.T_world_root[:, :3, 3] + motion.rest_joints_m[0]
    return fitted.with_pose(translation_world_m=pelvis_m, R_parent_joint=motion.R_parent_joint)


def fit_betas(body: SmplModel, rest_joints_m: Float[np.ndarray, "22 3"]) -> Float[np.ndarray, "betas"]:
    """The most likely betas (up to 16) for the bone lengths of a skeleton.

    Least squares over the 21 bone lengths and the betas, whose prior is a standard normal distribution.
    """
    from scipy.optimize import least_squares

    count = min(BETAS, body.shape_basis_m.shape[2])
    template_m = body.joint_regressor @ body.template_m
    basis_m = np.einsum("jv,vdb->jdb", body.joint_regressor, body.shape_basis_m[:, :, :count])
    wanted_m = _bone_lengths_m(rest_joints_m)

    def residuals(betas: np.ndarray) -> np.ndarray:
        lengths_m = _bone_lengths_m(template_m + basis_m @ betas)
        return np.concatenate([(lengths_m - wanted_m) / _LENGTH_SIGMA_M, betas])

    return least_squares(residuals, np.zeros(count), method="lm").x


def named_betas(betas: Float[np.ndarray, "betas"]) -> dict[str, float]:
    """Betas as the parameters of a `BodyShape`."""
    return {f"beta_{number}": float(value) for number, value in enumerate(betas)}


def _bone_lengths_m(joints_m: Float[np.ndarray, "22 3"]) -> Float[np.ndarray, "21"]:
    return np.linalg.norm(joints_m[1:] - joints_m[PARENTS[1:]], axis=1)
