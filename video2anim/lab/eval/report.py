"""Writes an evaluation as JSON and as one self-contained HTML page."""

from __future__ import annotations

import json
import math
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from video2anim import __version__
from video2anim.export.report import format_number
from video2anim.lab.eval import plots
from video2anim.lab.eval.model import (
    FORMAT_VERSION,
    Evaluation,
    Group,
    Row,
    SetEvaluation,
    SetGroup,
    SetRow,
    to_plain,
)
from video2anim.types.quality import Better

STAGED = ("motion", "true_scene", "true_scene_laid", "own_scene")
"""Groups whose columns are the motion stages; the last stage is compared with the first."""
HEADLINES = {
    "motion": ("mpjpe", "pa_mpjpe", "wa_mpjpe", "root_error", "acceleration_error", "jerk", "skating_gmd",
               "skating_kimodo", "contact_f1"),
    "true_scene": ("collision_frames_1cm", "penetration_max", "floating"),
    "true_scene_laid": ("collision_frames_1cm", "penetration_max", "floating"),
    "own_scene": ("collision_frames_1cm", "penetration_max", "floating"),
}  # fmt: skip
"""Rows that are plotted over clips, by group."""
PER_CLIP = (
    ("track", "main_recall", "value"), ("camera", "focal_error", "value"), ("camera", "gravity_error", "value"),
    ("motion", "mpjpe", "raw"), ("motion", "mpjpe", "refined"), ("motion", "root_error", "refined"),
    ("motion", "jerk", "refined"), ("motion", "skating_gmd", "refined"),
    ("true_scene_laid", "penetration_max", "refined"),
    ("depth", "abs_rel", "metric"), ("segment", "f1", "value"), ("objects", "chamfer", "scene"),
    ("space", "occupancy_iou", "value"),
)  # fmt: skip
"""Columns (group, row, column) of the table with one line per clip."""


def to_json(evaluation: Evaluation | SetEvaluation) -> str:
    """The whole evaluation as JSON text; missing numbers are null."""
    kind = "clip" if isinstance(evaluation, Evaluation) else "set"
    head = {"format_version": FORMAT_VERSION, "kind": kind, "video2anim": __version__}
    return json.dumps(head | to_plain(evaluation), indent=1, allow_nan=False) + "\n"


def render_html(evaluation: Evaluation | SetEvaluation) -> str:
    """The page as HTML text, with plots inside."""
    environment = Environment(
        loader=PackageLoader("video2anim.lab.eval"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["number"] = format_number
    if isinstance(evaluation, Evaluation):
        return environment.get_template("clip.html.j2").render(version=__version__, **_clip_page(evaluation))
    return environment.get_template("set.html.j2").render(version=__version__, **_set_page(evaluation))


def verdict(better: Better, first: float | None, last: float | None, truth: float | None) -> str:
    """Whether the last stage is better than the first: `better`, `worse`, `same`, or empty if undecidable."""
    if first is None or last is None or better == "none" or (better == "near_truth" and truth is None):
        return ""
    before, after = _deviation(better, first, truth), _deviation(better, last, truth)
    if math.isclose(before, after, abs_tol=1e-9):
        return "same"
    return "better" if after < before else "worse"


def _deviation(better: Better, value: float, truth: float | None) -> float:
    """Deviation of a value from the ideal; smaller is better."""
    if better == "near_1":
        return abs(math.log(max(value, 1e-9)))
    if better == "near_truth" and truth is not None:
        return abs(value - truth)
    return -value if better == "higher" else value


def better_text(better: Better) -> str:
    """The direction in words."""
    return "" if better == "none" else better.replace("_", " ")


def _clip_page(evaluation: Evaluation) -> dict[str, Any]:
    return {
        "title": evaluation.name,
        "facts": list(evaluation.facts.items()),
        "notes": evaluation.notes,
        "groups": [_group(group) for group in evaluation.groups],
        "people": [
            {
                "title": f"Person {person.true_person_id}",
                "lead": f"Person {person.person_id} of the estimate; "
                f"their joints lie {format_number(person.distance_px)} px apart in the picture.",
                "groups": [_group(group) for group in person.groups] if len(evaluation.people) > 1 else [],
                "plots": [
                    ("From above: filled true furniture, dashed estimated objects", plots.plan_plot(person.plan)),
                    *((curve.title, plots.curve_plot(curve)) for curve in person.curves),
                ],
            }
            for person in evaluation.people
        ],
    }


def _group(group: Group) -> dict[str, Any]:
    staged = group.key in STAGED
    rows = [_row(row, staged) for row in group.rows]
    return {
        "title": group.title,
        "columns": group.columns,
        "note": group.note,
        "staged": staged,
        "has_truth": any(row.truth is not None for row in group.rows),
        "rows": rows,
        "missing": missing_reasons(group),
    }


def _row(row: Row, staged: bool) -> dict[str, Any]:
    return {
        "label": row.label,
        "unit": row.unit,
        "better": better_text(row.better),
        "cells": list(zip(row.values, row.reasons, strict=True)),
        "truth": row.truth,
        "verdict": verdict(row.better, row.values[0], row.values[-1], row.truth) if staged else "",
    }


def missing_reasons(group: Group) -> list[str]:
    """Missing numbers of a group: one line per reason, for all columns that share it."""
    lacking: dict[tuple[str, str], list[str]] = {}
    for i, column in enumerate(group.columns):
        by_reason: dict[str, list[str]] = {}
        for row in group.rows:
            if row.values[i] is None:
                by_reason.setdefault(row.reasons[i], []).append(row.label)
        for reason, names in by_reason.items():
            what = "nothing" if len(names) == len(group.rows) else f"no {', '.join(names)}"
            lacking.setdefault((what, reason), []).append(column)
    return [
        f"{what}: {reason}" if columns == list(group.columns) else f"{', '.join(columns)}: {what}: {reason}"
        for (what, reason), columns in lacking.items()
    ]


def _set_page(evaluation: SetEvaluation) -> dict[str, Any]:
    groups = {group.key: group for group in evaluation.groups}
    pictures = []
    for key, names in HEADLINES.items():
        if key in groups:
            rows = [row for row in groups[key].rows if row.key in names and any(row.statistics)]
            if rows:
                pictures.append((groups[key].title, plots.stages_plot(groups[key], rows)))
    return {
        "clips": len(evaluation.clips),
        "failures": evaluation.failures,
        "failure_percent": 100 * evaluation.failure_ratio,
        "notes": evaluation.notes,
        "groups": [_set_group(group) for group in evaluation.groups],
        "pictures": pictures,
        "per_clip": _per_clip(evaluation, groups),
    }


def _set_group(group: SetGroup) -> dict[str, Any]:
    staged = group.key in STAGED
    return {
        "title": group.title,
        "columns": group.columns,
        "staged": staged,
        "has_truth": any(row.truth_mean is not None for row in group.rows),
        "rows": [_set_row(row, staged) for row in group.rows],
    }


def _set_row(row: SetRow, staged: bool) -> dict[str, Any]:
    first, last = row.statistics[0], row.statistics[-1]
    return {
        "label": row.label,
        "unit": row.unit,
        "better": better_text(row.better),
        "cells": row.statistics,
        "counts": " / ".join(dict.fromkeys(str(found.count if found else 0) for found in row.statistics)),
        "truth": row.truth_mean,
        "verdict": verdict(row.better, first and first.mean, last and last.mean, row.truth_mean) if staged else "",
    }


def _per_clip(evaluation: SetEvaluation, groups: dict[str, SetGroup]) -> dict[str, Any]:
    heads, columns = [], []
    for group_key, row_key, column in PER_CLIP:
        group = groups.get(group_key)
        row = next((row for row in group.rows if row.key == row_key), None) if group else None
        if group is None or row is None:
            continue
        heads.append(f"{row.label} ({row.unit})" + (f", {column}" if len(group.columns) > 1 else ""))
        columns.append(row.values[group.columns.index(column)])
    lines = [(name, [column[i] for column in columns]) for i, name in enumerate(evaluation.clips)]
    return {"heads": heads, "lines": lines}
