"""One solve for a motion in its scene: the prior's motion, corrected as little and as smoothly as picture, contact and
solids ask for.

Unknown are, in every frame, the displacement d of the root and one rotation vector w for each joint, in the joint's own
frame: R_parent_joint = R_reference exp(w). The reference is what the prior made. Terms, each a residual over its
standard deviation (`SolveConfig`):

- reference: w and d are small; their second differences over time are small against the accelerations of the reference,
  so that a correction adds no jerk that the prior did not have;
- picture: joints project to where the estimator saw them;
- targets: joints are where somebody wants them;
- stance: touching feet do not move; touching parts lie on a surface;
- solids: skin that is inside comes out; feet that swing stay a little above. A solid whose place is uncertain gives
  way: its displacement is unknown too.

Minimized by Gauss-Newton with reweighting (Tukey's biweight for what cannot be explained): normal equations of 69
unknowns a frame, coupled over three frames, solved by one banded factorization an iteration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from scenemi.postprocess.block_band import BlockBand, solve_together
from scenemi.postprocess.skin import PARTS, skin_of
from scenemi.postprocess.solids import Solids
from scenemi.windows import WINDOW_FRAMES
from video2anim.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from video2anim.types.skeleton import JOINT_INDEX, PARENTS, forward_kinematics

if TYPE_CHECKING:
    from video2anim.body.shaped_body import ShapedBody

JOINTS = len(PARENTS)
UNKNOWNS = 3 + 3 * JOINTS
"""Of a frame: way of the root, turns of the joints."""
STANDING = tuple(JOINT_INDEX[name] for name in ("left_ankle", "right_ankle", "left_foot", "right_foot"))
TRUNK = tuple(JOINT_INDEX[name] for name in ("pelvis", "spine1", "spine2", "spine3", "neck", "head"))


@dataclass(frozen=True, slots=True)
class SolveConfig:
    """Standard deviations of the residuals, and how long to iterate."""

    limb_rad: float = 0.08
    """Of the rotation of a limb's joint about the reference."""
    trunk_rad: float = 0.05
    """Of the rotation of the root, spine, neck and head about the reference: where trunk and scene disagree, the
    scene gives way."""
    root_m: float = 0.2
    """Of the root about the reference."""
    acceleration_ratio: float = 0.3
    """Acceleration of the correction over that of the reference (root mean square, each unknown)."""
    min_acceleration: tuple[float, float] = (0.1, 0.3)
    """Lower limits of the latter: m/s^2 of the root, rad/s^2 of the joints."""
    picture_ratio: float = 0.005
    """Of a joint in the picture, over the body's height there."""
    stance_m_s: float = 0.02
    """Of a standing foot's velocity."""
    odd_speed_m_s: float = 1.0
    """A foot as fast as this does not stand, whatever its contact says."""
    touch_m: float = 0.005
    """Of the distance of touching skin to a surface. With 15 mm, half of the feet that stand stay more than 3 cm above
    the floor where its tilt or the depth of a stride is a few degrees off."""
    touch_reach_m: float = 0.1
    """What touches something farther away touches what is not in the scene. With 0.25 m, a foot that swings over a beam
    is drawn to the floor (root-relative error 91 mm in place of 85, `pose2sim_single_cam01`)."""
    depth_m: float = 0.006
    """Of the depth of skin in solids."""
    odd_depth_m: float = 0.15
    """Skin as deep as this is not moved out: pose or solid are wrong."""
    toe_clearance_m: float = 0.01
    """Feet that do not touch keep this much above solids (toes of walkers: 1.3 cm, Winter 1992)."""
    contact_threshold: float = 0.5
    """Probability from which a part touches; it weighs the residual too."""
    iterations: int = 8
    """Of Gauss-Newton; 16 with partial keyframes (`scenemi.postprocess.in_scene.OBSERVED`)."""


@dataclass(frozen=True, slots=True, eq=False)
class PictureTarget:
    """Where the joints were seen."""

    joints_px: Float[np.ndarray, "frames 22 2"]
    seen: Bool[np.ndarray, "frames 22"]
    height_px: Float[np.ndarray, "frames"]
    """Of the standing body at its distance."""
    T_camera_world: Float[np.ndarray, "frames 4 4"]
    camera_matrix: Float[np.ndarray, "3 3"]


@dataclass(frozen=True, slots=True, eq=False)
class JointTargets:
    """Where joints are wanted (world, m), axis by axis."""

    position_m: Float[np.ndarray, "frames 22 3"]
    sigma_m: Float[np.ndarray, "frames 22 3"]
    """Standard deviation from it; infinite where the place does not matter."""

    def __post_init__(self) -> None:
        if not (self.sigma_m > 0).all() or not np.isfinite(self.position_m).all():
            raise ValueError("JointTargets: want standard deviations above 0 and finite positions")


@dataclass(frozen=True, slots=True, eq=False)
class SceneMotion:
    """What the solve starts from: a motion (world frame, +Y up, meters) and what is known of it."""

    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    translation_world_m: Float[np.ndarray, "frames 3"]
    contact: Float[np.ndarray, "frames 22"]
    """Probability of touching."""
    rest_joints_m: Float[np.ndarray, "22 3"]
    body: ShapedBody
    """Whose skin meets the scene: of this skeleton, or one like it."""
    fps: float
    fixed: Bool[np.ndarray, "frames"]
    """Frames that stay as they are."""
    picture: PictureTarget | None = None
    """None where there is no video."""
    targets: JointTargets | None = None
    uncertainty: Float[np.ndarray, "frames 3"] | None = None
    """Standard deviations of root (m), trunk and limbs (rad) about the reference, where they are known better than by
    the configuration."""


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Corrected motions, and how far each movable solid went."""

    R_parent_joint: tuple[Float[np.ndarray, "frames 22 3 3"], ...]
    translation_world_m: tuple[Float[np.ndarray, "frames 3"], ...]
    moved_m: Float[np.ndarray, "solids 3"]


def solve_motions(given: Sequence[SceneMotion], solids: Solids, config: SolveConfig | None = None) -> Solved:
    """Motions of people in one scene, corrected together."""
    config = config or SolveConfig()
    people = [_Person(one, solids, config) for one in given]
    moved_m = np.zeros((len(solids.movable), 3))
    sure = np.zeros((moved_m.size, moved_m.size))
    for k, solid in enumerate(solids.movable):
        sure[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = np.linalg.inv(solid.covariance_m2)
    for _ in range(config.iterations):
        # Not kept in a variable: of a long motion they fill hundreds of megabytes.
        steps, step_m = solve_together(
            [person.equations(moved_m) for person in people], sure, -sure @ moved_m.reshape(-1)
        )
        moved_m = moved_m + step_m.reshape(-1, 3)
        for person, step in zip(people, steps, strict=True):
            person.move(step)
    return Solved(tuple(p.R_parent_joint for p in people), tuple(p.translation_m for p in people), moved_m)


class _Person:
    """The present motion of one person, and its normal equations."""

    def __init__(self, given: SceneMotion, solids: Solids, config: SolveConfig) -> None:
        self.given, self.config = given, config
        self.solids = replace(solids, reach_m=2 * config.touch_reach_m)  # of one part some points are farther
        self.rest_m = given.rest_joints_m
        self.shift_m = np.zeros_like(given.translation_world_m)
        self.turn_rad = np.zeros((len(self.shift_m), JOINTS, 3))
        self.moved_m = np.zeros((0, 3))
        self.R_parent_joint, self.translation_m = given.R_parent_joint, given.translation_world_m
        self.skin = skin_of(given.body)
        fps2 = given.fps**2
        root = fps2 * np.diff(given.translation_world_m, n=2, axis=0)
        turning = fps2 * np.diff(_rates(given.R_parent_joint), axis=0)
        min_m, min_rad = config.min_acceleration
        usual = [np.maximum(config.acceleration_ratio * _rms(root), min_m)]
        usual += [np.maximum(config.acceleration_ratio * _rms(turning).reshape(-1), min_rad)]
        self.stiffness = fps2**2 / np.concatenate(usual) ** 2
        usual_error = np.array([[config.root_m, config.trunk_rad, config.limb_rad]])
        kind = np.concatenate([np.zeros(3, int), np.repeat(np.where(np.isin(np.arange(JOINTS), TRUNK), 1, 2), 3)])
        self.hold = (usual_error if given.uncertainty is None else given.uncertainty)[:, kind] ** -2.0

    def move(self, step: Float[np.ndarray, "frames 69"]) -> None:
        """Go on by a step of the unknowns; towards targets, which may be far away, by no more than `MAX_TURN_RAD`."""
        if self.given.targets is not None:
            step = step * min(1.0, MAX_TURN_RAD / max(float(np.abs(step[:, 3:]).max()), MAX_TURN_RAD))
        self.shift_m = self.shift_m + step[:, :3]
        turned = matrix_from_axis_angle(self.turn_rad + step[:, 3:].reshape(-1, JOINTS, 3))
        self.R_parent_joint = self.given.R_parent_joint @ turned
        self.turn_rad = axis_angle_from_matrix(turned)
        self.translation_m = self.given.translation_world_m + self.shift_m

    def equations(self, moved_m: Float[np.ndarray, "solids 3"]) -> BlockBand:
        """Gauss-Newton's normal equations at the present motion and place of the solids."""
        self.moved_m = moved_m
        joints_m, R_world_joint = forward_kinematics(self.R_parent_joint, self.translation_m, self.rest_m)
        band = BlockBand(len(joints_m), UNKNOWNS, moved_m.size)
        now = np.concatenate([self.shift_m, self.turn_rad.reshape(len(joints_m), -1)], 1)
        diagonal = np.arange(UNKNOWNS)
        band.same[:, diagonal, diagonal] += self.hold
        band.right -= self.hold * now
        band.add_second_difference(now, self.stiffness)
        self._stance(band, joints_m, R_world_joint)
        for start in range(0, len(joints_m), WINDOW_FRAMES):
            # More at once are not faster, and the memory of their rows stays below 50 MB.
            frames = slice(start, start + WINDOW_FRAMES)
            if self.given.targets is not None:
                self._targets(band, self.given.targets, frames, joints_m[frames], R_world_joint[frames])
            if self.given.picture is not None:
                self._picture(band, self.given.picture, frames, joints_m[frames], R_world_joint[frames])
            if self.solids.known:
                self._surfaces(band, frames, joints_m[frames], R_world_joint[frames])
        band.fix(self.given.fixed)
        return band

    def _picture(
        self, band: BlockBand, seen: PictureTarget, frames: slice, joints_m: np.ndarray, R_world_joint: np.ndarray
    ) -> None:
        R, t = seen.T_camera_world[frames, :3, :3], seen.T_camera_world[frames, :3, 3]
        camera_m = np.einsum("tab,tjb->tja", R, joints_m) + t[:, None]
        z_m = np.maximum(camera_m[..., 2], 0.1)
        fx, fy = seen.camera_matrix[0, 0], seen.camera_matrix[1, 1]
        focal = np.array([fx, fy])
        at_px = camera_m[..., :2] / z_m[..., None] * focal + seen.camera_matrix[:2, 2]
        in_front = (camera_m[..., 2] > 0.1) & seen.seen[frames]
        D = np.zeros((*z_m.shape, 2, 3))
        D[..., 0, 0], D[..., 1, 1] = fx / z_m, fy / z_m
        D[..., :, 2] = -camera_m[..., :2] * focal / z_m[..., None] ** 2
        off_px = seen.joints_px[frames] - at_px
        sigma_px = self.config.picture_ratio * seen.height_px[frames, None]
        weight = in_front / sigma_px**2
        directions = (D @ R[:, None]).reshape(len(D), -1, 3)
        points_m, joint = np.repeat(joints_m, 2, 1), np.repeat(np.arange(JOINTS), 2)
        rows = rows_along(joints_m, R_world_joint, points_m, joint, directions)
        _add(band, frames, rows, off_px.reshape(len(D), -1), np.repeat(weight, 2, axis=1))

    def _targets(
        self, band: BlockBand, wanted: JointTargets, frames: slice, joints_m: np.ndarray, R_world_joint: np.ndarray
    ) -> None:
        weight = wanted.sigma_m[frames] ** -2.0
        joint = np.flatnonzero(weight.any((0, 2)))
        every, shape = np.repeat(joint, 3), (len(weight), 3 * len(joint))
        along = np.broadcast_to(np.tile(np.eye(3), (len(joint), 1)), (*shape, 3))
        rows = rows_along(joints_m, R_world_joint, joints_m[:, every], every, along)
        off_m = (wanted.position_m[frames] - joints_m)[:, joint].reshape(shape)
        _add(band, frames, rows, off_m, weight[:, joint].reshape(shape))

    def _stance(self, band: BlockBand, joints_m: np.ndarray, R_world_joint: np.ndarray) -> None:
        config, fps = self.config, self.given.fps
        feet = list(STANDING)
        both = np.minimum(self.given.contact[1:], self.given.contact[:-1])[:, feet]
        speed = fps * np.diff(joints_m[:, feet], axis=0)
        slow = _believed(np.linalg.norm(speed, axis=-1) / config.odd_speed_m_s)
        weight = np.where(both > config.contact_threshold, both, 0.0) * slow / config.stance_m_s**2
        along = np.broadcast_to(np.tile(fps * np.eye(3), (len(feet), 1)), (len(joints_m), 3 * len(feet), 3))
        every = np.repeat(feet, 3)
        J = rows_along(joints_m, R_world_joint, joints_m[:, every], every, along)
        weights, off = np.repeat(weight, 3, axis=1), -speed.reshape(len(speed), 3 * len(feet))
        before, after = J[:-1] * weights[..., None], J[1:] * weights[..., None]
        band.same[:-1] += before.transpose(0, 2, 1) @ J[:-1]
        band.same[1:] += after.transpose(0, 2, 1) @ J[1:]
        band.next -= before.transpose(0, 2, 1) @ J[1:]
        band.right[:-1] -= (before.transpose(0, 2, 1) @ off[..., None])[..., 0]
        band.right[1:] += (after.transpose(0, 2, 1) @ off[..., None])[..., 0]

    def _surfaces(self, band: BlockBand, frames: slice, joints_m: np.ndarray, R_world_joint: np.ndarray) -> None:
        """Chosen skin points go a way along the surface's normal, or the surface goes against it."""
        skin_m = self.skin.at(joints_m, R_world_joint)
        distance_m, owner = self.solids.distance_m(skin_m, self.moved_m)
        index, way_m, weight = self._corrections(distance_m, self.given.contact[frames])
        active = weight > 0
        points_m, owner = np.take_along_axis(skin_m, index[..., None], 1), np.take_along_axis(owner, index, 1)
        normal = np.zeros_like(points_m)
        normal[active] = self.solids.normals(points_m[active], self.moved_m)
        rows = rows_along(joints_m, R_world_joint, points_m, self.skin.joint[index], normal)
        _add(band, frames, rows, way_m, weight)
        own = owner[..., None] == np.arange(len(self.moved_m))
        gives = (-normal[..., None, :] * own[..., None]).reshape(*owner.shape, self.moved_m.size)
        weighted = gives * weight[..., None]
        band.cross[frames] += rows.transpose(0, 2, 1) @ weighted
        band.shared += np.einsum("tpk,tpl->kl", weighted, gives)
        band.shared_right += np.einsum("tpk,tp->k", weighted, way_m)

    def _corrections(
        self, distance_m: Float[np.ndarray, "frames skin"], contact: Float[np.ndarray, "frames 22"]
    ) -> list[np.ndarray]:
        """Skin points that may not be where they should: their numbers, the way they should go in m, and its weight,
        each (frames, points)."""
        config = self.config
        margin_m = np.zeros_like(distance_m)
        found = []
        for k, part in enumerate(PARTS):
            chance = contact[:, list(part)].max(1)
            touching = np.where(chance > config.contact_threshold, chance, 0.0)
            rows = self.skin.of_part[k]
            index = rows[np.argpartition(distance_m[:, rows], TOUCHING_POINTS - 1, axis=1)[:, :TOUCHING_POINTS]]
            gap_m = np.take_along_axis(distance_m, index, 1)
            near = _believed(np.abs(gap_m).mean(1) / config.touch_reach_m)
            weight = touching * near / (config.touch_m**2 * TOUCHING_POINTS)
            found.append((index, -gap_m, np.broadcast_to(weight[:, None], gap_m.shape)))
            if k >= len(PARTS) - 2:
                margin_m[:, rows] = np.where(touching > 0, 0.0, config.toe_clearance_m)[:, None]
        missing_m = margin_m - distance_m
        index = np.argpartition(-missing_m, DEEPEST_POINTS - 1, axis=1)[:, :DEEPEST_POINTS]
        missing_m = np.take_along_axis(missing_m, index, 1)
        weight = (missing_m > 0) * _believed(np.maximum(missing_m, 0) / config.odd_depth_m) / config.depth_m**2
        found.append((index, missing_m, weight))
        index, way_m, weight = (np.concatenate(some, 1) for some in zip(*found, strict=True))
        at_work = weight.any(0)
        return [index[:, at_work], way_m[:, at_work], weight[:, at_work]]


MAX_TURN_RAD = 0.5
"""Largest turn of a joint in an iteration: beyond, the linear model is off by more than an eighth. Without it the solve
may run away where hands are to be at the knees while both feet are pinned (`gallery/hands.json`)."""
TOUCHING_POINTS = 5
"""Nearest skin points of a touching part that are brought to the surface."""
DEEPEST_POINTS = 12
"""Skin points of a frame that are brought out of solids."""


def _turned_by() -> Float[np.ndarray, "22 66"]:
    """[j, 3 a + axis]: 1 where turning joint a moves points of joint j: a is j or one of its ancestors."""
    turned = np.eye(JOINTS)
    for joint, parent in enumerate(PARENTS):  # parents come first
        if parent >= 0:
            turned[joint] += turned[parent]
    return np.repeat(turned, 3, axis=1)


TURNED_BY = _turned_by()


def rows_along(
    joints_m: Float[np.ndarray, "frames 22 3"],
    R_world_joint: Float[np.ndarray, "frames 22 3 3"],
    points_m: Float[np.ndarray, "frames points 3"],
    joint: Int[np.ndarray, "*frames points"],
    direction: Float[np.ndarray, "frames points 3"],
) -> Float[np.ndarray, "frames points 69"]:
    """How far points that move with a joint go along a direction n, by the unknowns: d p = d + sum over the joint and
    its ancestors a of (R_world_a w_a) x (p - p_a), so the row of w_a is n (p_a x R_world_a) + (p x n) R_world_a."""
    frames = len(joints_m)
    lever = np.cross(joints_m[..., None], R_world_joint, axis=2)
    turns = np.concatenate([lever, R_world_joint], 2).transpose(0, 2, 1, 3).reshape(frames, 6, 3 * JOINTS)
    turned = np.concatenate([direction, np.cross(points_m, direction)], -1) @ turns
    return np.concatenate([direction, turned * TURNED_BY[joint]], -1)


def _add(band: BlockBand, frames: slice, J: np.ndarray, off: np.ndarray, weight: np.ndarray) -> None:
    """Residuals of some frames, each of one: J (frames, rows, unknowns), off and weight (frames, rows)."""
    weighted = (J * weight[..., None]).transpose(0, 2, 1)
    band.same[frames] += weighted @ J
    band.right[frames] += (weighted @ off[..., None])[..., 0]


def _rates(R: Float[np.ndarray, "frames 22 3 3"]) -> Float[np.ndarray, "steps 22 3"]:
    """Rotation vectors from frame to frame, in each joint's frame."""
    return axis_angle_from_matrix(R[:-1].swapaxes(-1, -2) @ R[1:])


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(values**2, axis=0)) if len(values) else np.zeros(values.shape[1:])


def _believed(off: np.ndarray) -> np.ndarray:
    """Tukey's biweight: 1 at 0, nothing from 1 on."""
    return np.clip(1 - off**2, 0, None) ** 2
