"""What the export stage leaves for the user."""

from __future__ import annotations

from dataclasses import dataclass

from video2anim.types.storage import PayloadFile


@dataclass(frozen=True, slots=True)
class ExportedFiles:
    """Result files; the runner also places them at the top of the scene folder."""

    files: tuple[PayloadFile, ...]
