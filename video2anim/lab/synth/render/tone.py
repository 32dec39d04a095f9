"""Tone mapping: from linear light to 8-bit sRGB and back."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float, UInt8

_KNEE = 0.55
"""Exposed light up to this value is unchanged; above it the curve bends towards white."""
_MEDIAN_LIGHT = 0.24
"""Exposed value of the picture's median light."""
_BRIGHT = 1.1
"""Upper limit of the exposed 97th percentile."""
_STEPS = 1 << 14
_TOP = 4.0
"""Exposed light from this value on is white."""


def auto_exposure(radiance: Float[np.ndarray, "pixels 3"]) -> float:
    """Exposure factor from the median and the 97th percentile of the luminance."""
    luminance = radiance @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    lit = luminance[luminance > 0]
    if not len(lit):
        return 1.0
    middle, bright = np.percentile(lit, [50, 97])
    return float(min(_MEDIAN_LIGHT / max(middle, 1e-6), _BRIGHT / max(bright, 1e-6)))


def tone_curve(light: np.ndarray) -> np.ndarray:
    """Tone curve with a shoulder: identity up to `_KNEE`, then exponentially towards 1."""
    headroom = 1 - _KNEE
    return np.where(light < _KNEE, light, 1 - headroom * np.exp(-np.maximum(light - _KNEE, 0) / headroom))


def inverse_tone_curve(value: np.ndarray) -> np.ndarray:
    """Inverse of `tone_curve`; white becomes the smallest light that saturates."""
    headroom = 1 - _KNEE
    top = np.exp(-(_TOP - _KNEE) / headroom)
    return np.where(value < _KNEE, value, _KNEE - headroom * np.log(np.maximum((1 - value) / headroom, top)))


def encode(light: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """Exposed linear light to 8-bit sRGB."""
    return _encoding()[np.clip(light * ((_STEPS - 1) / _TOP) + 0.5, 0, _STEPS - 1).astype(np.int32)]


def decode(rgb: UInt8[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """8-bit sRGB to exposed linear light."""
    return _decoding()[rgb]


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear display light, 0 to 1, to sRGB, 0 to 1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


@functools.lru_cache(maxsize=1)
def _encoding() -> np.ndarray:
    light = np.linspace(0, _TOP, _STEPS)
    return np.round(255 * to_srgb(np.clip(tone_curve(light), 0, 1))).astype(np.uint8)


@functools.lru_cache(maxsize=1)
def _decoding() -> np.ndarray:
    value = np.arange(256) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return inverse_tone_curve(linear).astype(np.float32)
