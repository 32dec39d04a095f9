"""Values that nobody could make: for tests of readers, which must refuse what somebody edited."""

from __future__ import annotations

import copy
from typing import TypeVar

Value = TypeVar("Value")


def unchecked(value: Value, **changes: object) -> Value:
    """A frozen dataclass with other fields, without the checks of its making."""
    changed = copy.copy(value)
    for name, new in changes.items():
        object.__setattr__(changed, name, new)
    return changed
