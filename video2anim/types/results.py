"""Result files of stage export."""

from __future__ import annotations

from dataclasses import dataclass

from video2anim.types.contact import Contact
from video2anim.types.storage import PayloadFile


@dataclass(frozen=True, slots=True)
class ExportedFiles:
    """Result files, which the runner also places at the top of the scene folder."""

    files: tuple[PayloadFile, ...]
    contacts: tuple[Contact, ...] = ()
    """Contacts of all persons of the result; they are also in `run.json`."""
