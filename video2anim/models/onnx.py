"""ONNX sessions behind one function; the only place that knows the runtime."""

from __future__ import annotations

from pathlib import Path

import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as native  # pyright: ignore[reportAttributeAccessIssue]

from video2anim.errors import ModelMissingError

THREADS = 2
LOAD_ERRORS = (
    native.Fail,
    native.InvalidArgument,
    native.InvalidGraph,
    native.InvalidProtobuf,
    native.NoModel,
    native.NoSuchFile,
    native.NotImplemented,
    native.RuntimeException,
)
"""What the runtime raises for files it cannot load or run."""


def open_session(path: Path, *, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> onnxruntime.InferenceSession:
    """Load a network on the CPU and hold it to its tensor names.

    Raises:
        ModelMissingError: the file is no ONNX network, or one with other tensors.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = THREADS
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except LOAD_ERRORS as error:
        reason = " ".join(str(error).split())[:200]
        raise ModelMissingError(f"{path}: want an .onnx network, the runtime cannot load it: {reason}") from error
    came_in = tuple(tensor.name for tensor in session.get_inputs())
    came_out = tuple(tensor.name for tensor in session.get_outputs())
    if came_in != inputs or came_out != outputs:
        raise ModelMissingError(f"{path}: want tensors {inputs} -> {outputs}, got {came_in} -> {came_out}")
    return session
