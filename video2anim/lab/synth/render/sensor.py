"""The camera's sensor: exposure, white balance, vignette, noise and JPEG compression of a rendered image."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.lab.synth.render import tone
from video2anim.lab.synth.world import SensorModel

_MID_GRAY = 0.2140
"""Linear light of the sRGB value 0.5."""
_READ_SHARE = 0.25
"""Share of the noise variance at mid gray that does not depend on the light."""


class Sensor:
    """Applies a sensor model to rendered images. Frame t gives the same bytes in any order of calls."""

    def __init__(self, model: SensorModel, rng: np.random.Generator) -> None:
        self._model = model
        self._seed = int(rng.integers(0, 2**63))

    def apply(self, rgb: UInt8[np.ndarray, "height width 3"], t: int) -> UInt8[np.ndarray, "height width 3"]:
        """The image that the camera stores for frame t."""
        model = self._model
        light = tone.decode(rgb)
        gain = model.exposure * np.asarray(model.white_balance, np.float32)
        light = light * (self._vignette(rgb.shape[:2])[..., None] * gain).astype(np.float32)
        value = 255 * tone.to_srgb(np.clip(tone.tone_curve(light), 0, 1))
        if model.noise_steps > 0:
            value = value + self._noise(light, t)
        stored = np.clip(np.round(value), 0, 255).astype(np.uint8)
        return stored if model.jpeg_quality is None else _jpeg(stored, model.jpeg_quality)

    def _vignette(self, shape: tuple[int, ...]) -> Float[np.ndarray, "height width"]:
        """Factor on the light: 1 at the center, 1 - vignette in the corners."""
        y, x = (np.linspace(-1, 1, n, dtype=np.float32) for n in shape)
        return 1 - self._model.vignette * 0.5 * (y[:, None] ** 2 + x**2)

    def _noise(self, light: np.ndarray, t: int) -> np.ndarray:
        """Shot and read noise in 8-bit steps: variance linear in the light, scaled by the slope of the tone curve."""
        rng = np.random.default_rng([self._seed, t])
        relative = np.clip(light, 0, 2) / _MID_GRAY
        slope = np.clip(relative, 0.05, None) ** (1 / 2.4 - 1)
        sigma = np.sqrt(_READ_SHARE + (1 - _READ_SHARE) * relative) * np.minimum(slope, 2.5)
        return self._model.noise_steps * sigma * rng.standard_normal(light.shape, dtype=np.float32)


def _jpeg(rgb: np.ndarray, quality: int) -> np.ndarray:
    _, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    stored = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    return np.ascontiguousarray(stored[..., ::-1])
