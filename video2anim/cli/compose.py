"""Puts stages, models and a scene folder together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from stages import (
    background,
    camera,
    complete,
    depth,
    export,
    humans,
    ingest,
    keyframes,
    metric,
    place,
    reconstruct,
    refine,
    scene,
    segment,
    track,
)
from video2anim.artifacts.folder import file_digest
from video2anim.errors import InputError, UsageError
from video2anim.pipeline.config import PipelineConfig, expect_user_paths, load_preset, resolve
from video2anim.pipeline.graph import Node, build_graph
from video2anim.pipeline.runner import Event, Runner, StageStatus, library_versions
from video2anim.pipeline.scene_folder import RunRecord, locked, prepare, read_record, write_record
from video2anim.pipeline.stage import NO_MODEL
from video2anim.types.clip import SourceVideo

MODULES = (
    ingest, track, camera, humans, background, depth, metric, segment,
    complete, reconstruct, place, scene, keyframes, refine, export,
)  # fmt: skip
NO_NETWORK = ("geometric", NO_MODEL)
"""Names of stages' models and providers that use no network."""


def pipeline_nodes() -> tuple[Node, ...]:
    """The checked graph of all stages, in order."""
    return build_graph([module.STAGE for module in MODULES], given=[SourceVideo])


class TableModels:
    """Models by the table of `video2anim.models`.

    A stage's config names the model of a slot as `<slot>_model`, else as `model` or `provider`.
    """

    def __init__(self, on_fetch: Callable[[str, int, int], None] | None = None) -> None:
        self._on_fetch = on_fetch
        self._loaded: dict[str, Any] = {}

    def digests(self, slots: Sequence[str], config: Any) -> dict[str, str]:
        from video2anim.models import weight_digests

        found: dict[str, str] = {}
        for slot in slots:
            name = self._name(slot, config)
            if name not in NO_NETWORK:
                found |= weight_digests(name)
        return found

    def load(self, slot: str, config: Any) -> Any:
        from video2anim.models import load_model

        if slot not in self._loaded:
            self._loaded[slot] = load_model(slot, on_progress=self._on_fetch)
        return self._loaded[slot]

    @staticmethod
    def _name(slot: str, config: Any) -> str:
        own = getattr(config, f"{slot}_model", None)
        return own or getattr(config, "model", None) or getattr(config, "provider", None) or slot


def source_video(path: Path) -> SourceVideo:
    """The input file with its digest.

    Raises:
        InputError: missing, a folder, or not readable.
    """
    if not path.exists():
        raise InputError(f"input: want a video file, found nothing at {path}")
    if path.is_dir():
        raise InputError(f"input: want a video file, got a folder at {path}")
    try:
        return SourceVideo(path.absolute(), file_digest(path))
    except OSError as error:
        raise InputError(f"input: want a readable file, got {error.strerror} at {path}") from error


def run_video(
    video: Path,
    scene_dir: Path,
    *,
    preset: str,
    overrides: Sequence[tuple[str, Mapping[str, Any]]],
    start: str | None,
    until: str | None,
    overwrite: bool,
    device: str,
    on_event: Callable[[Event], None],
) -> tuple[Runner, list[StageStatus]]:
    """`video2anim run`: bring the scene folder of a video up to date.

    Raises:
        Video2AnimError: bad input, configuration or stage.
    """
    nodes = pipeline_nodes()
    config = resolve(nodes, preset, [(f"preset {preset}", load_preset(preset)), *overrides])
    expect_user_paths(config)
    source = source_video(video)
    prepare(scene_dir)
    with locked(scene_dir):
        _expect_same_input(scene_dir, source, overwrite)
        runner = Runner(scene_dir, nodes, config, source, TableModels(), device=device, on_event=on_event)
        for name in (start, until):
            if name is not None:
                runner.node(name)
        record = RunRecord(str(source.path), source.digest, preset, config.seed, config.as_dict(), library_versions())
        write_record(scene_dir, record)
        rows = runner.run(start=start, until=until)
        finish(scene_dir, runner, record, rows)
    return runner, rows


def open_scene(
    scene_dir: Path, *, device: str = "cpu", on_event: Callable[[Event], None] = lambda event: None
) -> tuple[Runner, RunRecord]:
    """Runner of an existing scene folder with the configuration it was made with; the video need not be there.

    Raises:
        InputError: not a scene folder.
    """
    record = read_record(scene_dir)
    nodes = pipeline_nodes()
    config: PipelineConfig = resolve(nodes, record.preset, [("run.json", record.config)])
    source = SourceVideo(Path(record.input_path), record.input_digest)
    return Runner(scene_dir, nodes, config, source, TableModels(), device=device, on_event=on_event), record


def rerun_stage(scene_dir: Path, name: str, *, device: str, on_event: Callable[[Event], None]) -> list[StageStatus]:
    """`video2anim stage NAME DIR`: one stage again, from cached inputs.

    Raises:
        UsageError: no such stage, or the folder's configuration names a program: who runs one says so themselves.
    """
    runner, record = open_scene(scene_dir, device=device, on_event=on_event)
    runner.node(name)
    program = record.config.get(name, {}).get("command")
    if program:
        raise UsageError(
            f"{scene_dir}: its configuration runs a program ({program!r}); give it yourself by "
            f"`video2anim run VIDEO --out {scene_dir} --from {name} --set {name}.command=...`"
        )
    prepare(scene_dir)
    with locked(scene_dir):
        rows = runner.run(only=name)
        finish(scene_dir, runner, record, rows)
    return rows


def finish(scene_dir: Path, runner: Runner, record: RunRecord, rows: Sequence[StageStatus]) -> None:
    """Write the stage table into `run.json`; once everything is made, place the results and the report."""
    from video2anim.cli.results import place_results

    table = [
        {"stage": r.name, "state": r.state, "key": r.manifest.key, "wall_time_s": r.manifest.wall_time_s}
        for r in rows
        if r.manifest is not None
    ]
    write_record(scene_dir, replace(record, stages=table))
    if rows and rows[-1].name == MODULES[-1].STAGE.name:
        place_results(scene_dir, runner, record, rows)


def _expect_same_input(scene_dir: Path, source: SourceVideo, overwrite: bool) -> None:
    if overwrite or not (scene_dir / "run.json").exists():
        return
    before = read_record(scene_dir)
    if before.input_digest != source.digest:
        raise UsageError(
            f"--out: {scene_dir} holds the results of another video ({before.input_path}); "
            "choose another folder, or --overwrite to replace them"
        )


def preset_models(name: str) -> list[str]:
    """Models of a preset, or the one model of that name."""
    from video2anim.pipeline.config import preset_names

    if name not in preset_names():
        return [name]
    nodes = pipeline_nodes()
    config = resolve(nodes, name, [(f"preset {name}", load_preset(name))])
    wanted = []
    for node in nodes:
        for slot in node.spec.models:
            model = TableModels._name(slot, config.stages[node.name])
            if model not in NO_NETWORK:
                wanted.append(model)
    return wanted
