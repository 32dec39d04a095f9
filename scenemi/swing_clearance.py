"""Toes that swing do not drag: where a foot moves over the floor without touching it, its toe clears it.

Landmarks and learned poses know the height of a toe to a centimetre or two, as much as a walker's toe clears the floor.
Drawn along the floor it looks, and counts, as a foot that slides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from scenemi.foot_lock import contact_phases
from scenemi.metrics import HORIZONTAL
from video2anim.body.leg_ik import LEGS, move_ankles
from video2anim.body.skeleton import forward_kinematics


@dataclass(frozen=True, slots=True)
class SwingConfig:
    """What counts as swinging, and how high."""

    contact_threshold: float = 0.5
    """Contact probability from which a joint counts as touching."""
    shortest_phase_s: float = 0.1
    """Shorter touches are ignored; shorter gaps in a phase are closed."""
    clearance_m: float = 0.013
    """Least height of a swinging toe above where it stands before or after (walkers: Winter 1992)."""
    slow_m_s: float = 0.25
    fast_m_s: float = 0.5
    """Toes slower than the one are not raised, those faster than the other by all that lacks."""
    blend_s: float = 0.1
    """Time after a touch and before the next one in which nothing, then all of it, is raised."""
    most_m: float = 0.05
    """Toes that lack more are raised by this: they are not low, but somewhere else."""


def clear_swings(
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"],
    translation_world_m: Float[np.ndarray, "frames 3"],
    rest_joints_m: Float[np.ndarray, "22 3"],
    contact: Float[np.ndarray, "frames 22"],
    fps: float,
    config: SwingConfig | None = None,
) -> Float[np.ndarray, "frames 22 3 3"]:
    """Local rotations with swinging feet raised by inverse kinematics of the legs, orientation of the feet kept.

    World +Y up. The root, and feet in their contact phases, are not touched; a foot without any contact is left alone.
    """
    config = config or SwingConfig()
    solved = R_parent_joint
    shortest = max(1, round(config.shortest_phase_s * fps))
    for leg in LEGS:
        touching = contact[:, (leg.ankle, leg.toe)] >= config.contact_threshold
        phases = contact_phases(np.asarray(touching.any(axis=1)), shortest)
        joints_m, _ = forward_kinematics(solved, translation_world_m, rest_joints_m)
        raise_m = _raise_m(joints_m[:, leg.toe], touching[:, 1], phases, fps, config)
        if raise_m.any():
            target_m = joints_m[:, leg.ankle] + raise_m[:, None] * np.array([0.0, 1.0, 0.0])
            raised = move_ankles(solved, translation_world_m, rest_joints_m, leg, target_m)
            solved = np.where((raise_m > 0)[:, None, None, None], raised, solved)
    return solved


def _raise_m(
    toe_m: Float[np.ndarray, "frames 3"],
    toe_down: Bool[np.ndarray, "frames"],
    phases: list[tuple[int, int]],
    fps: float,
    config: SwingConfig,
) -> Float[np.ndarray, "frames"]:
    """How much each frame's foot goes up."""
    raise_m = np.zeros(len(toe_m))
    stand_m = [_standing_m(toe_m[a:b, 1], toe_down[a:b]) for a, b in phases]
    swings = zip([0, *(b for _, b in phases)], [*(a for a, _ in phases), len(toe_m)], strict=True)
    for number, (start, stop) in enumerate(swings):
        sides = [stand_m[k] for k in (number - 1, number) if 0 <= k < len(phases)]
        known_m = [height for height in sides if height is not None]
        if stop - start < 3 or not known_m:
            continue
        swing = slice(start, stop)
        step_m = np.linalg.norm(np.gradient(toe_m[swing][:, HORIZONTAL], axis=0), axis=1)
        moving = np.clip((step_m * fps - config.slow_m_s) / (config.fast_m_s - config.slow_m_s), 0.0, 1.0)
        lack_m = np.clip(min(known_m) + config.clearance_m - toe_m[swing, 1], 0.0, config.most_m)
        # Wider than the lack itself, so that the smooth curve still has all of it.
        curve_m = gaussian_filter1d(maximum_filter1d(lack_m * moving, 5), 1.5)
        frames = np.arange(stop - start)
        since = np.where(start > 0, frames + 1.0, np.inf)
        until = np.where(stop < len(toe_m), stop - start - frames, np.inf)
        share = np.clip(np.minimum(since, until) / (config.blend_s * fps), 0.0, 1.0)
        raise_m[swing] = curve_m * share * share * (3 - 2 * share)
    return raise_m


def _standing_m(height_m: np.ndarray, toe_down: np.ndarray) -> float | None:
    """Height of the toe while it is down; None where only the heel touched."""
    return float(np.median(height_m[toe_down])) if toe_down.any() else None
