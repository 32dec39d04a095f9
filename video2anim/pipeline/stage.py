"""What a stage is: a typed function, a version, and the context it runs in."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from video2anim.errors import printable
from video2anim.types.quality import Better, Quality, Unit

NO_MODEL = "none"
"""Name in a stage's configuration of a model that is left out."""


@dataclass(slots=True)
class StageContext:
    """What a stage may use besides its inputs: randomness, models, a work folder, and a voice."""

    work_dir: Path
    """Folder of the payload being written; files for `PayloadFile` fields go here."""
    seed: int = 0
    device: str = "cpu"
    load_model: Callable[[str], Any] | None = None
    """Loads the model that fills a slot."""
    on_progress: Callable[[int, int], None] | None = None
    qualities: list[Quality] = field(default_factory=list[Quality])
    warnings: list[str] = field(default_factory=list[str])

    def rng(self, label: str) -> np.random.Generator:
        """Generator that depends on the run's seed and the label alone."""
        digest = hashlib.sha256(f"{self.seed}/{label}".encode()).digest()
        return np.random.default_rng(int.from_bytes(digest[:8], "little"))

    def quality(
        self,
        key: str,
        value: float,
        unit: Unit,
        better: Better = "none",
        *,
        person_id: int | None = None,
        object_id: int | None = None,
    ) -> None:
        """Record a quality number for the manifest and the report."""
        self.qualities.append(Quality(key, float(value), unit, better, person_id, object_id))

    def warn(self, text: str) -> None:
        """Record a warning that the user sees."""
        self.warnings.append(printable(text))

    def progress(self, done: int, total: int) -> None:
        """Report progress in items."""
        if self.on_progress is not None:
            self.on_progress(done, total)

    def model(self, slot: str) -> Any:
        """The loaded adapter of the model in `slot`.

        Raises:
            ModelMissingError: its weights are absent and cannot be had.
        """
        if self.load_model is None:
            raise RuntimeError(f"stage asked for model slot {slot!r} outside the runner")
        return self.load_model(slot)


@dataclass(frozen=True, slots=True)
class StageSpec:
    """A stage as the runner sees it. Inputs and output are read from the function's signature."""

    name: str
    function: Callable[..., Any]
    version: int
    """Raised with every edit that changes results."""
    models: tuple[str, ...] = ()
    """Model slots whose weights are part of the cache key."""
