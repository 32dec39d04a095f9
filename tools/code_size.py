"""Measures the size of the code: lines, importers, tuned constants, import cycles.

    python tools/code_size.py

Lines on the path of `run` are those of every module that a stage imports, directly or not, anywhere in its file. A
tuned number is an assignment at module or class level whose value contains a number other than 0, 1 and 2: constants,
tables and configuration fields. Adapters of networks and `video2anim.lab` count too.
"""

from __future__ import annotations

import ast
import json
import statistics
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("video2anim", "scenemi", "stages")


@dataclass(frozen=True, slots=True)
class Package:
    """Counts of one package."""

    files: int
    lines: int
    importers: int
    """Number of modules outside the package that import it."""
    tuned_numbers: int


@dataclass(frozen=True, slots=True)
class CodeSize:
    """Counts of all packages together."""

    lines: int
    run_lines: int
    """Lines on the path of `run`."""
    run_tuned_numbers: int
    tuned_numbers: int
    stage_lines: dict[str, int]
    median_file_lines: float
    functions_over_60_lines: int
    file_circles: list[list[str]]
    package_circles: list[list[str]]
    packages: dict[str, Package]


def modules(root: Path = ROOT) -> dict[str, Path]:
    """Files of the packages by module name."""
    found = {}
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def import_graph(known: dict[str, Path]) -> dict[str, set[str]]:
    """Modules that each module imports anywhere in its file; those for type checking are left out."""
    graph = {}
    for name, path in known.items():
        targets: set[str] = set()
        for node in _statements(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                named = {f"{node.module}.{alias.name}" for alias in node.names}
                targets |= (named & known.keys()) or {node.module}
                targets |= {node.module} if any(f"{node.module}.{a.name}" not in known for a in node.names) else set()
        graph[name] = (targets & known.keys()) - {name}
    return graph


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        yield child
        yield from _statements(child)


def reached(graph: dict[str, set[str]], starts: Iterable[str]) -> set[str]:
    """The start modules and all modules that they import, directly or not."""
    found, front = set(starts), list(starts)
    while front:
        for other in graph[front.pop()] - found:
            found.add(other)
            front.append(other)
    return found


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected groups of modules: those that import each other in a cycle."""
    names = sorted(graph)
    edges = np.array([[other in graph[name] for other in names] for name in names], bool)
    count, group = connected_components(csr_matrix(edges), connection="strong")
    members = [[name for name, own in zip(names, group, strict=True) if own == number] for number in range(count)]
    return [found for found in members if len(found) > 1]


def package_of(name: str) -> str:
    """Package of a module, such as `video2anim.geometry` for `video2anim.geometry.sdf`."""
    parts = name.split(".")
    return ".".join(parts[:2]) if parts[0] != "stages" and len(parts) > 2 else parts[0]


def tuned_numbers(path: Path) -> int:
    """Assignments of numbers other than 0, 1 and 2 at module and class level."""
    found, bodies = 0, [ast.parse(path.read_text(encoding="utf-8")).body]
    while bodies:
        for node in bodies.pop():
            if isinstance(node, ast.ClassDef):
                bodies.append(node.body)
            elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                found += any(_is_tuned(part) for part in ast.walk(node.value))
    return found


def _is_tuned(node: ast.AST) -> bool:
    if not isinstance(node, ast.Constant) or isinstance(node.value, bool):
        return False
    return isinstance(node.value, int | float) and node.value not in (0, 1, 2)


def _long_functions(path: Path, most: int) -> int:
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    functions = (node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))
    return sum((node.end_lineno or node.lineno) - node.lineno + 1 > most for node in functions)


def measure(root: Path = ROOT) -> CodeSize:
    """Count the code below a checkout's root."""
    known = modules(root)
    graph = import_graph(known)
    lines = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in known.items()}
    tuned = {name: tuned_numbers(path) for name, path in known.items()}
    run = reached(graph, [name for name in known if name.startswith("stages.")])
    by_package: dict[str, list[str]] = defaultdict(list)
    between: dict[str, set[str]] = defaultdict(set)
    for name, targets in graph.items():
        by_package[package_of(name)].append(name)
        # `__init__` imports its own parts for users; that is not a dependency between packages.
        if known[name].name != "__init__.py":
            between[package_of(name)] |= {package_of(other) for other in targets} - {package_of(name)}
    packages = {
        package: Package(
            len(names), sum(lines[n] for n in names),
            sum(any(package_of(t) == package for t in targets) and package_of(name) != package
                for name, targets in graph.items()),
            sum(tuned[n] for n in names),
        )
        for package, names in sorted(by_package.items())
    }  # fmt: skip
    return CodeSize(
        sum(lines.values()),
        sum(lines[name] for name in run),
        sum(tuned[name] for name in run),
        sum(tuned.values()),
        {name.removeprefix("stages."): lines[name] for name in sorted(known) if name.startswith("stages.")},
        statistics.median(lines.values()),
        sum(_long_functions(path, 60) for path in known.values()),
        circles(graph),
        circles({package: between[package] & by_package.keys() for package in by_package}),
        packages,
    )


if __name__ == "__main__":
    sys.stdout.write(json.dumps(asdict(measure(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT)), indent=1) + "\n")
