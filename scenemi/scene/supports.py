"""What a motion rests on: seats under low still hips, beds under lying bodies, steps under raised still feet, and
tables under still hands. Each is put against the body's lowest point there, and left out where it would be in its way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scenemi.scene.body_spheres import BodySpheres
from scenemi.scene.boxes import Boxes
from scenemi.scene.furniture import Piece, block, seat_of, table_of
from scenemi.scene.sliding import Slide, SweptBody, nearest_free
from video2anim.geometry.runs import runs
from video2anim.types.skeleton import JOINT_INDEX

_HIPS = [JOINT_INDEX[n] for n in ("pelvis", "left_hip", "right_hip")]
_TRUNK = [JOINT_INDEX[n] for n in ("pelvis", "spine1", "spine2", "spine3", "left_hip", "right_hip")]
_FEET = tuple((JOINT_INDEX[f"{s}_ankle"], JOINT_INDEX[f"{s}_foot"]) for s in ("left", "right"))
_WRISTS = (JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"])
_BACK = JOINT_INDEX["spine3"]
_PELVIS, _HEAD = JOINT_INDEX["pelvis"], JOINT_INDEX["head"]
_TOUCH_M = 0.002
"""Supports end this far below the lowest sphere, so that spheres do not block them."""
_CARRIED_M = 0.05
"""A part with a support this near needs no other."""


@dataclass(frozen=True, slots=True)
class RestConfig:
    """What counts as resting."""

    slowest_m_s: float = 0.15
    """A joint slower than this rests (not measured)."""
    pelvis_frames: int = 12
    """Shortest rest of the hips, and `foot_frames` and `hand_frames` of feet and hands."""
    foot_frames: int = 6
    hand_frames: int = pelvis_frames
    low_hips: float = 0.8
    """Hips lower than this share of the leg's length are carried by something."""
    lying_head_m: float = 0.35
    """A head less than this above the pelvis belongs to a lying body."""
    raised_m: float = 0.07
    """Feet higher than this stand on a step; hips and trunks are carried by furniture above twice this."""
    hand_height_m: tuple[float, float] = (0.4, 1.2)
    """Of tables and counters, from low to a bar."""
    hand_share: float = 0.5
    """Share of still hands that get a table."""
    hip_share: float = 0.9
    """Share of low still hips and lying bodies that get a seat or bed."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What supports are derived from, canonical frame."""

    joints_m: Float[np.ndarray, "frames 22 3"]
    R_world_joint: Float[np.ndarray, "frames 22 3 3"]
    contact: Bool[np.ndarray, "frames 22"]
    """Joints known to rest; all False where nothing is known."""
    spheres: BodySpheres
    body: SweptBody
    fps: float


def supports(rng: np.random.Generator, motion: Motion, config: RestConfig) -> list[tuple[str, Boxes]]:
    """Named supports, none with a sphere of the body in it."""
    speed = np.linalg.norm(np.diff(motion.joints_m, axis=0, prepend=motion.joints_m[:1]), axis=-1) * motion.fps
    still = speed < config.slowest_m_s
    found: list[tuple[str, Boxes]] = []
    for under in (_under_hips, _under_feet, _under_hands):
        under(rng, motion, still, config, found)
    return found


def _under_hips(
    rng: np.random.Generator, motion: Motion, still: np.ndarray, config: RestConfig, found: list[tuple[str, Boxes]]
) -> None:
    joints_m = motion.joints_m
    leg_m = np.linalg.norm(joints_m[0, [4, 7]] - joints_m[0, [1, 4]], axis=-1).sum() + 0.08
    height_m = joints_m[:, _PELVIS, 1]
    low = height_m < config.low_hips * leg_m
    near = np.isin(motion.spheres.joint, _HIPS)
    for start, stop in runs((still[:, _PELVIS] & low) | motion.contact[:, _PELVIS]):
        center = (start + stop) // 2
        if stop - start < config.pelvis_frames or rng.random() > config.hip_share:
            continue
        pelvis_m = joints_m[center, _PELVIS]
        lying = joints_m[center, _HEAD, 1] - pelvis_m[1] < config.lying_head_m
        spheres = np.isin(motion.spheres.joint, _TRUNK) if lying else near
        top_m = _bottom_m(motion, spheres, start, stop, pelvis_m, 0.6 if lying else 0.22)
        if top_m < 2 * config.raised_m or _carried(found, pelvis_m, top_m):
            continue
        add = _bed if lying else _seat
        boxes = add(rng, motion, center, top_m - _TOUCH_M)
        if boxes is not None:
            found.append(("bed" if lying else "seat", boxes))
        if not lying and motion.contact[start:stop, _BACK].any():
            found += _behind_back(rng, motion, center, top_m)


def _behind_back(rng: np.random.Generator, motion: Motion, frame: int, top_m: float) -> list[tuple[str, Boxes]]:
    facing = motion.R_world_joint[frame, _PELVIS, :, 2]
    rest = block("backrest", rng.uniform(0.4, 0.6), top_m + rng.uniform(0.35, 0.6), rng.uniform(0.04, 0.15), low=top_m)
    boxes = _slid(motion, rest, float(np.arctan2(facing[0], facing[2])), motion.joints_m[frame, _BACK], -0.1, 0.25)
    return [] if boxes is None else [("backrest", boxes)]


def _bottom_m(
    motion: Motion, spheres: np.ndarray, start: int, stop: int, around_m: np.ndarray, within_m: float
) -> float:
    """Lowest point of spheres near a place in some frames."""
    center_m, radius_m = motion.body.center_m[:, start:stop][:, :, spheres], motion.body.radius_m[spheres]
    beside2 = (center_m[0] - around_m[0]) ** 2 + (center_m[2] - around_m[2]) ** 2
    bottom_m = np.where(beside2 < within_m**2, center_m[1] - radius_m, np.inf)
    return float(bottom_m.min())


def _seat(rng: np.random.Generator, motion: Motion, frame: int, top_m: float) -> Boxes | None:
    facing = motion.R_world_joint[frame, _PELVIS, :, 2]
    yaw = float(np.arctan2(facing[0], facing[2]))
    for _ in range(3):
        seat = seat_of("seat", top_m, rng)
        boxes = _slid(motion, seat, yaw, motion.joints_m[frame, _PELVIS], rng.uniform(0.22, 0.36), 0.25)
        if boxes is not None:
            return boxes
    return _slid(motion, block("seat", 0.36, top_m, 0.34, low=max(0.0, top_m - 0.06)), yaw,
                 motion.joints_m[frame, _PELVIS], 0.2, 0.2)  # fmt: skip


def _bed(rng: np.random.Generator, motion: Motion, frame: int, top_m: float) -> Boxes | None:
    spine = motion.joints_m[frame, _HEAD] - motion.joints_m[frame, _PELVIS]
    yaw = float(np.arctan2(spine[0], spine[2]) + rng.choice([-0.5, 0.5]) * np.pi)
    center_m = motion.joints_m[frame, [_HEAD, 7, 8]].mean(axis=0)
    for width, depth in ((rng.uniform(1.9, 2.1), rng.uniform(0.9, 1.6)), (1.8, 0.8), (1.2, 0.6)):
        bed = block("bed", width, top_m, depth)
        boxes = _slid(motion, bed, yaw, center_m, rng.uniform(0.4, 0.6) * depth, 0.35)
        if boxes is not None:
            return boxes
    return None


def _under_feet(
    rng: np.random.Generator, motion: Motion, still: np.ndarray, config: RestConfig, found: list[tuple[str, Boxes]]
) -> None:
    for ankle, toe in _FEET:
        foot = np.isin(motion.spheres.joint, (ankle, toe))
        bottom_m = motion.body.bottom_m(foot)
        resting = motion.contact[:, [ankle, toe]].any(axis=1) | still[:, [ankle, toe]].all(axis=1)
        for start, stop in runs(resting & (bottom_m > config.raised_m)):
            if stop - start < config.foot_frames:
                continue
            top_m, center = float(bottom_m[start:stop].min()) - _TOUCH_M, (start + stop) // 2
            if _carried(found, motion.joints_m[center, toe], top_m):
                continue
            forward = motion.R_world_joint[center, ankle, :, 2]
            yaw = float(np.arctan2(forward[0], forward[2]) + rng.choice([0.0, np.pi]))
            for half in (rng.uniform(0.25, 0.6), 0.2, 0.12):
                step = block("step", 2 * half * rng.uniform(1.0, 1.6), top_m, 2 * half)
                boxes = _slid(motion, step, yaw, motion.joints_m[center, toe], half, min(half, 0.15))
                if boxes is not None:
                    found.append(("step", boxes))
                    break


def _under_hands(
    rng: np.random.Generator, motion: Motion, still: np.ndarray, config: RestConfig, found: list[tuple[str, Boxes]]
) -> None:
    for wrist in _WRISTS:
        hand = motion.spheres.joint == wrist
        bottom_m = motion.body.bottom_m(hand)
        low, high = config.hand_height_m
        for start, stop in runs((still[:, wrist] | motion.contact[:, wrist]) & (bottom_m > low) & (bottom_m < high)):
            center = (start + stop) // 2
            held = motion.contact[start:stop, wrist].any()
            if stop - start < config.hand_frames or not (held or rng.random() < config.hand_share):
                continue
            toward = motion.joints_m[center, _PELVIS] - motion.joints_m[center, wrist]
            yaw = float(np.arctan2(toward[0], toward[2]))
            top_m = float(bottom_m[start:stop].min()) - _TOUCH_M
            if _carried(found, motion.joints_m[center, wrist], top_m):
                continue
            width, depth = rng.uniform(0.4, 1.6), rng.uniform(0.4, 0.9)
            desk = table_of("table", width, depth, top_m, rng)
            desk = desk if rng.random() < 0.6 else block("counter", width, top_m, depth)
            boxes = _slid(motion, desk, yaw, motion.joints_m[center, wrist], rng.uniform(0.05, 0.15), 0.2)
            if boxes is not None:
                found.append(("table", boxes))


def _carried(found: list[tuple[str, Boxes]], at_m: np.ndarray, top_m: float) -> bool:
    """Whether something already stands under a point at this height."""
    point_m = np.array([at_m[0], top_m, at_m[2]])
    return any(float(boxes.signed_distance(point_m[None])[0]) < _CARRIED_M for _, boxes in found)


def _slid(motion: Motion, piece: Piece, yaw: float, at_m: np.ndarray, front_m: float, within_m: float) -> Boxes | None:
    """The piece with its front `front_m` before a point, or as near to that as the sweep allows."""
    slide = Slide(motion.body, yaw)
    sideways_m, along_m = slide.local(at_m)
    place_m = nearest_free(slide.free(piece, sideways_m, 0.0, Boxes.none()), along_m + front_m, within_m)
    return None if place_m is None else slide.placed(piece, sideways_m, place_m)
