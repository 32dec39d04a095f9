"""Quality of a fitted person, from the fit alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from scenemi import metrics
from video2anim.humans.problem import FittedBody, Observations
from video2anim.networks.landmarks import BLAZEPOSE_OF_KEYPOINT
from video2anim.types.motion import BodyMotion, PersonQuality
from video2anim.types.people import PersonTrack

_BONES = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
_MAX_REPROJECTION = 0.04
"""Maximum share of the person's size (landmarks err by about 0.01)."""
_MIN_VALID = 0.5
"""Share of the clip's frames in which somebody is to be seen. Not measured."""
_MAX_BONE_SPREAD = 0.2
"""Bones have fixed lengths: at this relative spread the detector confuses people or guesses."""
_FASTEST_M_S = 13.0
"""Maximum speed of a root; the fastest sprint measured is 12.4 m/s."""
_MAX_FAST = 0.02
"""Share of steps that may be as fast: single frames jump. Not measured."""
_BODY_HEIGHTS_M = (0.7, 2.2)
"""Of skeletons from a small child to the tallest adults; the top of the head is not in them."""
_SURE_FRAMES = 15
"""Half a second: fewer say nothing about a body. Not measured."""


def person_quality(
    track: PersonTrack,
    observed: Observations,
    fit: FittedBody,
    motion: BodyMotion,
    fps: float,
    body_height_sigma_m: float,
) -> PersonQuality:
    """Numbers of one person's fit, and the reasons not to trust it.

    Args:
        track: landmarks as they were detected.
        observed: the same as the fit saw them.
        fit: the body in the camera.
        motion: the body in the world.
        fps: frames per second.
        body_height_sigma_m: of the standing height before the fit.
    """
    valid = np.flatnonzero(motion.valid)
    error_px = np.nanmedian(fit.reprojection_px[valid], axis=1)
    joints_m = motion.measured_joints_m
    found = PersonQuality(
        reprojection_px=float(np.nanmedian(fit.reprojection_px)),
        reprojection_ratio=float(np.nanmedian(error_px / observed.size_px[valid])),
        jerk_m_s3=metrics.jerk_m_s3(joints_m, fps),
        skating_gmd=metrics.foot_skating_gmd(joints_m, fps) if len(joints_m) > 3 else float("nan"),
        bone_spread=bone_spread(track),
        valid_share=float(motion.valid.mean()),
        body_height_m=float(np.ptp(fit.rest_joints_m[:, 1])),
        fast_share=_fast_share(joints_m[:, 0], fps),
        body_height_sigma_m=body_height_sigma_m,
    )
    return replace(found, doubts=tuple(_doubts(found, len(valid))))


def bone_spread(track: PersonTrack) -> float:
    """Median over the limbs' bones of the robust relative spread of their length in the 3D landmarks; NaN if unseen."""
    spreads = []
    for side in ("left", "right"):
        for start, end in _BONES:
            first, second = (BLAZEPOSE_OF_KEYPOINT[f"{side}_{part}"] for part in (start, end))
            seen = track.valid & (np.minimum(track.visibility[:, first], track.visibility[:, second]) > 0.5)
            if seen.sum() < _SURE_FRAMES:
                continue
            length_m = np.linalg.norm(track.landmarks_m[seen, first] - track.landmarks_m[seen, second], axis=-1)
            center_m = np.median(length_m)
            spreads.append(1.4826 * np.median(np.abs(length_m - center_m)) / center_m)
    return float(np.median(spreads)) if spreads else float("nan")


def _fast_share(root_m: Float[np.ndarray, "frames 3"], fps: float) -> float:
    """Share of the steps in which the root is faster than a sprinter."""
    if len(root_m) < 2:
        return 0.0
    return float((np.linalg.norm(np.diff(root_m, axis=0), axis=-1) * fps > _FASTEST_M_S).mean())


def _doubts(quality: PersonQuality, valid_frames: int) -> list[str]:
    """Reasons not to trust the track."""
    low, high = _BODY_HEIGHTS_M
    checks = (
        (
            quality.reprojection_ratio > _MAX_REPROJECTION,
            f"the body misses its landmarks by {quality.reprojection_ratio:.1%} of its size",
        ),
        (quality.valid_share < _MIN_VALID, f"seen in {quality.valid_share:.0%} of the frames only"),
        (valid_frames < _SURE_FRAMES, f"seen in {valid_frames} frames only"),
        (
            quality.bone_spread > _MAX_BONE_SPREAD,
            f"limbs change their length by {quality.bone_spread:.0%}: hidden, or two people mixed up",
        ),
        (
            quality.fast_share > _MAX_FAST,
            f"faster than anybody can run in {quality.fast_share:.0%} of the frames: the place or the camera is wrong",
        ),
        (
            not low <= quality.body_height_m <= high,
            f"{quality.body_height_m:.2f} m from head to foot: the scale or the focal length is wrong",
        ),
    )
    return [text for holds, text in checks if holds]
