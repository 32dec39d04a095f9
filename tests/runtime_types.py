"""Annotations held against what comes, in tests only: shapes and kinds of arrays by jaxtyping, all else by beartype."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

CHECKED = (
    "video2anim.types",
    "video2anim.geometry",
    "video2anim.body",
    "video2anim.objects",
    "video2anim.scene",
    "video2anim.calibration",
    "video2anim.humans",
    "video2anim.depth",
    "video2anim.background",
    "video2anim.camera",
    "video2anim.motion",
)
"""Packages under watch. Commands that tests start in processes of their own are not, nor tracking, whose tests
have models that only see what they are asked for."""

CHECKS_IN_A_TEST = 5_000
"""Of arguments or results. What a test calls more often, it has called before; the checks would take half of the time
of the slowest ones."""
_strict = beartype(conf=BeartypeConf(is_pep484_tower=True))
_done = 0


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Checks of annotations until a test has had enough of them. Whole numbers pass for fractions, as in Python."""
    strict = _strict(function)

    @functools.wraps(function)
    def counted(*args: object, **kwargs: object) -> Any:
        global _done
        _done += 1
        if _done == CHECKS_IN_A_TEST:
            jaxtyping.config.update("jaxtyping_disable", True)
        return strict(*args, **kwargs)

    return counted


def start_test() -> None:
    """Check again."""
    global _done
    _done = 0
    jaxtyping.config.update("jaxtyping_disable", False)
