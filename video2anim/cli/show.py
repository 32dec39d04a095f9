"""Output of the command line: progress, tables, model states."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from video2anim.artifacts.manifest import Manifest, QualityRow
from video2anim.pipeline.runner import Event, StageStatus
from video2anim.types.quality import Quality

if TYPE_CHECKING:
    from video2anim.cli.compose import Outcome
    from video2anim.networks import ModelState
    from video2anim.types import InstanceMasks

_WIDE = 200
"""Width in columns if the output is not a terminal, so that tables in files and pipes are not cut."""
_out = Console(width=None if sys.stdout.isatty() else _WIDE)
_err = Console(stderr=True)


@contextmanager
def progress() -> Iterator[Callable[[Event], None]]:
    """Shows events of a run: a progress bar on a terminal, else one line per stage."""
    columns = (TextColumn("{task.description:<12}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(*columns, TimeRemainingColumn(), console=_err, transient=True, disable=not _err.is_terminal) as bar:
        task = bar.add_task("", total=None)

        def on_event(event: Event) -> None:
            if event.kind == "start":
                bar.reset(task, description=event.stage, total=None)
            elif event.kind == "progress":
                bar.update(task, completed=event.done, total=event.total)
            elif event.kind == "warning":
                _warn(event.stage, event.text)
            elif event.kind == "note":
                _err.print(event.text, soft_wrap=True, markup=False, highlight=False)
            elif event.kind == "cached" and event.manifest is not None:
                for text in event.manifest.warnings:
                    _warn(event.stage, text)
            elif event.kind == "done" and event.manifest is not None:
                _err.print(f"{event.stage:<12} {event.manifest.wall_time_s:7.1f} s", highlight=False)

        yield on_event


def _warn(stage: str, text: str) -> None:
    _err.print(f"[yellow]warning[/yellow] {stage}: {escape(text)}", soft_wrap=True)


def stage_table(rows: Sequence[StageStatus]) -> None:
    """Print the stages with state, time, memory, key and their first quality numbers."""
    table = Table("stage", "state", "time", "peak", "key", "quality", box=None, pad_edge=False)
    for row in rows:
        m = row.manifest
        if m is None:
            table.add_row(row.name, row.state, "-", "-", "-", escape(row.reason))
            continue
        note = ", ".join(f"{q.label} {_number(q.value)} {q.unit}" for q in map(_quality, m.qualities[:3]))
        note = f"{row.reason}; {note}" if row.reason else note
        peak = "n/a" if m.peak_memory_mb is None else f"{m.peak_memory_mb:.0f} MB"
        table.add_row(row.name, row.state, f"{m.wall_time_s:.1f} s", peak, m.key[:8], escape(note))
    _out.print(table)


def outcome(found: Outcome) -> None:
    """Print the stages and the result files."""
    stage_table(found.rows)
    for path in found.results:
        _out.print(str(path), soft_wrap=True, highlight=False, markup=False)
    if found.stale:
        names = ", ".join(path.name for path in found.stale)
        _out.print(f"of an earlier run, not made again: {names}", soft_wrap=True, highlight=False, markup=False)


def confirmed(text: str) -> bool:
    """Ask the user at the terminal; False if there is no terminal."""
    return sys.stdin.isatty() and typer.confirm(text, err=True)


def _quality(row: QualityRow) -> Quality:
    return Quality(**row)


def manifest(folder: Path, found: Manifest) -> None:
    """Print the manifest of a stage, and its files."""
    data = asdict(found)
    qualities, warnings = data.pop("qualities"), data.pop("warnings")
    for key, value in data.items():
        _out.print(f"{key}: {value}", soft_wrap=True, highlight=False, markup=False)
    for quality in map(_quality, qualities):
        hint = "" if quality.better == "none" else f" ({quality.better} is better)"
        line = f"{quality.label}: {_number(quality.value)} {quality.unit}{hint}"
        _out.print(line, soft_wrap=True, highlight=False, markup=False)
    for text in warnings:
        _out.print(f"warning: {text}", soft_wrap=True, highlight=False, markup=False)
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        _out.print(f"{path}  {path.stat().st_size} bytes", soft_wrap=True, highlight=False, markup=False)


def objects(found: InstanceMasks) -> None:
    """Print the IDs of the objects, which `reconstruct.meshes` uses, with their mask files."""
    for index, item in enumerate(found.instances):
        x0, y0, x1, y1 = item.box_px.round().astype(int)
        line = f"object {item.object_id}: {item.label}, score {item.score:.2f}, x {x0} to {x1}, y {y0} to {y1} px"
        _out.print(f"{line}, instances.{index}.mask.png", soft_wrap=True, highlight=False, markup=False)


def models_table(states: Sequence[ModelState]) -> None:
    """Print the model table with the state of the cache."""
    table = Table("slot", "model", "runtime", "size", "license", "verified", "here", "source", box=None, pad_edge=False)
    for state in states:
        e = state.entry
        size = f"{e.size_bytes / 1e6:.1f} MB" if e.size_bytes else "-"
        table.add_row(e.slot, e.name, e.runtime, size, e.license, e.verified, state.state, escape(e.source.text))
    _out.print(table)


def fail_on_damage(states: Sequence[ModelState]) -> None:
    """Raise `ModelMissingError` for the first model with a wrong digest."""
    from video2anim.networks import ensure

    for state in states:
        if state.state == "damaged":
            ensure(state.entry.name)


def pull(name: str) -> None:
    """Download a model or all models of a preset, and print their paths."""
    from video2anim.cli.compose import preset_models
    from video2anim.networks import pull as fetch

    with Progress(console=_err, disable=not _err.is_terminal) as bar:
        tasks = {}

        def on_progress(model: str, done: int, total: int) -> None:
            if model not in tasks:
                tasks[model] = bar.add_task(model, total=total or None)
            bar.update(tasks[model], completed=done, total=total or None)

        for model in preset_models(name):
            for path in fetch(model, on_progress):
                _out.print(str(path), soft_wrap=True, highlight=False)


def _number(value: float) -> str:
    return f"{value:.4g}"


@contextmanager
def counted(unit: str) -> Iterator[Callable[[Any, int], None]]:
    """Shows finished items of a set: a progress bar on a terminal, else one line per item."""
    columns = (TextColumn(unit), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(*columns, TimeRemainingColumn(), console=_err, transient=True, disable=not _err.is_terminal) as bar:
        task = bar.add_task("", total=None)

        def on_done(obj: Any, total: int) -> None:
            bar.update(task, advance=1, total=total)
            if not _err.is_terminal:
                _err.print(f"{obj.name}{' (cached)' if obj.cached else ''}", highlight=False)

        yield on_done
