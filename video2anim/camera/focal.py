"""Focal length: given by the user, read from metadata, or fitted together with the body of the main person."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from video2anim.geometry.perspective_field import FieldCamera
from video2anim.humans.body_height import KNOWN_SIGMA_M
from video2anim.humans.lifter_input import LiftedBody
from video2anim.humans.lifting import Network, lift
from video2anim.humans.objective import FitConfig
from video2anim.humans.observe import observations
from video2anim.humans.optimize import fit_body
from video2anim.humans.problem import FittedBody
from video2anim.types import Intrinsics, PersonTrack, VideoClip

FULL_FRAME_DIAGONAL_MM = math.hypot(36, 24)
"""Equivalent focal lengths refer to the full frame of 36 x 24 mm."""
_CONTRADICTION_FACTOR = 3.0
"""Metadata that differs from the body fit by more than this factor is not used. The fit itself is off by a factor of up
to 2.2 (V2A-Bench, `benchmarks/human_fit.py` of commit 6e3c79b)."""


@dataclass(frozen=True, slots=True, eq=False)
class FocalEstimate:
    """The focal length and the body fitted with it."""

    focal_px: float
    sigma_ratio: float
    """Standard deviation as a share of the focal length."""
    source: str
    """`user`, `metadata`, `picture` or `human`, as in `CameraEstimate.focal_source`."""
    body: FittedBody
    contradicted_px: float | None = None
    """Focal length by metadata that the fit contradicts; None where there is no contradiction."""


def lift_track(clip: VideoClip, track: PersonTrack, network: Network, focal_px: float | None) -> LiftedBody:
    """Bodies by the lifter, all frames of the track, under `focal_px` or else the usual focal length; they depend
    little on it."""
    long_side_px = max(clip.width_px, clip.height_px)
    intrinsics = Intrinsics.centered(focal_px or FitConfig().focal_ratio * long_side_px, clip.width_px, clip.height_px)
    times_s = clip.frame_time_s[track.first_frame : track.first_frame + len(track.valid)]
    return lift(observations(track, times_s, intrinsics), network)


def metadata_focal_px(clip: VideoClip) -> float | None:
    """Focal length by the source's metadata, in pixels; None where there is none."""
    if clip.source.focal_35mm <= 0:
        return None
    return clip.source.focal_35mm * math.hypot(clip.width_px, clip.height_px) / FULL_FRAME_DIAGONAL_MM


def focal_prior(clip: VideoClip, image: FieldCamera | None) -> tuple[float, float]:
    """Focal length over the longer side by usual cameras and the image, and the standard deviation of its logarithm."""
    usual, sigma = math.log(FitConfig().focal_ratio), FitConfig().focal_log_sigma
    if image is None:
        return math.exp(usual), sigma
    seen = math.log(image.focal_ratio * clip.height_px / max(clip.width_px, clip.height_px))
    weights = np.array([sigma**-2, image.focal_log_sigma**-2])
    return math.exp(float(weights @ [usual, seen] / weights.sum())), float(weights.sum() ** -0.5)


@dataclass(frozen=True, slots=True, eq=False)
class BodyFits:
    """Fits of the main person's body under given or free focal lengths."""

    clip: VideoClip
    track: PersonTrack
    lifted: LiftedBody
    frames: Int[np.ndarray, "chosen"]
    config: FitConfig
    iterations: int
    on_step: Callable[[int, int], None]

    def fit(self, focal_px: float, *, free: bool = False, warm: FittedBody | None = None) -> FittedBody:
        """The body under `focal_px`, which is the start only if `free`; a warm start takes half of the steps."""
        intrinsics = Intrinsics.centered(focal_px, self.clip.width_px, self.clip.height_px)
        return fit_body(
            observations(self.track, self.clip.frame_time_s, intrinsics, self.frames),
            self.lifted.rows(self.frames),
            fit_focal=free,
            config=self.config,
            warm=warm,
            on_step=self.on_step,
            iterations=self.iterations if warm is None else self.iterations // 2,
        )

    def focal_sigma(self, body: FittedBody) -> float:
        """Standard deviation of the logarithm of a fitted focal length, from the curvature of the cost."""
        step = 1.25
        costs = [self.fit(body.focal_px * factor, warm=body).cost for factor in (1 / step, 1.0, step)]
        curvature = (costs[0] - 2 * costs[1] + costs[2]) / math.log(step) ** 2
        # Errors of one clip do not average out: the evidence counts as little as in the weight of the fit's priors.
        curvature /= max(1.0, self.config.prior_share * len(self.frames))
        prior = self.config.focal_log_sigma
        return prior if curvature <= prior**-2 else curvature**-0.5


def estimate_focal(
    clip: VideoClip,
    track: PersonTrack,
    lifted: LiftedBody,
    frames: Int[np.ndarray, "chosen"],
    image: FieldCamera | None,
    *,
    focal_px: float | None,
    body_height_m: float | None,
    iterations: int,
    on_step: Callable[[int, int], None],
) -> FocalEstimate:
    """Focal length by the user, else by metadata unless the body fit contradicts it, else by the body fit.

    The fit sees the focal length in the perspective of the body and in how its size changes with depth. Both are weak,
    so it has the prior of `focal_prior`.

    Args:
        clip: The clip.
        track: The main person.
        lifted: The lifter's bodies of the main person, all frames of the track.
        frames: Frames of the fit.
        image: Camera by images alone, if known.
        focal_px: Known focal length.
        body_height_m: Known standing height of the main person.
        iterations: Steps of the fit.
        on_step: Called with steps done and steps in all.
    """
    ratio, log_sigma = focal_prior(clip, image)
    config = replace(FitConfig(), focal_ratio=ratio, focal_log_sigma=log_sigma)
    if body_height_m is not None:
        config = replace(config, body_height_m=body_height_m, body_height_sigma_m=KNOWN_SIGMA_M)
    fits = BodyFits(clip, track, lifted, frames, config, iterations, on_step)
    if focal_px is not None:
        return FocalEstimate(focal_px, 0.01, "user", fits.fit(focal_px))
    body = fits.fit(ratio * max(clip.width_px, clip.height_px), free=True)
    named_px = metadata_focal_px(clip)
    if named_px is not None and abs(math.log(named_px / body.focal_px)) < math.log(_CONTRADICTION_FACTOR):
        return FocalEstimate(named_px, 0.05, "metadata", fits.fit(named_px))
    source = "human" if image is None else "picture"
    return FocalEstimate(body.focal_px, fits.focal_sigma(body), source, body, named_px)
