"""`scenemi`: sample, evaluate, train, data."""

from __future__ import annotations

import os
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scenemi.cli.options import Device, Method, Settings, Steps, Temperature, Weights
from scenemi.cli.parts import (
    PlainCommand,
    note,
    print_table,
    progress,
    refuse,
    sampler_options,
    say_progress,
)
from scenemi.data.plain_files import MAX_FRAMES
from scenemi.windows import KEYFRAME_INTERVALS
from video2anim.errors import InputError, UsageError, expect_values, is_output_lost, last_words
from video2anim.geometry.torch_device import device_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from scenemi.training.packing import Unpacked
    from scenemi.training.runs import RunClips, RunFiles

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Fill the motion between keyframes of a person in a 3D scene.",
    epilog="Exit codes: 0 fine, 2 usage or configuration, 3 bad input, 4 model missing, 5 no usable result.",
)
INTERPOLATION = "interpolation"
DEFAULT_PART = "test"
YOUNG_STEPS = 2000
"""Weights of fewer steps than this are worse than interpolation."""
CAPTURED = "Data set with scenes, trumans=DIR, gimo=DIR or prox=DIR, repeatable"
UNITS = "m, cm, mm, inch, cmu (of the CMU database, 0.0564 m)"


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    if version:
        from video2anim import __version__

        typer.echo(f"scenemi {__version__}")
        raise typer.Exit


@app.command("sample", cls=PlainCommand)
def sample_command(
    keyframes: Annotated[Path, typer.Option(help="Keyframes: .npz, .json, .bvh, .glb, or a motion.npz.")],
    out: Annotated[Path, typer.Option(help="Motion to write (.npz).")],
    scene: Annotated[
        Path | None, typer.Option(help="Room: .glb, .ply, .obj, .npz, or a scene folder. Default: a bare floor.")
    ] = None,
    interval: Annotated[
        int, typer.Option(min=1, max=MAX_FRAMES, help="Frames between keyframes, where the file does not say it.")
    ] = KEYFRAME_INTERVALS[0],
    noisy: Annotated[bool, typer.Option("--noisy", help="Keyframes are noisy (1 degree, 1 cm): denoise them.")] = False,
    noise: Annotated[
        float | None, typer.Option(help="In place of --noisy: noise of the keyframes, degrees and cm.")
    ] = None,
    steps: Steps = None,
    temperature: Temperature = None,
    length: Annotated[int | None, typer.Option(min=2, max=MAX_FRAMES, help="Frames of the result.")] = None,
    samples: Annotated[int, typer.Option(min=1, max=100, help="Motions to make, each with its own seed.")] = 1,
    seed: Annotated[
        int | None, typer.Option(min=0, max=2**63 - 101, help="Of the first motion; other than 0 = a sample.")
    ] = None,
    weights: Weights = "small",
    device: Device = "auto",
) -> None:
    """Make a motion that goes through keyframes, in a scene."""
    from scenemi.cli.read_request import read_request
    from scenemi.cli.sample_motion import expect_noise, sample_motion
    from scenemi.data.files import expect_writable, write_motion
    from scenemi.model.choice import SAMPLE_STEPS, load_prior_by_name

    if noisy and noise is not None:
        raise UsageError("--noisy: does not apply with --noise, which says how inexact the keyframes are")
    level = expect_noise(noise if noise is not None else 1.0 if noisy else 0.0)
    if weights == INTERPOLATION:
        given_options = {"--noisy": noisy, "--noise": bool(noise), "--seed": seed is not None}
        refuse(given_options | sampler_options(steps, temperature), f"with --weights {INTERPOLATION}")
    first_seed = seed or 0
    targets = [out if i == 0 else out.with_name(f"{out.stem}_{i + 1}{out.suffix}") for i in range(samples)]
    if out.suffix != ".npz":
        raise UsageError(f"--out: want a .npz file, got {out}")
    for target in targets:
        expect_writable(target)
    asked = read_request(keyframes, scene, interval=interval, length=length, exact=not level)
    given, notes = asked.keyframes, asked.notes
    prior_device = device_of(device)
    if weights != INTERPOLATION and (samples > 1 or first_seed != 0):
        steps = steps or SAMPLE_STEPS
    for number, target in enumerate(targets):
        prior = load_prior_by_name(
            weights, device=prior_device, steps=steps, seed=first_seed + number, temperature=temperature
        )
        made = sample_motion(given, prior, scene=asked.scene, length=length, noise=level, partial=asked.partial)
        for text in (*notes, *made.notes):
            note(text)
        notes = ()
        write_motion(
            target, made.motion.R_parent_joint, made.motion.translation_world_m, made.is_keyframe, made.contact, given
        )
        typer.echo(str(target))


@app.command("evaluate", cls=PlainCommand)
def evaluate_command(
    clips: Annotated[list[Path] | None, typer.Option(help="Motion archive (.npz), repeatable.", metavar="FILE")] = None,
    scenes_from: Annotated[
        list[str] | None, typer.Option(help=f"{CAPTURED}; clips in their own scenes.", metavar="SOURCE=DIR")
    ] = None,
    interval: Annotated[int | None, typer.Option(min=1, max=MAX_FRAMES, help="Frames between keyframes.")] = None,
    probability: Annotated[float | None, typer.Option(help="Random keyframes with this chance, instead.")] = None,
    noise: Annotated[float, typer.Option(help="Noise of the keyframes in degrees and cm.")] = 0.0,
    steps: Steps = None,
    temperature: Temperature = None,
    weights: Weights = "small",
    split: Annotated[Path | None, typer.Option(help="JSON with lists of clip names; default: all clips.")] = None,
    part: Annotated[
        str | None,
        typer.Option(help="Part of --split, or of --scenes-from: train, val or test (default).", metavar="NAME"),
    ] = None,
    scenes: Annotated[bool, typer.Option(help="Put a random scene around every window (fixed seed).")] = True,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of sampling and of noise.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the numbers to this file.")] = None,
    details: Annotated[Path | None, typer.Option(help="Write all numbers with intervals to this file.")] = None,
    device: Device = "auto",
) -> None:
    """Fill every 121-frame window of the clips from some of its frames, and compare with the truth."""
    from scenemi.data.files import expect_writable, write_json
    from scenemi.evaluation.chosen import chosen_windows
    from scenemi.evaluation.fid import shipped_features
    from scenemi.evaluation.protocol import evaluate
    from scenemi.evaluation.windows import KeyframeProtocol
    from scenemi.model.choice import load_prior_by_name
    from scenemi.postprocess.in_scene import SolvedPrior

    if weights == INTERPOLATION:
        refuse(sampler_options(steps, temperature), f"with --weights {INTERPOLATION}")
    if split is None and not scenes_from:
        refuse({"--part": part is not None}, "without --split: all clips are taken")
    for path in (json_file, details):
        if path is not None:
            expect_writable(path)
    protocol = KeyframeProtocol(
        KEYFRAME_INTERVALS[-1] if interval is None and probability is None else interval, probability, noise
    )
    prior: Any = load_prior_by_name(weights, device=device_of(device), steps=steps, temperature=temperature)
    if prior.name == "scenemi":
        prior = SolvedPrior(prior)
    windows = chosen_windows(clips or (), scenes_from or (), split, part or DEFAULT_PART, made_up=scenes)
    with progress("windows") as on_window:
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


@app.command("train", cls=PlainCommand)
def train_command(
    out: Annotated[Path, typer.Option(help="Folder for checkpoint, logs and weights.")],
    motion: Annotated[
        list[Path] | None, typer.Option(help="Motion archive (.npz) or folder of them, repeatable.", metavar="PATH")
    ] = None,
    scenes: Annotated[list[str] | None, typer.Option(help=f"{CAPTURED}.", metavar="SOURCE=DIR")] = None,
    config: Settings = None,
    method: Method = None,
    noncommercial: Annotated[
        bool, typer.Option("--noncommercial", help="Also use clips that are not known to be free for commercial use.")
    ] = False,
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
        Path | None, typer.Option(help="Weights of the same model to start from, if --out has no checkpoint.")
    ] = None,
    pack: Annotated[
        Path | None,
        typer.Option(help="Do not train: write the run of --out, and --motion, to this folder, for another machine."),
    ] = None,
    from_pack: Annotated[Path | None, typer.Option(help="Folder of --pack in place of --motion and --start.")] = None,
    device: Device = "auto",
) -> None:
    """Train a model, or continue a run; it goes on until --minutes have passed or it is interrupted."""
    from scenemi.training.packing import unpack_run
    from scenemi.training.runs import RunFiles, clips_for, left_out

    if pack is not None:
        no_use = {"--scenes": scenes, "--from-pack": from_pack, "--cache": cache, "--errors": errors, "--start": start}
        no_use |= {"--minutes": minutes is not None, "--cool-steps": cool_steps}
        refuse(no_use, "with --pack, which trains nothing")
        _pack(pack, out, motion or (), config, method, split, noncommercial=noncommercial)
        return
    packed = None if from_pack is None else unpack_run(from_pack, out / "pack")
    if packed is not None:
        of_motion = {"--motion": motion, "--config": config, "--split": split, "--cache": cache, "--method": method}
        _refuse_with_pack(packed, scenes, start, {**of_motion, "--noncommercial": noncommercial})
    files = None if packed is None else packed.files
    files = files or RunFiles.of(config, motion or (), split, cache, scenes or (), noncommercial=noncommercial)
    if method is not None:
        files = replace(files, config=files.config.of_method(method))
    start = packed.start if packed is not None and packed.start is not None else start
    _expect_places(out, start)
    for text in left_out(files):
        note(text)
    clips = clips_for(files, out)
    if clips.watched is None:
        note("no clip is for validation (--split), so none is sampled while training")
    note(f"{sum(one.minutes for one in clips.sets):.1f} minutes of motion, {len(clips.motions.shapes)} bodies")
    _train(files, clips, out, errors=errors, start=start, minutes=minutes, cool_steps=cool_steps, device=device)


@app.command("data", cls=PlainCommand)
def data_command(
    files: Annotated[
        list[Path], typer.Argument(help="Motion archives, or BVH, AMC, AMASS files and folders.", metavar="FILE...")
    ],
    split: Annotated[Path | None, typer.Option(help="JSON with lists of clip names: count its parts.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write all clips to this motion archive.")] = None,
    source: Annotated[
        str | None, typer.Option(help="Collection that BVH and AMC files are of, for --out.", metavar="NAME")
    ] = None,
    license_name: Annotated[
        str | None,
        typer.Option(
            "--license", metavar="NAME",
            help="Of --source where that is not known by name: own, an SPDX name such as CC-BY-4.0, or unknown.",
        ),
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help=f"Unit of BVH files: {UNITS} (default: guessed).", metavar="NAME")
    ] = None,
    mapping: Annotated[Path | None, typer.Option(help="JSON: SMPL joint to joint of BVH files.")] = None,
    kind: Annotated[
        str | None, typer.Option(help="Kind of motion where a file does not say (default: unknown).", metavar="NAME")
    ] = None,
) -> None:  # fmt: skip
    """Show what motion files hold; with --out, convert them to one motion archive."""
    from scenemi.cli.data_summary import summarize
    from scenemi.data.container import read_split, write_archive
    from scenemi.data.files import expect_writable
    from scenemi.data.keyframe_file import read_mapping
    from scenemi.data.readers import ReadingOptions, forms_of, read_clips

    if out is not None:
        expect_writable(out)
    table = None if split is None else read_split(split)
    forms = forms_of(files)
    if "bvh" not in forms:
        refuse({"--unit": unit, "--mapping": mapping}, "to other files than BVH")
    if not forms & {"bvh", "amc"}:
        refuse({"--source": source, "--license": license_name}, "to files that say what they are")
    elif out is not None and source is None:
        raise UsageError(
            "--out: want --source NAME (and --license, where that is not known by name) for BVH and AMC files"
        )
    if not forms & {"bvh", "amc", "amass"}:
        refuse({"--kind": kind}, "to files that say their kinds")
    if source is None:
        refuse({"--license": license_name}, "without --source")
    names = None if mapping is None else read_mapping(mapping)
    options = ReadingOptions(unit, names, kind, source, license_name)
    everything = []
    for path in files:
        clips = read_clips(path, options)
        typer.echo(f"{path}")
        print_table(*summarize(clips, table))
        for clip in clips[:3] if clips and clips[0].description else []:
            typer.echo(f"  {clip.name}: {clip.description}")
        everything += clips
    if out is not None:
        write_archive(out, everything)
        typer.echo(str(out))


def _pack(
    pack: Path,
    out: Path,
    motion: Sequence[Path],
    config: str | None,
    method: str | None,
    split: Path | None,
    *,
    noncommercial: bool,
) -> None:
    from scenemi.data.split import Split
    from scenemi.training.config import TrainConfig
    from scenemi.training.packing import pack_run
    from scenemi.training.runs import RunFiles

    named = TrainConfig() if config is None else TrainConfig.read(config)
    named = named if method is None else named.of_method(method)
    parts = None if split is None else Split.read(split)
    run = RunFiles(named, tuple(motion), parts, None, noncommercial=noncommercial)
    typer.echo(f"{pack}: {pack_run(pack, run, out) / 2**20:.1f} MiB")


def _train(
    files: RunFiles, clips: RunClips, out: Path, *,
    errors: Path | None, start: Path | None, minutes: float | None, cool_steps: int, device: str,
) -> None:  # fmt: skip
    """Train, and write the averaged weights."""
    from scenemi.training.loop import cool, train
    from scenemi.training.noise import PipelineErrors
    from scenemi.training.runs import licenses_of, write_run_weights

    chosen = device_of(device)
    limit_s = None if minutes is None else 60 * minutes
    recorded = None if errors is None else PipelineErrors.read(errors)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as Ctrl-C does: the state is saved
    state = train(
        files.config, clips.motions, out, scenes=clips.scenes, validation=clips.watched, device=chosen, errors=recorded,
        start=start, time_limit_s=limit_s, on_progress=say_progress,
    )  # fmt: skip
    if cool_steps:
        state = cool(out, clips.motions, cool_steps, errors=recorded, device=chosen, on_progress=say_progress)
    licenses = licenses_of(files, *clips.sets)
    typer.echo(str(write_run_weights(out / "weights.safetensors", state, *clips.sets, licenses=licenses)))
    _note_on_young_weights(state.step)


def _refuse_with_pack(packed: Unpacked, scenes: object, start: object, of_motion: dict[str, object]) -> None:
    """A pack with motion holds its own settings; a pack of a started run holds the weights it continues from."""
    why = "with --from-pack, which has the run's own; give one of both"
    refuse({"--scenes": scenes, "--start": start if packed.start is not None else None}, why)
    if packed.files is not None:
        refuse(of_motion, why)


def _expect_places(out: Path, start: Path | None) -> None:
    """Check before the work that the weights exist, and make the output folder."""
    if start is not None and not start.is_file():
        raise InputError(f"--start: want a file of weights, found none at {start}")
    out.mkdir(parents=True, exist_ok=True)


def _note_on_young_weights(steps: int) -> None:
    if steps < YOUNG_STEPS:
        note(
            f"weights of {steps} steps are not usable yet (the shipped ones have several thousand); run the same "
            "command again to continue"
        )


def run() -> None:
    """Entry point: expected failures become one line and an exit code."""
    # Idle OpenMP workers otherwise spin and slow down whatever shares the machine. Read when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    debug = "--debug" in sys.argv  # wherever it stands
    sys.stdout, sys.stderr = (stream or open(os.devnull, "w") for stream in (sys.stdout, sys.stderr))  # noqa: SIM115
    try:
        expect_values(sys.argv[1:])
        app(args=[word for word in sys.argv[1:] if word != "--debug"], standalone_mode=True)
    except Exception as error:
        told = last_words(error)
        if debug or told is None:
            raise
        if is_output_lost(error):
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (what is left in the buffer is lost)
        typer.echo(f"scenemi: {told[0]}", err=True)
        sys.exit(told[1])


if __name__ == "__main__":
    run()
