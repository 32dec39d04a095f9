"""Training batches: random bodies in front of random cameras, with the errors of a landmark model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from video2anim.geometry.rotations import matrix_from_axis_angle, matrix_from_rot6d, rot6d_from_matrix
from video2anim.humans.initial import landmark_rotation, ray_rotation
from video2anim.humans.landmarks import KEYPOINT_INDEX
from video2anim.humans.lifter_input import ray_features
from video2anim.lab.lifter.bodies import draw_bodies
from video2anim.lab.lifter.contacts import MIRRORED
from video2anim.lab.lifter.kinematics import planes, posed
from video2anim.lab.lifter.landmark_errors import LandmarkErrors, SimulatedLandmarks
from video2anim.lab.lifter.motions import LiftingMotions
from video2anim.lab.lifter.residuals import ResidualLibrary
from video2anim.lab.lifter.variation import varied
from video2anim.lab.lifter.views import draw_views
from video2anim.types import Intrinsics
from video2anim.types.skeleton import MIRROR_JOINT

WINDOW_FRAMES = 96
_HIPS = [KEYPOINT_INDEX["left_hip"], KEYPOINT_INDEX["right_hip"]]
_MIRROR_ROT6D = torch.tensor([1.0, -1.0, -1.0, -1.0, 1.0, 1.0])
"""Signs of the first two columns of a rotation in the mirror x -> -x."""
_SLOWER_OR_FASTER, _SLOWEST, _FASTEST = 0.4, 0.7, 1.6
"""Share of the windows with another speed, and the range of the factor on the speed."""
_BACKWARD = 0.05
"""Share of the windows played backward."""
_ASKEW, _ASKEW_RAD = 0.4, 0.25
"""Share of the windows with a rolled camera, and the standard deviation of the roll."""
_LONGEST_SHARE = 900
"""Number of frames above which a clip is not drawn more often, so that a few long clips do not dominate."""
_SHAPES = 192
_FOCAL_ERROR = 0.08
"""Standard deviation of the logarithm of assumed over true focal length."""
_UNIT = Intrinsics(1.0, 1.0, 0.0, 0.0, 1, 1)


@dataclass(frozen=True, slots=True, eq=False)
class LiftingBatch:
    """Windows with their truth, in the viewing ray frame of each frame."""

    features: Float[Tensor, "batch frames features"]
    rot6d: Float[Tensor, "batch frames 22 6"]
    joints_m: Float[Tensor, "batch frames 22 3"]
    """Relative to the pelvis."""
    rest_joints_m: Float[Tensor, "batch 22 3"]
    log_size: Float[Tensor, "batch frames"]
    """Logarithm of the pelvis's depth times the size by which the features are divided."""
    pelvis_m: Float[Tensor, "batch frames 3"]
    """Offset from the viewing ray (x, y), and depth."""
    contact: Float[Tensor, "batch frames 8"]
    contact_known: Float[Tensor, "batch frames 8"]
    up: Float[Tensor, "batch frames 3"]


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedWindow:
    """One window: simulated output of a landmark model for a camera with focal length 1, and the truth."""

    directions: Float[np.ndarray, "frames keypoints 2"]
    """x and y of the viewing rays at depth 1."""
    points_m: Float[np.ndarray, "frames keypoints 3"]
    """3D landmarks in the frame of the model's output (`landmark_rotation`)."""
    visibility: Float[np.ndarray, "frames keypoints"]
    valid: Bool[np.ndarray, "frames"]
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    """Local rotations; joint 0 is the root's orientation in the world."""
    R_camera_world: Float[np.ndarray, "3 3"]
    pelvis_camera_m: Float[np.ndarray, "frames 3"]


class LiftingSampler:
    """Makes batches; all random numbers depend on (seed, step) only."""

    def __init__(
        self,
        motions: LiftingMotions,
        residuals: ResidualLibrary,
        *,
        seed: int,
        frames: int = WINDOW_FRAMES,
        noise: bool = True,
        varied: bool = True,
    ) -> None:
        self.motions, self.library, self.seed, self.frames = motions, residuals, seed, frames
        self.noise, self.varied = noise, varied
        self._bodies = draw_bodies(np.random.default_rng([seed, 0x5A]), _SHAPES)
        self._errors = LandmarkErrors(residuals)
        lengths = np.diff(motions.start)
        self._clips = np.flatnonzero(lengths >= 20)
        share = np.minimum(lengths[self._clips], _LONGEST_SHARE).astype(float)
        self._share = share / share.sum()

    def batch(self, step: int, size: int) -> LiftingBatch:
        """The batch of `size` windows of a training step."""
        rng = np.random.default_rng([self.seed, step])
        R, translation, contact, known = self._moved(rng, size)
        if self.varied:
            R, known = varied(rng, R, known)
        body = torch.from_numpy(rng.integers(0, _SHAPES, size))
        rest = self._bodies.rest_joints_m[body]
        joint_planes, R_joint = posed(planes(R), rest)
        joint_planes = joint_planes + translation.permute(2, 0, 1)[:, None]
        joints = joint_planes.permute(2, 3, 1, 0).contiguous()
        view = draw_views(rng, joints)
        R_camera_world = view.R_camera_world[:, None]
        joints, points = (
            part @ R_camera_world.transpose(-1, -2) + view.t_camera_m[:, None, None]
            for part in (joints, self._bodies.keypoints_m(body, joint_planes, R_joint).contiguous())
        )
        features, given_size, R_camera_ray, R_askew = self._seen(rng, points, view.half)
        R_ray_camera = R_camera_ray.transpose(-1, -2) @ R_askew[:, None]
        R_ray_world = R_ray_camera @ R_camera_world
        R[:, :, 0] = R_ray_world @ R[:, :, 0]
        pelvis = (R_ray_camera @ joints[:, :, 0, :, None])[..., 0]
        relative = (joints - joints[:, :, :1]) @ R_ray_camera.transpose(-1, -2)
        return LiftingBatch(
            features, rot6d_from_matrix(R), relative, rest, (pelvis[..., 2] * given_size).log(), pelvis,
            contact.float(), known.float(), R_ray_world[..., 1],
        )  # fmt: skip

    def simulate(self, rng: np.random.Generator) -> SimulatedWindow:
        """One window of an unchanged clip with all errors of the landmark model."""
        R, translation, _, _ = self._moved(rng, 1)
        body = torch.from_numpy(rng.integers(0, _SHAPES, 1))
        joint_planes, R_joint = posed(planes(R), self._bodies.rest_joints_m[body])
        joint_planes = joint_planes + translation.permute(2, 0, 1)[:, None]
        view = draw_views(rng, joint_planes.permute(2, 3, 1, 0).contiguous())
        to_camera = view.R_camera_world[:, None].transpose(-1, -2), view.t_camera_m[:, None, None]
        joints = joint_planes.permute(2, 3, 1, 0) @ to_camera[0] + to_camera[1]
        points = self._bodies.keypoints_m(body, joint_planes, R_joint).contiguous() @ to_camera[0] + to_camera[1]
        R_true = _ray_rotations(points)
        in_ray = points @ R_true
        inside = ((points[..., :2] / points[..., 2:].clamp_min(0.1)).abs() < view.half[:, None, None]).all(-1)
        relative = in_ray - in_ray[:, :, _HIPS].mean(2, keepdim=True)
        found = self._errors(rng, in_ray[..., :2] / in_ray[..., 2:].clamp_min(0.1), relative, inside)
        ray = torch.cat([found.directions, torch.ones_like(found.directions[..., :1])], -1) @ R_true.transpose(-1, -2)
        directions = (ray[..., :2] / ray[..., 2:].clamp_min(0.1))[0].numpy().astype(np.float64)
        up_camera = np.tile(view.R_camera_world[0, :, 1].numpy().astype(np.float64), (self.frames, 1))
        R_landmarks = landmark_rotation(directions[:, _HIPS].mean(1), _UNIT, up_camera)
        in_camera = (found.points_m @ R_true.transpose(-1, -2))[0].numpy().astype(np.float64)
        return SimulatedWindow(
            directions, in_camera @ R_landmarks, found.visibility[0].numpy(), found.valid[0].numpy(),
            R[0].numpy().astype(np.float64), view.R_camera_world[0].numpy().astype(np.float64),
            joints[0, :, 0].numpy().astype(np.float64),
        )  # fmt: skip

    def _moved(self, rng: np.random.Generator, size: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Parts of clips at random speeds, some mirrored, rotated about the vertical axis."""
        m = self.motions
        row, share = self._rows(rng, size)
        after = row + (share > 0)
        share = torch.from_numpy(share).float()[..., None]
        rot6d, translation = (
            torch.lerp(torch.from_numpy(part[row]), torch.from_numpy(part[after]), share.unflatten(-1, shape))
            for part, shape in ((m.rot6d, (1, 1)), (m.translation_m, (1,)))
        )
        contact, known = torch.from_numpy(m.contact[row]), torch.from_numpy(m.contact_known[row])
        mirrored = torch.from_numpy(rng.random(size) < 0.5)
        rot6d[mirrored] = rot6d[mirrored][:, :, MIRROR_JOINT] * _MIRROR_ROT6D
        translation[mirrored] *= torch.tensor([-1.0, 1.0, 1.0])
        contact[mirrored], known[mirrored] = (part[mirrored][..., MIRRORED] for part in (contact, known))
        R = matrix_from_rot6d(rot6d)
        yaw = np.stack([np.zeros(size), rng.uniform(-np.pi, np.pi, size), np.zeros(size)], -1)
        turn = torch.from_numpy(matrix_from_axis_angle(yaw)).float()[:, None]
        R[:, :, 0] = turn @ R[:, :, 0]
        return R, translation @ turn[:, 0].transpose(-1, -2), contact, known

    def _rows(
        self, rng: np.random.Generator, size: int
    ) -> tuple[Int[np.ndarray, "batch frames"], Float[np.ndarray, "batch frames"]]:
        """Rows of the clips, and the interpolation weight of the next row. After its end a clip stands still."""
        clip = rng.choice(self._clips, size, p=self._share)
        first, last = self.motions.start[clip], self.motions.start[clip + 1] - 1
        other = self.varied & (rng.random(size) < _SLOWER_OR_FASTER)
        speed = np.where(other, np.exp(rng.uniform(np.log(_SLOWEST), np.log(_FASTEST), size)), 1.0)
        spare = np.maximum(last - first - speed * (self.frames - 1), 0.0)
        begin = first + np.floor(rng.random(size) * (spare + 1))
        place = np.minimum(begin[:, None] + speed[:, None] * np.arange(self.frames), last[:, None])
        backward = self.varied & (rng.random(size) < _BACKWARD)
        place[backward] = place[backward, ::-1]
        row = np.floor(place).astype(int)
        return row, place - row

    def _seen(
        self, rng: np.random.Generator, points_m: Float[Tensor, "batch frames keypoints 3"], half: Float[Tensor, "b 2"]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Features, sizes, viewing ray frames, and the roll of each camera (a rotation to be applied to the truth).

        A landmark model rotates its crop upright and its output back, so its errors rotate with the roll."""
        batch, frames = points_m.shape[:2]
        R_true = _ray_rotations(points_m)
        in_ray = points_m @ R_true
        directions = in_ray[..., :2] / in_ray[..., 2:].clamp_min(0.1)
        relative = in_ray - in_ray[:, :, _HIPS].mean(2, keepdim=True)
        roll = rng.normal(0.0, _ASKEW_RAD, batch) * (self.varied & (rng.random(batch) < _ASKEW))
        vector = np.stack([np.zeros(batch), np.zeros(batch), roll], -1)
        R_askew = torch.from_numpy(matrix_from_axis_angle(vector)).float()
        R_camera_ray = R_askew[:, None] @ R_true
        if self.noise:
            true_ray = in_ray @ R_camera_ray.transpose(-1, -2)
            picture = true_ray[..., :2] / true_ray[..., 2:].clamp_min(0.1)
            inside = (picture.abs() < half[:, None, None]).all(-1)
            found = self._errors(rng, directions, relative, inside)
            focal = np.exp(rng.normal(0, _FOCAL_ERROR, (batch, 1, 1, 1)))
        else:
            seen = torch.ones(batch, frames, points_m.shape[2])
            found, focal = SimulatedLandmarks(directions, relative, seen, seen[..., 0] > 0), np.ones(1)
        ray = torch.cat([found.directions, torch.ones_like(found.directions[..., :1])], -1)
        ray = ray @ R_camera_ray.transpose(-1, -2)
        ray = ray[..., :2] / ray[..., 2:].clamp_min(0.1) * torch.from_numpy(focal).float()
        ray = torch.cat([ray, torch.ones_like(ray[..., :1])], -1)
        R_given = _ray_rotations(ray)
        landmarks = found.points_m @ R_askew[:, None].transpose(-1, -2)
        given = ray_features(
            ray.numpy(), R_given.numpy(), landmarks.numpy(), found.visibility.numpy(), found.valid.numpy()
        )
        return torch.from_numpy(given.features), torch.from_numpy(given.size).float(), R_given, R_askew


def _ray_rotations(points: Float[Tensor, "batch frames keypoints 3"]) -> Float[Tensor, "batch frames 3 3"]:
    """`ray_rotation` of the center of the hips in the picture."""
    hips = (points[:, :, _HIPS, :2] / points[:, :, _HIPS, 2:].clamp_min(0.1)).mean(2)
    return torch.from_numpy(ray_rotation(hips.reshape(-1, 2).numpy(), _UNIT)).float().reshape(*hips.shape[:2], 3, 3)
