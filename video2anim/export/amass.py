"""AMASS npz (Mahmood et al. 2019): SMPL-H or SMPL-X parameters that motion datasets and their loaders use.

AMASS is +Z up, so root orientation and translation are turned by +90 degrees about X: (x, y, z) -> (x, -z, y).
`trans` moves the origin of the model file, as in SMPL: the pelvis lies at `trans` plus the pelvis of the rest body.

Rest pelvis and betas come from the user's model file where `VIDEO2ANIM_SMPL_DIR` has one: betas are those of the
motion's own shape where it is of that model, else fitted to the lengths of its bones. Without a file betas are zero and
the rest pelvis is that of the mean shape, so joints differ by what the person's limbs differ from the mean body's.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from video2anim.body.smpl_fit import BETAS, fit_betas, named_betas
from video2anim.body.smplx_body import (
    DIR_VARIABLE,
    MEAN_PELVIS_M,
    MODEL_OF_JOINTS,
    load_body_model,
    model_file,
    smpl_folder,
)
from video2anim.errors import InputError
from video2anim.export.frames import ZUP_FROM_YUP
from video2anim.geometry.rotations import axis_angle_from_matrix
from video2anim.types import BodyMotion, BodyShape

AmassModel = Literal["smplh", "smplx"]


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    betas: Float[np.ndarray, "16"]
    pelvis_m: Float[np.ndarray, "3"]
    """Of the rest body in the model's own frame."""
    gender: str
    source: str
    """Where betas and pelvis come from, for the file's note."""
    known: bool


def write_amass(path: Path, motion: BodyMotion, model: AmassModel) -> None:
    """Write one person's motion.

    Keys of SMPL-H files: `poses` (T, 156) axis-angle in radians, `trans` (T, 3) meters, `betas` (16,), `gender`,
    `mocap_framerate`. Keys of SMPL-X files: the same with `poses` (T, 165), and `root_orient` (T, 3), `pose_body`
    (T, 63), `pose_jaw` (T, 3), `pose_eye` (T, 6), `pose_hand` (T, 90), `surface_model_type`, `mocap_frame_rate`,
    `mocap_time_length`. Beside AMASS's own: `valid`, `joints_m` (T, 22, 3) +Z up, `betas_estimated`, `shape_model`,
    `shape_names`, `shape_values`, `note`.

    Raises:
        InputError: the user's model file cannot be used.
    """
    fitted = _fit(motion, model)
    body = axis_angle_from_matrix(motion.R_parent_joint[:, 1:]).reshape(motion.frame_count, -1)
    joints = next(count for count, name in MODEL_OF_JOINTS.items() if name == model)
    poses = np.zeros((motion.frame_count, 3 * joints))
    poses[:, :3] = axis_angle_from_matrix(ZUP_FROM_YUP @ motion.R_parent_joint[:, 0])
    poses[:, 3 : 3 + body.shape[1]] = body
    pelvis_m = motion.T_world_root[:, :3, 3] + motion.rest_joints_m[0]
    names = sorted(motion.shape.parameters)
    arrays = {
        "poses": poses,
        "trans": pelvis_m @ ZUP_FROM_YUP.T - fitted.pelvis_m,
        "betas": fitted.betas,
        "gender": np.array(fitted.gender),
        "valid": motion.valid,
        "joints_m": motion.joints_world_m @ ZUP_FROM_YUP.T,
        "betas_estimated": np.array(fitted.known),
        "shape_model": np.array(motion.shape.model),
        "shape_names": np.array(names, dtype=np.str_),
        "shape_values": np.array([motion.shape.parameters[name] for name in names], dtype=np.float64),
        "note": np.array(f"{fitted.source}; hands are at rest; rows with valid == False are not measured"),
    }
    fps = _fps(motion)
    if model == "smplx":
        arrays |= dict(zip(_SMPLX_PARTS, np.split(poses, np.cumsum([3, 63, 3, 6]), axis=1), strict=True))
        arrays["surface_model_type"] = np.array("smplx")
        arrays["mocap_frame_rate"] = np.array(fps)
        arrays["mocap_time_length"] = np.array(motion.frame_count / fps)
    else:
        arrays["mocap_framerate"] = np.array(fps)
    np.savez_compressed(path, **arrays)


_SMPLX_PARTS = ("root_orient", "pose_body", "pose_jaw", "pose_eye", "pose_hand")
"""Parts of an SMPL-X pose in their order."""


def _fit(motion: BodyMotion, model: AmassModel) -> _Fitted:
    own, _, gender = motion.shape.model.partition("-")
    wanted = motion.shape.model if own == model else model
    gender = gender if own == model and gender else "neutral"
    if (path := _users_file(wanted)) is None:
        source = (
            f"betas are zero and the rest pelvis is that of the mean {model} body: no model file in {DIR_VARIABLE}; "
            "the person's shape is in shape_*"
        )
        return _Fitted(np.zeros(BETAS), MEAN_PELVIS_M[model], gender, source, known=False)
    body = load_body_model(path)
    if own == model:
        shape, source = motion.shape, "betas are those of the motion's own shape"
    else:
        shape = BodyShape(model, named_betas(fit_betas(body, motion.rest_joints_m)))
        source = f"betas are fitted to the lengths of the bones of the person's {own} body"
    betas = np.zeros(BETAS)
    for name, value in shape.parameters.items():
        if (number := int(name.removeprefix("beta_"))) < BETAS:
            betas[number] = value
    # The rest pelvis of what the file says, not of betas beyond those it holds.
    written = BodyShape(shape.model, named_betas(betas[: body.shape_basis_m.shape[2]]))
    return _Fitted(betas, body.pelvis_m(written), gender, source, known=True)


def _users_file(model: str) -> Path | None:
    """The user's file, or None where there is none: AMASS files are written without betas then, and say so.

    Raises:
        InputError: the folder that is named does not exist.
    """
    if not os.environ.get(DIR_VARIABLE):
        return None
    smpl_folder()
    try:
        return model_file(model)
    except InputError:
        return None


def _fps(motion: BodyMotion) -> float:
    if motion.frame_count < 2:
        return 30.0
    return float(np.round((motion.frame_count - 1) / (motion.frame_time_s[-1] - motion.frame_time_s[0]), 3))
