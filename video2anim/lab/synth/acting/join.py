"""A captured walk followed by a procedural motion, without sliding feet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import UsageError
from video2anim.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from video2anim.lab.synth.acting.curves import ease, hermite, smooth_lift, yaw_rotation
from video2anim.lab.synth.acting.finish import cut
from video2anim.lab.synth.acting.limbs import leg_rotations
from video2anim.lab.synth.acting.measure import LEG
from video2anim.lab.synth.world import ProceduralMotion, Prop
from video2anim.types.clip import FPS
from video2anim.types.skeleton import forward_kinematics

BLEND_S = 0.8
_SETTLE_S = 0.25
"""Time in which a foot that stands at the seam takes the tilt of the procedural foot."""
_STILL_M = 0.0015
"""A joint that moves farther than this per frame has no contact."""
_REACH = 0.998
_CONTACT_COST = 2.0
_SPEED_COST_S = 0.12


def joined(
    translation_m: Float[np.ndarray, "captured 3"],
    R_parent_joint: Float[np.ndarray, "captured 22 3 3"],
    contact: Bool[np.ndarray, "captured 22"],
    procedural: ProceduralMotion,
    body: ShapedBody,
) -> ProceduralMotion:
    """The captured motion followed by the procedural one from the frame whose pose is most like the captured end.

    The procedural motion and its props are moved on the ground plane. Remaining differences of pose and speed fade out
    in `BLEND_S` seconds. A foot that stands at the seam stays there until the procedural motion lifts it.

    Raises:
        UsageError: fewer than 3 captured frames.
    """
    if len(translation_m) < 3:
        raise UsageError(f"joining motions: want at least 3 captured frames, got {len(translation_m)}")
    rest = body.rest_joints_m
    captured_joints, captured_world = forward_kinematics(R_parent_joint[-3:], translation_m[-3:], rest)
    first = _best_frame(captured_joints, captured_world, contact[-1], procedural, rest)
    procedural = cut(procedural, first, len(procedural.translation_m))
    procedural = _moved_to(procedural, captured_joints[-1], captured_world[-1], rest)
    R, translation = _faded_pose(translation_m, R_parent_joint, procedural)
    R, translation = _stand(R, translation, captured_joints, captured_world[-1], procedural, rest)
    down = procedural.contact & _still(R, translation, rest)
    count = len(translation_m) - 1
    item, held = procedural.item_pose, procedural.item_held
    return replace(
        procedural,
        translation_m=np.concatenate([translation_m[:-1], translation]),
        R_parent_joint=np.concatenate([R_parent_joint[:-1], R]),
        contact=np.concatenate([contact[:-1], down]).astype(bool),
        props=tuple(replace(p, frames=(p.frames[0] + count, p.frames[1] + count)) for p in procedural.props),
        item_pose=None if item is None else np.concatenate([np.repeat(item[:1], count, 0), item]),
        item_held=None if held is None else np.concatenate([np.repeat(held[:1], count, 0), held]),
    )


def _still(R: np.ndarray, translation: np.ndarray, rest: np.ndarray) -> Bool[np.ndarray, "frames 22"]:
    """False where a joint moves too fast for a contact."""
    joints, _ = forward_kinematics(R, translation, rest)
    step = np.linalg.norm(np.diff(joints, axis=0), axis=-1)
    fast = np.zeros(joints.shape[:2], bool)
    fast[1:] |= step > _STILL_M
    fast[:-1] |= step > _STILL_M
    return ~fast


def _heading(R_world_pelvis: np.ndarray) -> np.ndarray:
    return np.arctan2(R_world_pelvis[..., 0, 2], R_world_pelvis[..., 2, 2])


def _local(joints_m: np.ndarray, R_world: np.ndarray) -> Float[np.ndarray, "frames 22 3"]:
    """Joints in the heading frame with its origin on the floor under the pelvis, meters."""
    root = joints_m[:, 0] * np.array([1.0, 0.0, 1.0])
    return (joints_m - root[:, None]) @ yaw_rotation(_heading(R_world[:, 0]))


def _best_frame(
    captured_m: np.ndarray, captured_R: np.ndarray, contact: np.ndarray, procedural: ProceduralMotion, rest: np.ndarray
) -> int:
    """Frame of the procedural motion, before the first use of a prop, that is most like the captured end."""
    used = min((p.frames[0] for p in procedural.props), default=len(procedural.translation_m))
    limit = int(np.clip(_last_with_steps(procedural, used), 2, 0.5 * len(procedural.translation_m)))
    joints, R_world = forward_kinematics(
        procedural.R_parent_joint[: limit + 1], procedural.translation_m[: limit + 1], rest
    )
    places, speeds = _local(joints, R_world), np.diff(joints, axis=0) @ yaw_rotation(_heading(R_world[:-1, 0])) * FPS
    goal = _local(captured_m[-1:], captured_R[-1:])[0]
    goal_speed = (captured_m[-1] - captured_m[-2]) @ yaw_rotation(_heading(captured_R[-1, 0])) * FPS
    cost = np.linalg.norm(places[:-1] - goal, axis=-1).mean(1)
    cost = cost + _SPEED_COST_S * np.linalg.norm(speeds - goal_speed, axis=-1).mean(1)
    feet = [7, 8, 10, 11]
    cost = cost + _CONTACT_COST * (procedural.contact[:limit, feet] != contact[feet]).mean(1)
    return int(cost.argmin())


def _last_with_steps(procedural: ProceduralMotion, used: int) -> int:
    """Last frame after which both feet still step before the first use of a prop."""
    last = used
    for heel, ball in ((7, 10), (8, 11)):
        up = np.flatnonzero(~(procedural.contact[:used, heel] | procedural.contact[:used, ball]))
        last = min(last, int(up[-1]) - 8 if len(up) else 0)
    return last


def _moved_to(
    procedural: ProceduralMotion, joints_m: np.ndarray, R_world: np.ndarray, rest: np.ndarray
) -> ProceduralMotion:
    """The procedural motion and its props, turned and shifted so that the first pelvis is at the captured one."""
    yaw = float(_heading(R_world[0]) - _heading(procedural.R_parent_joint[0, 0]))
    R = yaw_rotation(yaw)
    shift = (joints_m[0] - R @ (procedural.translation_m[0] + rest[0])) * np.array([1.0, 0.0, 1.0])

    def prop(p: Prop) -> Prop:
        x, y, z = (float(c) for c in R @ np.array(p.position_m) + shift)
        return replace(p, position_m=(x, y, z), yaw_rad=float((p.yaw_rad + yaw + np.pi) % (2 * np.pi) - np.pi))

    rotations = procedural.R_parent_joint.copy()
    rotations[:, 0] = R @ rotations[:, 0]
    item = procedural.item_pose
    if item is not None:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, shift
        item = T @ item
    return replace(
        procedural,
        translation_m=procedural.translation_m @ R.T + shift,
        R_parent_joint=rotations,
        props=tuple(prop(p) for p in procedural.props),
        item_pose=item,
    )


def _faded_pose(
    translation_m: np.ndarray, R_parent_joint: np.ndarray, procedural: ProceduralMotion
) -> tuple[Float[np.ndarray, "frames 22 3 3"], Float[np.ndarray, "frames 3"]]:
    """Procedural rotations and translation plus the difference to the captured end in pose and speed, which fades
    out."""
    u = np.minimum(np.arange(len(procedural.translation_m)) / FPS / BLEND_S, 1.0)
    gap = translation_m[-1] - procedural.translation_m[0]
    rate = ((translation_m[-1] - translation_m[-2]) - (procedural.translation_m[1] - procedural.translation_m[0])) * FPS
    translation = procedural.translation_m + hermite(u, (gap, rate), (np.zeros(3), np.zeros(3)), BLEND_S)
    ended, began = R_parent_joint[-2:], procedural.R_parent_joint[:2]
    turn = axis_angle_from_matrix(ended[1] @ np.swapaxes(began[0], -1, -2))
    before = axis_angle_from_matrix(ended[0] @ np.swapaxes(began[0] @ np.swapaxes(began[1], -1, -2) @ began[0], -1, -2))
    spin = np.clip((turn - before) * FPS, -4.0, 4.0)
    faded = hermite(u, (turn.ravel(), spin.ravel()), (np.zeros(66), np.zeros(66)), BLEND_S).reshape(-1, 22, 3)
    return matrix_from_axis_angle(faded) @ procedural.R_parent_joint, translation


def _stand(
    R: np.ndarray, translation: np.ndarray, joints_m: np.ndarray, R_world: np.ndarray, procedural: ProceduralMotion,
    rest: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Inverse kinematics of the legs to the foot targets; the pelvis is lowered where a leg is too short."""
    procedural_joints, procedural_world = forward_kinematics(procedural.R_parent_joint, procedural.translation_m, rest)
    targets = [
        _foot_targets(
            side,
            procedural_joints,
            procedural_world,
            joints_m[-1],
            joints_m[-1] - joints_m[-2],
            R_world,
            procedural.contact,
        )
        for side in (0, 1)
    ]
    thigh, shin = np.linalg.norm(rest[4] - rest[1]), np.linalg.norm(rest[7] - rest[4])
    deficit = np.zeros(len(R))
    for side, (hip, _, _, _) in enumerate(LEG):
        hip_m = translation + rest[0] + R[:, 0] @ rest[hip]
        gap = targets[side][0] - hip_m
        room = np.sqrt(np.maximum((_REACH * (thigh + shin)) ** 2 - gap[:, 0] ** 2 - gap[:, 2] ** 2, 1e-4))
        short = -gap[:, 1] - room
        deficit = np.maximum(deficit, np.where(short > 1e-3, short, 0.0))
    translation = (
        translation
        - np.array([0.0, 1.0, 0.0]) * (smooth_lift(deficit, 0.3) * ease((np.arange(len(R)) + 1) / 5))[:, None]
    )
    joints, world = forward_kinematics(R, translation, rest)
    R = R.copy()
    for side, (hip, knee, ankle, _) in enumerate(LEG):
        place, R_foot = targets[side]
        pole = joints[:, knee] - 0.5 * (joints[:, hip] + joints[:, ankle]) + 0.08 * world[:, 0, :, 2]
        R_thigh, R_shin, _ = leg_rotations(joints[:, hip], place, pole, float(thigh), float(shin))
        R[:, hip] = np.swapaxes(world[:, 0], -1, -2) @ R_thigh
        R[:, knee] = np.swapaxes(R_thigh, -1, -2) @ R_shin
        R[:, ankle] = np.swapaxes(R_shin, -1, -2) @ R_foot
    return R, translation


def _foot_targets(
    side: int,
    procedural_m: np.ndarray,
    procedural_R: np.ndarray,
    ended_m: np.ndarray,
    ended_step_m: np.ndarray,
    ended_R: np.ndarray,
    contact: np.ndarray,
) -> tuple[Float[np.ndarray, "frames 3"], Float[np.ndarray, "frames 3 3"]]:
    """World ankle and foot orientation: offset to the captured foot while it stands; the offset fades in the next
    swing."""
    _, _, ankle, ball = LEG[side]
    down = contact[:, ankle] | contact[:, ball]
    count = len(down)
    lift = int(np.argmin(down)) if down[0] and not down.all() else (count - 1 if down[0] else 0)
    later = np.flatnonzero(down[lift + 1 :]) if lift + 1 < count else np.zeros(0, int)
    land = int(later[0]) + lift + 1 if len(later) else count - 1
    full = ended_R[ankle] @ procedural_R[0, ankle].T
    frames = np.arange(count)
    weight = 1.0 - ease((frames - lift) / max(1, land - lift))
    if not down[0]:
        span = max(1, land) / FPS
        gap, speed = (
            ended_m[ankle] - procedural_m[0, ankle],
            (ended_step_m[ankle] - procedural_m[1, ankle] + procedural_m[0, ankle]) * FPS,
        )
        fade = hermite(np.minimum(frames / FPS / span, 1.0), (gap, speed), (np.zeros(3), np.zeros(3)), span)
        R_off = matrix_from_axis_angle(weight[:, None] * axis_angle_from_matrix(full))
        return procedural_m[:, ankle] + fade, R_off @ procedural_R[:, ankle]
    ahead = full @ np.array([0.0, 0.0, 1.0])
    yaw = float(np.arctan2(ahead[0], ahead[2]))
    soon = 1.0 - ease(frames / (_SETTLE_S * FPS))
    tilt = matrix_from_axis_angle(soon[:, None] * axis_angle_from_matrix(full @ yaw_rotation(yaw).T))
    arm = (procedural_m[:, ankle] - procedural_m[0, ball]) @ yaw_rotation(yaw).T
    still = ended_m[ball] + (tilt @ arm[..., None])[..., 0]
    still[:, 1] += (1.0 - soon) * (procedural_m[0, ball, 1] - ended_m[ball, 1])
    gap = (still - procedural_m[:, ankle])[np.minimum(frames, lift)]
    R_off = tilt @ yaw_rotation(weight * yaw)
    return procedural_m[:, ankle] + weight[:, None] * gap, R_off @ procedural_R[:, ankle]
