"""Data of an evaluation: groups of rows of `Quality`, curves, and a floor plan of the clip."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from video2anim.types.quality import Better, Quality, Unit

FORMAT_VERSION = 2
"""Version of the JSON format."""


class _OneMeasure:
    """Key, label, unit and direction of a row, which all of its columns share."""

    __slots__ = ()
    qualities: tuple[Quality, ...]

    @property
    def key(self) -> str:
        """Key of the measure, unique in the group."""
        return self.qualities[0].key

    @property
    def label(self) -> str:
        return self.qualities[0].label

    @property
    def unit(self) -> Unit:
        return self.qualities[0].unit

    @property
    def better(self) -> Better:
        return self.qualities[0].better


@dataclass(frozen=True, slots=True)
class Row(_OneMeasure):
    """One measure in each column of its group."""

    qualities: tuple[Quality, ...]
    """One per column; the value is NaN where it is not available."""
    truth: float | None = None
    """The measure of the ground truth itself, if it has one (jerk, skating, frame count)."""
    reasons: tuple[str, ...] = ()
    """Why a value is not available, one per column; empty where there is a value."""

    @property
    def values(self) -> tuple[float | None, ...]:
        """The values, one per column; None where a value is not available."""
        return tuple(finite_or_none(quality.value) for quality in self.qualities)


@dataclass(frozen=True, slots=True)
class Group:
    """Numbers of one subject side by side, for example one column per motion stage."""

    key: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""
    """A remark for the reader, such as the number of objects compared."""


@dataclass(frozen=True, slots=True)
class Curve:
    """Values over time, one line per series; None where there is no value."""

    title: str
    unit: str
    time_s: tuple[float, ...]
    series: Mapping[str, tuple[float | None, ...]]


@dataclass(frozen=True, slots=True)
class Plan:
    """Floor plan of the clip in the true world (x, z in meters)."""

    paths_m: Mapping[str, tuple[tuple[float, float], ...]]
    """Path of the pelvis in the truth and in each stage."""
    true_outlines_m: tuple[tuple[str, tuple[tuple[float, float], ...]], ...]
    """Label and convex outline of each true piece of furniture."""
    outlines_m: tuple[tuple[str, tuple[tuple[float, float], ...]], ...]
    """Label and convex outline of each estimated object."""


@dataclass(frozen=True, slots=True)
class PersonEvaluation:
    """Numbers of one matched person."""

    person_id: int
    """In the estimate."""
    true_person_id: int
    distance_px: float
    """Mean distance of projected joints by which they were matched."""
    groups: tuple[Group, ...]
    curves: tuple[Curve, ...]
    plan: Plan


@dataclass(frozen=True, slots=True)
class Evaluation:
    """One scene folder against the truth of its clip."""

    name: str
    facts: Mapping[str, str]
    """Facts about the clip: kind, preset, length, persons."""
    groups: tuple[Group, ...]
    """Numbers of the whole clip; those of motion are means over the matched persons."""
    people: tuple[PersonEvaluation, ...]
    notes: tuple[str, ...]
    """Missing stages and persons without a match."""


@dataclass(frozen=True, slots=True)
class Statistic:
    """Statistics of one number over clips."""

    count: int
    """Number of clips that have the number."""
    mean: float
    median: float
    low: float
    high: float
    """95 % confidence interval of the mean (bootstrap over clips); equal to the mean for one clip."""


@dataclass(frozen=True, slots=True)
class SetRow(_OneMeasure):
    """One measure over clips, in each column of its group."""

    qualities: tuple[Quality, ...]
    """Means over clips, one per column; NaN if no clip has the value."""
    statistics: tuple[Statistic | None, ...]
    truth_mean: float | None
    """Mean of the measure of the ground truth itself, over the clips that have it."""
    values: tuple[tuple[float | None, ...], ...]
    """Values by [column][clip]."""


@dataclass(frozen=True, slots=True)
class SetGroup:
    key: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[SetRow, ...]


@dataclass(frozen=True, slots=True)
class SetEvaluation:
    """Statistics over many clips. Clips without a usable result are failures, which are not in the means."""

    clips: tuple[str, ...]
    """Names of the evaluated clips, in the order of `SetRow.values`."""
    failures: tuple[tuple[str, str], ...]
    """Clip name and reason."""
    notes: tuple[tuple[str, str], ...]
    """Clip name and what its result lacks; also results without a truth folder."""
    facts: tuple[Mapping[str, str], ...]
    """Facts about each evaluated clip."""
    groups: tuple[SetGroup, ...]

    @property
    def failure_ratio(self) -> float:
        total = len(self.clips) + len(self.failures)
        return len(self.failures) / total if total else 0.0


def finite_or_none(value: float | None) -> float | None:
    """The number, or None for NaN and infinity, which JSON does not have."""
    return None if value is None or not math.isfinite(value) else float(value)


Numbers = Mapping[str, float | str]
"""Values by row key; a text is the reason why a value is missing."""


def make_group(
    key: str,
    title: str,
    measures: Sequence[Quality],
    columns: Mapping[str, Numbers | str],
    *,
    undefined: Mapping[str, str] | None = None,
    truth: Mapping[str, float] | None = None,
    note: str = "",
    person_id: int | None = None,
) -> Group:
    """A group from the numbers of each column. A text in place of a column or a number is the reason why it is missing.

    Args:
        key: Key of the group.
        title: Heading in reports.
        measures: Key, unit and direction of every row, without a value.
        columns: Numbers by measure, by column.
        undefined: Why a number may be NaN, by measure.
        truth: Numbers of the ground truth itself, by measure.
        note: A remark for the reader.
        person_id: Person that the numbers describe, if any.

    Raises:
        KeyError: a column with numbers lacks a row.
    """
    rows = []
    for measure in measures:
        given = [column if isinstance(column, str) else column[measure.key] for column in columns.values()]
        numbers = [math.nan if isinstance(value, str) else float(value) for value in given]
        why = (undefined or {}).get(measure.key, "not defined for this clip")
        reasons = tuple(
            value if isinstance(value, str) else ("" if math.isfinite(number) else why)
            for value, number in zip(given, numbers, strict=True)
        )
        qualities = tuple(replace(measure, value=number, person_id=person_id) for number in numbers)
        rows.append(Row(qualities, finite_or_none((truth or {}).get(measure.key)), reasons))
    return Group(key, title, tuple(columns), tuple(rows), note)


def to_plain(value: Any) -> Any:
    """Dataclasses, tuples and mappings as dicts and lists that JSON can hold."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if isinstance(value, float):
        return finite_or_none(value)
    return value
