"""LiteRT interpreters behind one small class; the only place that knows the runtime."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from ai_edge_litert.interpreter import Interpreter
from jaxtyping import Float

from video2anim.errors import ModelMissingError

THREADS = 2


class TfliteNet:
    """A network of one image input (1, H, W, 3) float32."""

    def __init__(self, path: Path, *, threads: int = THREADS) -> None:
        """Load a `.tflite` file.

        Raises:
            ModelMissingError: the file is no network of that kind.
        """
        try:
            with _quiet_stderr():
                self._interpreter = Interpreter(str(path), num_threads=threads)
                self._interpreter.allocate_tensors()
        except (ValueError, RuntimeError) as error:
            raise ModelMissingError(f"{path}: want a .tflite network, the runtime cannot load it: {error}") from error
        self._input = self._interpreter.get_input_details()[0]
        self._outputs = self._interpreter.get_output_details()
        self.output_shapes = tuple(tuple(int(n) for n in out["shape"]) for out in self._outputs)

    @property
    def input_size_px(self) -> int:
        """Side of the square input."""
        return int(self._input["shape"][1])

    def __call__(self, image: Float[np.ndarray, "height width 3"]) -> tuple[np.ndarray, ...]:
        """All outputs, in file order, as copies."""
        self._interpreter.set_tensor(self._input["index"], np.ascontiguousarray(image, dtype=np.float32)[None])
        self._interpreter.invoke()
        return tuple(self._interpreter.get_tensor(out["index"]) for out in self._outputs)


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Keep the runtime's native start-up lines off the terminal."""
    saved = os.dup(2)
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(sink)
        os.close(saved)
