"""Camera metadata in the tags of a video."""

from __future__ import annotations

import re
from collections.abc import Mapping


def focal_35mm_of(metadata: Mapping[str, str]) -> float:
    """35 mm equivalent focal length in millimeters from a video's tags, 0 where there is none.

    Reads every tag whose name has a focal length and 35 mm in it, for example Apple's
    `com.apple.quicktime.camera.focal_length.35mm_equivalent` or EXIF's `FocalLengthIn35mmFilm`. A plain focal length is
    not used, since the sensor's size is unknown. Whether the value is plausible is decided by stage camera.
    """
    for key, value in metadata.items():
        name = re.sub(r"[^a-z0-9]", "", key.lower())
        if "focallength" not in name or "35mm" not in name:
            continue
        number = re.search(r"\d+(?:\.\d+)?", value)
        if number:
            return float(number.group())
    return 0.0
