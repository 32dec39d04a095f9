"""Colors of interiors, clothes and people, from the table `colors.json` (sRGB, 0 to 1).

They are chosen from ranges that occur in photographs of interiors. Entries of `wood` are the light and the dark color
of the grain; those of `fabrics` are a main, a second and an accent color that match; all others are one color.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

Rgb = tuple[float, float, float]


def _tuples(value: Any) -> Any:
    values = value.values() if isinstance(value, dict) else value
    return tuple(map(_tuples, values)) if isinstance(value, list | dict) else value


COLORS: dict[str, Any] = {
    name: _tuples(value)
    for name, value in json.loads(Path(__file__).with_name("colors.json").read_text(encoding="utf-8")).items()
}
