"""Losses and validation measures of the lifter."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from video2anim.humans.lifter_input import CONTACT_OUTPUTS, ERROR_OUTPUTS, LOG_ERROR_RANGE
from video2anim.lab.lifter.contacts import PARTS
from video2anim.lab.lifter.kinematics import planes_from_rot6d, posed
from video2anim.lab.lifter.samples import LiftingBatch
from video2anim.types.skeleton import JOINT_INDEX, PARENTS

_PARENTS = torch.from_numpy(PARENTS[1:])
_LIMBS = [
    JOINT_INDEX[f"{side}_{part}"]
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    for side in ("left", "right")
]


def losses(output: Float[Tensor, "batch frames outputs"], batch: LiftingBatch) -> dict[str, Tensor]:
    """Weighted loss terms by name. The weights give the terms similar sizes after 1000 steps, with joints the
    largest."""
    rot6d = output[..., :132].unflatten(-1, (22, 6))
    joints, true = posed(planes_from_rot6d(rot6d), batch.rest_joints_m)[0], _planes(batch.joints_m)
    off = joints - true
    error_m = _length(off)
    contact = functional.binary_cross_entropy_with_logits(
        output[..., CONTACT_OUTPUTS], batch.contact, weight=batch.contact_known, reduction="sum"
    ) / batch.contact_known.sum().clamp_min(1.0)
    up = functional.normalize(output[..., -3:], dim=-1)
    # Laplace likelihood of the predicted error. Detached, so that it does not change the predicted joints.
    predicted_error = output[..., ERROR_OUTPUTS].permute(2, 0, 1)[1:].clamp(*LOG_ERROR_RANGE)
    return {
        "joints": 10.0 * error_m.mean(),
        "bones": 1.5 * _length(_bone_directions(joints) - _bone_directions(true)).mean(),
        "picture": 10.0 * _length(_in_picture(joints, batch) - _in_picture(true, batch)).mean(),
        "error": 0.2 * (error_m.detach()[1:] * torch.exp(-predicted_error) + predicted_error).mean(),
        "speed": 20.0 * _length(off.diff(dim=-1)).mean(),
        "rotations": 1.0 * (rot6d - batch.rot6d).abs().mean(),
        "size": 2.0 * (output[..., 132] - batch.log_size).abs().mean(),
        "offset": 5.0 * (output[..., 133:135] - batch.pelvis_m[..., :2]).abs().mean(),
        "contact": 1.0 * contact,
        "up": 2.0 * (up - batch.up).norm(dim=-1).mean(),
    }


def _planes(joints_m: Float[Tensor, "batch frames 22 3"]) -> Float[Tensor, "3 22 batch frames"]:
    return joints_m.permute(3, 2, 0, 1).contiguous()


def _length(vectors: Float[Tensor, "axes *any"]) -> Float[Tensor, "*any"]:
    """Norm over the first axis, with a finite gradient at zero."""
    return (vectors.square().sum(0) + 1e-12).sqrt()


def _bone_directions(joints_m: Float[Tensor, "3 22 *any"]) -> Float[Tensor, "3 21 *any"]:
    """Unit vectors from each joint's parent to it, independent of limb lengths."""
    bones = joints_m[:, 1:] - joints_m.index_select(1, _PARENTS)
    return bones / _length(bones)


def _in_picture(joints_m: Float[Tensor, "3 22 batch frames"], batch: LiftingBatch) -> Float[Tensor, "2 22 b f"]:
    """Image positions of the joints with the pelvis at its true place, in meters at the pelvis's depth."""
    x, y, depth = batch.pelvis_m.unbind(-1)
    nearness = depth / (joints_m[2] + depth).clamp_min(0.3)
    return torch.stack([(joints_m[0] + x) * nearness, (joints_m[1] + y) * nearness])


def measures(output: Float[Tensor, "batch frames outputs"], batch: LiftingBatch) -> dict[str, float]:
    """Validation measures by name; the suffix is the unit.

    `pa_mpjpe_mm`: of 12 limb joints after a similarity fit in every frame, as in benchmarks. `f1_*`: F1 score of
    contacts. `error_told`: mean ratio of true to predicted error. `error_known`: correlation of the two.
    """
    rot6d = output[..., :132].unflatten(-1, (22, 6))
    joints = posed(planes_from_rot6d(rot6d), batch.rest_joints_m)[0].permute(2, 3, 1, 0)
    up = functional.normalize(output[..., -3:], dim=-1)
    angle = torch.arccos((up * batch.up).sum(-1).clamp(-1, 1)).rad2deg()
    predicted_contact, known, truth = output[..., CONTACT_OUTPUTS] > 0, batch.contact_known > 0, batch.contact > 0.5
    scores = {}
    for name, part in PARTS.items():
        both = (predicted_contact & truth & known)[..., part].sum()
        either = (predicted_contact & known)[..., part].sum() + (truth & known)[..., part].sum()
        scores[f"f1_{name}"] = float(2 * both / either.clamp_min(1))
    error_m = (joints - batch.joints_m).norm(dim=-1)
    predicted_error = torch.exp(output[..., ERROR_OUTPUTS].clamp(*LOG_ERROR_RANGE))
    return {
        "pa_mpjpe_mm": 1000 * float(_aligned_apart(joints[..., _LIMBS, :], batch.joints_m[..., _LIMBS, :]).mean()),
        "mpjpe_mm": 1000 * float(error_m.mean()),
        "error_told": float((error_m / predicted_error)[..., 1:].mean()),
        "error_known": float(
            torch.corrcoef(torch.stack([error_m[..., 1:].flatten(), predicted_error[..., 1:].flatten()]))[0, 1]
        ),
        "depth_percent": 100 * float((output[..., 132] - batch.log_size).abs().mean()),
        "up_deg": float(angle.mean()),
        **scores,
    }


def _aligned_apart(joints_m: Float[Tensor, "*any n 3"], true_m: Float[Tensor, "*any n 3"]) -> Float[Tensor, "*any n"]:
    """Distance of each point after the similarity transform with the least squared error (Umeyama 1991)."""
    a, b = (part - part.mean(-2, keepdim=True) for part in (joints_m, true_m))
    u, s, vt = torch.linalg.svd(b.transpose(-1, -2) @ a)
    sign = torch.ones_like(s)
    sign[..., 2] = torch.det(u @ vt).sign()
    scale = (s * sign).sum(-1) / a.square().sum((-1, -2))
    R = (u * sign[..., None, :]) @ vt
    return (scale[..., None, None] * (a @ R.transpose(-1, -2)) - b).norm(dim=-1)
