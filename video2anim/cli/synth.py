"""`video2anim synth`: synthetic clips, images and motions with ground truth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from video2anim.errors import UsageError

_DO_NOT_APPLY = {
    "--motion-only": ("preset", "workers", "size", "motion", "noncommercial", "meshes", "room_size", "longest"),
    "--frames-only": ("preset", "longest"),
}
"""Options that have no effect with each mode."""


def synth_command(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="Folder to create or complete (a file with --motion-only).")],
    preset: Annotated[
        str, typer.Option(help="bench (V2A-Bench, 24 clips), hidden, carried, moving (6) or random.")
    ] = "bench",
    count: Annotated[int | None, typer.Option(help="Number of clips or images (default: all of the preset).")] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same bytes; bench with seed 0 is V2A-Bench.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes.")] = 1,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT in pixels.")] = "640x480",
    motion: Annotated[
        list[Path] | None, typer.Option(help="Archive of captured motion or folder of archives, repeatable.")
    ] = None,
    noncommercial: Annotated[bool, typer.Option(help="Use sources under non-commercial licenses too.")] = False,
    meshes: Annotated[Path | None, typer.Option(help="Folder of GLB, OBJ or PLY meshes to add to rooms.")] = None,
    room_size: Annotated[str | None, typer.Option(help="Size of the room: WIDTHxDEPTH in meters.")] = None,
    longest: Annotated[float | None, typer.Option(help="Cut clips to this many seconds.")] = None,
    frames_only: Annotated[bool, typer.Option(help="Single labeled images in shards, instead of clips.")] = False,
    motion_only: Annotated[bool, typer.Option(help="Procedural motions only, as one motion archive.")] = False,
) -> None:
    """Make synthetic clips of people in furnished rooms with exact ground truth."""
    from video2anim.cli import show
    from video2anim.lab.synth.generate import SynthConfig, generate

    if frames_only and motion_only:
        raise UsageError("--frames-only and --motion-only exclude each other; give one")
    for mode, wanted in (("--motion-only", motion_only), ("--frames-only", frames_only)):
        if wanted:
            _expect_applicable(context, mode)
    if noncommercial and not motion:
        raise UsageError("--noncommercial: selects clips of --motion; give --motion too, or leave it out")
    if workers < 1:
        raise UsageError(f"--workers: want 1 or more, got {workers}")
    width_px, height_px = (int(x) for x in _pair(size, "--size", "640x480", 64, 4096, whole=True))
    room_m = _pair(room_size, "--room-size", "5x4", 0.5, 100.0) if room_size is not None else None
    if longest is not None and not 0 < longest < math.inf:
        raise UsageError(f"--longest: want more than 0 seconds, got {longest:g}")
    config = SynthConfig(
        preset, count, seed, width_px, height_px, tuple(motion or ()), noncommercial, meshes, room_m, longest_s=longest
    )
    if motion_only:
        from video2anim.lab.synth.motions import write_procedural

        written = write_procedural(out, count=24 if count is None else count, seed=seed)
        typer.echo(f"{out}: {written} motions")
        return
    with show.counted("clips" if not frames_only else "shards") as on_done:
        if frames_only:
            from video2anim.lab.synth.frames import generate_frames

            generate_frames(config, out, workers=workers, on_done=on_done)
        else:
            generate(config, out, workers=workers, on_done=on_done)
    typer.echo(str(out))


def _expect_applicable(context: typer.Context, mode: str) -> None:
    given = [
        f"--{name.replace('_', '-')}"
        for name in _DO_NOT_APPLY[mode]
        if (source := context.get_parameter_source(name)) is not None and source.name == "COMMANDLINE"
    ]
    if given:
        raise UsageError(f"{', '.join(given)}: cannot apply with {mode}; leave them out")


def _pair(text: str, option: str, example: str, low: float, high: float, *, whole: bool = False) -> tuple[float, float]:
    try:
        a, b = (float(x) for x in text.lower().split("x"))
    except ValueError:
        raise UsageError(f"{option}: want two numbers such as {example}, got {text!r}") from None
    if not (low <= a <= high and low <= b <= high):
        raise UsageError(f"{option}: want numbers from {low:g} to {high:g}, got {text!r}")
    if whole and (a % 1 or b % 1):
        raise UsageError(f"{option}: want whole numbers such as {example}, got {text!r}")
    return a, b
