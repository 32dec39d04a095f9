"""Up direction of the first frame's camera from the image, the lifter and the body's balance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from video2anim.camera.ground_plane import ground_evidence
from video2anim.geometry.perspective_field import FieldCamera
from video2anim.humans.ground import LEVEL_CAMERA_SIGMA_RAD, UpEstimate, up_from_static_equilibrium
from video2anim.humans.lifter_input import LiftedBody
from video2anim.types import PersonTrack
from video2anim.types.camera import UpEvidence
from video2anim.types.clip import FPS

_LIFTER_SIGMA_RAD = 0.1
"""Error of the lifter's up direction."""


def up_by_lifter(
    people: Sequence[tuple[LiftedBody, PersonTrack]], R_first_camera: Float[np.ndarray, "frames 3 3"]
) -> Float[np.ndarray, "3"]:
    """Up direction by the lifter: mean over people, weighted by the expected error of their poses.

    People who are seen for less than a second weigh less.
    """
    total = np.zeros(3)
    for lifted, track in people:
        turn = R_first_camera[track.first_frame + np.flatnonzero(track.valid)]
        up = np.median(np.einsum("nab,nb->na", turn, lifted.up_camera[track.valid]), axis=0)
        share = min(int(track.valid.sum()), FPS) / FPS
        # Unusual poses mislead the lifter about gravity by more than the error of their joints.
        total += share * float(np.median(lifted.error_m[track.valid])) ** -4 * up / np.linalg.norm(up)
    return total / np.linalg.norm(total)


def up_of_people(
    joints_m: Float[np.ndarray, "frames 22 3"], by_lifter: Float[np.ndarray, "3"], duration_s: float
) -> UpEstimate:
    """Mean of the up directions by the balance of a body (joints along the first camera's axes) and by the lifter."""
    balance = up_from_static_equilibrium(joints_m, duration_s)
    together = by_lifter + balance.up
    # Half of the angle between two estimates is the least error of their mean.
    sigma_rad = math.hypot(0.5 * _angle_rad(by_lifter, balance.up), balance.sigma_rad / math.sqrt(2))
    return UpEstimate(together / np.linalg.norm(together), sigma_rad, balance.support)


def with_scene(up: UpEstimate, evidence: Sequence[UpEvidence]) -> UpEstimate:
    """Mean of the up directions by people and by what is seen of the scene (picture, ground), weighted by their
    variances."""
    for source in (one for one in evidence if one.source in ("picture", "ground")):
        weights = np.array([up.sigma_rad**-2, source.sigma_rad**-2])
        together = weights @ np.stack([up.up, source.up_camera]) / weights.sum()
        # Where the two disagree, neither is as certain as its standard deviation.
        apart_rad = _angle_rad(up.up, source.up_camera)
        sigma_rad = max(float(weights.sum() ** -0.5), 0.5 * apart_rad * float(min(weights) / max(weights)) ** 0.5)
        up = replace(up, up=together / np.linalg.norm(together), sigma_rad=sigma_rad)
    return up


def up_evidence(
    by_lifter: Float[np.ndarray, "3"], image: FieldCamera | None, points: Float[np.ndarray, "points 3"]
) -> tuple[UpEvidence, ...]:
    """Every source of the up direction on its own.

    Args:
        by_lifter: Of people's poses.
        image: Camera by the image, if known.
        points: Background points of known depth that a traveling camera has passed, in the first camera's axes.
    """
    sources = [] if image is None else [UpEvidence("picture", image.up_camera, image.up_sigma_rad)]
    ground = ground_evidence(points, by_lifter if image is None else image.up_camera)
    sources += [] if ground is None else [ground]
    sources.append(UpEvidence("lifter", by_lifter, _LIFTER_SIGMA_RAD))
    sources.append(UpEvidence("level camera", np.array([0.0, -1.0, 0.0]), LEVEL_CAMERA_SIGMA_RAD))
    return tuple(sources)


def _angle_rad(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> float:
    return math.acos(float(np.clip(a @ b, -1, 1)))
