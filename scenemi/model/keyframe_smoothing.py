"""Noisy keyframes smoothed before they are joined: a smoothing spline for every feature.

A feature moves as if its acceleration were white and keyframes show it with noise of known size. The mean given the
keyframes is then the natural cubic smoothing spline, and how strongly a feature accelerates in a window is what makes
its keyframes most likely (Wahba 1985; matrices as in Green & Silverman 1994, section 2.1): resting limbs are averaged
over seconds, swinging ones hardly at all.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

EXACT = 1e6
"""Weight of a keyframe without noise, where one with noise has 1."""
_STIFFNESS = 10.0 ** torch.arange(-4.0, 7.0, dtype=torch.float64)
"""Tried ratios of the noise's variance to that which the speed gains in a frame."""
_FEWEST = 4
"""Below so many keyframes there is nothing to tell noise from movement by."""


@torch.no_grad()
def smooth_keyframes(
    keys: Float[Tensor, "batch frames channels"],
    weight: Float[Tensor, "batch frames"],
    deviation: Float[Tensor, "batch channels"],
) -> Float[Tensor, "batch frames channels"]:
    """Keyframes with less noise.

    Args:
        keys: values; rows with weight 0 are not read.
        weight: 0 where there is no keyframe, 1 at noisy ones, `EXACT` at ones to be kept.
        deviation: standard deviation of the noise of each channel, > 0.

    Returns:
        The values at keyframes; zero elsewhere.
    """
    out = torch.zeros_like(keys)
    held: dict[bytes, tuple[Tensor, Tensor]] = {}
    weights = weight.detach().cpu().double()
    for row, w in enumerate(weights):
        at = torch.nonzero(w)[:, 0]
        frames = at.to(keys.device)
        values = keys[row, frames]
        if len(at) >= _FEWEST:
            name = w.numpy().tobytes()
            if name not in held:
                held[name] = _bending(at, w[at])
            roughness, shapes = (part.to(keys.device) for part in held[name])
            scaled = values.double() / deviation[row] * w[at].sqrt().to(keys.device)[:, None]
            smooth = _fitted(shapes.T @ scaled, roughness)
            values = (shapes @ smooth / w[at].sqrt().to(keys.device)[:, None] * deviation[row]).to(keys.dtype)
        out[row, frames] = values
    return out


def _bending(at: Int[Tensor, "keyframes"], w: Tensor) -> tuple[Float[Tensor, "keyframes"], Tensor]:
    """Eigenvalues and vectors of the natural spline's bending energy, as a form in sqrt(w) times its values."""
    h = at.diff().double()
    count = len(at)
    Q = torch.zeros(count, count - 2, dtype=torch.float64)
    R = torch.zeros(count - 2, count - 2, dtype=torch.float64)
    inner = torch.arange(count - 2)
    Q[inner, inner], Q[inner + 2, inner] = 1 / h[:-1], 1 / h[1:]
    Q[inner + 1, inner] = -1 / h[:-1] - 1 / h[1:]
    R[inner, inner] = (h[:-1] + h[1:]) / 3
    R[inner[:-1], inner[1:]] = R[inner[1:], inner[:-1]] = h[1:-1] / 6
    Q = Q / w.sqrt()[:, None]
    return torch.linalg.eigh(Q @ torch.linalg.solve(R, Q.T))


def _fitted(z: Float[Tensor, "shapes channels"], roughness: Float[Tensor, "shapes"]) -> Tensor:
    """Each channel's coefficients shrunk with its likeliest stiffness. The two straight shapes are kept."""
    product = _STIFFNESS.to(z.device)[:, None] * roughness[2:]
    # A coefficient has variance 1 from the noise and 1 / product from the movement.
    variance = 1 + 1 / product.clamp(min=1e-12)
    misfit = (1 / variance) @ z[2:].square() + variance.log().sum(1, keepdim=True)
    best = misfit.argmin(0)
    kept = torch.ones_like(z)
    kept[2:] = (1 / (1 + product))[best].T
    return kept * z
