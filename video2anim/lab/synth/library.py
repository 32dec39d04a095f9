"""Captured motion for synthetic clips, from archives in the file format of captured motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenemi.data.container import MotionArchive
from scenemi.data.retarget import RetargetedMotion, retarget
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class MotionDatabase:
    """Clips of several archives, drawn by kind."""

    archives: tuple[MotionArchive, ...]
    clips: tuple[tuple[int, str, str, str], ...]
    """(archive, name, kind, source), sorted by name."""

    @classmethod
    def read(cls, paths: Sequence[Path], *, noncommercial: bool = False) -> MotionDatabase:
        """Open archives, or all archives of a folder.

        Raises:
            InputError: a file is missing, is not an archive, or has no clips (that are free for commercial use).
        """
        files: list[Path] = []
        for path in paths:
            found = sorted(path.glob("*.npz")) if path.is_dir() else [path]
            if not found:
                raise InputError(f"motion: want at least one .npz archive, found none in {path}")
            files += found
        archives = tuple(MotionArchive.read(path) for path in files)
        rows = [
            (number, name, kind, source)
            for number, archive in enumerate(archives)
            for name, kind, source, free in zip(
                archive.names, archive.kinds, archive.sources, archive.free, strict=True
            )
            if noncommercial or free
        ]
        if not rows:
            raise InputError(
                f"motion: no clip in {files[0]} is known to be free for commercial use; add --noncommercial"
            )
        return cls(archives, tuple(sorted(rows, key=lambda row: row[1])))

    def draw(
        self, kind: str, body: ShapedBody, rng: np.random.Generator, *, min_s: float = 1.5
    ) -> RetargetedMotion | None:
        """A random clip of a kind, at least `min_s` seconds long, retargeted to a body; None if there is none."""
        names = [row for row in self.clips if row[2] == kind]
        for number in rng.permutation(len(names)):
            archive, name, _, _ = names[int(number)]
            clip = self.archives[archive].clip(name)
            if len(clip.root_position_m) / clip.fps >= min_s and not clip.uneven:
                return retarget(clip, body)
        return None
