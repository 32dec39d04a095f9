"""Annotations held against what comes, in tests only: shapes and kinds of arrays by jaxtyping, all else by beartype."""

from __future__ import annotations

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

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""Whole numbers are taken for fractions, as Python does."""
