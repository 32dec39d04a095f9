"""ONNX sessions behind one function; the only place that knows the runtime."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as native  # pyright: ignore[reportAttributeAccessIssue]

from video2anim.errors import ModelMissingError

THREADS = 2
_FATAL = 4
"""Log level: what is wrong with a network comes as an error, the runtime's own lines only repeat it."""
_QUOTED = 200
"""Most characters of what a file says that a message quotes."""
RUNTIME_ERRORS = (
    native.EPFail,
    native.Fail,
    native.InvalidArgument,
    native.InvalidGraph,
    native.InvalidProtobuf,
    native.ModelRequiresCompilation,
    native.NoModel,
    native.NoSuchFile,
    native.NotImplemented,
    native.RuntimeException,
    UnicodeDecodeError,  # names, and messages that quote them, that are no text
)
"""What the runtime raises for files it cannot load or run."""


class Session:
    """A network on the CPU, with the names of its tensors."""

    def __init__(self, path: Path) -> None:
        """Load it.

        Raises:
            ModelMissingError: the file is no ONNX network.
        """
        self.path = path
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = THREADS
        options.log_severity_level = _FATAL
        cpu = ["CPUExecutionProvider"]
        try:
            self._native = onnxruntime.InferenceSession(str(path), options, providers=cpu, enable_fallback=0)
            self.inputs: dict[str, Any] = {tensor.name: tensor for tensor in self._native.get_inputs()}
            self.outputs: dict[str, Any] = {tensor.name: tensor for tensor in self._native.get_outputs()}
        except RUNTIME_ERRORS as error:
            raise ModelMissingError(
                f"{path}: want an .onnx network, the runtime cannot load it: {_one_line(error)}"
            ) from error
        if empty := [name for name, tensor in self.inputs.items() if 0 in tensor.shape]:
            raise ModelMissingError(
                f"{path}: want a network that takes pictures, got room for none in {_quoted(empty)}"
            )

    @property
    def tensors(self) -> str:
        """Names of inputs and outputs, for a message."""
        return f"{_quoted(tuple(self.inputs))} -> {_quoted(tuple(self.outputs))}"

    def run(self, outputs: Sequence[str], feeds: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """The named outputs.

        Raises:
            ModelMissingError: the network refuses its input, or gives no numbers.
        """
        try:
            found = [np.asarray(value) for value in self._native.run(list(outputs), dict(feeds))]
        except RUNTIME_ERRORS as error:
            shapes = ", ".join(f"{name} {value.shape}" for name, value in feeds.items())
            raise ModelMissingError(
                f"{self.path}: want a network of {shapes}, it refuses: {_one_line(error)}"
            ) from error
        for name, value in zip(outputs, found, strict=True):
            if not value.size or value.dtype.kind not in "fiub":
                raise ModelMissingError(f"{self.path}: want numbers in {name}, got {value.dtype} {value.shape}")
        return found


def open_session(path: Path, *, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> Session:
    """Load a network and hold it to its tensor names.

    Raises:
        ModelMissingError: the file is no ONNX network, or one with other tensors.
    """
    session = Session(path)
    if tuple(session.inputs) != inputs or tuple(session.outputs) != outputs:
        raise ModelMissingError(f"{path}: want tensors {inputs} -> {outputs}, got {session.tensors}")
    return session


def _one_line(error: Exception) -> str:
    """The beginning of what the runtime says."""
    return " ".join(str(error).split())[:_QUOTED]


def _quoted(names: Sequence[str]) -> str:
    text = str(tuple(names))
    return text if len(text) <= _QUOTED else f"{text[:_QUOTED]}..."
