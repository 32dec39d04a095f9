"""Lines of stages and of what only they import.

    python tools/lines_of_stages.py metric keyframes refine

A module counts if every module of the repository's packages that imports it (anywhere in the file, tests, benchmarks
and tools left out) counts too. The prior (`scenemi.model`, its data and weights) does not.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("video2anim", "scenemi", "stages")
PRIOR = ("scenemi.model", "scenemi.data", "scenemi.training", "scenemi.evaluation")


def modules() -> dict[str, Path]:
    """Files of the packages by module name."""
    found = {}
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(path: Path, known: dict[str, Path]) -> set[str]:
    """Modules that a file names."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names & known.keys()


def own(stages: list[str]) -> dict[str, int]:
    """Lines by module."""
    known = modules()
    importers: dict[str, set[str]] = {name: set() for name in known}
    for name, path in known.items():
        for other in imported(path, known) - {name}:
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
