"""Data of an evaluation: rows of `Quality` in groups, curves, and a plan of the clip from above."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from video2anim.types.quality import Better, Quality, Unit

FORMAT_VERSION = 2
"""Of the JSON form."""


class _OneMeasure:
    """What the numbers of a row have in common."""

    __slots__ = ()
    qualities: tuple[Quality, ...]

    @property
    def key(self) -> str:
        """Unique in the group."""
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
    """One measure at each column of its group."""

    qualities: tuple[Quality, ...]
    """One per column; NaN where the value is not available."""
    truth: float | None = None
    """The same measure of the ground truth, where it means something (jerk, skating, frame count)."""
    reasons: tuple[str, ...] = ()
    """Why a value is not available; one per column, empty where there is a value."""

    @property
    def values(self) -> tuple[float | None, ...]:
        """One per column; None where the value is not available."""
        return tuple(plain(quality.value) for quality in self.qualities)


@dataclass(frozen=True, slots=True)
class Group:
    """Numbers of one subject side by side, for example one column per motion stage."""

    key: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""
    """What the reader has to know: how many objects were compared, which part was not looked at."""


@dataclass(frozen=True, slots=True)
class Curve:
    """Numbers over the clip, one line per series; None where there is no number."""

    title: str
    unit: str
    time_s: tuple[float, ...]
    series: Mapping[str, tuple[float | None, ...]]


@dataclass(frozen=True, slots=True)
class Plan:
    """The clip from above in the true world (x, z in meters)."""

    paths_m: Mapping[str, tuple[tuple[float, float], ...]]
    """Pelvis of the truth and of each stage."""
    true_outlines_m: tuple[tuple[str, tuple[tuple[float, float], ...]], ...]
    """Label and convex outline of each true piece of furniture."""
    outlines_m: tuple[tuple[str, tuple[tuple[float, float], ...]], ...]
    """The same of the estimated objects."""


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
    """Of the clip: kind, preset, length, persons."""
    groups: tuple[Group, ...]
    """Over the whole clip; numbers of motion are means over the matched persons."""
    people: tuple[PersonEvaluation, ...]
    notes: tuple[str, ...]
    """Stages that are missing, persons without a match."""


@dataclass(frozen=True, slots=True)
class Statistic:
    """One number over clips."""

    count: int
    """Clips that have the number."""
    mean: float
    median: float
    low: float
    high: float
    """95 % confidence interval of the mean (bootstrap over clips); equal to the mean for one clip."""


@dataclass(frozen=True, slots=True)
class SetRow(_OneMeasure):
    """One measure over clips, at each column of its group."""

    qualities: tuple[Quality, ...]
    """Means over clips, one per column; NaN where no clip has the value."""
    statistics: tuple[Statistic | None, ...]
    truth_mean: float | None
    """Mean of the truth's own number over the clips that have it."""
    values: tuple[tuple[float | None, ...], ...]
    """[column][clip]."""


@dataclass(frozen=True, slots=True)
class SetGroup:
    key: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[SetRow, ...]


@dataclass(frozen=True, slots=True)
class SetEvaluation:
    """Many clips. Clips without a usable result are failures: counted and named, in no mean."""

    clips: tuple[str, ...]
    """Evaluated, in the order of `SetRow.values`."""
    failures: tuple[tuple[str, str], ...]
    """Clip and reason."""
    notes: tuple[tuple[str, str], ...]
    """Clip, and what is missing in it though it was evaluated; also results without a truth folder."""
    facts: tuple[Mapping[str, str], ...]
    """Of each evaluated clip."""
    groups: tuple[SetGroup, ...]

    @property
    def failure_ratio(self) -> float:
        total = len(self.clips) + len(self.failures)
        return len(self.failures) / total if total else 0.0


def plain(value: float | None) -> float | None:
    """A number as JSON can hold it: NaN and infinity become None."""
    return None if value is None or not math.isfinite(value) else float(value)


Numbers = Mapping[str, float | str]
"""Values by row key; a text is the reason why there is none."""


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
    """Rows from the numbers of each column; a text in place of a column or number is the reason why there is none.

    Args:
        key: of the group.
        title: for people.
        measures: key, unit and direction of every row, without a value.
        columns: numbers by measure, by column.
        undefined: why a number may be NaN, by measure.
        truth: numbers of the ground truth, by measure.
        note: what the reader has to know.
        person_id: whom the numbers describe.

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
        rows.append(Row(qualities, plain((truth or {}).get(measure.key)), reasons))
    return Group(key, title, tuple(columns), tuple(rows), note)


def to_plain(value: Any) -> Any:
    """Dataclasses, tuples and mappings as JSON-able dicts and lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if isinstance(value, float):
        return plain(value)
    return value
