"""Body shapes for training the lifter: adults of the body model (Anny) with the proportions of motion capture
actors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from video2anim.body.anny_body import KEYPOINT_NAMES, anny_model
from video2anim.lab.synth.compose import draw_shape
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES, PARENTS

_STRETCH = {
    "thigh": (0.04, 0.05), "shank": (-0.04, 0.05), "foot": (0.0, 0.05), "hips": (-0.1, 0.1), "trunk": (0.0, 0.06),
    "shoulders": (0.04, 0.04), "upper_arm": (0.0, 0.06), "forearm": (0.06, 0.07), "neck": (0.0, 0.1),
}  # fmt: skip
"""Mean and standard deviation of the logarithm of length(actor) / length(random adult of the body model), where lengths
are relative to the leg. From the skeletons of six actors (CMU's ASF files, ACCAD; without the upper arms of
`accad_female1`, which are wrong in the file). The mean is kept as 0 where skeletons place joints differently (trunk,
feet, neck), and halved for the hips, whose anatomical distance is that of the body model."""
_HEIGHT = (0.3, 0.5)
"""Range of the body model's height parameter. It is narrow because proportions change with it; size is not
observable."""
_BONE = {
    "hip": "hips", "knee": "thigh", "ankle": "shank", "foot": "foot", "spine1": "trunk", "spine2": "trunk",
    "spine3": "trunk", "collar": "trunk", "neck": "trunk", "shoulder": "shoulders", "elbow": "upper_arm",
    "wrist": "forearm", "head": "neck",
}  # fmt: skip
"""Kind of length, by the joint at the end of the bone."""
_KEYPOINT_JOINT = {
    "nose": "head", "eye": "head", "ear": "head", "shoulder": "shoulder", "elbow": "elbow", "wrist": "wrist",
    "hip": "hip", "knee": "knee", "ankle": "ankle", "heel": "ankle", "big_toe": "foot", "index": "wrist",
    "pinky": "wrist",
}  # fmt: skip
"""Joint that a keypoint moves with when proportions change."""


def _side(name: str) -> tuple[str, str]:
    """`left_knee` -> (`left_`, `knee`)."""
    for side in ("left_", "right_"):
        if name.startswith(side):
            return side, name.removeprefix(side)
    return "", name


def _joint_of(keypoint: str) -> int:
    side, part = _side(keypoint)
    joint = _KEYPOINT_JOINT[part]
    return JOINT_INDEX[joint if joint == "head" else side + joint]


_KEYPOINT_JOINTS = torch.tensor([_joint_of(name) for name in KEYPOINT_NAMES])


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """Rest geometry of several body shapes (T-pose, pelvis at the origin)."""

    rest_joints_m: Float[Tensor, "bodies 22 3"]
    keypoint_offsets_m: Float[Tensor, "bodies keypoints 22 3"]
    """As in `RestSkeleton`."""
    keypoint_weights: Float[Tensor, "keypoints 22"]

    def keypoints_m(
        self,
        body: Int[Tensor, "batch"],
        joints_m: Float[Tensor, "3 22 batch frames"],
        R_frame_joint: Float[Tensor, "3 3 22 batch frames"],
    ) -> Float[Tensor, "batch frames keypoints 3"]:
        """Keypoints of posed bodies: `RestSkeleton.keypoints_m` for many bodies, as one matrix product each."""
        batch, frames = joints_m.shape[2:]
        weighted = (self.keypoint_weights[..., None] * self.keypoint_offsets_m[body]).flatten(2)
        # (batch, frames x 3, 22 x 3) @ (batch, 22 x 3, keypoints)
        rows = R_frame_joint.permute(3, 4, 0, 2, 1).reshape(batch, frames * 3, -1)
        turned = (rows @ weighted.transpose(1, 2)).reshape(batch, frames, 3, -1).transpose(2, 3)
        at_joints = self.keypoint_weights @ joints_m.flatten(2)
        return turned + at_joints.reshape(3, -1, batch, frames).permute(2, 3, 1, 0)


def draw_bodies(rng: np.random.Generator, count: int, *, performers: bool = True) -> Bodies:
    """Random adults; with `performers`, limbs, trunk and widths also vary independently, as among actors."""
    model = anny_model()
    with torch.no_grad():
        shapes = [draw_shape(rng).parameters | {"height": rng.uniform(*_HEIGHT)} for _ in range(count)]
        rests = [model.rest_skeleton({name: torch.tensor(value) for name, value in shape.items()}) for shape in shapes]
        joints, offsets = (
            torch.stack([getattr(rest, name) for rest in rests]) for name in ("rest_joints_m", "keypoint_offsets_m")
        )
    if performers:
        scaled = _proportioned(joints, rng)
        moved = scaled - joints
        offsets = offsets + moved[:, _KEYPOINT_JOINTS][:, :, None] - moved[:, None]
        joints = scaled
    return Bodies(joints, offsets, model.keypoint_weights)


def _proportioned(joints_m: Float[Tensor, "bodies 22 3"], rng: np.random.Generator) -> Float[Tensor, "bodies 22 3"]:
    """Joints after random stretching of each kind of bone, symmetric."""
    count = len(joints_m)
    stretch = {name: torch.from_numpy(np.exp(rng.normal(*log, (count, 1)))).float() for name, log in _STRETCH.items()}
    scaled = [joints_m[:, 0]]
    for joint in range(1, len(PARENTS)):
        parent = int(PARENTS[joint])
        bone = joints_m[:, joint] - joints_m[:, parent]
        scaled.append(scaled[parent] + stretch[_BONE[_side(JOINT_NAMES[joint])[1]]] * bone)
    return torch.stack(scaled, 1)
