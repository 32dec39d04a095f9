"""How good a retargeted motion is: measured on the skin and against the source, not on what was aimed at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scenemi.data.container import SourceClip
from scenemi.data.retarget import RetargetedMotion
from scenemi.metrics import jerk_m_s3
from video2anim.body.legs import LEGS
from video2anim.body.shaped_body import ShapedBody
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

_SIDES = ("left", "right")
LIMBS = tuple(
    (JOINT_INDEX[f"{side}_{a}"], JOINT_INDEX[f"{side}_{b}"])
    for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
    for side in _SIDES
)


@dataclass(frozen=True, slots=True)
class RetargetQuality:
    """Numbers of one motion. Lower is better but for `contact_share` and `jerk_ratio` (1 = as the source).

    Heights over the floor are NaN for uneven clips.
    """

    contact_share: float
    """Share of frames in which a foot touches."""
    slide_mm: float
    """Mean movement of a touching ankle or toe joint from frame to frame; NaN without contact."""
    slide_max_mm: float
    sink_mm: float
    """Deepest sole vertex under the floor in frames of contact."""
    float_mm: float
    """Largest gap between floor and the lowest vertex of a touching foot."""
    below_floor_mm: float
    """Deepest foot vertex under the floor in any frame."""
    body_below_mm: float
    """Deepest vertex of the whole body under the floor, every fifth frame."""
    jerk_ratio: float
    """Jerk over that of the source scaled by leg length, joints that both have."""
    limb_error_deg: float
    """Mean angle between thighs, shins, upper arms and forearms and those of the source."""
    limb_error_max_deg: float
    knee_min_deg: float
    """Smallest flexion of a knee about the body's left; negative bends backward."""


def measure_retarget(clip: SourceClip, body: ShapedBody, motion: RetargetedMotion) -> RetargetQuality:
    """Compare a motion with its source clip and with the floor y = 0."""
    joints_m, R_world = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    source_m = clip.smpl_joints_m()
    steps = np.linalg.norm(np.diff(joints_m, axis=0), axis=-1)
    held = motion.contact[1:] & motion.contact[:-1]
    errors = _limb_errors(joints_m, source_m)
    sink = gap = below = body_below = float("nan")
    if not clip.uneven:
        sink, gap, below = _sole_heights(body, motion, joints_m, R_world)
        body_below = max(0.0, -float(body.vertices(R_world[::5], joints_m[::5])[..., 1].min()))
    return RetargetQuality(
        contact_share=float(motion.contact.any(axis=1).mean()),
        slide_mm=float(1000 * steps[held].mean()) if held.any() else float("nan"),
        slide_max_mm=float(1000 * steps[held].max()) if held.any() else float("nan"),
        sink_mm=1000 * sink,
        float_mm=1000 * gap,
        below_floor_mm=1000 * below,
        body_below_mm=1000 * body_below,
        jerk_ratio=_jerk_ratio(joints_m, source_m, clip.fps),
        limb_error_deg=float(errors.mean()),
        limb_error_max_deg=float(errors.max()),
        knee_min_deg=_min_knee_deg(motion),
    )


def _limb_errors(joints_m: np.ndarray, source_m: np.ndarray) -> Float[np.ndarray, "frames limbs"]:
    angles = []
    for start, end in LIMBS:
        a, b = joints_m[:, end] - joints_m[:, start], source_m[:, end] - source_m[:, start]
        sine, cosine = np.linalg.norm(np.cross(a, b), axis=-1), np.einsum("td,td->t", a, b)
        angles.append(np.degrees(np.arctan2(sine, cosine)))
    return np.stack(angles, -1)


def _sole_heights(
    body: ShapedBody, motion: RetargetedMotion, joints_m: np.ndarray, R_world: np.ndarray
) -> tuple[float, float, float]:
    """Depth of the touching sole, gap under it, depth of any foot vertex in any frame; meters."""
    sink = gap = below = 0.0
    for leg in LEGS:
        chosen = np.flatnonzero(body.skin_weights[:, [leg.ankle, leg.toe]].sum(1) > 0.5)
        lowest = body.vertices(R_world, joints_m, index=chosen)[..., 1].min(axis=1)
        touching = motion.contact[:, [leg.ankle, leg.toe]].any(axis=1)
        below = max(below, float(-lowest.min()))
        if touching.any():
            sink = max(sink, float(-lowest[touching].min()))
            gap = max(gap, float(lowest[touching].max()))
    return sink, gap, below


def _jerk_ratio(joints_m: np.ndarray, source_m: np.ndarray, fps: float) -> float:
    both = ~np.isnan(source_m[0, :, 0])
    own, theirs = (_leg_length(joints) for joints in (joints_m, source_m))
    return _jerk(joints_m, both, fps) / max(_jerk(source_m * own / theirs, both, fps), 1e-9)


def _jerk(joints_m: np.ndarray, chosen: np.ndarray, fps: float) -> float:
    """Jerk of the chosen joints; the others are held still and taken out of the mean."""
    still_m = np.where(chosen[:, None], joints_m, 0.0)
    return jerk_m_s3(still_m, fps) * 22 / int(chosen.sum())


def _leg_length(joints_m: np.ndarray) -> float:
    pairs = LIMBS[:4]
    return float(sum(np.linalg.norm(joints_m[0, b] - joints_m[0, a]) for a, b in pairs))


def _min_knee_deg(motion: RetargetedMotion) -> float:
    knees = motion.R_parent_joint[:, [leg.knee for leg in LEGS]]
    return float(np.degrees(np.arctan2(knees[..., 2, 1], knees[..., 1, 1]).min()))
