"""Procedural motions as an archive in the file format of captured motion."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np

from scenemi.data.container import write_archive
from video2anim.body.anny_body import shaped_body
from video2anim.lab.synth.acting import act, to_source_clip
from video2anim.lab.synth.compose import draw_shape
from video2anim.lab.synth.generate import reported_write_errors
from video2anim.lab.synth.presets import PROCEDURAL, expect_count_and_seed

MAX_MOTIONS = 100_000
"""Maximum number of motions of an archive, which is assembled in memory."""


def write_procedural(path: Path, *, count: int, seed: int) -> int:
    """Write `count` procedural motions of all kinds in turn, each on its own random body; their source is `synthetic`.

    Returns:
        Number of motions written.

    Raises:
        UsageError: count or seed is out of range.
        InputError: the file cannot be written.
    """
    expect_count_and_seed(count, seed, MAX_MOTIONS)
    with reported_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if path.is_symlink() or (path.exists() and not path.is_file()):
            raise OSError("a link, pipe or device")
    clips = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        body = shaped_body(draw_shape(rng))
        clips.append(
            to_source_clip(
                act(PROCEDURAL[number % len(PROCEDURAL)], body, rng), body, name=f"synthetic_{seed}_{number:05d}"
            )
        )
    with reported_write_errors(path):
        write_archive(path, clips)
    return len(clips)
