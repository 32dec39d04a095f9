"""Random bodies before random cameras, seen with the errors of a landmark model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from scenemi.data.augment import MIRROR_JOINT
from video2anim.body.anny_body import anny_model
from video2anim.body.skeleton import JOINT_INDEX, forward_kinematics
from video2anim.fitting.initial import ray_rotation
from video2anim.fitting.landmarks import KEYPOINT_INDEX
from video2anim.fitting.lifter_input import LIFTER_FPS, ray_features
from video2anim.geometry.rotations import matrix_from_axis_angle, rot6d_from_matrix
from video2anim.lifting.motions import LiftingMotions
from video2anim.lifting.residuals import ResidualLibrary
from video2anim.synth.compose import draw_shape
from video2anim.types import Intrinsics

_HIPS = [KEYPOINT_INDEX["left_hip"], KEYPOINT_INDEX["right_hip"]]
_MIRRORED_CONTACTS = np.array([1, 0, 3, 2, 5, 4, 6, 7])
_ARMS = np.array(
    [JOINT_INDEX[f"{side}_{part}"] for side in ("left", "right") for part in ("shoulder", "elbow", "wrist")]
)
_WIDE = np.array([JOINT_INDEX[f"{side}_{part}"] for side in ("left", "right") for part in ("shoulder", "hip")])
_LEGS = np.array([JOINT_INDEX[f"{side}_{part}"] for side in ("left", "right") for part in ("hip", "knee", "ankle")])
_NOT_HANDS = np.array([True, True, True, True, False, False, True, True])
_NOT_FEET = np.array([False, False, False, False, True, True, False, False])
_OTHER_ARMS, _OTHER_LEGS, _TURNED, _SWUNG, _LEANING = 0.25, 0.15, 0.3, 0.35, 0.15
"""Shares of the windows."""
_ROLLED = 0.5
"""Share of the windows whose camera is held askew."""
_SHAPES = 96
_CANDIDATES = 24
"""Of so many runs of residuals the one is taken whose pose is nearest."""
_LONGEST_RUN = 45
_UNIT = Intrinsics(1.0, 1.0, 0.0, 0.0, 1, 1)


@dataclass(frozen=True, slots=True, eq=False)
class LiftingBatch:
    """Windows with their truth, in the frame of each frame's viewing ray."""

    features: Float[Tensor, "batch frames features"]
    rot6d: Float[Tensor, "batch frames 22 6"]
    joints_m: Float[Tensor, "batch frames 22 3"]
    """Relative to the pelvis."""
    rest_joints_m: Float[Tensor, "batch 22 3"]
    log_size: Float[Tensor, "batch frames"]
    """Logarithm of the pelvis's depth times the size that the features were divided by."""
    offset_m: Float[Tensor, "batch frames 2"]
    """Of the pelvis from the viewing ray."""
    contact: Float[Tensor, "batch frames 8"]
    contact_known: Float[Tensor, "batch frames 8"]
    up: Float[Tensor, "batch frames 3"]


class LiftingSampler:
    """Batches; everything random comes from (seed, step)."""

    def __init__(
        self,
        motions: LiftingMotions,
        residuals: ResidualLibrary,
        *,
        seed: int,
        frames: int = 81,
        noise: bool = True,
        varied: bool = True,
    ) -> None:
        self.motions, self.residuals, self.seed, self.frames = motions, residuals, seed, frames
        self.noise, self.varied = noise, varied
        rng = np.random.default_rng([seed, 0x5A])
        model = anny_model()
        with torch.no_grad():
            self._bodies = [
                model.rest_skeleton({name: torch.tensor(value) for name, value in draw_shape(rng).parameters.items()})
                for _ in range(_SHAPES)
            ]
        self._runs = np.flatnonzero(np.diff(residuals.start) >= 12)
        lengths = np.diff(motions.start)
        self._clips = np.flatnonzero(lengths >= 20)
        share = np.minimum(lengths[self._clips], 900).astype(float)
        self._share = share / share.sum()

    def batch(self, step: int, size: int) -> LiftingBatch:
        """One batch of windows."""
        rng = np.random.default_rng([self.seed, step])
        windows = [self._window(rng) for _ in range(size)]
        return LiftingBatch(*(torch.from_numpy(np.stack(column)) for column in zip(*windows, strict=True)))

    def _window(self, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        R, translation, contact, known = self._moved(rng)
        if self.varied:
            R, known = self._varied(rng, R, known)
        body = self._bodies[int(rng.integers(_SHAPES))]
        rest = body.rest_joints_m.numpy().astype(np.float64)
        R_camera_world, up = _camera_rotation(rng)
        R[:, 0] = R_camera_world @ R[:, 0]
        joints, R_joint = forward_kinematics(R, translation @ R_camera_world.T, rest)
        joints = joints + _place(rng, joints)
        with torch.no_grad():
            points = body.keypoints_m(torch.from_numpy(joints).float(), torch.from_numpy(R_joint).float()).numpy()
        features, R_ray, size, askew = self._seen(rng, points)
        R[:, 0] = askew @ R[:, 0]
        joints, up = joints @ askew.T, askew @ up
        R[:, 0] = np.swapaxes(R_ray, -1, -2) @ R[:, 0]
        pelvis = np.einsum("tba,tb->ta", R_ray, joints[:, 0])
        relative = np.einsum("tba,tjb->tja", R_ray, joints - joints[:, :1])
        single = (
            features, rot6d_from_matrix(R), relative, rest, np.log(pelvis[:, 2] * size), pelvis[:, :2],
            contact, known, np.einsum("tba,b->ta", R_ray, up),
        )  # fmt: skip
        return tuple(part.astype(np.float32) for part in single)

    def _moved(self, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        """A piece of a clip, perhaps mirrored, at a speed of its own, turned about the vertical axis."""
        m = self.motions
        clip = int(rng.choice(self._clips, p=self._share))
        first, last = int(m.start[clip]), int(m.start[clip + 1]) - 1
        speed = rng.choice([1, 1, 1, 2]) if last - first > 2 * self.frames else 1
        begin = int(rng.integers(first, max(last - speed * self.frames, first) + 1))
        rows = np.minimum(begin + speed * np.arange(self.frames), last)
        if speed == 1 and rng.random() < 0.1 and last - first > self.frames:
            rows = rows[::-1]
        R, translation = m.R_parent_joint[rows].astype(np.float64), m.translation_m[rows].astype(np.float64)
        contact, known = m.contact[rows], m.contact_known[rows]
        if rng.random() < 0.5:
            flip = np.array([1.0, -1.0, -1.0])
            R = R[:, MIRROR_JOINT] * flip[:, None] * flip
            translation = translation * np.array([-1.0, 1.0, 1.0])
            contact, known = contact[:, _MIRRORED_CONTACTS], known[:, _MIRRORED_CONTACTS]
        turn = matrix_from_axis_angle(np.array([0.0, rng.uniform(-np.pi, np.pi), 0.0]))
        R[:, 0] = turn @ R[:, 0]
        return R, translation @ turn.T, contact, known

    def _varied(
        self, rng: np.random.Generator, R: Float[np.ndarray, "frames 22 3 3"], known: Bool[np.ndarray, "frames 8"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses that the clips lack: arms or legs of another clip, limbs that swing wide, limbs and trunk turned by a
        steady amount, bodies that lean. People in videos do what no clip shows, and there the network has to believe
        its eyes."""
        if rng.random() < _OTHER_ARMS:
            arms = self._moved(rng)[0][:, _ARMS]
            R[:, _ARMS] = arms
            known = known & _NOT_HANDS
        if rng.random() < _OTHER_LEGS:
            R[:, _LEGS] = self._moved(rng)[0][:, _LEGS]
            known = known & _NOT_FEET
        if rng.random() < _SWUNG:
            R[:, _WIDE] = R[:, _WIDE] @ _swings(rng, self.frames)
            known = np.zeros_like(known)
        if rng.random() < _LEANING:
            R[:, 0] = matrix_from_axis_angle(rng.normal(0, 0.2, 3) * np.array([1.0, 0.0, 1.0])) @ R[:, 0]
            known = np.zeros_like(known)
        if rng.random() < _TURNED:
            turned = rng.random(22) < 0.35
            turned[0] = False
            spread = np.where(np.isin(np.arange(22), _WIDE), 0.45, 0.2)[:, None]
            offset = matrix_from_axis_angle(rng.normal(0, 1, (22, 3)) * spread * turned[:, None])
            R = R @ offset
            known = np.zeros_like(known)
        return R, known

    def _seen(
        self, rng: np.random.Generator, points: Float[np.ndarray, "frames keypoints 3"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Features, ray frames, sizes, and by how much the camera was held askew: a turn about its axis, to be applied
        to the truth. A landmark model turns its crop upright and its answer back, so its errors turn along."""
        frames = len(points)
        ray = points / np.maximum(points[..., 2:], 0.1)
        R_true = ray_rotation(ray[:, _HIPS].mean(1)[:, :2], _UNIT)
        in_ray = points @ R_true
        relative = in_ray - in_ray[:, _HIPS].mean(1, keepdims=True)
        directions = in_ray[..., :2] / in_ray[..., 2:]
        visibility = np.ones(points.shape[:2])
        valid = np.ones(frames, bool)
        if self.noise:
            error_2d, error_3d, visibility = self._errors(rng, relative)
            spread = directions - directions[:, _HIPS].mean(1, keepdims=True)
            size = np.sqrt((spread**2).sum(-1).mean(1))
            directions = directions + error_2d * size[:, None, None]
            relative = relative * np.exp(rng.normal(0, 0.03)) + error_3d
            tilt = matrix_from_axis_angle(rng.normal(0, 0.05, 3) * np.array([1.0, 1.0, 0.3]))
            relative = relative @ tilt.T
            if rng.random() < 0.15:
                gone = int(rng.integers(frames))
                valid[gone : gone + int(rng.integers(1, 12))] = False
        roll = rng.normal(0.0, 0.25) if self.varied and rng.random() < _ROLLED else 0.0
        askew = matrix_from_axis_angle(np.array([0.0, 0.0, roll]))
        seen_ray = np.concatenate([directions, np.ones((*directions.shape[:2], 1))], -1)
        camera_ray = np.einsum("tab,tkb->tka", askew @ R_true, seen_ray)
        camera_ray /= np.maximum(camera_ray[..., 2:], 0.1)
        if self.noise:
            # The focal length is never known exactly.
            camera_ray[..., :2] *= np.exp(rng.normal(0, 0.08))
        R_ray = ray_rotation(camera_ray[:, _HIPS].mean(1)[:, :2], _UNIT)
        given = ray_features(camera_ray, R_ray, relative @ askew.T, visibility, valid)
        return given.features, R_ray, given.size, askew

    def _errors(
        self, rng: np.random.Generator, relative_m: Float[np.ndarray, "frames keypoints 3"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals of runs that were in much the same pose, joined until all frames have one."""
        lib, frames = self.residuals, len(relative_m)
        rows = np.empty(frames, int)
        begin = 0
        while begin < frames:
            runs = rng.choice(self._runs, _CANDIDATES)
            at = (lib.start[runs] + rng.random(_CANDIDATES) * (np.diff(lib.start)[runs] - 8)).astype(int)
            near = ((lib.truth_m[at] - relative_m[begin]) ** 2).sum((1, 2)).argmin()
            first = int(at[near])
            length = min(int(lib.start[runs[near] + 1]) - first, frames - begin, _LONGEST_RUN)
            rows[begin : begin + length] = np.arange(first, first + length)
            begin += length
        scale = rng.uniform(0.2, 1.1), rng.uniform(0.2, 1.1)
        bias = rng.normal(0, 0.012, (1, relative_m.shape[1], 3))
        jitter = rng.normal(0, 0.006, (*relative_m.shape[:2], 3))
        seen: Bool[np.ndarray, "frames keypoints"] = lib.visibility[rows]
        return (
            scale[0] * (lib.pixels[rows] + jitter[..., :2] + bias[..., :2]),
            scale[1] * (lib.points_m[rows] + bias + jitter),
            seen,
        )


def _camera_rotation(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """R_camera_world of a camera that looks along the ground, more often down than up, and up in it."""
    pitch = np.clip(rng.normal(0.17, 0.22), -0.5, 1.1)
    roll = rng.normal(0.0, 0.05)
    level = np.diag([1.0, -1.0, -1.0])
    down = matrix_from_axis_angle(np.array([pitch, 0.0, 0.0]))
    rolled = matrix_from_axis_angle(np.array([0.0, 0.0, roll]))
    R = rolled @ down @ level
    return R, R @ np.array([0.0, 1.0, 0.0])


def _swings(rng: np.random.Generator, frames: int) -> Float[np.ndarray, "frames 4 3 3"]:
    """Turns of hips and shoulders that rise and fall over the window; half of them stay as they are."""
    time_s = np.arange(frames)[:, None, None] / LIFTER_FPS
    axis = rng.normal(0, 0.5, (2, 4, 3)) * (rng.random((1, 4, 1)) < 0.5)
    rate = 2 * np.pi * rng.uniform(0.1, 1.2, (1, 4, 1))
    wave = np.sin(rate * time_s + rng.uniform(0, 2 * np.pi, (1, 4, 1)))
    return matrix_from_axis_angle(axis[0] + axis[1] * wave)


def _place(rng: np.random.Generator, joints: Float[np.ndarray, "frames 22 3"]) -> Float[np.ndarray, "3"]:
    """Shift of a body to a random place in the picture, near enough to be seen and before the camera throughout."""
    middle = joints[:, 0].mean(0)
    reach = np.abs(joints - middle).max((0, 1))
    depth = max(np.exp(rng.uniform(np.log(1.8), np.log(8.0))), reach[2] + 1.0, 0.9 * reach[:2].max())
    aside = depth * rng.normal(0, [0.2, 0.1])
    return np.array([*aside, depth]) - middle
