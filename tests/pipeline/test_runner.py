"""Graph, configuration, keys and the runner, with small stages of their own."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from video2anim.artifacts.codec import read_value
from video2anim.artifacts.manifest import read_manifest
from video2anim.errors import ArtifactError, InputError, StageError, UsageError
from video2anim.pipeline.config import known_part, load_preset, parse_set, resolve
from video2anim.pipeline.graph import GraphError, Node, build_graph
from video2anim.pipeline.runner import Edits, Event, Runner, StageStatus
from video2anim.pipeline.scene_folder import (
    RunRecord,
    StageRow,
    locked,
    prepare,
    read_record,
    stage_folder,
    write_record,
)
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import Contact, SourceVideo


@dataclass(frozen=True)
class Seeds:
    values: np.ndarray


@dataclass(frozen=True)
class Doubled:
    values: np.ndarray


@dataclass(frozen=True)
class Total:
    value: float


@dataclass(frozen=True)
class Loud:
    value: float


@dataclass(frozen=True)
class SeedsConfig:
    count: int = 3
    noise: float = 0.0
    name: str = "x"


@dataclass(frozen=True)
class PlainConfig:
    factor: float = 2.0
    fail: str = ""


calls: list[str] = []


def make_seeds(source: SourceVideo, config: SeedsConfig, ctx: StageContext) -> Seeds:
    calls.append("seeds")
    ctx.quality("items", config.count, "count", "higher")
    return Seeds(np.arange(config.count) + config.noise * ctx.rng("seeds").normal(size=config.count))


def double(seeds: Seeds, config: PlainConfig, ctx: StageContext) -> Doubled:
    calls.append("double")
    if config.fail == "crash":
        raise ZeroDivisionError("by\nzero")
    if config.fail == "full":
        raise OSError(28, "No space left on device")
    if config.fail == "said":
        raise StageError("double: want less, got more")
    ctx.warn("twice as much")
    ctx.progress(1, 2)
    return Doubled(seeds.values * config.factor)


def add(doubled: Doubled, seeds: Seeds, config: PlainConfig, ctx: StageContext) -> Total:
    calls.append("add")
    return Total(float(doubled.values.sum() + seeds.values.sum()))


SPECS = (StageSpec("seeds", make_seeds, 1), StageSpec("double", double, 1, ("net",)), StageSpec("add", add, 1))


class Weights:
    """A model provider whose digest a test may change."""

    digest = "d1"

    def digests(self, slots: Sequence[str], config: Any) -> dict[str, str]:
        return {slot: self.digest for slot in slots}

    def licenses(self, digests: Mapping[str, str]) -> dict[str, str]:
        return dict.fromkeys(digests, "MIT")

    def load(self, slot: str) -> Any:
        return slot


@pytest.fixture
def run(tmp_path: Path) -> Callable[..., dict[str, str]]:
    """Run (or look at) a scene folder; gives stage -> state."""

    def go(
        *, source: str = "s1", specs: Sequence[StageSpec] = SPECS, weights: str = "d1", seed: int = 0,
        look: bool = False, start: str | None = None, until: str | None = None, only: str | None = None,
        events: list[Event] | None = None, edits: Edits = "refuse",
        on_row: Callable[[StageStatus], None] = lambda row: None, **options: dict[str, Any],
    ) -> dict[str, str]:  # fmt: skip
        calls.clear()
        nodes = build_graph(specs, [SourceVideo])
        config = resolve(nodes, "p", [("test", {"seed": seed, **options})])
        provider = Weights()
        provider.digest = weights
        video = SourceVideo(Path("v.mp4"), source)
        collect = events.append if events is not None else lambda event: None
        runner = Runner(tmp_path, nodes, config, video, provider, on_event=collect)
        rows = runner.status() if look else runner.run(start=start, until=until, only=only, edits=edits, on_row=on_row)
        return {row.name: row.state for row in rows}

    return go


RAN = {"seeds": "ran", "double": "ran", "add": "ran"}
CACHED = {"seeds": "cached", "double": "cached", "add": "cached"}


def test_runs_once(run: Callable, tmp_path: Path) -> None:
    assert run(look=True) == dict.fromkeys(RAN, "missing")
    assert run() == RAN
    assert calls == ["seeds", "double", "add"]
    assert run() == CACHED == run(look=True)
    assert calls == []
    assert read_value(Total, tmp_path / "stages" / "03_add").value == 9.0


@pytest.mark.parametrize(
    ("change", "again"),
    [
        ({"source": "s2"}, {"seeds": "ran"}),  # same numbers come out, so what follows stays
        ({"seeds": {"count": 4}}, RAN),
        ({"seeds": {"name": "y"}}, {"seeds": "ran"}),
        ({"double": {"factor": 3.0}}, {"double": "ran", "add": "ran"}),
        ({"add": {"factor": 3.0}}, {"add": "ran"}),
        ({"weights": "d2"}, {"double": "ran"}),
        ({"seed": 1}, {"seeds": "ran", "double": "ran", "add": "ran"}),
    ],
)
def test_a_change_reruns_what_it_can_change(run: Callable, change: dict[str, Any], again: dict[str, str]) -> None:
    run()
    assert run(**change) == CACHED | again


def test_new_version_of_a_stage(run: Callable) -> None:
    run()
    newer = (SPECS[0], StageSpec("double", double, 2, ("net",)), SPECS[2])
    assert run(specs=newer, look=True) == {"seeds": "cached", "double": "stale", "add": "stale"}
    assert run(specs=newer) == {"seeds": "cached", "double": "ran", "add": "cached"}


def test_edit_by_hand(run: Callable, tmp_path: Path) -> None:
    run()
    path = tmp_path / "stages" / "02_double" / "arrays.npz"
    np.savez(path, **{"values": np.array([100.0])})
    assert run(look=True) == {"seeds": "cached", "double": "edited", "add": "stale"}
    assert run() == {"seeds": "cached", "double": "edited", "add": "ran"}
    assert read_value(Total, tmp_path / "stages" / "03_add").value == 103.0
    assert run() == {"seeds": "cached", "double": "edited", "add": "cached"}


def test_an_edit_is_never_overwritten_without_a_word(run: Callable, tmp_path: Path) -> None:
    run()
    path = tmp_path / "stages" / "02_double" / "arrays.npz"
    np.savez(path, **{"values": np.array([100.0])})
    edited = path.read_bytes()
    for words in ({"double": {"factor": 5.0}}, {"seeds": {"count": 4}}, {"start": "seeds"}, {"only": "double"}):
        with pytest.raises(UsageError, match=r"stage double: .*02_double.*--keep-edits.*--discard-edits"):
            run(**words)
        assert calls == [], "nothing runs before"
    assert path.read_bytes() == edited
    assert run(start="add")["add"] == "ran", "stages after an edit run as ever"
    kept = run(double={"factor": 5.0}, edits="keep")
    assert kept == {"seeds": "cached", "double": "edited", "add": "cached"}
    assert path.read_bytes() == edited
    assert run(double={"factor": 5.0}) == kept, "a kept edit counts as made from the present settings"
    assert run(double={"factor": 5.0}, start="double", edits="discard")["double"] == "ran"
    assert read_value(Total, tmp_path / "stages" / "03_add").value == 18.0


def test_rows_are_told_one_by_one(run: Callable) -> None:
    told: list[tuple[str, str]] = []
    with pytest.raises(StageError):
        run(double={"fail": "crash"}, on_row=lambda row: told.append((row.name, row.state)))
    assert told == [("seeds", "ran")]


def test_device_is_recorded(run: Callable, tmp_path: Path) -> None:
    run()
    assert read_manifest(tmp_path / "stages" / "01_seeds").device == "cpu"


def test_a_stray_file_is_no_edit(run: Callable, tmp_path: Path) -> None:
    run()
    for name in (".DS_Store", "Thumbs.db"):
        (tmp_path / "stages" / "02_double" / name).write_bytes(b"x")
    assert run(look=True) == CACHED == run()


def test_start_until_only(run: Callable) -> None:
    assert run(until="double") == {"seeds": "ran", "double": "ran"}
    assert run(look=True)["add"] == "missing"
    assert run(start="double") == {"seeds": "cached", "double": "ran", "add": "ran"}
    assert run(only="double") == {"seeds": "cached", "double": "ran"}
    assert calls == ["double"]
    for words in ({"start": "no"}, {"until": "no"}, {"only": "no"}):
        with pytest.raises(UsageError, match="want one of seeds, double, add"):
            run(**words)
    with pytest.raises(UsageError, match="--from add --until seeds: want a first stage before the last"):
        run(start="add", until="seeds")


def test_only_needs_its_inputs(run: Callable) -> None:
    with pytest.raises(UsageError, match="earlier stage 'seeds' is missing"):
        run(only="add")


def test_randomness_depends_on_seed_and_label_alone(run: Callable, tmp_path: Path) -> None:
    def noisy(seed: int) -> np.ndarray:
        run(seeds={"noise": 1.0}, seed=seed, start="seeds")
        return read_value(Seeds, tmp_path / "stages" / "01_seeds").values

    first = noisy(1)
    np.testing.assert_array_equal(first, noisy(1))
    assert (first != noisy(2)).all()
    ctx = StageContext(tmp_path, seed=3)
    assert ctx.rng("a").random() == ctx.rng("a").random() != ctx.rng("b").random()


@pytest.mark.parametrize(
    ("fail", "said"),
    [
        ("crash", "stage 'double' failed: ZeroDivisionError: by"),
        ("full", "no space left"),
        ("said", "want less, got more"),
    ],
)
def test_failing_stage_keeps_what_was_there(run: Callable, tmp_path: Path, fail: str, said: str) -> None:
    run()
    kept = (tmp_path / "stages" / "02_double" / "manifest.json").read_bytes()
    with pytest.raises(StageError, match=said) as caught:
        run(double={"fail": fail})
    assert "\n" not in str(caught.value)
    assert (tmp_path / "stages" / "02_double" / "manifest.json").read_bytes() == kept
    assert run() == CACHED
    assert not list((tmp_path / "stages").glob(".*"))


def test_damaged_input_is_named(run: Callable, tmp_path: Path) -> None:
    run()
    (tmp_path / "stages" / "01_seeds" / "arrays.npz").write_bytes(b"PK")
    with pytest.raises(ArtifactError, match=r"arrays\.npz.*video2anim stage \S+ seeds --discard-edits"):
        run()
    assert run(only="seeds", edits="discard") == {"seeds": "ran"}
    assert run() == CACHED


def test_manifest_and_events(run: Callable, tmp_path: Path) -> None:
    events: list[Event] = []
    run(events=events)
    assert [(e.kind, e.stage) for e in events if e.stage == "double"] == [
        ("start", "double"), ("progress", "double"), ("warning", "double"), ("done", "double")
    ]  # fmt: skip
    manifest = read_manifest(tmp_path / "stages" / "01_seeds")
    assert manifest.config == {"count": 3, "noise": 0.0, "name": "x"}
    assert manifest.qualities == [
        {"key": "items", "value": 3.0, "unit": "count", "better": "higher", "person_id": None, "object_id": None}
    ]
    second = read_manifest(tmp_path / "stages" / "02_double")
    assert second.inputs == {"Seeds": manifest.output_digest}
    assert second.weights == {"net": "d1"}
    assert second.licenses == {"net": "MIT"}
    assert second.warnings == ["twice as much"]
    assert second.wall_time_s >= 0
    assert second.peak_memory_mb > 1


def test_unfinished_folders_are_removed(run: Callable, tmp_path: Path) -> None:
    left = tmp_path / "stages" / ".unfinished-02_double-abc"
    left.mkdir(parents=True)
    run()
    assert not left.exists()


def shout(seeds: Seeds, config: PlainConfig, ctx: StageContext) -> Loud:
    calls.append("shout")
    return Loud(float(seeds.values.max()))


def test_a_stage_that_is_added_leaves_the_others_as_they_are(run: Callable, tmp_path: Path) -> None:
    run()
    specs = (SPECS[0], StageSpec("shout", shout, 1), *SPECS[1:])
    assert run(specs=specs) == {"seeds": "cached", "shout": "ran", "double": "cached", "add": "cached"}
    assert calls == ["shout"]
    assert run(specs=specs, double={"factor": 3.0})["double"] == "ran"
    assert run(specs=specs) == dict.fromkeys(("seeds", "shout", "double", "add"), "cached") | {
        "double": "ran",
        "add": "ran",
    }
    names = sorted(path.name for path in (tmp_path / "stages").iterdir())
    assert names == ["01_seeds", "02_double", "02_shout", "03_add"], "each stage has one folder"
    assert stage_folder(tmp_path, "double") == tmp_path / "stages" / "02_double"
    assert not stage_folder(tmp_path, "subtract").exists()


# The graph is checked before anything runs.


def test_graph_reads_signatures() -> None:
    nodes = build_graph(SPECS, [SourceVideo])
    assert [node.folder_name for node in nodes] == ["01_seeds", "02_double", "03_add"]
    assert nodes[2].inputs == (("doubled", Doubled), ("seeds", Seeds))
    assert (nodes[2].output, nodes[2].config_type) == (Total, PlainConfig)


def test_graph_refuses_what_does_not_fit() -> None:
    def no_config(seeds: Seeds, ctx: StageContext) -> Total: ...
    def no_result(config: PlainConfig, ctx: StageContext): ...
    def plain_result(config: PlainConfig, ctx: StageContext) -> int: ...

    with pytest.raises(GraphError, match="needs Seeds"):
        build_graph(SPECS[1:], [SourceVideo])
    with pytest.raises(GraphError, match="both make Seeds"):
        build_graph([SPECS[0], StageSpec("again", make_seeds, 1)], [SourceVideo])
    for function in (no_config, no_result, plain_result):
        spec = StageSpec("bad", function, 1)
        with pytest.raises(GraphError, match="stage 'bad'"):
            build_graph([spec], [Seeds])


# Configuration.


def nodes() -> tuple[Node, ...]:
    return build_graph(SPECS, [SourceVideo])


def test_later_layers_win() -> None:
    config = resolve(
        nodes(), "p", [("a", {"seeds": {"count": 5, "noise": 1.0}}), ("b", {"seeds": {"count": 6}, "seed": 4})]
    )
    assert config.stages["seeds"] == SeedsConfig(count=6, noise=1.0)
    assert config.seed == 4
    assert resolve(nodes(), "p", [("run.json", json.loads(json.dumps(config.as_dict())))]) == config


def test_a_record_of_another_version_is_read_without_what_this_one_has_not() -> None:
    recorded = {"seed": 3, "gone": {"a": 1}, "seeds": {"count": 4, "least": 2, "noise": "no such"}, "odd": 3}
    known, unknown = known_part(nodes(), recorded)
    assert known == {"seed": 3, "seeds": {"count": 4}}
    assert unknown == ["gone", "seeds.least", "seeds.noise", "odd"]
    assert resolve(nodes(), "p", [("run.json", known)]).seed == 3


def test_parse_set() -> None:
    assert parse_set(["a.b=1", "a.c=x", "seed=3", "a.d=[1, 2]", "a.e=null", "a.f="]) == {
        "a": {"b": 1, "c": "x", "d": [1, 2], "e": None, "f": None}, "seed": 3
    }  # fmt: skip
    for text in ("a.b", "=1", "a.=1", ".b=1", "a.b.c=1", "a.b=[1"):
        with pytest.raises(UsageError, match="--set"):
            parse_set([text])


@pytest.mark.parametrize(
    ("layer", "said"),
    [
        ({"seds": {}}, "unknown key 'seds' .did you mean 'seeds'"),
        ({"seeds": {"cont": 1}}, "unknown key 'seeds.cont' .did you mean 'seeds.count'"),
        ({"seeds": {"zzz": 1}}, "known: count, noise, name"),
        ({"seeds": 3}, "wants a mapping"),
        ({"seeds": {"count": "many"}}, "seeds.count: .*'many'"),
        ({"seeds": {"count": 2.5}}, "seeds.count"),
        ({"seed": "x"}, "seed: .*'x'"),
    ],
)
def test_wrong_configuration_is_one_line(layer: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=said) as caught:
        resolve(nodes(), "p", [("--set", layer)])
    assert "\n" not in str(caught.value)


def test_numbers_are_text_where_text_is_wanted() -> None:
    assert resolve(nodes(), "p", [("--set", {"seeds": {"name": 7}})]).stages["seeds"].name == "7"
    with pytest.raises(UsageError, match=r"seeds\.name"):
        resolve(nodes(), "p", [("--set", {"seeds": {"name": [7]}})])


def test_unknown_preset() -> None:
    with pytest.raises(UsageError, match="embedded"):
        load_preset("none")


# The folder.


def record() -> RunRecord:
    rows = [StageRow("seeds", "ran", "k", 0.5)]
    contacts = [
        Contact(1, "left hand", 2, "table", "top", 0.5, 1.0, 0.01, -0.02),
        Contact(1, "left foot", None, "floor", "floor", 0.0, 2.0, 0.0, 0.01),
    ]
    return RunRecord("v.mp4", "d", "embedded", 0, {"seeds": {"count": 3}}, {}, {}, rows, {"motion.npz": "0"}, contacts)


def test_record_round_trip(tmp_path: Path) -> None:
    write_record(tmp_path, record())
    assert read_record(tmp_path) == record()
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


CONTACT = asdict(record().contacts[0])
WRONG = (
    '{"input_path": 3}', '{"input_path": null}', "[]", "null", '"text"', "{", "[" * 100_000, "\\xff",
    *(json.dumps(asdict(record()) | change) for change in (
        {"config": []}, {"config": "text"}, {"config": None}, {"input_path": ["a"]}, {"stages": 3}, {"stages": [{}]},
        {"stages": [None]}, {"seed": "x"}, {"results": {"motion.npz": 1}}, {"results": {"../motion.npz": "0"}},
        {"results": {"/tmp/x": "0"}}, {"results": {"objects/../../1.glb": "0"}}, {"versions": 2}, {"unknown": 1},
        {"contacts": [{"person_id": 1}]}, {"contacts": [CONTACT | {"object_id": "2"}]},
        {"contacts": [CONTACT | {"x": 1}]},
    )),
)  # fmt: skip


@pytest.mark.parametrize("text", WRONG)
def test_damaged_record_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(ArtifactError, match=r"run\.json: .* delete it and run") as caught:
        read_record(tmp_path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("part", ["stages", "objects", ".lock", "run.json", "stages/01_seeds"])
def test_links_out_of_the_folder_are_refused(tmp_path: Path, part: str) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "kept.txt").write_text("kept")
    scene = tmp_path / "scene"
    (scene / part).parent.mkdir(parents=True)
    (scene / part).symlink_to(outside / "kept.txt" if part == ".lock" else outside)
    with pytest.raises(InputError, match="want plain files and folders, got a link"):
        prepare(scene)
    if part == ".lock":
        with pytest.raises(InputError), locked(scene):
            pass
    assert (outside / "kept.txt").read_text() == "kept"


def test_lock_keeps_others_out_and_clears_leftovers(tmp_path: Path) -> None:
    prepare(tmp_path)
    (tmp_path / ".run-old").touch()
    (tmp_path / ".new-old").touch()
    with locked(tmp_path), pytest.raises(UsageError, match="another video2anim run"), locked(tmp_path):
        pass
    assert not list(tmp_path.glob(".run-*")) + list(tmp_path.glob(".new-*"))
    with locked(tmp_path):
        pass
