"""Runs the lifter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp
from video2anim.humans.lifter_input import LiftedBody, lifted_body, lifter_input
from video2anim.humans.problem import Observations

Network = Callable[[Float[np.ndarray, "frames features"]], Float[np.ndarray, "frames outputs"]]

_UNKNOWN_M = 0.3
"""A body whose joints are expected to be off by more, on the mean, is not known. Those of the real clips and of
V2A-Bench are expected to be off by at most 0.25 m; those of people who are cut at the hips, by 0.3 to 1.6."""


def lift(observed: Observations, network: Network) -> LiftedBody:
    """Bodies of consecutive frames.

    Args:
        observed: all frames of a clip, in order of time, at `FPS` as every clip after ingest.
        network: features -> outputs, at `FPS`.
    """
    given = lifter_input(observed)
    return _guessed_between(lifted_body(network(given.features), given), observed.valid)


def _guessed_between(found: LiftedBody, valid: Bool[np.ndarray, "frames"]) -> LiftedBody:
    """The bodies, those of which the network says that it does not know them replaced by what is between their
    neighbors, without contacts.

    So it is where most of a body is out of the picture. Their expected errors stay, so the fit follows what is seen.
    """
    known = np.flatnonzero(valid & (found.error_m.mean(1) < _UNKNOWN_M))
    if len(known) in (0, len(valid)):
        return found
    frames = np.arange(len(valid))
    after = np.searchsorted(known, frames).clip(1, max(len(known) - 1, 1))
    first, last = known[after - 1], known[np.minimum(after, len(known) - 1)]
    share = np.clip((frames - first) / np.maximum(last - first, 1), 0.0, 1.0)[:, None, None]
    quaternions = quaternion_from_matrix(found.R_parent_joint)
    R = np.asarray(matrix_from_quaternion(slerp(quaternions[first], quaternions[last], share)))
    own = np.isin(frames, known)
    return replace(
        found, R_parent_joint=np.where(own[:, None, None, None], found.R_parent_joint, R),
        contact=np.where(own[:, None], found.contact, 0.0),
    )  # fmt: skip
