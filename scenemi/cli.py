"""`scenemi`: sample, evaluate, train, data."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from video2anim.errors import UsageError, Video2AnimError

if TYPE_CHECKING:
    from scenemi.training.run import Progress

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Fill the motion between keyframes of a person in a 3D scene.",
    epilog="Exit codes: 0 fine, 2 usage or configuration, 3 bad input, 4 model missing, 5 no usable result.",
)
Weights = Annotated[str, typer.Option(help="small, a .safetensors file, or interpolation.")]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.")]
Steps = Annotated[
    int | None, typer.Option(min=1, max=1000, help="1 = the expected motion, 20 = a sample, 1000 = the paper's.")
]
Temperature = Annotated[
    float | None,
    typer.Option(min=0, max=1, help="1 = motions as varied as the data; less = nearer to the expected one."),
]
DEFAULT_INTERVAL = 15
CAPTURED = "Data set with scenes, trumans=DIR, gimo=DIR or prox=DIR, repeatable"


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    if version:
        from video2anim import __version__

        typer.echo(f"scenemi {__version__}")
        raise typer.Exit


@app.command("sample")
def sample_command(
    keyframes: Annotated[Path, typer.Option(help="Keyframes: .npz, .json, .bvh, or a motion.npz.")],
    out: Annotated[Path, typer.Option(help="Motion to write (.npz).")],
    scene: Annotated[Path | None, typer.Option(help="Room: .glb, .ply, .obj, .npz. Default: a bare floor.")] = None,
    interval: Annotated[
        int, typer.Option(min=1, help="Frames between keyframes, where the file does not say it.")
    ] = DEFAULT_INTERVAL,
    noisy: Annotated[bool, typer.Option("--noisy", help="Keyframes are inexact (1 degree, 1 cm): clean them.")] = False,
    noise: Annotated[float | None, typer.Option(help="The same with another size, degrees and cm.")] = None,
    steps: Steps = None,
    temperature: Temperature = None,
    length: Annotated[int | None, typer.Option(min=2, help="Frames of the result.")] = None,
    samples: Annotated[int, typer.Option(min=1, max=100, help="Motions to make, each with its own seed.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Of the first motion; other than 0 = a sample.")] = 0,
    weights: Weights = "small",
    device: Device = "auto",
) -> None:
    """Make a motion that goes through keyframes, in a scene."""
    from scenemi.choice import SAMPLE_STEPS, choose_prior
    from scenemi.files import expect_writable, read_keyframes, read_scene, write_motion
    from scenemi.sample_motion import sample_motion
    from scenemi.scene_field import geometry_of, notes_on

    targets = [out if i == 0 else out.with_name(f"{out.stem}_{i + 1}{out.suffix}") for i in range(samples)]
    if out.suffix != ".npz":
        raise UsageError(f"--out: want a .npz file, got {out}")
    for target in targets:
        expect_writable(target)
    given = read_keyframes(keyframes, interval=interval, length=length)
    parts = None if scene is None else read_scene(scene)
    notes = [] if parts is None else notes_on(parts, given.translation_m)
    solids = geometry_of(parts or (), given.translation_m)
    level = noise if noise is not None else 1.0 if noisy else 0.0
    prior_device = _device(device)
    if samples > 1 or seed != 0:
        steps = steps or SAMPLE_STEPS
    for number, target in enumerate(targets):
        prior = choose_prior(weights, device=prior_device, steps=steps, seed=seed + number, temperature=temperature)
        made = sample_motion(given, prior, scene=solids, length=length, noise=level)
        for note in (*notes, *made.notes):
            _note(note)
        notes = []
        write_motion(
            target, made.motion.R_parent_joint, made.motion.translation_world_m, made.is_keyframe, made.contact, given
        )
        typer.echo(str(target))


@app.command("evaluate")
def evaluate_command(
    clips: Annotated[list[Path] | None, typer.Option(help="Motion archive (.npz), repeatable.")] = None,
    scenes_from: Annotated[list[str] | None, typer.Option(help=f"{CAPTURED}; clips in their own scenes.")] = None,
    interval: Annotated[int | None, typer.Option(min=1, help="Frames between keyframes.")] = None,
    probability: Annotated[float | None, typer.Option(help="Random keyframes with this chance, instead.")] = None,
    noise: Annotated[float, typer.Option(help="Noise of the keyframes in degrees and cm.")] = 0.0,
    steps: Steps = None,
    temperature: Temperature = None,
    weights: Weights = "small",
    split: Annotated[Path | None, typer.Option(help="JSON with lists of clip names; default: all clips.")] = None,
    part: Annotated[str, typer.Option(help="Part of the split.")] = "test",
    scenes: Annotated[bool, typer.Option(help="Put a random scene around every window (fixed seed).")] = True,
    seed: Annotated[int, typer.Option(min=0, help="Of sampling.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the numbers to this file.")] = None,
    details: Annotated[Path | None, typer.Option(help="Write all numbers with intervals to this file.")] = None,
    device: Device = "auto",
) -> None:
    """Fill every 121-frame window of the clips from some of its frames, and compare with the truth."""
    from scenemi.choice import choose_prior
    from scenemi.evaluation.chosen import chosen_windows
    from scenemi.evaluation.fid import shipped_features
    from scenemi.evaluation.protocol import evaluate
    from scenemi.evaluation.windows import KeyframeProtocol
    from scenemi.files import expect_writable, write_json

    for path in (json_file, details):
        if path is not None:
            expect_writable(path)
    protocol = KeyframeProtocol(60 if interval is None and probability is None else interval, probability, noise)
    prior = choose_prior(weights, device=_device(device), steps=steps, temperature=temperature)
    windows = chosen_windows(clips or (), scenes_from or (), split, part, made_up=scenes)
    with _progress("windows") as on_window:
        found = evaluate(
            windows, prior, protocol, seed=seed, features=shipped_features() if details else None, on_window=on_window
        )
    summary = found.summary()
    for name, value in summary.items():
        typer.echo(f"{name} {value:.6g}")
    if json_file is not None:
        write_json(json_file, summary)
        typer.echo(str(json_file))
    if details is not None:
        write_json(details, found.details())
        typer.echo(str(details))


@app.command("train")
def train_command(
    out: Annotated[Path, typer.Option(help="Folder for checkpoint, logs and weights.")],
    motion: Annotated[
        list[Path] | None, typer.Option(help="Motion archive (.npz) or folder of them, repeatable.")
    ] = None,
    scenes: Annotated[list[str] | None, typer.Option(help=f"{CAPTURED}.")] = None,
    config: Annotated[Path | None, typer.Option(help="JSON of the run (default: the shipped model's).")] = None,
    split: Annotated[Path | None, typer.Option(help="JSON with lists of clip names.")] = None,
    cache: Annotated[Path | None, typer.Option(help="Folder for retargeted motion, so that it is made once.")] = None,
    minutes: Annotated[float | None, typer.Option(min=0.01, help="Stop after this time; resume later.")] = None,
    cool_steps: Annotated[
        int, typer.Option(min=0, help="Steps of falling learning rate before the weights are written; not kept.")
    ] = 0,
    errors: Annotated[
        Path | None, typer.Option(help="Errors of the video pipeline (.npz of training/pipeline_errors.py).")
    ] = None,
    start: Annotated[
        Path | None, typer.Option(help="Weights to begin from where --out has no checkpoint and they are alike.")
    ] = None,
    pack: Annotated[
        Path | None,
        typer.Option(help="Train nothing: write the run in --out, and --motion if given, to this folder to carry."),
    ] = None,
    from_pack: Annotated[Path | None, typer.Option(help="Folder of --pack in place of --motion and --start.")] = None,
    device: Device = "auto",
) -> None:
    """Train a model, or go on training it: a run has no end, it stops after --minutes or when it is interrupted."""
    from scenemi.data.split import Split
    from scenemi.training.config import TrainConfig
    from scenemi.training.packing import pack_run, unpack_run
    from scenemi.training.runs import RunFiles, clips_for, write_run_weights

    if scenes and (pack is not None or from_pack is not None):
        raise UsageError("--scenes: captured scenes cannot be packed")
    if pack is not None:
        run_config = TrainConfig() if config is None else TrainConfig.read(config)
        run = RunFiles(run_config, tuple(motion or ()), None if split is None else Split.read(split), None)
        typer.echo(f"{pack}: {pack_run(pack, run, out) / 2**20:.1f} MiB")
        return
    packed = None if from_pack is None else unpack_run(from_pack, out / "pack")
    files = None if packed is None else packed.files
    if motion and files is not None:
        raise UsageError(f"--motion: {from_pack} has the run's motion; give one of both")
    files = files or RunFiles.of(config, motion or (), split, cache, scenes or ())
    start = packed.start if packed is not None else start
    clips = clips_for(files, out)
    if clips.watched is None:
        _note("no clip is for validation (--split), so none is sampled while training")
    _note(f"{sum(one.minutes for one in clips.sets):.1f} minutes of motion, {len(clips.motions.shapes)} bodies")
    from scenemi.training.loop import cool, train
    from scenemi.training.noise import PipelineErrors

    chosen = _device(device)
    limit_s = None if minutes is None else 60 * minutes
    recorded = None if errors is None else PipelineErrors.read(errors)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as Ctrl-C does: the state is saved
    state = train(
        files.config, clips.motions, out, scenes=clips.scenes, validation=clips.watched, device=chosen, errors=recorded,
        start=start, time_limit_s=limit_s, on_progress=_say_progress,
    )  # fmt: skip
    if cool_steps:
        state = cool(out, clips.motions, cool_steps, errors=recorded, device=chosen, on_progress=_say_progress)
    typer.echo(str(write_run_weights(out / "weights.safetensors", state, *clips.sets)))


@app.command("data")
def data_command(
    files: Annotated[
        list[Path], typer.Argument(help="Motion archives, or BVH, AMC, AMASS files and folders.", metavar="FILE...")
    ],
    split: Annotated[Path | None, typer.Option(help="JSON with lists of clip names: count its parts.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write all clips to this motion archive.")] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of BVH files: m, cm, mm, inch (default: guessed).")] = None,
    mapping: Annotated[Path | None, typer.Option(help="JSON: SMPL joint to joint of BVH files.")] = None,
    kind: Annotated[str, typer.Option(help="Kind of motion where a file does not say.")] = "unknown",
) -> None:
    """Show what motion files hold; with --out, convert them to one motion archive."""
    from scenemi.data.container import read_split, write_archive
    from scenemi.data.readers import read_clips
    from scenemi.data_summary import summarize
    from scenemi.files import expect_writable, read_mapping

    if out is not None:
        expect_writable(out)
    table = None if split is None else read_split(split)
    names = None if mapping is None else read_mapping(mapping)
    everything = []
    for path in files:
        clips = read_clips(path, unit=unit, mapping=names, kind=kind)
        typer.echo(f"{path}")
        _print_table(*summarize(clips, table))
        for clip in clips[:3] if clips and clips[0].description else []:
            typer.echo(f"  {clip.name}: {clip.description}")
        everything += clips
    if out is not None:
        write_archive(out, everything)
        typer.echo(str(out))


def _device(wanted: str) -> str:
    if wanted not in ("auto", "cpu", "cuda"):
        raise UsageError(f"--device: want auto, cpu or cuda, got {wanted!r}")
    if wanted == "cpu":
        return "cpu"
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if wanted == "cuda":
        raise UsageError("--device: want cuda, but this PyTorch sees no CUDA device; use --device cpu")
    return "cpu"


def _print_table(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    widths = [max(len(row[i]) for row in (heads, *lines)) for i in range(len(heads))]
    for row in (heads, *lines):
        others = (text.rjust(width) for text, width in zip(row[1:], widths[1:], strict=True))
        typer.echo("  ".join((row[0].ljust(widths[0]), *others)))


def _say_progress(found: Progress) -> None:
    rows = "".join(
        f"; r = {row.interval}{' in scenes shown' if row.scene else ''}: error x {row.mjpe_ratio:.3f}, "
        f"jerk x {row.jerk_ratio:.2f}" + (f", inside {row.inside:.3f}" if row.inside == row.inside else "")
        for row in found.validation
    )
    speed = f", {found.windows_per_s:.0f} windows/s" if found.windows_per_s else ""
    typer.echo(
        f"step {found.step}, {found.windows} windows, {found.hours:.2f} hours: loss {found.total:.4f}{speed}{rows}",
        err=True,
    )


def _note(text: str) -> None:
    typer.echo(f"note: {text}", err=True)


@contextmanager
def _progress(what: str) -> Iterator[Callable[[int, int], None]]:
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def run() -> None:
    """Entry point: expected failures become one line and an exit code."""
    # Idle OpenMP workers otherwise spin and slow down whatever shares the machine. Read when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    debug = "--debug" in sys.argv  # wherever it stands
    try:
        app(args=[word for word in sys.argv[1:] if word != "--debug"], standalone_mode=True)
    except Video2AnimError as error:
        if debug:
            raise
        typer.echo(f"scenemi: {' '.join(str(error).split())}", err=True)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    run()
