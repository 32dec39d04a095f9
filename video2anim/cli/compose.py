"""Runs the stages on a scene folder: graph, models, configuration, results."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
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
from video2anim.cli.report import report_html
from video2anim.digest import file_digest
from video2anim.errors import InputError, UsageError
from video2anim.pipeline import results
from video2anim.pipeline.config import PipelineConfig, expect_user_paths, known_part, load_preset, resolve
from video2anim.pipeline.graph import Node, build_graph
from video2anim.pipeline.runner import CURRENT, Edits, Event, Runner, StageStatus, library_versions
from video2anim.pipeline.scene_folder import (
    RECORD,
    STAGES,
    RunRecord,
    StageRow,
    has_record,
    is_result_name,
    locked,
    prepare,
    read_record,
    write_record,
)
from video2anim.pipeline.stage import NO_MODEL
from video2anim.types import ExportedFiles
from video2anim.types.clip import SourceVideo

MODULES = (
    ingest, track, camera, humans, background, depth, segment, metric,
    complete, reconstruct, place, scene, keyframes, refine, export,
)  # fmt: skip
DEFAULT_PRESET = "embedded"
NO_NETWORK = ("geometric", "interpolation", NO_MODEL)
"""Names of models, providers and priors that use no network."""


def pipeline_nodes() -> tuple[Node, ...]:
    """The checked graph of all stages, in order."""
    return build_graph([module.STAGE for module in MODULES], given=[SourceVideo])


class TableModels:
    """Loads the models of slots by the table of `video2anim.networks`.

    A stage's config names the model of a slot as `<slot>_model` or `<slot>`, else as `model` or `provider`.
    """

    def __init__(self, on_fetch: Callable[[str, int, int], None] | None = None) -> None:
        self._on_fetch = on_fetch
        self._loaded: dict[str, Any] = {}

    def digests(self, slots: Sequence[str], config: Any) -> dict[str, str]:
        from video2anim.networks import weight_digests

        found: dict[str, str] = {}
        for slot in slots:
            name = self._name(slot, config)
            if name not in NO_NETWORK:
                found |= weight_digests(name)
        return found

    def licenses(self, digests: Mapping[str, str]) -> dict[str, str]:
        from video2anim.networks import weight_licenses

        return weight_licenses(digests)

    def load(self, slot: str) -> Any:
        from video2anim.networks import load_model

        if slot not in self._loaded:
            self._loaded[slot] = load_model(slot, on_progress=self._on_fetch)
        return self._loaded[slot]

    @staticmethod
    def _name(slot: str, config: Any) -> str:
        own = getattr(config, f"{slot}_model", None) or getattr(config, slot, None)
        return own or getattr(config, "model", None) or getattr(config, "provider", None) or slot


def source_video(path: Path) -> SourceVideo:
    """The input file with its sha256 digest.

    Raises:
        InputError: the path is missing, a URL, a folder, not a regular file, empty, or not readable.
    """
    from video2anim.video.container import expect_video_file

    expect_video_file(path)
    try:
        return SourceVideo(path.absolute(), file_digest(path))
    except OSError as error:
        raise InputError(f"input: want a readable file, got {error.strerror} at {path}") from error


@dataclass(frozen=True, slots=True)
class RunRequest:
    """Options of `video2anim run`."""

    scene_dir: Path
    video: Path | None = None
    """None = the video recorded in the folder."""
    preset: str | None = None
    """None = the preset recorded in the folder, else `embedded`."""
    options: Sequence[tuple[str, Mapping[str, Any]]] = ()
    """Changed options, each with the source that sets them; later ones override earlier ones."""
    start: str | None = None
    until: str | None = None
    overwrite: bool = False
    """Forget the folder's video and settings."""
    edits: Edits = "refuse"
    device: str = "cpu"


@dataclass(frozen=True, slots=True)
class Outcome:
    """State of a scene folder after a command."""

    rows: list[StageStatus]
    results: list[Path]
    """Result files made by the current stages."""
    stale: list[Path]
    """Result files of an earlier run that were not made again."""


def run_video(
    request: RunRequest,
    *,
    confirm: Callable[[str], bool] = lambda text: False,
    on_event: Callable[[Event], None] = lambda event: None,
) -> Outcome:
    """`video2anim run`: bring a scene folder up to date.

    Args:
        request: Scene folder and options.
        confirm: Called with a question before people who have motions are dropped.
        on_event: Called with events of the run.

    Raises:
        Video2AnimError: bad input or configuration, or a failed stage; existing results are kept.
    """
    scene_dir, nodes = request.scene_dir, pipeline_nodes()
    fresh = request.overwrite or not has_record(scene_dir)
    if request.video is None and fresh:
        why = "--overwrite forgets the one" if request.overwrite else "there is none remembered"
        raise UsageError(f"run: want a video, as {why} of {scene_dir}; give `video2anim run VIDEO --out DIR`")
    given = None if request.video is None else source_video(request.video)
    if fresh:
        _settled(nodes, None, request)  # refused before a folder is made
    prepare(scene_dir)
    with locked(scene_dir):
        before = read_record(scene_dir) if has_record(scene_dir) else None
        remembered = None if request.overwrite else before
        config, settings = _settled(nodes, remembered, request)
        expect_user_paths(config)
        source = _source(scene_dir, given, remembered)
        if before is not None:
            results.expect_unedited(scene_dir, before, request.edits)
        record = RunRecord(
            str(source.path), source.digest, config.preset, config.seed, config.as_dict(), library_versions(), settings,
            [] if before is None else before.stages, {} if before is None else before.results,
        )  # fmt: skip
        runner = Runner(scene_dir, nodes, config, source, TableModels(), device=request.device, on_event=on_event)
        if remembered is not None:
            _tell_changes(runner, remembered, record, on_event)
            _expect_consent(scene_dir, remembered, record, confirm)
        step = _Step(scene_dir, record)
        rows = runner.run(start=request.start, until=request.until, edits=request.edits, on_row=step)
        return finish(scene_dir, runner, step.record, rows, request.edits)


def open_scene(
    scene_dir: Path, *, device: str = "cpu", on_event: Callable[[Event], None] = lambda event: None
) -> tuple[Runner, RunRecord]:
    """Runner of an existing scene folder with its recorded configuration. The video may be missing.

    Raises:
        InputError: not a scene folder.
    """
    record = read_record(scene_dir)
    nodes = pipeline_nodes()
    known, unknown = known_part(nodes, record.config)
    if unknown:
        text = f"{scene_dir / 'run.json'}: options of another version are left out: {', '.join(unknown)}"
        on_event(Event("note", "", text=text))
    config: PipelineConfig = resolve(nodes, record.preset, [("run.json", known)])
    source = SourceVideo(Path(record.input_path), record.input_digest)
    return Runner(scene_dir, nodes, config, source, TableModels(), device=device, on_event=on_event), record


def rerun_stage(
    scene_dir: Path, name: str, *, edits: Edits = "refuse", device: str, on_event: Callable[[Event], None]
) -> Outcome:
    """`video2anim stage DIR STAGE`: run one stage again from cached inputs.

    Raises:
        UsageError: unknown stage, the stage was edited by hand, or the folder's configuration runs a program (which
            the user has to give explicitly, since a scene folder may come from somebody else).
    """
    runner, record = open_scene(scene_dir, device=device, on_event=on_event)
    runner.node(name)
    program = record.config.get(name, {}).get("command")
    if program:
        raise UsageError(
            f"{scene_dir}: its configuration runs a program ({program!r}); give it yourself by "
            f"`video2anim run --out {scene_dir} --from {name} --set {name}.command=...`"
        )
    prepare(scene_dir)
    with locked(scene_dir):
        if name == MODULES[-1].STAGE.name:
            results.expect_unedited(scene_dir, record, edits)
        step = _Step(scene_dir, record)
        rows = runner.run(only=name, edits=edits, on_row=step)
        return finish(scene_dir, runner, step.record, rows, edits)


def finish(
    scene_dir: Path, runner: Runner, record: RunRecord, rows: Sequence[StageStatus], edits: Edits = "refuse"
) -> Outcome:
    """Write `run.json`; if all stages are up to date, place the results at the top of the folder."""
    rows = list(rows)
    if rows[-1].name == MODULES[-1].STAGE.name:
        folder, exported = runner.folder(runner.node(rows[-1].name)), runner.value(ExportedFiles)
        files = {item.path.relative_to(folder).as_posix(): item.path for item in exported.files}
        shown = {name: path for name, path in files.items() if not path.name.startswith(("overlay_", "worst_"))}
        report = partial(report_html, runner, record, rows, exported)
        new = any(row.state == "ran" for row in rows)
        placed = results.publish_results(scene_dir, shown, report, record, edits, new_report=new)
        record = replace(record, results=placed, contacts=list(runner.value(ExportedFiles).contacts))
    if not has_record(scene_dir) or read_record(scene_dir) != record:
        write_record(scene_dir, record)
    return scene_outcome(scene_dir, runner, record, rows)


def scene_outcome(scene_dir: Path, runner: Runner, record: RunRecord, rows: list[StageStatus]) -> Outcome:
    """The files at the top of a folder, split into those of the current stages and older ones."""
    files = [scene_dir / name for name in record.results if (scene_dir / name).is_file()]
    current = rows if rows[-1].name == MODULES[-1].STAGE.name else runner.status()
    return Outcome(rows, files, []) if current[-1].state in CURRENT else Outcome(rows, [], files)


class _Step:
    """Updates `run.json` after each stage that ran, so that it always matches the folder. A command that fails earlier
    does not change it."""

    def __init__(self, scene_dir: Path, record: RunRecord) -> None:
        self._scene_dir, self.record = scene_dir, record
        self._rows: dict[str, StageRow] = {}

    def __call__(self, row: StageStatus) -> None:
        if row.manifest is None:
            return
        self._rows[row.name] = StageRow(row.name, row.state, row.manifest.key, row.manifest.wall_time_s)
        place = {module.STAGE.name: number for number, module in enumerate(MODULES)}
        # Stages that only another version has come last.
        rows = sorted(self.record.with_rows(self._rows), key=lambda one: place.get(one.stage, len(place)))
        self.record = replace(self.record, stages=rows)
        if row.state == "ran":
            write_record(self._scene_dir, self.record)


def _settled(
    nodes: Sequence[Node], remembered: RunRecord | None, request: RunRequest
) -> tuple[PipelineConfig, dict[str, Any]]:
    """The configuration of a run, and the settings given by the user, now or in earlier runs."""
    settings: dict[str, Any] = {} if remembered is None else dict(remembered.settings)
    for _, options in request.options:
        for key, value in options.items():
            both = isinstance(value, Mapping) and isinstance(settings.get(key), Mapping)
            settings[key] = {**settings[key], **value} if both else value
    preset = request.preset or (DEFAULT_PRESET if remembered is None else remembered.preset)
    base = [(f"preset {preset}", load_preset(preset))]
    if remembered is not None:
        base.append(("run.json", known_part(nodes, remembered.settings)[0]))
    return resolve(nodes, preset, [*base, *request.options]), settings


def _source(scene_dir: Path, given: SourceVideo | None, remembered: RunRecord | None) -> SourceVideo:
    """The video of a run.

    Raises:
        UsageError: the folder holds another video's results, or the video is a file that a run writes.
    """
    if given is None:
        assert remembered is not None
        return SourceVideo(Path(remembered.input_path), remembered.input_digest)
    inside = given.path.resolve()
    if inside.is_relative_to(scene_dir.resolve()):
        name = inside.relative_to(scene_dir.resolve())
        if name.parts[0] in (STAGES, RECORD) or is_result_name(name.as_posix()):
            raise UsageError(f"{given.path}: a run writes this file of {scene_dir}; move the video out of the folder")
    if remembered is not None and remembered.input_digest != given.digest:
        raise UsageError(
            f"--out: {scene_dir} holds the results of another video ({remembered.input_path}); "
            "choose another folder, or --overwrite to replace them"
        )
    return given


def _tell_changes(runner: Runner, before: RunRecord, now: RunRecord, on_event: Callable[[Event], None]) -> None:
    """Report settings that differ from those of the folder, and the stages that run again for them."""
    changed = []
    for stage, options in now.config.items():
        old = before.config.get(stage)
        if not isinstance(options, Mapping) or not isinstance(old, Mapping):
            changed += [f"{stage} {old} -> {options}"] if old != options else []
            continue
        changed += [f"{stage}.{k} {old.get(k)} -> {v}" for k, v in options.items() if old.get(k) != plain(v)]
        changed += [f"{stage}.{k} {old[k]}, which this version has not" for k in old.keys() - options.keys()]
    if changed:
        again = ", ".join(row.name for row in runner.status() if row.state == "stale")
        told = f"; to run again: {again}" if again else ""
        on_event(Event("note", "", text=f"changed: {'; '.join(changed)}{told}"))


def _expect_consent(scene_dir: Path, before: RunRecord, now: RunRecord, confirm: Callable[[str], bool]) -> None:
    """Ask before people who have motions are dropped.

    Raises:
        UsageError: the user declined.
    """
    old, new = (record.config.get("track", {}).get("person") for record in (before, now))
    if old == new or new == "all" or not before.results:
        return
    people = f"the people now in {scene_dir} (person {old})"
    if not confirm(f"--person {new} drops {people}; go on?"):
        raise UsageError(f"--person {new} would drop {people}; give --yes too, or another folder")


def plain(value: Any) -> Any:
    """The value after a round trip through JSON."""
    return json.loads(json.dumps(value))


def preset_models(name: str) -> list[str]:
    """Names of the models of a preset, or the model of that name."""
    from video2anim.networks import find_model
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
                wanted.append(find_model(model).name)
    return wanted
