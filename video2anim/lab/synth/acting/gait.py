"""Cyclic motion of pelvis, spine and arms while walking, as Fourier series over the phase of the gait."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from jaxtyping import Float

from video2anim.lab.synth.acting.curves import smooth_track
from video2anim.lab.synth.acting.script import NEUTRAL, Script, Stride

_NOMINAL_STRIDE_M = 1.2
_TABLE = Path(__file__).with_name("gait.npz")
_MEAN_SHARE = {"l_elbow": 1.0, "r_elbow": 1.0, "l_flex": 0.5, "r_flex": 0.5}
"""Share of the captured mean that each channel takes. Other means depend on the captured skeleton and are left out."""
_SWING_SHARE = {"pelvis_roll": 0.6, "spine_side": 0.6}


@functools.lru_cache(maxsize=1)
def styles() -> tuple[tuple[str, ...], Float[np.ndarray, "styles channels coefficients"]]:
    """Channel names, and for each captured walk the mean and the cosine, sine pairs of the harmonics.

    From walks of the CMU Graphics Lab motion capture database (mocap.cs.cmu.edu, created with funding from NSF
    EIA-0196217; free for research and commercial use), training split, by `tools/fit_gait.py`.
    """
    with np.load(_TABLE, allow_pickle=False) as table:
        return tuple(str(name) for name in table["channels"]), table["coefficients"].astype(float)


def gait_phase(
    strides: list[Stride], t: Float[np.ndarray, "frames"], leg_m: float
) -> tuple[Float[np.ndarray, "frames"], Float[np.ndarray, "frames"]]:
    """Phase in radians (left touch-down at multiples of 2 pi) and strength (1 = brisk walking) at times `t` in
    seconds."""
    if not strides:
        return np.zeros(len(t)), np.zeros(len(t))
    times, phases = [], []
    phase = 0.0 if strides[0].side == 0 else np.pi
    for index, stride in enumerate(strides):
        if index and stride.side != strides[index - 1].side:
            phase += np.pi
        elif index:
            phase += 2 * np.pi
        times.append(stride.land_s)
        phases.append(phase)
    first = strides[0].lift_s - 0.15
    times, phases = [first, *times, times[-1] + 0.6], [phases[0] - np.pi * 0.8, *phases, phases[-1] + 0.9]
    track = smooth_track(np.interp(t, times, phases), 1.0, 0.15)
    strength = np.zeros(len(t))
    for stride in strides:
        share = min(1.2, stride.length_m / (_NOMINAL_STRIDE_M * leg_m / 0.838))
        inside = (t > stride.lift_s - 0.15) & (t < stride.land_s + 0.12)
        strength[inside] = np.maximum(strength[inside], share)
    return track, np.clip(smooth_track(strength, 1.0, 0.45), 0.0, 1.3)


def gait_channels(script: Script, t: Float[np.ndarray, "frames"]) -> dict[str, Float[np.ndarray, "frames"]]:
    """Offsets that walking adds to the keyed channels, by channel; radians. `t` in seconds."""
    phase, strength = gait_phase(script.strides, t, script.size.leg_m)
    names, table = styles()
    rng = script.noise()
    style = table[rng.integers(len(table))]
    added = {}
    for k, name in enumerate(names):
        coefficients = style[k] * _SWING_SHARE.get(name, 1.0)
        coefficients[0] = _MEAN_SHARE.get(name, 0.0) * (style[k, 0] - NEUTRAL.get(name, 0.0))
        added[name] = strength * series(coefficients, phase)
    return added


def series(coefficients: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Fourier series at a phase (radians): coefficients are the mean, then cosine and sine of each harmonic."""
    out = np.full(len(phase), coefficients[0])
    for k in range(1, (len(coefficients) + 1) // 2):
        out = out + coefficients[2 * k - 1] * np.cos(k * phase) + coefficients[2 * k] * np.sin(k * phase)
    return out
