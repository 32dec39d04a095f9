"""Runs of true values in a sequence of flags over time."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool


def runs(flags: Bool[np.ndarray, "frames"]) -> list[tuple[int, int]]:
    """[start, stop) of each run of true values, in order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def without_short_runs(
    flags: Bool[np.ndarray, "frames"], shortest: int, *, close_gaps: bool = True
) -> Bool[np.ndarray, "frames"]:
    """The flags after closing gaps between two runs, then dropping runs, of fewer than `shortest` frames."""
    cleaned = flags.copy()
    if close_gaps:
        for start, stop in runs(~flags):
            if stop - start < shortest and start > 0 and stop < len(flags):
                cleaned[start:stop] = True
    for start, stop in runs(cleaned):
        if stop - start < shortest:
            cleaned[start:stop] = False
    return cleaned
