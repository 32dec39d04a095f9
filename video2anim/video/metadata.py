"""What cameras write into a video's tags."""

from __future__ import annotations

import re
from collections.abc import Mapping

_SHORTEST_MM, _LONGEST_MM = 4.0, 3000.0
"""Focal lengths that a 35 mm equivalent can have; anything else is not one."""


def focal_35mm_of(metadata: Mapping[str, str]) -> float:
    """35 mm equivalent focal length in millimeters from a video's tags, 0 where there is none.

    Reads every tag whose name speaks of a focal length and of 35 mm, whatever its prefix, for example Apple's
    `com.apple.quicktime.camera.focal_length.35mm_equivalent` or EXIF's `FocalLengthIn35mmFilm`. A plain focal length
    says nothing without the sensor's size and is not used.
    """
    for key, value in metadata.items():
        name = re.sub(r"[^a-z0-9]", "", key.lower())
        if "focallength" not in name or "35mm" not in name:
            continue
        number = re.search(r"\d+(?:\.\d+)?", value)
        if number and _SHORTEST_MM <= float(number.group()) <= _LONGEST_MM:
            return float(number.group())
    return 0.0
