"""Acted motions as an archive in the motion container format."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scenemi.data.container import write_archive
from video2anim.body.anny_body import shaped_body
from video2anim.errors import InputError, UsageError
from video2anim.synth.acting import act, to_source_clip
from video2anim.synth.compose import draw_shape
from video2anim.synth.presets import ACTED


def write_acted(path: Path, *, count: int, seed: int) -> int:
    """Write `count` acted motions, kinds in turn, each on a body of its own; their source is `synthetic`.

    Returns:
        How many were written.

    Raises:
        UsageError: count or seed is out of range.
        InputError: the file cannot be written.
    """
    if count < 1 or seed < 0:
        raise UsageError(f"want --count of 1 or more and --seed of 0 or more, got {count} and {seed}")
    clips = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        body = shaped_body(draw_shape(rng))
        clips.append(
            to_source_clip(act(ACTED[number % len(ACTED)], body, rng), body, name=f"synthetic_{seed}_{number:05d}")
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_archive(path, clips)
    except OSError as error:
        raise InputError(f"--out: cannot write {path}: {error.strerror or error}") from error
    return len(clips)
