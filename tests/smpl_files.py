"""Made-up model files in the layout of SMPL's makers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.types import BodyShape
from video2anim.types.skeleton import PARENTS

HIDDEN = {"smpl": 2, "smplh": 30, "smplx": 33}
"""Joints beyond the 22: hands, face, knuckles."""
PELVIS_M = np.array([0.01, -0.3, 0.02])
"""Of the files' mean body, in the files' own frame."""


def write_human(folder: Path, model: str = "smplx", gender: str = "NEUTRAL") -> Path:
    """Anny's middle adult as a model file: its skin in the T-pose, and one vertex at each joint, which the regressor
    picks. Beta 0 makes the body 5 % larger; the others do nothing."""
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    upright = np.broadcast_to(np.eye(3), (1, 22, 3, 3))
    skin_m = body.vertices(upright, body.rest_joints_m[None])[0].astype(np.float64)
    parents = np.array([2**32 - 1, *PARENTS[1:], *[20] * HIDDEN[model]])
    joints_m = np.concatenate([body.rest_joints_m, body.rest_joints_m[[20] * HIDDEN[model]]])
    joints, vertices_m = len(joints_m), np.concatenate([skin_m, joints_m])
    shapes = np.zeros((len(vertices_m), 3, 10))
    shapes[:, :, 0] = 0.05 * vertices_m
    weights = np.zeros((len(vertices_m), joints))
    weights[: len(skin_m), :22] = body.skin_weights
    weights[len(skin_m) :] = np.eye(joints)
    regressor = np.zeros((joints, len(vertices_m)))
    regressor[:, len(skin_m) :] = np.eye(joints)
    path = folder / f"{model.upper()}_{gender}.npz"
    np.savez(
        path, v_template=vertices_m + PELVIS_M, shapedirs=shapes, weights=weights, J_regressor=regressor,
        f=body.faces.astype(np.uint32), kintree_table=np.stack([parents, np.arange(joints)]).astype(np.uint32),
    )  # fmt: skip
    return path
