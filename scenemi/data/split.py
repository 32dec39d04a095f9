"""Which part of the data a clip belongs to. Clips that no file names are assigned by their name alone."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from scenemi.data.container import read_split

Part = Literal["train", "val", "test"]
PARTS: tuple[Part, ...] = ("train", "val", "test")
HELD_OUT = 0.05
"""Share of the clips that goes to `val`, and to `test`: a twentieth of the 200 minutes here are 10 (not measured)."""


@dataclass(frozen=True, slots=True)
class Split:
    """Parts by clip name."""

    named: dict[str, Part] = field(default_factory=dict)

    @classmethod
    def read(cls, path: str | Path) -> Split:
        """From a JSON file with lists of clip names.

        Raises:
            InputError: the file is missing or no split.
        """
        table = read_split(path)
        return cls({name: part for part in PARTS for name in table[part]})

    def part_of(self, name: str) -> Part:
        """Part of a clip: as named, else by a digest of its name, so it never changes when clips are added."""
        if name in self.named:
            return self.named[name]
        share = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") / 2**64
        if share < HELD_OUT:
            return "test"
        return "val" if share < 2 * HELD_OUT else "train"
