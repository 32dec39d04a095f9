"""The windows that a command line asks for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scenemi.data.container import MotionArchive, read_split
from scenemi.data.scene_clips import scene_folders
from scenemi.data.split import PARTS
from scenemi.evaluation.real_scenes import windows_in_real_scenes
from scenemi.evaluation.scenes import with_synthetic_scenes
from scenemi.evaluation.windows import EvaluationWindow, cut_windows
from video2anim.errors import UsageError


def chosen_windows(
    clips: Sequence[Path], scenes_from: Sequence[str], split: Path | None, part: str, *, made_up: bool
) -> tuple[EvaluationWindow, ...]:
    """Windows of archives, then those of data sets in their own scenes.

    Args:
        clips: motion archives.
        scenes_from: `source=folder` of data sets with captured scenes.
        split: which clips are in which part; None = all clips of archives, and data sets by their own rules.
        part: of the split.
        made_up: whether windows of archives get made-up scenes.

    Raises:
        UsageError: nothing is asked for, or an unknown part or source.
        InputError: files are missing or broken, or no clip is long enough.
    """
    if not clips and not scenes_from:
        raise UsageError("evaluation: want --clips FILE or --scenes-from SOURCE=FOLDER, got neither")
    table = None if split is None else read_split(split)
    if part not in PARTS:
        raise UsageError(f"--part: want one of {', '.join(PARTS)}, got {part!r}")
    names = None if table is None else table[part]
    windows: list[EvaluationWindow] = []
    if clips:
        found = cut_windows([MotionArchive.read(path) for path in clips], names)
        windows += with_synthetic_scenes(found) if made_up else found
    if scenes_from:
        windows += windows_in_real_scenes(scene_folders(scenes_from), part if names is None else names)
    return tuple(windows)
