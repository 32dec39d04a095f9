"""Fits of disparity that lose the scene's depth, and what is done instead.

Disparity of a network has an unknown offset. Where the person stays at one distance, what varies in their disparity is
error, and the fit that does best by it has a scale near 0: everything in the picture is as far away as the person.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from video2anim.geometry.depth_fit import DepthFit, FrameEvidence, GroundEvidence, fit_depth

_FLATTEST = 0.3
"""Disparity of the picture's farthest and nearest twentieth differ by this share of the middle one at least, or the fit
has lost the scene's depth. In the rooms of V2A-Bench it is 0.54 and more."""
USUAL_OFFSET = {"room-depth": 1.25}
"""By provider, the same for networks of which it is known: about the geometric mean of the fits to those rooms' true
depth (1.22)."""
_USUAL_LOG_SIGMA = 0.5
"""Standard deviation of its logarithm there."""


def is_flat(fit: DepthFit, kind: str, background_value: Float[np.ndarray, "height width"]) -> bool:
    """Whether the picture's depth varies far less than that of pictures does."""
    far, middle, near = np.quantile(background_value, [0.05, 0.5, 0.95])
    return kind == "disparity" and fit.scale * (near - far) < _FLATTEST * (fit.scale * middle + fit.offset)


def fit_at_usual_offset(
    frames: Sequence[FrameEvidence],
    background_value: Float[np.ndarray, "height width"],
    provider: str,
    *,
    rng: np.random.Generator,
    ground: GroundEvidence | None = None,
) -> DepthFit | None:
    """The scale of disparity alone, its offset being in the usual proportion to it; None for unknown networks.

    It is no estimate but a prior, and so wide is the offset's deviation.

    Raises:
        NoScaleError: no positive scale makes the medians agree.
    """
    if provider not in USUAL_OFFSET:
        return None
    more = USUAL_OFFSET[provider] * float(np.median(background_value))
    moved = [replace(frame, value=frame.value + more) for frame in frames]
    below = None if ground is None else replace(ground, value=ground.value + more)
    fit = fit_depth(moved, "disparity", with_offset=False, rng=rng, ground=below)
    sigma = float(np.hypot(fit.scale_sigma / fit.scale, _USUAL_LOG_SIGMA))
    return replace(fit, offset=fit.scale * more, offset_sigma=sigma * fit.scale * more)
