"""Hold feet still while they touch: a light clean-up after any in-betweening prior.

In a contact phase the toe (or, before the toe is down, the ankle) is stopped by shifting the ankle against its motion,
and put where a reference (the observed motion) has it on average; the leg follows by inverse kinematics. Outside the
phases the shift fades with continuous velocity, so nothing pops.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicHermiteSpline

from scenemi.metrics import HORIZONTAL
from video2anim.body.leg_ik import LEGS, Leg, move_ankles
from video2anim.body.skeleton import forward_kinematics


@dataclass(frozen=True, slots=True)
class FootLockConfig:
    """When a foot is held, and how far it may be moved."""

    contact_threshold: float = 0.5
    """Contact probability from which a joint counts as touching."""
    shortest_phase_s: float = 0.1
    """Shorter touches are ignored; shorter gaps in a phase are closed."""
    blend_s: float = 0.2
    """Time in which a shift fades out after a phase and in before it."""
    max_drift_m: float = 0.3
    """A phase in which the reference foot itself strays farther from its mean place is left alone: its contact label
    contradicts the observation."""
    max_shift_m: float = 0.4
    """A phase whose foot lies farther from the reference is left alone: the leg could not follow."""


@dataclass(frozen=True, slots=True, eq=False)
class FootLock:
    """Result of `lock_feet`."""

    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    held_phases: int
    refused_phases: int
    """Phases left alone for `max_drift_m` or `max_shift_m`."""
    max_shift_m: float
    """Largest displacement of an ankle."""


def lock_feet(
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"],
    translation_world_m: Float[np.ndarray, "frames 3"],
    rest_joints_m: Float[np.ndarray, "22 3"],
    contact: Float[np.ndarray, "frames 22"],
    fps: float,
    reference_joints_m: Float[np.ndarray, "frames 22 3"] | None = None,
    config: FootLockConfig | None = None,
) -> FootLock:
    """Local rotations with the feet held in their contact phases; the root is not touched.

    `reference_joints_m` says where feet stand (the observed motion); without it each foot stays near where it is.
    """
    config = config or FootLockConfig()
    joints_m, _ = forward_kinematics(R_parent_joint, translation_world_m, rest_joints_m)
    reference_m = joints_m if reference_joints_m is None else reference_joints_m
    solved, held, refused, largest = R_parent_joint, 0, 0, 0.0
    for leg in LEGS:
        touching = contact[:, (leg.ankle, leg.toe)] >= config.contact_threshold
        shifts, bad = [], 0
        for start, stop in contact_phases(
            np.asarray(touching.any(axis=1)), max(1, round(config.shortest_phase_s * fps))
        ):
            phase, toe_down = slice(start, stop), touching[start:stop, 1]
            hold_m, drift_m = _holding_shift(joints_m[phase], reference_m[phase], leg, toe_down)
            if drift_m > config.max_drift_m or np.linalg.norm(hold_m, axis=1).max() > config.max_shift_m:
                bad += 1
                continue
            shifts.append((start, hold_m))
        held, refused = held + len(shifts), refused + bad
        if not shifts:
            continue
        shift_m = _faded(shifts, len(joints_m), max(1, round(config.blend_s * fps)))
        largest = max(largest, float(np.linalg.norm(shift_m, axis=1).max()))
        target_m = joints_m[:, leg.ankle] + shift_m
        solved = move_ankles(solved, translation_world_m, rest_joints_m, leg, target_m)
    return FootLock(solved, held, refused, largest)


def contact_phases(touching: Bool[np.ndarray, "frames"], shortest: int) -> list[tuple[int, int]]:
    """Runs [start, stop) of contact; gaps below `shortest` frames are closed first, then such runs dropped."""
    closed = touching.copy()
    for start, stop in _runs(~touching):
        if stop - start < shortest and start > 0 and stop < len(touching):
            closed[start:stop] = True
    return [(start, stop) for start, stop in _runs(closed) if stop - start >= shortest]


def _runs(flags: Bool[np.ndarray, "frames"]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _holding_shift(
    joints_m: Float[np.ndarray, "phase 22 3"],
    reference_m: Float[np.ndarray, "phase 22 3"],
    leg: Leg,
    toe_down: Bool[np.ndarray, "phase"],
) -> tuple[Float[np.ndarray, "phase 3"], float]:
    """Ankle displacement that stops the holding joint at the reference's mean place, and how far the reference strays.

    An ankle is held in the ground plane only: it rises and sinks about the heel.
    """
    stop_m = _stopping_shift(joints_m, leg, toe_down)
    reference_stop_m = _stopping_shift(reference_m, leg, toe_down)
    drift_m = float(np.linalg.norm(reference_stop_m - reference_stop_m.mean(axis=0), axis=1).max())
    holding = np.where(toe_down, leg.toe, leg.ankle)
    rows = np.arange(len(joints_m))
    gap_m = reference_m[rows, holding] - (joints_m[rows, holding] + stop_m)
    return stop_m + gap_m.mean(axis=0), drift_m


def _stopping_shift(joints_m: np.ndarray, leg: Leg, toe_down: np.ndarray) -> Float[np.ndarray, "phase 3"]:
    """Displacement that undoes the holding joint's motion since the first frame."""
    toe_step = np.diff(joints_m[:, leg.toe], axis=0)
    ankle_step = np.zeros_like(toe_step)
    ankle_step[:, HORIZONTAL] = np.diff(joints_m[:, leg.ankle], axis=0)[:, HORIZONTAL]
    by_toe = (toe_down[:-1] & toe_down[1:])[:, None]
    step_m = np.where(by_toe, toe_step, ankle_step)
    return -np.concatenate([np.zeros((1, 3)), np.cumsum(step_m, axis=0)])


def _faded(
    shifts: list[tuple[int, Float[np.ndarray, "phase 3"]]], frame_count: int, blend: int
) -> Float[np.ndarray, "frames 3"]:
    """Shift of every frame: as given in the phases, cubic with continuous slope to zero or to the next phase."""
    knots: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    dense = np.zeros((frame_count, 3))
    inside = np.zeros(frame_count, dtype=bool)
    zero = np.zeros(3)
    for index, (start, shift_m) in enumerate(shifts):
        stop = start + len(shift_m)
        dense[start:stop], inside[start:stop] = shift_m, True
        before = shifts[index - 1][0] + len(shifts[index - 1][1]) - 1 if index else -blend
        after = shifts[index + 1][0] if index + 1 < len(shifts) else frame_count + blend
        slopes = np.diff(shift_m, axis=0) if len(shift_m) > 1 else np.zeros((1, 3))
        if start - blend > before + blend or index == 0:
            knots.setdefault(start - blend, (zero, zero))
        knots[start], knots[stop - 1] = (shift_m[0], slopes[0]), (shift_m[-1], slopes[-1])
        if stop - 1 + blend < after - blend or index + 1 == len(shifts):
            knots.setdefault(stop - 1 + blend, (zero, zero))
    times = np.array(sorted(knots))
    spline = CubicHermiteSpline(times, [knots[t][0] for t in times], [knots[t][1] for t in times])
    frames = np.arange(frame_count)
    curve = np.where(((frames >= times[0]) & (frames <= times[-1]))[:, None], spline(frames), 0.0)
    return np.where(inside[:, None], dense, curve)
