"""Metric depth and bodies: the result of stage metric."""

# `stored()` gives the file format of a field. It is not a default value, although it has the place of one.
# pyright: reportGeneralTypeIssues=false

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import FiniteFloat, NonNegativeFloat, PositiveFloat

from video2anim.types.checks import Checked
from video2anim.types.motion import BodyTracks
from video2anim.types.storage import Holds


@dataclass(frozen=True, slots=True, eq=False)
class MetricDepth(Checked):
    """Scale and offset that make a `DepthClip` metric (paper 8.1), the metric depth (with a distance of its own for
    every object and person), and the people and the camera of the same fit."""

    scale: PositiveFloat
    offset_m: FiniteFloat
    """Meters for kind `depth`, 1/meters for `disparity`."""
    scale_sigma: float
    offset_sigma: float
    chamfer_before_m: NonNegativeFloat | None
    """None if no fit was possible."""
    chamfer_after_m: NonNegativeFloat | None
    trusted: bool
    """False if the person covers too few pixels to determine the scale."""
    reason: str
    frame_index: Annotated[Int[np.ndarray, "samples"], Holds.FRAMES]
    depth_m: Annotated[Float[np.ndarray, "samples small_height small_width"], Holds.GAPS]
    valid: Bool[np.ndarray, "samples small_height small_width"]
    background_depth_m: Annotated[Float[np.ndarray, "small_height small_width"], Holds.GAPS]
    background_valid: Bool[np.ndarray, "small_height small_width"]
    object_sigma: dict[str, NonNegativeFloat]
    """Standard deviation of the logarithm of each object's depth, by object ID."""
    bodies: BodyTracks
    """People and camera of the same fit; later stages use these bodies."""
