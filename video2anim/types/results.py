"""What the export stage leaves for the user."""

from __future__ import annotations

from dataclasses import dataclass

from video2anim.types.contact import Contact
from video2anim.types.storage import PayloadFile


@dataclass(frozen=True, slots=True)
class ExportedFiles:
    """Result files; the runner also places them at the top of the scene folder."""

    files: tuple[PayloadFile, ...]
    contacts: tuple[Contact, ...] = ()
    """What every person of the result touches; `run.json` holds them too."""
