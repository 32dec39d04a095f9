"""Tables about motion clips."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from scenemi.data.source_clip import SourceClip
from scenemi.windows import WINDOW_FRAMES
from video2anim.types.clip import FPS

_ALL = ("all", "")


def summarize(
    clips: Sequence[SourceClip], split: Mapping[str, Sequence[str]] | None = None
) -> tuple[list[str], list[list[str]]]:
    """Head and lines of a table: for each source and kind its clips, minutes, whole windows, and clips in each part."""
    part_of = {name: part for part, names in (split or {}).items() for name in names}
    parts = list(split or {})
    count: Counter[tuple[str, str]] = Counter()
    frames: Counter[tuple[str, str]] = Counter()
    windows: Counter[tuple[str, str]] = Counter()
    in_part: Counter[tuple[str, str, str]] = Counter()
    for clip in clips:
        for source, kind in ((clip.source, clip.kind), _ALL):
            key = (source, kind)
            count[key] += 1
            frames[key] += len(clip.root_position_m)
            windows[key] += len(clip.root_position_m) // WINDOW_FRAMES
            in_part[(source, kind, part_of.get(clip.name, ""))] += 1
    lines = []
    for key in [*sorted(key for key in count if key != _ALL), _ALL]:
        minutes = f"{frames[key] / FPS / 60:.1f}"
        in_parts = [str(in_part[(*key, part)]) for part in parts]
        lines.append([" ".join(key).strip(), str(count[key]), minutes, str(windows[key]), *in_parts])
    return ["source kind", "clips", "minutes", f"{WINDOW_FRAMES}-frame windows", *parts], lines
