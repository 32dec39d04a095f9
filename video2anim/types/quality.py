"""The schema of quality numbers in run.json, the report, `show` and the benchmarks."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, get_args

Better = Literal["lower", "higher", "near_1", "near_truth", "none"]
"""Which values are better; `near_truth`: near to the same measure of the ground truth; `none`: only a fact."""
Unit = Literal[
    "m", "m/s", "m/s^2", "m/s^3", "px", "deg", "ratio", "%", "count", "MB", "Hz", "dB", "/255",
]  # fmt: skip
_WRITTEN = {
    "pa_mpjpe": "PA-MPJPE", "wa_mpjpe": "WA-MPJPE", "w_mpjpe": "W-MPJPE", "mpjpe": "MPJPE", "iou": "IoU",
    "psnr": "PSNR", "f1": "F1", "rte": "RTE", "gmd": "GMD", "sdf": "SDF", "fid": "FID",
}  # fmt: skip
"""Usual spelling of abbreviations in keys."""
_WORDS = re.compile("|".join(rf"(?<![a-z0-9]){word}(?![a-z0-9])" for word in _WRITTEN))
_KEY = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")


@dataclass(frozen=True, slots=True)
class Quality:
    """One quality number.

    Raises:
        ValueError: the key is not lower-case words joined by underscores, or the unit is not in `Unit`.
    """

    key: str
    value: float
    """NaN if it could not be measured."""
    unit: Unit
    better: Better = "none"
    person_id: int | None = None
    """Person that it describes; None = the main person, or no person."""
    object_id: int | None = None

    def __post_init__(self) -> None:
        if not _KEY.fullmatch(self.key):
            raise ValueError(f"Quality.key: want words joined by underscores, got {self.key!r}")
        if self.unit not in get_args(Unit) or self.better not in get_args(Better):
            raise ValueError(f"Quality {self.key}: want a unit of {get_args(Unit)} and a direction, got {self.unit!r}")

    @property
    def label(self) -> str:
        """Text for tables: the words of the key, and the person or object."""
        of = [f"{word} {number}" for word, number in (("person", self.person_id), ("object", self.object_id))
              if number is not None]  # fmt: skip
        words = _WORDS.sub(lambda found: _WRITTEN[found[0]], self.key).replace("_", " ")
        return words + (f" ({', '.join(of)})" if of else "")
