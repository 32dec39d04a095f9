"""Numbers out of an evaluation."""

from __future__ import annotations

from video2anim.lab.eval.model import Evaluation, Row


def row(evaluation: Evaluation, group: str, key: str) -> Row:
    found = next(g for g in evaluation.groups if g.key == group)
    return next(r for r in found.rows if r.key == key)


def value(evaluation: Evaluation, group: str, key: str, column: int = 0) -> float:
    number = row(evaluation, group, key).values[column]
    assert number is not None, row(evaluation, group, key).reasons
    return number
