"""Anny (Bregier et al. 2025, Apache-2.0, CC0 data) as a 22-joint body in the SMPL rest convention.

Anny's Mixamo rig has an A-pose as its rest pose, and its own bone frames. Here each joint gets the rotation from the
A-pose to the T-pose (arms along x, legs along -y, all else unchanged). All joint frames are then parallel to the body
frame (x to the body's left, y up, z forward), as in SMPL.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import root_scalar

from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import UsageError
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES, PARENTS

PHENOTYPES: tuple[str, ...] = ("gender", "age", "muscle", "weight", "height", "proportions")
ADULT = {"gender": 0.5, "age": 0.67, "muscle": 0.5, "weight": 0.5, "height": 0.4, "proportions": 0.5}
"""Center of the adult range; `height` 0.4 is 1.73 m."""
LENGTHS: dict[str, str] = {
    "upper_leg": "measure-upperleg-height-incr", "lower_leg": "measure-lowerleg-height-incr",
    "upper_arm": "measure-upperarm-length-incr", "lower_arm": "measure-lowerarm-length-incr",
    "shoulders": "measure-shoulder-dist-incr", "trunk": "measure-napetowaist-dist-incr",
}  # fmt: skip
"""Parameters of single lengths in [-1, 1] (default 0), and Anny's names for them. They exist because the phenotypes
hardly change the ratio of limb length to body height."""
PEOPLES_LENGTHS = {
    "upper_leg": (0.15, 0.22), "lower_leg": (-0.30, 0.31), "upper_arm": (0.0, 0.27), "lower_arm": (0.23, 0.31),
    "shoulders": (0.24, 0.3), "trunk": (0.0, 0.5),
}  # fmt: skip
"""Mean and standard deviation of `LENGTHS` over people: those of `video2anim.lab.lifter.bodies` (six actors), divided
by the change of length per unit for the average adult (thigh 90 mm, shank 70, upper arm 59, forearm 55, shoulders 38,
trunk 60)."""

_MIXAMO_BODY = dict(
    zip(
        JOINT_NAMES,
        (
            "Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot",
            "RightFoot", "Spine2", "LeftToeBase", "RightToeBase", "Neck", "LeftShoulder", "RightShoulder",
            "Head", "LeftArm", "RightArm", "LeftForeArm", "RightForeArm", "LeftHand", "RightHand",
        ),
        strict=True,
    )
)  # fmt: skip
_STRAIGHT = {
    "left_hip": ("left_knee", (0.0, -1.0, 0.0)), "right_hip": ("right_knee", (0.0, -1.0, 0.0)),
    "left_knee": ("left_ankle", (0.0, -1.0, 0.0)), "right_knee": ("right_ankle", (0.0, -1.0, 0.0)),
    "left_shoulder": ("left_elbow", (1.0, 0.0, 0.0)), "right_shoulder": ("right_elbow", (-1.0, 0.0, 0.0)),
    "left_elbow": ("left_wrist", (1.0, 0.0, 0.0)), "right_elbow": ("right_wrist", (-1.0, 0.0, 0.0)),
}  # fmt: skip
"""Bones with a given direction in the T-pose: joint to (child, direction)."""
_FOLLOWS = {"left_wrist": "left_elbow", "right_wrist": "right_elbow"}
"""Joints that take the A-to-T rotation of their parent."""

KEYPOINT_NAMES: tuple[str, ...] = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
    "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee",
    "right_knee", "left_ankle", "right_ankle", "left_big_toe", "right_big_toe", "left_heel", "right_heel",
    "left_index", "right_index", "left_pinky", "right_pinky",
)  # fmt: skip
"""Keypoints (surface and knuckle points) that are compared with image landmarks."""
_JOINT_KEYPOINTS = ("left_shoulder", "right_shoulder")
"""Keypoints that are joint centers: BlazePose's shoulders come from GHUM's joints, not from a skin point."""
_KNUCKLES = {
    "left_index": "LeftHandIndex1", "right_index": "RightHandIndex1",
    "left_pinky": "LeftHandPinky1", "right_pinky": "RightHandPinky1",
}  # fmt: skip


def _y_up(points: torch.Tensor) -> torch.Tensor:
    """Points from Anny's axes (z up, facing -y) to ours (y up, facing +z)."""
    return torch.stack([points[..., 0], points[..., 2], -points[..., 1]], -1)


@dataclass(frozen=True, slots=True, eq=False)
class RestSkeleton:
    """Differentiable rest geometry of one shape (torch, float32)."""

    rest_joints_m: torch.Tensor
    """(22, 3) T-pose joints, pelvis at the origin."""
    keypoint_offsets_m: torch.Tensor
    """(keypoints, 22, 3) rest position of each keypoint in each joint's T-pose frame."""
    keypoint_weights: torch.Tensor
    """(keypoints, 22) weight of each joint in the motion of a keypoint."""
    body_height_m: torch.Tensor
    """Scalar: standing height from sole to crown."""

    def keypoints_m(self, joints_m: torch.Tensor, R_frame_joint: torch.Tensor) -> torch.Tensor:
        """(T, keypoints, 3) keypoints of the posed body.

        Args:
            joints_m: (T, 22, 3) posed joints in any frame.
            R_frame_joint: (T, 22, 3, 3) their orientations in that frame.
        """
        weighted = self.keypoint_weights[..., None] * self.keypoint_offsets_m
        turned = torch.einsum("tjab,kjb->tka", R_frame_joint, weighted)
        return turned + torch.einsum("kj,tja->tka", self.keypoint_weights, joints_m)


class AnnyModel:
    """Anny's linear rest model reduced to the 22 body joints and the keypoints."""

    def __init__(self) -> None:
        source = _quiet_anny()
        self._source = source
        labels = [label.removeprefix("mixamorig:") for label in source.bone_labels]
        body = [labels.index(_MIXAMO_BODY[name]) for name in JOINT_NAMES]
        knuckles = [labels.index(bone) for bone in _KNUCKLES.values()]
        self.faces = source.faces.numpy().astype(np.int64)
        self._vertices = _y_up(source.template_vertices).float()
        self._vertex_blend = _y_up(source.blendshapes).float()
        self._heads = _y_up(source.template_bone_heads[body]).float()
        self._head_blend = _y_up(source.bone_heads_blendshapes[:, body]).float()
        self.skin_weights = self._body_weights(source, labels)
        regressor, names = _keypoint_regressor(source)
        rows = [names.index(name) for name in KEYPOINT_NAMES if name not in _KNUCKLES]
        weights = regressor[rows].float()
        self._points = torch.cat([weights @ self._vertices, _y_up(source.template_bone_heads[knuckles]).float()])
        self._point_blend = torch.cat(
            [
                torch.einsum("kv,bvd->bkd", weights, self._vertex_blend),
                _y_up(source.bone_heads_blendshapes[:, knuckles]).float(),
            ],
            1,
        )
        height = self._vertices[:, 1]
        crown_sole = [int(height.argmax()), int(height.argmin())]
        self._ends, self._end_blend = height[crown_sole], self._vertex_blend[:, crown_sole, 1]
        for name in _JOINT_KEYPOINTS:
            keypoint, joint = KEYPOINT_NAMES.index(name), JOINT_INDEX[name]
            self._points[keypoint] = self._heads[joint]
            self._point_blend[:, keypoint] = self._head_blend[:, joint]
        knuckle_joint = [JOINT_INDEX[f"{name.split('_')[0]}_wrist"] for name in _KNUCKLES]
        self.keypoint_weights = torch.cat([weights @ self.skin_weights, torch.eye(22)[knuckle_joint]])
        for name in _JOINT_KEYPOINTS:
            self.keypoint_weights[KEYPOINT_NAMES.index(name)] = torch.eye(22)[JOINT_INDEX[name]]

    @staticmethod
    def _body_weights(source: Any, labels: list[str]) -> torch.Tensor:
        """(V, 22) skinning weights; bones outside the 22 (fingers) give theirs to the nearest body ancestor."""
        of_bone = {_MIXAMO_BODY[name]: joint for joint, name in enumerate(JOINT_NAMES)}
        target = []
        for bone in range(len(labels)):
            while labels[bone] not in of_bone:
                bone = source.bone_parents[bone]
            target.append(of_bone[labels[bone]])
        joints = torch.tensor(target)[source.vertex_bone_indices]
        weights = torch.zeros(len(joints), 22)
        weights.scatter_add_(1, joints, source.vertex_bone_weights.float())
        return weights / weights.sum(1, keepdim=True)

    def coefficients(self, phenotype: dict[str, torch.Tensor]) -> torch.Tensor:
        """(blendshapes,) coefficients from scalar phenotypes in [0, 1] and `LENGTHS`; differentiable."""
        values = {k: v.reshape(1).to(self._source.dtype) for k, v in phenotype.items()}
        lengths = {LENGTHS[k]: v for k, v in values.items() if k in LENGTHS}
        phenotypes = {k: v for k, v in values.items() if k not in LENGTHS}
        return self._source.get_phenotype_blendshape_coefficients(**phenotypes, local_changes=lengths)[0].float()

    def rest_skeleton(self, phenotype: dict[str, torch.Tensor]) -> RestSkeleton:
        """T-pose joints and keypoints of a shape, differentiable with respect to its parameters."""
        coefficients = self.coefficients(phenotype)
        heads = self._heads + torch.einsum("b,bjd->jd", coefficients, self._head_blend)
        points = self._points + torch.einsum("b,bkd->kd", coefficients, self._point_blend)
        rotations = _tpose_rotations(heads)
        offsets = torch.einsum("jab,kjb->kja", rotations, points[:, None] - heads[None])
        ends = self._ends + coefficients @ self._end_blend
        return RestSkeleton(_tpose_joints(heads, rotations), offsets, self.keypoint_weights, ends[0] - ends[1])

    def shaped(self, shape: BodyShape) -> ShapedBody:
        """Rest mesh, weights and bind matrices of a shape.

        Raises:
            UsageError: the shape is not Anny's or names an unknown parameter.
        """
        known = (*PHENOTYPES, *LENGTHS)
        unknown = set(shape.parameters) - set(known)
        if shape.model != "anny" or unknown:
            raise UsageError(f"body shape: want model 'anny' with {known}, got {shape.model!r} {sorted(unknown)}")
        phenotype = {k: torch.tensor(float(v)) for k, v in shape.parameters.items()}
        with torch.no_grad():
            coefficients = self.coefficients(phenotype)
            vertices = self._vertices + torch.einsum("b,bvd->vd", coefficients, self._vertex_blend)
            heads = self._heads + torch.einsum("b,bjd->jd", coefficients, self._head_blend)
            rotations = _tpose_rotations(heads)
            joints = _tpose_joints(heads, rotations)
        inverse_bind = torch.eye(4).repeat(22, 1, 1)
        inverse_bind[:, :3, :3] = rotations
        inverse_bind[:, :3, 3] = -torch.einsum("jab,jb->ja", rotations, heads - heads[0])
        return ShapedBody(
            shape,
            (vertices - heads[0]).numpy().astype(np.float64),
            self.faces,
            self.skin_weights.numpy().astype(np.float64),
            inverse_bind.numpy().astype(np.float64),
            joints.numpy().astype(np.float64),
        )


def _tpose_rotations(heads: torch.Tensor) -> torch.Tensor:
    """(22, 3, 3) smallest rotations that straighten the limbs of the A-pose."""
    rotations = [torch.eye(3)] * 22
    for name, (child, direction) in _STRAIGHT.items():
        bone = heads[JOINT_INDEX[child]] - heads[JOINT_INDEX[name]]
        rotations[JOINT_INDEX[name]] = _smallest_rotation(bone, torch.tensor(direction))
    for name, leader in _FOLLOWS.items():
        rotations[JOINT_INDEX[name]] = rotations[JOINT_INDEX[leader]]
    return torch.stack(rotations)


def _smallest_rotation(start: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """Rotation of unit(start) onto the unit vector goal, I + K + K^2 / (1 + cos); differentiable."""
    unit = start / start.norm()
    x, y, z = torch.linalg.cross(unit, goal)
    zero = torch.zeros(())
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    return torch.eye(3) + skew + skew @ skew / (1 + unit @ goal)


def _tpose_joints(heads: torch.Tensor, rotations: torch.Tensor) -> torch.Tensor:
    """(22, 3) joints after each bone is rotated by its parent joint's rotation; pelvis at the origin."""
    joints = [torch.zeros(3)]
    for joint in range(1, 22):
        parent = int(PARENTS[joint])
        joints.append(joints[parent] + rotations[parent] @ (heads[joint] - heads[parent]))
    return torch.stack(joints)


def _quiet_anny() -> Any:
    """The Anny model, loaded without the start-up messages of its skinning backend."""
    import video2anim.geometry.mesh_kernels  # noqa: F401 (silences Warp, which Anny imports)

    logging.getLogger("anny").setLevel(logging.ERROR)
    import anny

    return anny.Anny(rig="mixamo", local_changes=list(LENGTHS.values()))


def _keypoint_regressor(source: Any) -> tuple[torch.Tensor, list[str]]:
    """(keypoints, V) weights of Anny's own COCO-style keypoints, and their names."""
    from anny.keypoints import KeypointsRegressor

    regressor = KeypointsRegressor.coco(source)
    weights = torch.zeros(len(regressor.labels), source.template_vertices.shape[0], dtype=source.dtype)
    dense = regressor.regression_weights
    indices = getattr(regressor, "regression_indices", None)
    if indices is None:
        weights = dense
    else:
        weights.scatter_add_(1, indices, dense)
    return weights, list(regressor.labels)


@functools.lru_cache(maxsize=1)
def anny_model() -> AnnyModel:
    """The model, loaded once per process (about 2 s)."""
    return AnnyModel()


def shaped_body(shape: BodyShape) -> ShapedBody:
    """Body of a shape: Anny, or SMPL, SMPL-H or SMPL-X from the user's own file (`smplx_body`).

    Raises:
        UsageError: unknown model or parameters, or no folder of SMPL files is named.
        InputError: the user's SMPL file is missing or cannot be used.
    """
    if shape.model.startswith("smpl"):
        from video2anim.body.smplx_body import shaped_smpl

        return shaped_smpl(shape)
    return _shaped_cached(shape.model, tuple(sorted(shape.parameters.items())))


@functools.lru_cache(maxsize=8)
def _shaped_cached(model: str, parameters: tuple[tuple[str, float], ...]) -> ShapedBody:
    return anny_model().shaped(BodyShape(model, dict(parameters)))


def rest_of(parameters: Mapping[str, float]) -> RestSkeleton:
    """Rest skeleton of a body, without gradients."""
    with torch.no_grad():
        return anny_model().rest_skeleton({name: torch.tensor(value) for name, value in parameters.items()})


def height_phenotype(parameters: Mapping[str, float], body_height_m: float) -> float:
    """Phenotype `height` with which a body stands this high, as far as the model's range goes."""

    def off_m(height: float) -> float:
        return float(rest_of({**parameters, "height": height}).body_height_m) - body_height_m

    if off_m(0.0) >= 0:
        return 0.0
    return 1.0 if off_m(1.0) <= 0 else float(root_scalar(off_m, bracket=(0.0, 1.0)).root)
