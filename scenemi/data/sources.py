"""Which sources may be used for what."""

from __future__ import annotations

NONCOMMERCIAL_SOURCES: frozenset[str] = frozenset({"bandai1", "bandai2", "sie", "amass", "trumans", "gimo"})
"""Sources whose licence forbids commercial use; they are left out unless asked for."""


def is_free(source: str) -> bool:
    """Whether clips of a source may be used commercially. Sources of the user's own count as free."""
    return source not in NONCOMMERCIAL_SOURCES
