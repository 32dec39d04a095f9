"""The project's own temporal lifter: landmarks of a clip -> rotations, place, contacts and up of every frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from video2anim.errors import ModelMissingError
from video2anim.networks.onnx import open_session

_INPUT, _OUTPUT = "features", "body"
WIDTHS = (154, 168)
"""Features and outputs of a frame, as `video2anim.humans.lifter_input` lists them."""
_CHUNK, _MARGIN = 1800, 72
"""Long clips go through in pieces; a frame of the answer depends on 71 frames on each side. Both are multiples of the
frames that the network folds into one (4), so that pieces are folded as the whole clip would be."""


class Lifter:
    """Runs the network over clips of any length in constant memory.

    Raises:
        ModelMissingError: the file is not this network.
    """

    def __init__(self, path: Path) -> None:
        self._session = open_session(path, inputs=(_INPUT,), outputs=(_OUTPUT,))
        widths = (self._session.inputs[_INPUT].shape[-1], self._session.outputs[_OUTPUT].shape[-1])
        if widths != WIDTHS:
            raise ModelMissingError(f"{path}: want {WIDTHS[0]} features and {WIDTHS[1]} outputs a frame, got {widths}")

    def __call__(self, features: Float[np.ndarray, "frames features"]) -> Float[np.ndarray, "frames outputs"]:
        """Answers for consecutive frames; see `video2anim.humans.lifter_input` for what columns mean."""
        parts = []
        for begin in range(0, len(features), _CHUNK):
            low, high = max(begin - _MARGIN, 0), min(begin + _CHUNK + _MARGIN, len(features))
            piece = features[None, low:high].astype(np.float32)
            answer = self._session.run([_OUTPUT], {_INPUT: piece})[0][0]
            parts.append(answer[begin - low : begin - low + _CHUNK])
        return np.concatenate(parts)
