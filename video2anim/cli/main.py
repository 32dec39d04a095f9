"""The commands of `video2anim`, their options and exit codes."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from video2anim import __version__
from video2anim.cli.evaluate import eval_command, eval_set_command
from video2anim.cli.pictures import models_run
from video2anim.cli.synth import synth_command
from video2anim.errors import expect_values, is_output_lost, last_words
from video2anim.geometry.torch_device import device_of

if TYPE_CHECKING:
    from video2anim.pipeline.runner import Edits

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Turn a video of a person among objects into a metric 3D scene with a skinned, animated human.",
    epilog="Exit codes: 0 success, 2 usage or configuration, 3 bad input, 4 model missing, 5 stage failed.",
)
models_app = typer.Typer(no_args_is_help=True, help="List, download and verify models.")
app.add_typer(models_app, name="models")

SceneDir = Annotated[Path, typer.Argument(help="Scene folder made by `run`.", metavar="DIR")]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.")]
KeepEdits = Annotated[
    bool, typer.Option("--keep-edits", help="Keep stages edited by hand instead of running them again.")
]
Body = Annotated[
    str | None,
    typer.Option(
        metavar="MODEL",
        help="Put people on an SMPL body from your own file: smpl, smplh or smplx, or with -male or -female.",
    ),
]
SmplDir = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Folder of your SMPL files (default: VIDEO2ANIM_SMPL_DIR); see docs/exports.md."),
]
DiscardEdits = Annotated[bool, typer.Option("--discard-edits", help="Run stages edited by hand again; edits are lost.")]


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    if version:
        typer.echo(f"video2anim {__version__}")
        raise typer.Exit


@app.command("run")
def run_command(
    *,
    out: Annotated[Path, typer.Option(help="Scene folder to make or bring up to date.", metavar="DIR")],
    video: Annotated[
        Path | None, typer.Argument(help="Input video; not needed if the folder has one.", metavar="VIDEO")
    ] = None,
    preset: Annotated[
        str | None, typer.Option(help="Shipped preset, or a YAML file; default: the folder's, else embedded.")
    ] = None,
    sets: Annotated[
        list[str] | None, typer.Option("--set", help="STAGE.OPTION=VALUE, repeatable.", metavar="STAGE.OPTION=VALUE")
    ] = None,
    start: Annotated[str | None, typer.Option("--from", help="Run this stage and all after it again.")] = None,
    until: Annotated[str | None, typer.Option(help="Stop after this stage.")] = None,
    person: Annotated[str | None, typer.Option(help="largest, all, or an ID of the track stage.")] = None,
    focal_px: Annotated[float | None, typer.Option(help="Known focal length in pixels of the upright video.")] = None,
    heights: Annotated[
        list[str] | None,
        typer.Option(
            "--height-m",
            help="Known standing height: 1.70 of the main person, or 2=1.12 by ID, repeatable.",
            metavar="[ID=]M",
        ),
    ] = None,
    device: Device = "auto",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the folder's video and settings.")] = False,
    keep_edits: KeepEdits = False,
    discard_edits: DiscardEdits = False,
    yes: Annotated[bool, typer.Option("--yes", help="Drop people who have motions without asking.")] = False,
) -> None:
    """Run the pipeline on a video; stages that are up to date do not run again.

    The folder records its video and settings; an option changes only its own setting.
    """
    from video2anim.cli import compose, show
    from video2anim.humans.body_height import parse_heights
    from video2anim.pipeline.config import parse_set

    shortcuts: dict[str, dict[str, Any]] = {}
    if person is not None:
        shortcuts["track"] = {"person": person}
    if focal_px is not None:
        shortcuts["camera"] = {"focal_px": focal_px}
    if heights:
        shortcuts["humans"] = {"height_m": parse_heights(heights)}
    request = compose.RunRequest(
        out, video, preset, [("--set", parse_set(sets or [])), ("option", shortcuts)], start, until, overwrite,
        _edits(keep_edits, discard_edits), device_of(device),
    )  # fmt: skip
    with show.progress() as on_event:
        outcome = compose.run_video(request, confirm=lambda text: yes or show.confirmed(text), on_event=on_event)
    show.outcome(outcome)


@app.command("stage")
def stage_command(
    scene_dir: SceneDir,
    name: Annotated[str, typer.Argument(help="Stage to run again.", metavar="STAGE")],
    keep_edits: KeepEdits = False,
    discard_edits: DiscardEdits = False,
    device: Device = "auto",
) -> None:
    """Run one stage again from cached inputs."""
    from video2anim.cli import compose, show

    edits = _edits(keep_edits, discard_edits)
    with show.progress() as on_event:
        outcome = compose.rerun_stage(scene_dir, name, edits=edits, device=device_of(device), on_event=on_event)
    show.outcome(outcome)


@app.command("status")
def status_command(scene_dir: SceneDir) -> None:
    """Show which stages are up to date, edited by hand, or stale."""
    from video2anim.cli import compose, show

    with show.progress() as on_event:
        runner, record = compose.open_scene(scene_dir, on_event=on_event)
    show.outcome(compose.scene_outcome(scene_dir, runner, record, runner.status()))


@app.command("show")
def show_command(scene_dir: SceneDir, stage: Annotated[str, typer.Argument(help="Stage.", metavar="STAGE")]) -> None:
    """Show the manifest of a stage: inputs, configuration, weights, quality."""
    from video2anim.artifacts.manifest import read_manifest
    from video2anim.cli import compose, show
    from video2anim.errors import InputError
    from video2anim.types import InstanceMasks

    runner, _ = compose.open_scene(scene_dir)
    folder = runner.folder(runner.node(stage))
    if not folder.is_dir():
        raise InputError(f"stage {stage}: not run yet in {scene_dir}; run `video2anim run VIDEO --out {scene_dir}`")
    show.manifest(folder, read_manifest(folder))
    if stage == "segment":
        show.objects(runner.value(InstanceMasks))


@app.command("export")
def export_command(
    scene_dir: SceneDir,
    format_name: Annotated[str, typer.Option("--format", help="glb, usd, bvh, amass, fbx or fbx-ready.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder, or a file such as my.bvh (default: in the scene folder).")
    ] = None,
    body: Body = None,
    smpl_dir: SmplDir = None,
) -> None:
    """Export the result to another format; FBX needs Blender (docs/exports.md)."""
    from video2anim.cli import results

    results.use_smpl_files(smpl_dir)
    for path in results.export_format(scene_dir, format_name, out, body):
        typer.echo(str(path))


@app.command("view")
def view_command(
    scene_dir: SceneDir,
    screenshot: Annotated[Path | None, typer.Option(help="Render one frame to this PNG, without a window.")] = None,
    frame: Annotated[int, typer.Option(help="Frame to start with or to render.")] = 0,
    motion: Annotated[str, typer.Option(help="raw, keyframes or refined.")] = "refined",
    body: Body = None,
    smpl_dir: SmplDir = None,
) -> None:
    """View the scene in a window: playback, raw / keyframes / refined motion, camera, objects."""
    from video2anim.cli import results

    results.use_smpl_files(smpl_dir)
    results.view(scene_dir, frame=frame, motion=motion, screenshot=screenshot, body=body)


@app.command("demo")
def demo_command(
    out: Annotated[Path, typer.Option(help="Scene folder.")] = Path("demo_out"),
    device: Device = "auto",
) -> None:
    """Download a small real clip (BSD-3, from the Sports2D wheel) and run the whole pipeline on it."""
    from video2anim.cli import results

    clip = results.demo_clip(lambda text: typer.echo(text, err=True))
    run_command(video=clip, out=out, person="all", device=device, yes=True)


app.command("synth")(synth_command)
app.command("eval")(eval_command)
app.command("eval-set")(eval_set_command)


@models_app.command("list")
def models_list() -> None:
    """List all models with slot, runtime, size, license, and whether the weights are installed."""
    from video2anim.cli import show
    from video2anim.networks import verify

    show.models_table(verify())


@models_app.command("pull")
def models_pull(
    name: Annotated[str, typer.Argument(help="Model, or preset: embedded, standard.")] = "embedded",
) -> None:
    """Download a model, or all models of a preset, and verify their digests."""
    from video2anim.cli import show

    show.pull(name)


@models_app.command("verify")
def models_verify() -> None:
    """Verify the digest of every installed model."""
    from video2anim.cli import show
    from video2anim.networks import verify

    states = verify()
    show.models_table(states)
    show.fail_on_damage(states)


models_app.command("run")(models_run)


def _edits(keep: bool, discard: bool) -> Edits:
    from video2anim.errors import UsageError

    if keep and discard:
        raise UsageError("--keep-edits --discard-edits: want one of them, got both")
    return "keep" if keep else "discard" if discard else "refuse"


def run() -> None:
    """Entry point: expected errors become one line and an exit code."""
    # Idle OpenMP workers would otherwise spin and slow down other processes. Read when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    debug = "--debug" in sys.argv  # at any position
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
        typer.echo(f"video2anim: {told[0]}", err=True)
        sys.exit(told[1])


if __name__ == "__main__":
    run()
