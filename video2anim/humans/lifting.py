"""Runs the lifter."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from video2anim.humans.lifter_input import LiftedBody, lifted_body, lifter_input
from video2anim.humans.problem import Observations

Network = Callable[[Float[np.ndarray, "frames features"]], Float[np.ndarray, "frames outputs"]]


def lift(observed: Observations, network: Network) -> LiftedBody:
    """Bodies of consecutive frames.

    Args:
        observed: all frames of a clip, in order of time, at `FPS` as every clip after ingest.
        network: features -> outputs, at `FPS`.
    """
    given = lifter_input(observed)
    return lifted_body(network(given.features), given)
