"""CondMDI: Flexible Motion In-betweening with Diffusion Models (Cohan et al., SIGGRAPH 2024).

A 1D U-Net that is trained with random keyframes in the noisy window and their mask beside it: the paper's own denoiser
without the scene at keyframes and without noisy keyframes. Simplified: the features hold no velocities (theirs do,
which keyframes of one pose do not tell), whole poses are keyframes, and the reconstruction guidance that they offer
beside imputation is not used.
"""

from __future__ import annotations

from scenemi.model.baselines.base import Baseline
from scenemi.model.paper import PaperDenoiser


class CondMdi(Baseline, PaperDenoiser):
    """Predicts x_0 from x_t with the keyframes imputed, their mask, the step and the scene."""
