"""Options that are a user's own files: found again from anywhere, and remade when their content changes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from video2anim.errors import UsageError
from video2anim.pipeline.config import expect_user_paths, parse_set, resolve, result_config, user_path
from video2anim.pipeline.graph import Node, build_graph
from video2anim.pipeline.runner import Runner
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import SourceVideo


@dataclass(frozen=True)
class Letters:
    values: np.ndarray


@dataclass(frozen=True)
class LettersConfig:
    scan: str = user_path()
    name: str = "x"


def read_letters(source: SourceVideo, config: LettersConfig, ctx: StageContext) -> Letters:
    return Letters(np.frombuffer(Path(config.scan).read_bytes() if config.scan else b"", np.uint8))


class NoModels:
    def digests(self, slots: Sequence[str], config: Any) -> dict[str, str]:
        return {}

    def licenses(self, digests: Mapping[str, str]) -> dict[str, str]:
        return dict.fromkeys(digests, "MIT")

    def load(self, slot: str) -> Any:
        raise AssertionError(f"no stage here wants {slot}")


def nodes() -> tuple[Node, ...]:
    return build_graph([StageSpec("letters", read_letters, 1)], [SourceVideo])


def config_of(**options: Any) -> LettersConfig:
    return resolve(nodes(), "p", [("--set", {"letters": options})]).stages["letters"]


def test_relative_paths_become_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They count from the folder in which the command was given; `~` is the user's home."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert Path(config_of(scan="room.ply").scan) == tmp_path / "here" / "room.ply"
    assert Path(config_of(scan="~/room.ply").scan) == tmp_path / "home" / "room.ply"
    assert config_of(scan="/scans/room.ply").scan == "/scans/room.ply"
    assert Path(config_of(scan=7).scan) == tmp_path / "here" / "7", "YAML reads a folder's name as a number"
    config = config_of(name="room.ply")
    assert (config.scan, config.name) == ("", "room.ply"), "no path stays none, other text stays as it is"


def test_a_run_found_again_from_another_folder_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = resolve(nodes(), "p", [("--set", parse_set(["letters.scan=room.ply"]))])
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert resolve(nodes(), "p", [("run.json", json.loads(json.dumps(first.as_dict())))]) == first
    assert first.stages["letters"].scan == str(tmp_path / "room.ply")


def test_the_last_layer_decides(tmp_path: Path) -> None:
    layers = [("preset", {"letters": {"scan": "/a.ply"}}), ("--set", {"letters": {"scan": ""}})]
    assert resolve(nodes(), "p", layers).stages["letters"].scan == ""
    assert config_of(scan=None).scan == "", "as `--set letters.scan=` has it"


def test_the_key_has_the_content_in_place_of_the_path(tmp_path: Path) -> None:
    for name, content in (("a.ply", b"1"), ("b.ply", b"1"), ("c.ply", b"2")):
        (tmp_path / name).write_bytes(content)
    a, b, c = (result_config(LettersConfig(str(tmp_path / name))) for name in ("a.ply", "b.ply", "c.ply"))
    assert a == b != c
    assert str(tmp_path) not in json.dumps(a)
    assert result_config(LettersConfig()) == {"scan": "", "name": "x"}
    assert result_config(LettersConfig(str(tmp_path / "a.ply"), "y")) == a | {"name": "y"}


@pytest.fixture
def run(tmp_path: Path) -> Callable[..., str]:
    def go(scan: Path | str, *, look: bool = False) -> str:
        config = resolve(nodes(), "p", [("test", {"letters": {"scan": str(scan)}})])
        runner = Runner(tmp_path / "out", nodes(), config, SourceVideo(Path("v.mp4"), "s"), NoModels())
        (row,) = runner.status() if look else runner.run()
        return row.state

    return go


def test_a_stage_is_remade_when_the_content_changes(run: Callable, tmp_path: Path) -> None:
    """Moved, changed in place, and left out."""
    place, moved = tmp_path / "in" / "room.ply", tmp_path / "moved" / "other.ply"
    for path in (place, moved):
        path.parent.mkdir()
    place.write_bytes(b"1")
    assert run(place) == "ran"
    assert run(place) == "cached"
    shutil.move(place, moved)
    assert run(moved) == "cached"
    moved.write_bytes(b"2")
    assert run(moved, look=True) == "stale"
    assert run(moved) == "ran"
    assert run("") == "ran"


def test_of_a_folder_names_and_content_count(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "1.glb").write_bytes(b"1")
    key = result_config(LettersConfig(str(tmp_path / "in")))
    moved = (tmp_path / "in").rename(tmp_path / "moved")
    assert result_config(LettersConfig(str(moved))) == key
    (moved / "2.glb").write_bytes(b"1")
    assert result_config(LettersConfig(str(moved))) != key


def test_a_missing_file_is_one_clear_line_before_anything_runs(tmp_path: Path) -> None:
    path = tmp_path / "none.ply"
    config = resolve(nodes(), "p", [("test", {"letters": {"scan": str(path)}})])
    with pytest.raises(UsageError, match=r"letters\.scan: want a file or folder, found nothing at") as caught:
        expect_user_paths(config)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    path.write_bytes(b"1")
    expect_user_paths(config)


def test_the_state_can_be_seen_when_the_file_is_gone(run: Callable, tmp_path: Path) -> None:
    path = tmp_path / "room.ply"
    path.write_bytes(b"1")
    assert run(path) == "ran"
    path.unlink()
    assert run(path, look=True) == "stale"


def test_files_that_belong_to_a_mesh_count_too(tmp_path: Path) -> None:
    """The places of a glTF's vertices are in a file of its own, as are the colors of an OBJ."""
    import trimesh
    from trimesh.exchange.gltf import export_gltf

    for name, data in export_gltf(trimesh.Scene(trimesh.creation.box((1, 1, 1)))).items():
        (tmp_path / name).write_bytes(data)
    key = result_config(LettersConfig(str(tmp_path / "model.gltf")))
    for path in tmp_path.glob("*.bin"):
        path.write_bytes((2 * np.frombuffer(path.read_bytes(), np.float32)).tobytes())
    assert result_config(LettersConfig(str(tmp_path / "model.gltf"))) != key


def test_material_and_texture_of_an_obj_count_too(tmp_path: Path) -> None:
    """Two libraries, one with a blank in its name and a texture with options; what is missing is left to the reader."""
    (tmp_path / "model.obj").write_text("mtllib plain.mtl\nmtllib with blank.mtl\nmtllib none.mtl\nv 0 0 0\n")
    (tmp_path / "plain.mtl").write_text("newmtl a\nKd 1 0 0\n")
    (tmp_path / "with blank.mtl").write_text("newmtl b\n  map_Kd -s 1 1 1 wood.png\n")
    (tmp_path / "wood.png").write_bytes(b"1")
    (tmp_path / "other.png").write_bytes(b"1")
    keys = [result_config(LettersConfig(str(tmp_path / "model.obj")))]
    for name in ("plain.mtl", "with blank.mtl", "wood.png", "model.obj", "other.png"):
        path = tmp_path / name
        path.write_bytes(path.read_bytes() + b"\n")
        keys.append(result_config(LettersConfig(str(tmp_path / "model.obj"))))
    assert len({str(key) for key in keys}) == 5
    assert keys[-1] == keys[-2], "it names no other.png"


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"buffers": 3}', '{"buffers": [3], "images": [{}]}'])
def test_a_broken_gltf_still_counts_by_its_own_bytes(tmp_path: Path, text: str) -> None:
    path = tmp_path / "model.gltf"
    path.write_text(text)
    key = result_config(LettersConfig(str(path)))
    path.write_text(text + " ")
    assert result_config(LettersConfig(str(path))) != key
