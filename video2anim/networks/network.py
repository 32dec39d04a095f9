"""What the adapters of picture networks share: sessions with optional outputs, and pictures as their input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.errors import ModelMissingError
from video2anim.networks.onnx import Session


class Network:
    """A network on the CPU, held to the tensor names that its adapter needs; it may have others besides."""

    def __init__(
        self,
        path: Path,
        *,
        inputs: Sequence[str],
        outputs: Sequence[str],
        optional_inputs: Sequence[str] = (),
    ) -> None:
        """Load the weights. Inputs must be those named; outputs beyond those named are never computed for the adapter.

        Raises:
            ModelMissingError: the file is no ONNX network, or one without these tensors.
        """
        self.path = path
        self._session = Session(path)
        self.inputs, self.outputs = self._session.inputs, tuple(self._session.outputs)
        fits = set(inputs) <= set(self.inputs) <= {*inputs, *optional_inputs} and set(outputs) <= set(self.outputs)
        if not fits:
            raise ModelMissingError(
                f"{path}: want tensors {tuple(inputs)} -> {tuple(outputs)}, got {self._session.tensors}"
            )

    def fixed_size(self, name: str) -> tuple[int, int] | None:
        """Height and width of an input picture, None where either may vary."""
        shape = self.inputs[name].shape
        height, width = shape[-2:] if len(shape) >= 2 else (None, None)
        return (height, width) if isinstance(height, int) and isinstance(width, int) else None

    def run(self, feeds: Mapping[str, np.ndarray], outputs: Sequence[str]) -> dict[str, np.ndarray]:
        """The named outputs as float32 (those that are numbers of another width too).

        Raises:
            ModelMissingError: the network refuses its input.
        """
        values = self._session.run(outputs, feeds)
        return {name: np.asarray(value, np.float32) for name, value in zip(outputs, values, strict=True)}

    def expect_shape(self, name: str, value: np.ndarray, wanted: Sequence[int | None]) -> None:
        """Hold an output to its shape; None is any length.

        Raises:
            ModelMissingError: another shape.
        """
        fits = value.ndim == len(wanted) and all(
            want in (None, length) for want, length in zip(wanted, value.shape, strict=True)
        )
        if not fits:
            shape = ", ".join("*" if want is None else str(want) for want in wanted)
            raise ModelMissingError(f"{self.path}: want {name} ({shape}), got {value.shape}")


def resized(image: UInt8[np.ndarray, "height width 3"], height: int, width: int) -> UInt8[np.ndarray, "h w 3"]:
    """The picture at another size: areas when shrinking, straight lines when growing."""
    if image.shape[:2] == (height, width):
        return image
    grows = width > image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR if grows else cv2.INTER_AREA)


def to_unit_values(image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "1 3 height width"]:
    """RGB in [0, 1], channels first, float32."""
    return np.ascontiguousarray(image.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255.0))


def sigmoid(logits: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Logistic function that never overflows."""
    return 1.0 / (1.0 + np.exp(-np.clip(logits, -60.0, 60.0)))
