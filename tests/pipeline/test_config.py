"""Configuration is checked before the first stage: types, ranges, names, keys, and what YAML may hold."""

from __future__ import annotations

import codecs
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_origin

import pytest
from pydantic.fields import FieldInfo

from video2anim.cli.compose import pipeline_nodes
from video2anim.errors import UsageError
from video2anim.pipeline.config import PipelineConfig, expect_user_paths, load_preset, parse_set, resolve
from video2anim.pipeline.options import Option, options_of
from video2anim.pipeline.plain_yaml import PlainYamlError, read_yaml

NODES = pipeline_nodes()
OPTIONS = [(node.name, name, option) for node in NODES for name, option in options_of(node.config_type).items()]
NAMES = [f"{stage}.{name}" for stage, name, _ in OPTIONS]
PATHS = ("reconstruct.meshes", "scene.scan")


def with_sets(*sets: str) -> PipelineConfig:
    return resolve(NODES, "p", [("--set", parse_set(sets))])


def refusal(*sets: str) -> str:
    with pytest.raises(UsageError) as caught:
        with_sets(*sets)
    return one_line(caught.value)


def one_line(error: UsageError) -> str:
    text = str(error)
    assert text.isprintable()
    assert len(text) < 700
    return text


# Every option of every stage.


def parts_of(hint: Any) -> Iterator[tuple[type, tuple[Any, ...]]]:
    """Plain types in a type, each with its notes."""
    base, *notes = get_args(hint) if get_origin(hint) is typing.Annotated else (hint,)
    if get_origin(base) is None:
        yield base, tuple(notes)
    elif get_origin(base) is not typing.Literal:
        for part in get_args(base):
            if part not in (Ellipsis, type(None)):
                yield from ((kind, (*inner, *notes)) for kind, inner in parts_of(part))


@pytest.mark.parametrize(("stage", "name", "option"), OPTIONS, ids=NAMES)
def test_every_option_says_what_it_takes(stage: str, name: str, option: Option) -> None:
    """Numbers have a lowest and a highest value, text is a path, matched by a pattern or checked against names."""
    for kind, notes in parts_of(option.hint):
        if kind in (int, float):
            bounds = {type(bound).__name__ for note in notes if isinstance(note, FieldInfo) for bound in note.metadata}
            assert len(bounds) == 2, f"{stage}.{name} has the bounds {bounds}"
        elif kind is str:
            assert notes, f"{stage}.{name} takes any text"
        else:
            assert kind is bool


@pytest.mark.parametrize(("stage", "name", "option"), OPTIONS, ids=NAMES)
def test_every_default_is_in_its_range(stage: str, name: str, option: Option) -> None:
    assert option.checked(option.default, name) == option.default


@pytest.mark.parametrize(("stage", "name", "option"), OPTIONS, ids=NAMES)
def test_no_option_takes_nonsense(stage: str, name: str, option: Option) -> None:
    any_text = (".nan", ".inf", "-.inf", "-1e+9", "'no such object'") if f"{stage}.{name}" not in PATHS else ()
    for value in ("[[1]]", "{a: 1}", "no", *any_text):
        if value != "no" or bool not in [kind for kind, _ in parts_of(option.hint)]:
            assert f"--set: {stage}.{name}: want " in refusal(f"{stage}.{name}={value}")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("segment.max_objects=-1", "want a whole number from 0 to 1000 objects, got -1"),
        ("humans.height_m=17", "want a number from 0.5 to 2.5 m (--height-m) or a mapping"),
        ("keyframes.keyframe_interval_frames=0", "want a whole number from 1 to 100000 frames, got 0"),
        ("refine.keyframe_interval_frames=0", "want a whole number from 1 to 100000 frames, got 0"),
        ("export.preview_height_px=-4", "want a whole number from 16 to 4320 px, got -4"),
        ("export.formats=[glb, obj]", "want a list of glb, usd, bvh, amass"),
        ("depth.provider=nosuch", "want a model of slot depth (room-depth, "),
        ("segment.provider=geocalib", "NAME@PATH for weights of your own) or 'geometric', got 'geocalib'"),
        ("depth.provider=geocalib", "NAME@PATH for weights of your own), got 'geocalib'"),
        ("refine.prior=none", "want 'auto' or 'interpolation' or 'scenemi', got 'none'"),
        ("reconstruct.model=triposr@~nosuchuser/x", "want a model of slot object-mesh (triposr; "),
        ("reconstruct.command=make {mesh}", "{image} and {mesh}"),
        ("track.person=somebody", "'largest', 'all' or a person's ID, got 'somebody'"),
        ("ingest.start_s=.nan", "want a number from 0 to 1000000 s, got nan"),
        ("camera.field_frames=yes", "want a whole number from 1 to 1000, got True"),
        ("camera.field_frames=2.5", "want a whole number from 1 to 1000, got 2.5"),
        ("depth.hue_shifts_rad=[0.1, 7]", "a list, each a number from -3.1416 to 3.1416 rad"),
        ("scene.scan_shift_m=[1, 2]", "a list of 3, each a number"),
        ("refine.keyframe_noise_deg=-1", "want a number from 0 to 100 degrees, got -1"),
        ("seed=-1", "seed: want a whole number from 0 to 4294967295, got -1"),
        ("seed=4294967296", "seed: want"),
        (f"seed=0x{'f' * 9000}", "got a number of thousands of digits"),
        (f"camera.model={'x' * 60_000}", "..."),
    ],
)
def test_the_message_says_what_is_wanted(given: str, said: str) -> None:
    assert said in refusal(given)


def test_two_options_that_contradict_each_other() -> None:
    assert "start_s < stop_s" in refusal("ingest.start_s=2", "ingest.stop_s=1")


def test_valid_values_stay_what_they_were() -> None:
    stages = with_sets(
        "camera.focal_px=1e3", "humans.height_m=2", "track.person=3", "ingest.shot=1", "place.yaw_starts_deg=[1, 2]",
        "humans.iterations=50", "segment.max_objects=0", "depth.provider=depth", "humans.model=lifter@x.onnx", "seed=7",
    ).stages  # fmt: skip
    assert (stages["camera"].focal_px, stages["humans"].height_m) == (1000.0, 2.0)
    assert (stages["track"].person, stages["ingest"].shot) == ("3", 1)
    assert stages["place"].yaw_starts_deg == (1.0, 2.0)
    assert (stages["humans"].iterations, stages["segment"].max_objects) == (50, 0)
    assert (stages["depth"].provider, stages["humans"].model) == ("depth", "lifter@x.onnx")


# Options that another one makes meaningless.


@pytest.mark.parametrize(
    "given",
    [
        ("export.preview=false", "export.preview_height_px=100"),
        ("scene.scan_up=z",),
        ("scene.scan=room.ply", "scene.walked_m=2"),
        ("reconstruct.model_resolution=64",),
    ],
)
def test_an_option_that_means_nothing_is_an_error(given: tuple[str, ...]) -> None:
    assert f"{given[-1].split('=')[0]}: means nothing with " in refusal(*given)


def test_what_is_chosen_later_may_make_an_option_of_a_preset_meaningless() -> None:
    layers = [("preset", {"export": {"preview_height_px": 100}}), ("--set", {"export": {"preview": False}})]
    assert resolve(NODES, "p", layers).stages["export"].preview_height_px == 100
    layers[0][1]["export"]["preview"] = False
    with pytest.raises(UsageError, match=r"export\.preview_height_px: means nothing"):
        resolve(NODES, "p", layers[:1])


def test_a_record_of_a_run_is_taken_as_it_is() -> None:
    """It names every option, so none of them was chosen against another."""
    layers = [("preset", {"export": {"preview_height_px": 100}}), ("--set", {"export": {"preview": False}})]
    before = resolve(NODES, "p", layers)
    assert resolve(NODES, "p", [("run.json", before.as_dict())]) == before


# Presets.


def preset(tmp_path: Path, text: str | bytes) -> str:
    path = tmp_path / "mine.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return str(path)


def test_a_partial_preset_changes_only_what_it_names(tmp_path: Path) -> None:
    shipped = resolve(NODES, "embedded", [("preset", load_preset("embedded"))])
    mine = load_preset(preset(tmp_path, "humans:\n  height_m: 1.82\n"))
    config = resolve(NODES, "mine", [("mine", mine)])
    assert config.stages.pop("humans").height_m == 1.82  # type: ignore[attr-defined]
    assert config.stages == {name: stage for name, stage in shipped.stages.items() if name != "humans"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("depth:\n  far_m: 1\ndepth:\n  provider: mine\n", "line 3, column 1: this key is there twice"),
        ("depth: {far_m: 1, far_m: 2}\n", "this key is there twice"),
        ("a: &a [1]\ndepth: *a\n", "aliases"),
        ("<<: {depth: {}}\n", ""),
        ("camera: {frames: !!int x}\n", "tags"),
        ("camera: {frames: !!timestamp x}\n", "tags"),
        ("camera: !!python/object/apply:os.system [exit]\n", "tags"),
        ("1: {}\n", "line 1, column 1: want a name as key"),
        ("~: {}\n", "want a name as key"),
        ("on: {}\n", "want a name as key"),
        ("? [a, b]\n: 1\n", "want a name as key"),
        ("[" * 5000, "nested more than"),
        ("a: " * 3, "line 1"),
        ("- " * 5000, "nested more than"),
        (f"camera: {{frames: {'9' * 5000}}}\n", "number"),
        (f"camera: {{frames: 1{':1' * 400}.0}}\n", "number"),
        (f"camera: {{frames: {'x' * 32_768}}}\n", "more than 32768 characters"),
        (b"x" * 10**6, "more than"),
        ("camera: {model: \x07}\n", "a character that YAML text cannot hold"),
        ("camera: {}\n--- \ndepth: {}\n", "line"),
        ("- a\n", "want a mapping of stages to options, got ['a']"),
        ("false\n", "want a mapping"),
        ("camera: {frames: caf\xe9}".encode("latin-1"), "UTF-8"),
        (codecs.BOM_UTF16_LE + "camera: {}".encode("utf-16-le"), "UTF-8"),
        ("camera: {}".encode("utf-16-be"), "a character that YAML text cannot hold"),
    ],
)
def test_a_bad_preset_is_one_line_that_names_it(tmp_path: Path, text: str | bytes, said: str) -> None:
    with pytest.raises(UsageError) as caught:
        resolve(NODES, "mine", [("mine.yaml", load_preset(preset(tmp_path, text)))])
    assert said in one_line(caught.value)
    assert "mine.yaml" in str(caught.value)


def test_nested_aliases_end_at_once(tmp_path: Path) -> None:
    """Nine lines that would become 10^9 values."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 9)]
    with pytest.raises(UsageError, match="aliases"):
        load_preset(preset(tmp_path, "\n".join(lines)))


@pytest.mark.parametrize("text", ["2020-99-99", "2020-01-01", "=", "<<", "12:x"])
def test_what_looks_like_a_date_or_a_sign_is_text(text: str) -> None:
    assert read_yaml(text) == text


@pytest.mark.parametrize(
    ("text", "value"),
    [("", None), ("~", None), ("yes", True), ("0x10", 16), ("1_000", 1000), ("1.5e+3", 1500.0), ("'1'", "1"),
     ("[a]", ["a"])],
)  # fmt: skip
def test_plain_yaml(text: str, value: Any) -> None:
    assert read_yaml(text) == value


def test_marked_orders_of_bytes_are_read(tmp_path: Path) -> None:
    assert load_preset(preset(tmp_path, codecs.BOM_UTF8 + b"camera: {frames: 3}")) == {"camera": {"frames": 3}}


@pytest.mark.parametrize("name", ["x" * 5000 + ".yaml", "a\0b.yaml", "../presets/embedded", "", ".yaml", "\udcff.yaml"])
def test_odd_names_of_presets(name: str) -> None:
    with pytest.raises(UsageError, match="--preset: want one of") as caught:
        load_preset(name)
    one_line(caught.value)


def test_an_unreadable_preset_and_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = preset(tmp_path, "camera: {}")

    def refused(self: Path, *words: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(UsageError, match=r"mine\.yaml.*Permission denied"):
        load_preset(name)
    with pytest.raises(UsageError, match="want one of"):
        load_preset(str(tmp_path) + ".yaml")


# --set.


def test_sets_of_one_stage_come_together() -> None:
    """Whichever way they are written, each changes only what it names."""
    sets = ["depth={far_m: 1}", "depth.provider=geometric", "depth={contact_threshold: 0.3}"]
    assert parse_set(sets) == {"depth": {"far_m": 1, "provider": "geometric", "contact_threshold": 0.3}}


@pytest.mark.parametrize(
    "sets",
    [("seed=1", "seed.x=2"), ("depth=3", "depth.far_m=1"), ("camera.field_frames=" + "[" * 5000,), ("a.b=!!int x",),
     ("a.b=*x",), ("depth={1: 2}",), ("depth={far_m: 1, far_m: 2}",), ("\udcff.x=1",), ("depth.\n=1",),
     ("camera.model=\"a\\0b\"",), ("camera.model=\"\\ud800\"",), ("x" * 70_000 + "=1",)],
)  # fmt: skip
def test_bad_sets_are_one_line(sets: tuple[str, ...]) -> None:
    try:
        refusal(*sets)
    except PlainYamlError:
        pytest.fail("the reader's own error came through")


@pytest.mark.parametrize("path", ["~nosuchuser/x", "x" * 5000, '"a\\0b"'])
def test_odd_paths_of_the_user_are_found_missing(path: str) -> None:
    with pytest.raises(UsageError, match=r"scene\.scan: want") as caught:
        expect_user_paths(with_sets(f"scene.scan={path}"))
    one_line(caught.value)


@pytest.mark.parametrize("layer", [None, [], "camera", 3, {1: {}}, {"camera": {2: 3}}, {"camera": [1]}, {None: 1}])
def test_layers_that_are_no_mappings_of_names(layer: Any) -> None:
    """As a damaged `run.json` has them."""
    with pytest.raises(UsageError, match=r"run\.json") as caught:
        resolve(NODES, "p", [("run.json", layer)])
    one_line(caught.value)
