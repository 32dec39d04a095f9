"""What the table of models says of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from video2anim.networks.sources import Source


@dataclass(frozen=True, slots=True)
class ModelEntry:
    """One row of the table."""

    slot: str
    """What the model does; stages ask for a slot or for a name."""
    name: str
    runtime: Literal["onnx", "tflite", "torch", "arrays"]
    source: Source
    sha256: str
    """Digest of the weights; empty for files that the user brings, which are taken as they are, and for dependencies,
    which have a version."""
    size_bytes: int
    """Of all its files; 0 for files that the user brings, dependencies, and where the origin states a digest alone."""
    license: str
    verified: Literal["weights", "contract"]
    """`weights`: run against real pictures with these weights; `contract`: only the tensor contract is tested."""
    adapter: str
    """`module:Class` that runs it; empty where not `load_model` but the part that it belongs to does."""
    also: tuple[str, ...] = ()
    """Slots whose question it answers in part: in `camera` the lens alone, without gravity."""
    requires: tuple[str, ...] = ()
    """Other models the adapter needs."""
    files: tuple[str, ...] = ()
    """Names of the user's files where a model has several: PATH is their folder, the adapter gets the first."""

    @property
    def file_name(self) -> str:
        """Name of the weights in the cache folder."""
        return f"{self.name}.{self.runtime}"
