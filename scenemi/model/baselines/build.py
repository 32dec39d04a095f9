"""A denoiser of any form by its configuration."""

from __future__ import annotations

from scenemi.model.baselines.condmdi import CondMdi
from scenemi.model.baselines.mdm import Mdm
from scenemi.model.baselines.omnicontrol import OmniControl
from scenemi.model.baselines.scenediffuser import SceneDiffuser
from scenemi.model.baselines.stablemofusion import StableMoFusion
from scenemi.model.baselines.wang2021 import Wang2021
from scenemi.model.build import AnyDenoiser, build_denoiser
from scenemi.model.config import AnyConfig, BaselineConfig, Method

AnyBaseline = Mdm | StableMoFusion | SceneDiffuser | Wang2021 | OmniControl | CondMdi
BASELINES: dict[Method, type[AnyBaseline]] = {
    "mdm": Mdm, "stablemofusion": StableMoFusion, "scenediffuser": SceneDiffuser, "wang2021": Wang2021,
    "omnicontrol": OmniControl, "condmdi": CondMdi,
}  # fmt: skip
"""In the order of the paper's table 1."""


def build_any(config: AnyConfig) -> AnyDenoiser:
    """An untrained denoiser of the shipped form, the paper's, or a baseline."""
    return BASELINES[config.method](config) if isinstance(config, BaselineConfig) else build_denoiser(config)
