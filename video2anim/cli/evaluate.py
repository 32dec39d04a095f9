"""`video2anim eval` and `video2anim eval-set`: results against the truth of synthetic clips."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from video2anim.errors import InputError, UsageError, printable

if TYPE_CHECKING:
    from video2anim.lab.eval.model import Evaluation, Group, SetEvaluation, SetGroup

_WIDE = 200
"""Width in columns if the output is not a terminal, so that tables in files and pipes are not cut."""
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write everything to this JSON file.", metavar="FILE")]
HtmlFile = Annotated[
    Path | None, typer.Option("--html", help="Write a self-contained page with plots to this file.", metavar="FILE")
]


def eval_command(
    scene_dir: Annotated[Path, typer.Argument(help="Scene folder made by `run`.", metavar="DIR")],
    truth: Annotated[Path, typer.Option(help="Truth folder of the clip, made by `synth`.")],
    json_file: JsonFile = None,
    html_file: HtmlFile = None,
) -> None:
    """Compare a scene folder with the truth of its clip; stages that have not run or are stale give no numbers."""
    from video2anim.lab.eval.evaluate import evaluate
    from video2anim.lab.eval.report import render_html, to_json

    _expect_writable(json_file, html_file)
    evaluation = evaluate(scene_dir, truth)
    _show_clip(evaluation)
    _write(json_file, "--json", lambda: to_json(evaluation))
    _write(html_file, "--html", lambda: render_html(evaluation))


def eval_set_command(
    results_dir: Annotated[Path, typer.Argument(help="Folder of scene folders, one per clip.", metavar="RESULTS_DIR")],
    truth: Annotated[Path, typer.Option(help="Folder of truth folders of the same names.")],
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    json_file: JsonFile = None,
    html_file: HtmlFile = None,
) -> None:
    """Compare many scene folders with their truths; clips without a usable result are counted as failures."""
    from video2anim.lab.eval.aggregate import evaluate_set, paired_folders
    from video2anim.lab.eval.report import render_html, to_json

    _expect_writable(json_file, html_file)
    pairs, strangers = paired_folders(results_dir, truth)
    with _progress() as on_clip:
        evaluation = evaluate_set(pairs, workers=workers, on_clip=on_clip)
    _show_set(evaluation)
    for name in strangers:
        _say(f"left out: {results_dir / name} has no truth folder of that name in {truth}")
    _write(json_file, "--json", lambda: to_json(evaluation))
    _write(html_file, "--html", lambda: render_html(evaluation))
    if not evaluation.clips:
        name, reason = evaluation.failures[0]
        raise InputError(f"eval-set: no clip of {truth} could be evaluated; the first, {name}: {reason}")


def _show_clip(evaluation: Evaluation) -> None:
    from video2anim.lab.eval.report import missing_reasons

    _say(", ".join(f"{name} {text}" for name, text in evaluation.facts.items()))
    for group in evaluation.groups:
        _say("")
        _say(group.title + (f" ({group.note.rstrip('.')})" if group.note else ""))
        _print_table(*_clip_table(group))
        for line in missing_reasons(group):
            _say(f"n/a - {line}")
    for note in evaluation.notes:
        _say(f"note: {note}")


def _clip_table(group: Group) -> tuple[list[str], list[list[str]]]:
    from video2anim.export.report import format_number
    from video2anim.lab.eval.report import better_text

    has_truth = any(row.truth is not None for row in group.rows)
    heads = ["number", *group.columns, *(["truth"] if has_truth else []), "unit", "good is"]
    lines = []
    for row in group.rows:
        true = [format_number(row.truth) if row.truth is not None else ""] if has_truth else []
        values = [format_number(value) for value in row.values]
        lines.append([row.label, *values, *true, row.unit, better_text(row.better)])
    return heads, lines


def _show_set(evaluation: SetEvaluation) -> None:
    total = len(evaluation.clips) + len(evaluation.failures)
    _say(f"{len(evaluation.clips)} of {total} clips evaluated, {len(evaluation.failures)} failed")
    for name, reason in evaluation.failures:
        _say(f"failed: {name}: {reason}")
    for group in evaluation.groups:
        _say("")
        _say(f"{group.title}: mean [95 % interval] median")
        _print_table(*_set_table(group))
    for name, note in evaluation.notes:
        _say(f"note: {name}: {note}")


def _set_table(group: SetGroup) -> tuple[list[str], list[list[str]]]:
    from video2anim.export.report import format_number
    from video2anim.lab.eval.report import better_text

    has_truth = any(row.truth_mean is not None for row in group.rows)
    heads = ["number", *group.columns, "clips", *(["truth"] if has_truth else []), "unit", "good is"]
    lines = []
    for row in group.rows:
        cells = []
        for found in row.statistics:
            if found is None:
                cells.append("n/a")
                continue
            mean, low, high, median = map(format_number, (found.mean, found.low, found.high, found.median))
            cells.append(f"{mean} [{low}, {high}] {median}")
        counts = "/".join(dict.fromkeys(str(found.count if found else 0) for found in row.statistics))
        true = [format_number(row.truth_mean) if row.truth_mean is not None else ""] if has_truth else []
        lines.append([row.label, *cells, counts, *true, row.unit, better_text(row.better)])
    return heads, lines


def _print_table(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for i, head in enumerate(heads):
        words = i == 0 or head in ("unit", "good is")
        table.add_column(head, justify="left" if words else "right", overflow="fold")
    for line in lines:
        table.add_row(*(escape(text) for text in line))
    console = Console()
    (console if console.is_terminal else Console(width=_WIDE)).print(table, highlight=False)


@contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("clips", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _say(text: str) -> None:
    typer.echo(printable(text))


def _expect_writable(*paths: Path | None) -> None:
    """Check before the work that the output files can be written after it.

    Raises:
        UsageError: the same file is given twice.
        InputError: the folder is missing or not writable, or the path is a folder, link, pipe or device.
    """
    given = [path.absolute() for path in paths if path is not None]
    if len(given) != len(set(given)):
        raise UsageError(f"--json, --html: want two files, got {given[0]} for both")
    for path in given:
        try:
            with tempfile.TemporaryFile(dir=path.parent):
                usable = not path.is_symlink() and (path.is_file() or not path.exists())
        except OSError:
            usable = False
        if not usable:
            raise InputError(f"output: want a file in an existing folder that can be written, got {path}")


def _write(path: Path | None, option: str, text: Callable[[], str]) -> None:
    from video2anim.pipeline.results import into_place

    if path is not None:
        into_place(path, lambda aside: Path(aside).write_text(text(), encoding="utf-8"), option)
        _say(str(path))
