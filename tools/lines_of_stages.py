"""Counts the lines of stages and of the modules that only they import.

    python tools/lines_of_stages.py metric keyframes refine

A module counts if every module that imports it (anywhere in the file) counts too; tests, benchmarks and tools are
ignored. The prior (`scenemi.model`, its data and weights) does not count.
"""

from __future__ import annotations

import sys

from code_size import import_graph, modules

PRIOR = ("scenemi.model", "scenemi.data", "scenemi.training", "scenemi.evaluation")


def own(stages: list[str]) -> dict[str, int]:
    """Lines by module."""
    known = modules()
    importers: dict[str, set[str]] = {name: set() for name in known}
    for name, targets in import_graph(known).items():
        for other in targets:
            importers[other].add(name)
    counted = {f"stages.{stage}" for stage in stages}
    composed = {"video2anim.cli.compose"}
    while True:
        more = {
            name for name, by in importers.items()
            if name not in counted and not name.startswith(PRIOR) and by - composed and by - composed <= counted
        }  # fmt: skip
        if not more:
            return {name: len(known[name].read_text(encoding="utf-8").splitlines()) for name in sorted(counted)}
        counted |= more


if __name__ == "__main__":
    lines = own(sys.argv[1:])
    sys.stdout.write("".join(f"{count:5d} {name}\n" for name, count in lines.items()) + f"{sum(lines.values()):5d}\n")
