"""Depth of background image and sampled frames by a network, up to one scale and offset for the clip."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from video2anim.depth.hue_jitter import jittered_disparity, reliable
from video2anim.depth.temporal_alignment import Alignment, aligned_to_background
from video2anim.types import BackgroundImage, DepthClip, VideoClip
from video2anim.video import read_frames

CLIP_KINDS = {"disparity": "disparity", "depth": "depth", "metric": "depth"}
"""`DepthModel.kind` -> `DepthClip.kind`. `disparity` (larger is nearer) and `depth` (larger is farther) are known up to
scale and offset; `metric` is depth in meters, to which stage metric fits a scale and offset all the same."""


@runtime_checkable
class DepthModel(Protocol):
    """A network in slot `depth`."""

    kind: str
    """A key of `CLIP_KINDS`."""

    def infer(self, image_rgb: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """Depth or disparity at the size of the image; NaN where unknown."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class DepthMaps:
    """Depth of one image or several, at the working resolution."""

    value: Float32[np.ndarray, "*images small_height small_width"]
    """Depth or disparity as the network gives it."""
    sigma: Float32[np.ndarray, "*images small_height small_width"]
    """Standard deviation over hue shifts."""
    valid: Bool[np.ndarray, "*images small_height small_width"]


@dataclass(frozen=True, slots=True)
class HueJitter:
    """How uncertainty is measured."""

    shifts_rad: Sequence[float]
    """Hue shifts of the copies of each image."""
    unreliable_ratio: float
    """Pixels with a deviation above this share of the range of values are invalid."""


def image_depth(
    model: DepthModel, image_rgb: UInt8[np.ndarray, "height width 3"], shape: tuple[int, int], jitter: HueJitter
) -> DepthMaps:
    """Depth of one image.

    Args:
        model: The network.
        image_rgb: The image.
        shape: Rows and columns of the working resolution.
        jitter: How uncertainty is measured.
    """
    size = (shape[1], shape[0])
    # No network gains from images much larger than the working resolution.
    factor = min(1.0, 3 * shape[1] / image_rgb.shape[1])
    seen_size = (round(image_rgb.shape[1] * factor), round(image_rgb.shape[0] * factor))
    seen_rgb = cv2.resize(image_rgb, seen_size, interpolation=cv2.INTER_AREA)
    maps = jittered_disparity(model.infer, seen_rgb, jitter.shifts_rad)
    value, sigma = (cv2.resize(one.astype(np.float32), size, interpolation=cv2.INTER_AREA) for one in maps)
    valid = reliable(value, sigma, jitter.unreliable_ratio)
    return DepthMaps(
        np.where(np.isfinite(value), value, np.float32(0)), np.where(np.isfinite(sigma), sigma, np.float32(1e3)), valid
    )


def frame_depths(
    model: DepthModel,
    clip: VideoClip,
    background: BackgroundImage,
    jitter: HueJitter,
    on_frame: Callable[[int, int], None],
) -> DepthMaps:
    """Depth of every sampled frame, each in units of its own.

    Raises:
        InputError: the clip's video cannot be read.
    """
    wanted = {int(frame): sample for sample, frame in enumerate(background.frame_index)}
    shape = (len(wanted), *background.seen_ratio.shape)
    maps = DepthMaps(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, bool))
    for frame, image_rgb in enumerate(read_frames(clip, 0, int(background.frame_index.max()) + 1)):
        if frame in wanted:
            sample = wanted[frame]
            found = image_depth(model, image_rgb, shape[1:], jitter)
            maps.value[sample], maps.sigma[sample], maps.valid[sample] = found.value, found.sigma, found.valid
            on_frame(sample + 1, len(wanted))
    return maps


def clip_depth(
    provider: str, kind: str, background: BackgroundImage, empty: DepthMaps, frames: DepthMaps, *, is_static: bool
) -> tuple[DepthClip, Alignment | None]:
    """Depth of the clip in the units of the background image, and how the frames of a static camera were aligned.

    Args:
        provider: Name of the network.
        kind: Of the network, a key of `CLIP_KINDS`.
        background: Background image and person masks.
        empty: Depth of the background image.
        frames: Depth of the sampled frames.
        is_static: Whether the camera is. If so, only people keep the depth of their own frame.
    """
    value, sigma, valid, alignment = frames.value, frames.sigma, frames.valid, None
    background_value = empty.value
    if is_static:
        alignment = aligned_to_background(
            value, sigma, valid, (empty.value, empty.sigma, empty.valid), background.person_mask
        )
        value, sigma, valid = alignment.value, alignment.sigma, alignment.valid
    if kind == "disparity":
        # Its zero is anywhere: put it a little beyond the farthest object, so that all values are positive.
        known = background_value[empty.valid] if empty.valid.any() else background_value
        low, high = np.percentile(known, [0.5, 98])
        zero = np.float32(low - 0.05 * (high - low))
        value, background_value = value - zero, background_value - zero
    depth = DepthClip(
        kind=CLIP_KINDS[kind],
        provider=provider,
        frame_index=background.frame_index,
        value=value,
        sigma=sigma,
        valid=valid,
        background_value=background_value,
        background_valid=empty.valid,
    )
    return depth, alignment
