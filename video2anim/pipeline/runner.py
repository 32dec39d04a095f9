"""Runs the stages of a scene folder that are not up to date, and nothing else."""

from __future__ import annotations

import errno
import hashlib
import json
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, Protocol

from video2anim import __version__
from video2anim.artifacts.codec import read_value, write_value
from video2anim.artifacts.folder import atomic_directory, remove_unfinished, value_digest
from video2anim.artifacts.manifest import MANIFEST_NAME, Manifest, QualityRow, read_manifest
from video2anim.errors import StageError, UsageError, Video2AnimError, is_memory_shortage
from video2anim.pipeline import memory
from video2anim.pipeline.config import PipelineConfig, result_config
from video2anim.pipeline.graph import Node
from video2anim.pipeline.scene_folder import STAGES, stage_folder
from video2anim.pipeline.stage import StageContext
from video2anim.types.clip import SourceVideo, VideoClip

State = Literal["cached", "edited", "ran", "stale", "missing"]
Edits = Literal["refuse", "keep", "discard"]
"""What happens to files edited by hand where a run would make them again."""
CURRENT: tuple[State, ...] = ("cached", "edited", "ran")
"""States of a stage that is up to date."""
DECIDING = (
    "numpy", "scipy", "torch", "opencv-contrib-python-headless", "av", "anny", "ai-edge-litert", "onnxruntime",
    "trimesh", "embreex", "kornia", "scikit-image", "fast-simplification",
)  # fmt: skip
"""Libraries whose version may change results."""


class ModelProvider(Protocol):
    """Gives stages their models, and the runner the digests that belong in cache keys."""

    def digests(self, slots: Sequence[str], config: Any) -> dict[str, str]: ...

    def licenses(self, digests: Mapping[str, str]) -> dict[str, str]: ...

    def load(self, slot: str) -> Any: ...


@dataclass(frozen=True, slots=True)
class Event:
    """Something the user may want to see."""

    kind: Literal["cached", "start", "progress", "done", "warning", "note"]
    stage: str
    done: int = 0
    total: int = 0
    text: str = ""
    manifest: Manifest | None = None


@dataclass(frozen=True, slots=True)
class StageStatus:
    """State of one stage folder."""

    name: str
    state: State
    manifest: Manifest | None
    reason: str = ""
    by_hand: bool = False
    """Whether files of the stage were edited by hand, up to date or not."""


def library_versions() -> dict[str, str]:
    """Versions that are written beside results. They are not part of cache keys: a folder made on one machine opens on
    another without being made again."""
    found = {"video2anim": __version__, "python": platform.python_version()}
    for name in DECIDING:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


class Runner:
    """One scene folder, one configuration, one graph."""

    def __init__(
        self,
        scene_dir: Path,
        nodes: Sequence[Node],
        config: PipelineConfig,
        source: SourceVideo,
        models: ModelProvider,
        *,
        device: str = "cpu",
        on_event: Callable[[Event], None] = lambda event: None,
    ) -> None:
        self._scene_dir = scene_dir
        self._nodes = tuple(nodes)
        self._config = config
        self._source = source
        self._models = models
        self._device = device
        self._on_event = on_event
        self._digests: dict[type, str] = {SourceVideo: source.digest}
        self._values: dict[type, Any] = {SourceVideo: source}

    def folder(self, node: Node) -> Path:
        """Where the stage's value lies; a folder of an earlier version, with another number, is used on."""
        numbered, found = self._scene_dir / STAGES / node.folder_name, stage_folder(self._scene_dir, node.name)
        return numbered if numbered.exists() or not found.exists() else found

    def node(self, name: str) -> Node:
        """Node of a stage.

        Raises:
            UsageError: no such stage.
        """
        for node in self._nodes:
            if node.name == name:
                return node
        raise UsageError(f"stage: want one of {', '.join(n.name for n in self._nodes)}, got {name!r}")

    def key(self, node: Node) -> str:
        """Cache key: everything that can change the result, and nothing else."""
        config = self._config.stages[node.name]
        parts = {
            "name": node.name,
            "version": node.spec.version,
            "config": result_config(config),
            "inputs": {kind.__name__: self._digests[kind] for _, kind in node.inputs},
            "weights": self._models.digests(node.spec.models, config),
            "seed": self._config.seed,
        }
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def status(self) -> list[StageStatus]:
        """State of every stage without running any; what follows a stale stage is stale too."""
        rows: list[StageStatus] = []
        made: set[type] = {SourceVideo}
        for node in self._nodes:
            if not all(kind in made for _, kind in node.inputs):
                state: State = "stale" if self.folder(node).exists() else "missing"
                rows.append(StageStatus(node.name, state, None, "an earlier stage is not up to date"))
                continue
            row = self._check(node)
            rows.append(row)
            if row.state in CURRENT:
                made.add(node.output)
        return rows

    def run(
        self,
        *,
        start: str | None = None,
        until: str | None = None,
        only: str | None = None,
        edits: Edits = "refuse",
        on_row: Callable[[StageStatus], None] = lambda row: None,
    ) -> list[StageStatus]:
        """Bring stages up to date, in order.

        Args:
            start: this stage and all after it run even if cached.
            until: the last stage to run.
            only: run just this stage again, from cached inputs.
            edits: of a stage that would run again: refuse to run, keep them as the stage's output, or discard them.
            on_row: called after each stage.

        Raises:
            UsageError: unknown stages, `start` after `until`, `only` with inputs that are not up to date, or edits in
                the way.
            Video2AnimError: what the stage raised.
        """
        self._expect_order(start, until, only)
        if edits == "refuse":
            self._expect_no_edits(start, until, only)
        remove_unfinished(self._scene_dir / STAGES)
        rows, forced = list[StageStatus](), False
        for node in self._nodes:
            forced = forced or node.name == start
            row = self._check(node)
            if node.name == only or (only is None and (forced or row.state not in CURRENT)):
                row = self._keep(node, row) if row.by_hand and edits == "keep" else self._execute(node)
            elif only is not None and row.state not in CURRENT:
                raise UsageError(
                    f"stage {only}: earlier stage '{node.name}' is {row.state}; use `video2anim run` first"
                )
            else:
                self._on_event(Event("cached", node.name, manifest=row.manifest))
            rows.append(row)
            on_row(row)
            if node.name in (until, only):
                break
        return rows

    def _expect_order(self, start: str | None, until: str | None, only: str | None) -> None:
        number = {name: self.node(name).number for name in (start, until, only) if name is not None}
        if start is not None and until is not None and number[start] > number[until]:
            raise UsageError(f"--from {start} --until {until}: want a first stage before the last one")

    def _expect_no_edits(self, start: str | None, until: str | None, only: str | None) -> None:
        """See before anything runs whether a stage that may run again was edited by hand."""
        after = self._nodes if start is None else self._nodes[self.node(start).number - 1 :]
        last = len(self._nodes) if until is None else self.node(until).number
        for node, row in zip(self._nodes, self.status(), strict=True):
            again = node.name == only if only else row.state not in CURRENT or (start is not None and node in after)
            if again and node.number <= last and self._by_hand(node):
                raise UsageError(
                    f"stage {node.name}: {self.folder(node)} was edited by hand and would be made again; --keep-edits "
                    "goes on with it as it is, --discard-edits makes it anew"
                )

    def _by_hand(self, node: Node) -> bool:
        folder = self.folder(node)
        return (folder / MANIFEST_NAME).is_file() and value_digest(folder) != read_manifest(folder).output_digest

    def _keep(self, node: Node, row: StageStatus) -> StageStatus:
        """Take the edited output as made from the present inputs."""
        assert row.manifest is not None
        inputs = {kind.__name__: self._digests[kind] for _, kind in node.inputs}
        kept = replace(row.manifest, kept_for=self.key(node), inputs=inputs)
        kept.write(self.folder(node))
        self._digests[node.output] = value_digest(self.folder(node))
        self._on_event(Event("cached", node.name, manifest=kept))
        return StageStatus(node.name, "edited", kept, "changed by hand, kept", by_hand=True)

    def value(self, kind: type) -> Any:
        """A value by type, read from its stage folder on first use."""
        if kind not in self._values:
            node = next(node for node in self._nodes if node.output is kind)
            of_clip = kind is not VideoClip and any(other.output is VideoClip for other in self._nodes)
            self._values[kind] = read_value(kind, self.folder(node), self.value(VideoClip) if of_clip else None)
        return self._values[kind]

    def _check(self, node: Node) -> StageStatus:
        folder = self.folder(node)
        if not (folder / MANIFEST_NAME).is_file():
            return StageStatus(node.name, "missing", None, "never run")
        manifest = read_manifest(folder)
        digest = value_digest(folder)
        by_hand = digest != manifest.output_digest
        if self.key(node) not in (manifest.key, manifest.kept_for):
            reason = "input, configuration or version changed"
            return StageStatus(node.name, "stale", manifest, reason, by_hand=by_hand)
        self._digests[node.output] = digest
        if by_hand:
            return StageStatus(node.name, "edited", manifest, "changed by hand", by_hand=True)
        return StageStatus(node.name, "cached", manifest)

    def _execute(self, node: Node) -> StageStatus:
        self._on_event(Event("start", node.name))
        config = self._config.stages[node.name]
        key, weights = self.key(node), self._models.digests(node.spec.models, config)
        inputs = {name: self.value(kind) for name, kind in node.inputs}
        memory.reset_peak()
        started = time.perf_counter()
        with self._described(node), atomic_directory(self.folder(node)) as work:
            ctx = StageContext(
                work, self._config.seed, self._device,
                self._models.load,
                lambda done, total: self._on_event(Event("progress", node.name, done, total)),
            )  # fmt: skip
            value = node.spec.function(**inputs, config=config, ctx=ctx)
            write_value(value, work)
            manifest = Manifest(
                node.name, node.spec.version, key, result_config(config),
                {kind.__name__: self._digests[kind] for _, kind in node.inputs}, weights,
                self._config.seed, value_digest(work), time.perf_counter() - started, memory.peak_mb(),
                [QualityRow(**asdict(quality)) for quality in ctx.qualities], ctx.warnings, library_versions(),
                self._models.licenses(weights), self._device,
            )  # fmt: skip
            manifest.write(work)
        self._digests[node.output] = manifest.output_digest
        self._values.pop(node.output, None)  # later stages see what is on disk, as after a restart
        for text in manifest.warnings:
            self._on_event(Event("warning", node.name, text=text))
        self._on_event(Event("done", node.name, manifest=manifest))
        return StageStatus(node.name, "ran", manifest)

    def _described(self, node: Node) -> _Described:
        return _Described(node.name, self._scene_dir)


class _Described:
    """Turns what a stage lets slip into one line that names the stage."""

    def __init__(self, stage: str, scene_dir: Path) -> None:
        self._stage, self._scene_dir = stage, scene_dir

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if error is None or isinstance(error, Video2AnimError) or not isinstance(error, Exception):
            return
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            raise StageError(
                f"stage '{self._stage}': no space left on the device of {self._scene_dir}; "
                "free some and run again, finished stages are kept"
            ) from error
        if is_memory_shortage(error):
            raise StageError(
                f"stage '{self._stage}': not enough memory; close other programs, raise the limit on memory, or make "
                "the picture smaller by --set ingest.max_long_side_px=N; earlier stages are kept"
            ) from error
        detail = str(error).splitlines()[0] if str(error) else "no message"
        raise StageError(
            f"stage '{self._stage}' failed: {type(error).__name__}: {detail}; earlier stages are kept, "
            "--debug shows where"
        ) from error
