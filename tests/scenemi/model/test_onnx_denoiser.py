"""The ONNX graph computes what the torch denoiser computes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scenemi.model.config import SIZES, ModelConfig
from scenemi.model.denoiser import Conditions, Denoiser

pytest.importorskip("onnx", reason="the exporter needs onnx (dev extra)")
from scenemi.model.onnx_denoiser import INPUT_NAMES, OnnxDenoiser, to_onnx

TINY = SIZES["tiny"]


def drawn(config: ModelConfig, batch: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, Conditions]:
    g = torch.Generator().manual_seed(seed)
    frames, features = config.window_frames, config.feature_count

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g)

    mask = (normal(batch, frames) > 1).float()
    given = Conditions(
        mask=mask, imputed=mask * (normal(batch)[:, None] > 0), base=normal(batch, frames, features),
        local=normal(batch, frames, config.bps_anchors, 3), body=normal(batch, config.body_lengths),
        noise_level=normal(batch).abs(), scene=normal(batch, config.embedding),
        scene_known=torch.arange(batch).remainder(2).float(), local_known=torch.ones(batch),
    )  # fmt: skip
    return normal(batch, frames, features), torch.randint(1, 1001, (batch,), generator=g), given


def denoiser_of(config: ModelConfig) -> Denoiser:
    """Weights everywhere, also where training starts from zero."""
    torch.manual_seed(0)
    model = Denoiser(config).eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return model


@pytest.mark.parametrize(
    "config",
    [
        TINY,
        replace(TINY, use_local=False),
        replace(TINY, condition="token", residual=False),
        replace(TINY, condition="adagn", noise_channel=False),
    ],
)
@pytest.mark.parametrize("batch", [1, 2, 5])
def test_onnxruntime_gives_what_torch_gives(config: ModelConfig, batch: int) -> None:
    model = denoiser_of(config)
    exported = OnnxDenoiser(model, threads=1)
    x, t, given = drawn(config, batch, batch)
    with torch.no_grad():
        wanted = model(x, t, given)
    assert wanted.std() > 0.02
    assert (exported(x, t, given) - wanted).abs().max() <= 1e-4


def test_the_graph_is_valid_and_has_the_documented_names() -> None:
    import onnx

    graph = onnx.load_from_string(to_onnx(denoiser_of(TINY)))
    onnx.checker.check_model(graph)
    # What is imputed shows in `seen` already.
    assert {item.name for item in graph.graph.input} == set(INPUT_NAMES) - {"imputed"}
    assert [item.name for item in graph.graph.output] == ["x0"]
