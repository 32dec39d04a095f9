"""Standing heights of people that the user knows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from video2anim.errors import UsageError

KNOWN_SIGMA_M = 0.01
"""Standard deviation of a height that the user gives: people are 1 to 2 cm taller in the morning than at night."""


def height_of(known_m: float | Mapping[int, float] | None, person_id: int, main_id: int) -> float | None:
    """Known height of a person in meters, None where it is not known: one number is that of the main person."""
    if isinstance(known_m, Mapping):
        return known_m.get(person_id)
    return known_m if person_id == main_id else None


def expect_heights(known_m: float | Mapping[int, float] | None, person_ids: Sequence[int]) -> None:
    """Refuse heights of people who are not selected.

    Raises:
        UsageError: an ID that is not one of `person_ids`.
    """
    if known_m is None:
        return
    heights_m = known_m if isinstance(known_m, Mapping) else dict.fromkeys(person_ids[:1], known_m)
    for person_id, height_m in heights_m.items():
        if person_id not in person_ids:
            selected = ", ".join(map(str, person_ids))
            raise UsageError(
                f"--height-m {person_id}={height_m:g}: want the ID of a selected person ({selected}); "
                "--person selects them"
            )


def parse_heights(words: Sequence[str]) -> float | dict[int, float] | None:
    """`["1.70"]`, the main person's height in meters, or `["1=1.70", "2=1.12"]`, by ID; None for no words.

    Raises:
        UsageError: of neither form, or a person twice.
    """
    heights_m: dict[int, float] = {}
    for word in words:
        number, by_id, height = word.rpartition("=")
        try:
            if not by_id and len(words) == 1:
                return float(height)
            person_id, height_m = int(number), float(height)
        except ValueError:
            person_id, height_m = 0, 0.0
        if person_id < 1 or person_id in heights_m:
            raise UsageError(
                f"--height-m: want one height in meters, such as 1.70, or heights by person, as in 2=1.12, got {word!r}"
            )
        heights_m[person_id] = height_m
    return heights_m or None
