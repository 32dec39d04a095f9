"""What the commands of `scenemi` share: refusals, notes, tables, progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperCommand

from video2anim.errors import UsageError

if TYPE_CHECKING:
    from scenemi.training.run import Progress


class PlainCommand(TyperCommand):
    """A command whose help names no types of Python: an option has its metavar or a plain type, a flag neither."""

    def get_params(self, ctx: Any) -> Any:
        """All options and arguments."""
        params = super().get_params(ctx)
        for param in params:
            if param.metavar is not None or getattr(param, "is_flag", False):
                param.display_type_rich = lambda ctx: None  # pyright: ignore[reportAttributeAccessIssue] # typer sets it
        return params


def sampler_options(steps: int | None, temperature: float | None) -> dict[str, object]:
    """Which options of a sampler were given."""
    return {"--steps": steps, "--temperature": temperature is not None}


def refuse(options: Mapping[str, object], why: str) -> None:
    """Refuse options that cannot apply.

    Raises:
        UsageError: the first of them that was given.
    """
    for name, given in options.items():
        if given:
            raise UsageError(f"{name}: does not apply {why}")


def print_table(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    """Columns, the first one to the left."""
    widths = [max(len(row[i]) for row in (heads, *lines)) for i in range(len(heads))]
    for row in (heads, *lines):
        others = (text.rjust(width) for text, width in zip(row[1:], widths[1:], strict=True))
        typer.echo("  ".join((row[0].ljust(widths[0]), *others)))


def say_progress(found: Progress) -> None:
    """A line on a training run."""
    rows = "".join(
        f"; r = {row.interval}{' in scenes shown' if row.scene else ''}: error x {row.mjpe_ratio:.3f}, "
        f"jerk x {row.jerk_ratio:.2f}" + (f", inside {row.inside:.3f}" if row.inside == row.inside else "")
        for row in found.validation
    )
    skipped = f"; {found.skipped} steps without a finite gradient, left out" if found.skipped else ""
    speed = f", {found.windows_per_s:.0f} windows/s" if found.windows_per_s else ""
    typer.echo(
        f"step {found.step}, {found.windows} windows, {found.hours:.2f} hours: loss {found.total:.4f}"
        f"{speed}{rows}{skipped}",
        err=True,
    )


def note(text: str) -> None:
    """Something a user may not expect."""
    typer.echo(f"note: {text}", err=True)


@contextmanager
def progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar, on a terminal only."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
