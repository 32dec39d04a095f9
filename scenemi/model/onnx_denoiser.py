"""The denoiser as an ONNX graph, and run by onnxruntime. The scene encoder stays in torch: it runs once per window."""

from __future__ import annotations

import importlib.util
import io
import warnings
from dataclasses import fields
from typing import Any, cast

import numpy as np
import onnxruntime
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from scenemi.model.denoiser import Conditions, Denoiser
from video2anim.errors import ModelMissingError

OPSET = 17
CONDITION_NAMES = tuple(item.name for item in fields(Conditions))
INPUT_NAMES = ("seen", "t", *CONDITION_NAMES)
OUTPUT_NAME = "x0"


class _Flat(nn.Module):
    """The denoiser with its conditions as separate arguments, which is what a graph has."""

    def __init__(self, denoiser: Denoiser) -> None:
        super().__init__()
        self.denoiser = denoiser

    def forward(self, seen: Tensor, t: Tensor, *conditions: Tensor) -> Tensor:
        return self.denoiser.answer(seen, t, Conditions(*conditions))


def to_onnx(denoiser: Denoiser) -> bytes:
    """The denoiser as an ONNX file: inputs `INPUT_NAMES` (batch free, float32, `t` int64), output `x0`.

    `seen` is `Denoiser.guess` of the noisy window (its matrix factors have no ONNX operator), or the noisy window
    itself for a model without `residual`.

    Inputs that the configuration does not use are left out. The exporter by tracing is taken: it needs the package
    `onnx` only, and a graph without control flow gains nothing from the newer one.

    Raises:
        ModelMissingError: `onnx` is not installed.
    """
    if importlib.util.find_spec("onnx") is None:
        raise ModelMissingError("ONNX export: want the package onnx; install it, or use the runtime 'torch'")
    config, batch = denoiser.config, 2
    frames = config.window_frames
    shapes = {
        "seen": (frames, config.feature_count), "mask": (frames,), "imputed": (frames,),
        "base": (frames, config.feature_count), "local": (frames, config.bps_anchors, 3),
        "body": (config.body_lengths,), "noise_level": (), "scene": (config.embedding,), "scene_known": (),
        "local_known": (),
    }  # fmt: skip
    example = {name: torch.zeros(batch, *shape) for name, shape in shapes.items()}
    example["t"] = torch.ones(batch, dtype=torch.int64)
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            _Flat(denoiser).eval().cpu(),
            tuple(example[name] for name in INPUT_NAMES),
            cast(Any, file),
            input_names=list(INPUT_NAMES),
            output_names=[OUTPUT_NAME],
            dynamic_axes={name: {0: "batch"} for name in (*INPUT_NAMES, OUTPUT_NAME)},
            opset_version=OPSET,
            dynamo=False,
        )
    return file.getvalue()


class OnnxDenoiser:
    """`Denoiser` with the same call, run by onnxruntime on the CPU."""

    def __init__(self, denoiser: Denoiser, *, threads: int | None = None, graph: bytes | None = None) -> None:
        """`graph` = what `to_onnx` made before; None = made now. `threads` None = as torch is set."""
        self._torch = denoiser
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads or torch.get_num_threads()
        options.inter_op_num_threads = 1
        # A thread that spins while it waits takes the core from whoever has work.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        self._session = onnxruntime.InferenceSession(
            graph if graph is not None else to_onnx(denoiser), options, providers=["CPUExecutionProvider"]
        )
        self._read = [item.name for item in self._session.get_inputs()]

    def encode_scene(self, occupancy: Float[Tensor, "batch x y z"]) -> Float[Tensor, "batch embedding"]:
        """The global scene vector."""
        return self._torch.encode_scene(occupancy)

    def __call__(
        self, x: Float[Tensor, "batch frames 201"], t: Int[Tensor, "batch"], given: Conditions
    ) -> Float[Tensor, "batch frames 201"]:
        """Estimate of the clean window."""
        seen = self._torch.guess(x, t, given) if self._torch.config.residual else x
        values = {"seen": seen, "t": t, **{name: getattr(given, name) for name in CONDITION_NAMES}}
        feed = {name: np.ascontiguousarray(values[name].detach().numpy()) for name in self._read}
        (x0,) = self._session.run([OUTPUT_NAME], feed)
        return torch.from_numpy(x0)
