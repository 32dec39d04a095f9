"""What an evaluation is made of: rows of numbers in groups, curves, and a plan. Plain values throughout."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

Better = Literal["lower", "higher", "one", "truth", "none"]
"""Direction of a number; `one`: the nearer to 1 the better; `truth`: the nearer to the truth's own number the better;
`none`: a fact, not a grade."""

FORMAT_VERSION = 1
"""Of the JSON form."""


@dataclass(frozen=True, slots=True)
class Row:
    """One number at each column of its group. A value is None where it could not be had; `reasons` says why."""

    key: str
    """Stable name, unique in the group."""
    name: str
    unit: str
    """Symbol, or empty for a ratio or count."""
    better: Better
    values: tuple[float | None, ...]
    """One per column of the group; never NaN."""
    truth: float | None = None
    """The same number of the truth itself, where it means something (jerk, skating, frame count)."""
    reasons: tuple[str, ...] = ()
    """One per column, empty where there is a value."""


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
class SetRow:
    """One number over clips, at each column of its group; None where no clip has it."""

    key: str
    name: str
    unit: str
    better: Better
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


@dataclass(frozen=True, slots=True)
class Spec:
    """A row before it has values."""

    key: str
    name: str
    unit: str
    better: Better
    undefined: str = "not defined for this clip"
    """Why the number may be NaN."""


Numbers = Mapping[str, float | str]
"""Values by row key; a text is the reason why there is none."""


def make_group(
    key: str,
    title: str,
    specs: Sequence[Spec],
    columns: Mapping[str, Numbers | str],
    *,
    truth: Mapping[str, float] | None = None,
    note: str = "",
) -> Group:
    """Rows from the numbers of each column; a text in place of a column is the reason why it has none.

    Raises:
        KeyError: a column with numbers lacks a row.
    """
    rows = []
    for spec in specs:
        given = [column if isinstance(column, str) else column[spec.key] for column in columns.values()]
        values = tuple(None if isinstance(value, str) else plain(value) for value in given)
        reasons = tuple(
            value if isinstance(value, str) else ("" if number is not None else spec.undefined)
            for value, number in zip(given, values, strict=True)
        )
        true_value = plain((truth or {}).get(spec.key))
        rows.append(Row(spec.key, spec.name, spec.unit, spec.better, values, true_value, reasons))
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
