"""Colors and labels of contacts, the same in the viewer and the report."""

from __future__ import annotations

from collections.abc import Sequence

from video2anim.types.contact import FLOOR, Contact

FLOOR_RGB = (110, 118, 130)
OBJECT_RGB = (
    (31, 111, 178), (217, 130, 43), (26, 127, 75), (140, 86, 175), (120, 72, 30), (23, 154, 165), (190, 150, 20),
    (214, 93, 150),
)  # fmt: skip
"""By object id, repeated: distinct on white, and from the red of contacts with unknown objects."""
_JITTER_S = 1e-6
"""Times of contacts are rounded to fewer decimals than those of frames."""


def touched_rgb(object_id: int | None) -> tuple[int, int, int]:
    """Color of an object's contacts; None for the floor."""
    return FLOOR_RGB if object_id is None else OBJECT_RGB[object_id % len(OBJECT_RGB)]


def touched_name(contact: Contact) -> str:
    """What is touched, such as `chair 3`."""
    return FLOOR if contact.object_id is None else f"{contact.label} {contact.object_id}"


def contacts_at(contacts: Sequence[Contact], person_id: int, time_s: float) -> list[Contact]:
    """Contacts of a person that hold at a time."""
    return [
        one
        for one in contacts
        if one.person_id == person_id and one.start_s - _JITTER_S <= time_s <= one.end_s + _JITTER_S
    ]


def contact_line(contact: Contact) -> str:
    """Such as `left hand: table 2, top`."""
    where = "" if contact.object_id is None else f", {contact.surface}"
    return f"{contact.body_part}: {touched_name(contact)}{where}"
