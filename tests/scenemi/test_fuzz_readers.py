"""Every reader of files from outside, on files bent at random: only the project's errors come out, on one line.

Short here; longer by hand: `SCENEMI_FUZZ_S=300 pytest tests/scenemi/test_fuzz_readers.py`, seconds for each reader.
"""

from __future__ import annotations

import io
import json
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from scenemi_cases import keyframe_arrays, walk_archive, walk_bvh

from scenemi.data.container import MotionArchive
from scenemi.data.keyframe_file import read_keyframes
from scenemi.data.readers import read_clips
from scenemi.data.retarget import retarget
from scenemi.data.scene_file import read_scene
from scenemi.evaluation.windows import adult_body
from scenemi.scene.scene_parts import geometry_of
from scenemi.training.config import TrainConfig
from video2anim.errors import Video2AnimError

SECONDS = float(os.environ.get("SCENEMI_FUZZ_S", "0"))
EXAMPLES = 25
NUMBERS = st.sampled_from(
    [0, -1, 1, 2, 3, 22, 2**31, 2**63, 10**400, 0.5, -0.0, 1e-300, 1e300, float("nan"), float("inf"), True, None]
)
VALUES = st.recursive(
    st.one_of(NUMBERS, st.text(max_size=4)),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=4), inner, max_size=2)),
    max_leaves=6,
)
EDITS = st.lists(
    st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 12), st.binary(max_size=6)), min_size=1, max_size=6
)
"""Place as a share of the file, bytes that go, bytes that come."""
WORDS = st.sampled_from(
    ["", "-1", "1e300", "nan", "9" * 400, "{", "}", "JOINT", "CHANNELS", "OFFSET", "0", "-6", "a b"]
)
DTYPES = st.sampled_from(["<f4", "<f8", "<i2", "<i8", "<u8", "?", "<c8", "<M8[s]", "<U3", "S2", "V4"])
SHAPES = st.lists(st.integers(0, 23), max_size=4)


def bent(data: bytes, edits: list[tuple[float, int, bytes]]) -> bytes:
    for place, gone, come in edits:
        at = int(place * len(data))
        data = data[:at] + come + data[at + gone :]
    return data


def only_own_errors(read: Callable[[], object], what: object) -> None:
    said = ""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            read()
    except Video2AnimError as error:
        said = str(error)
    assert "\n" not in said, what
    assert len(said) < 1500, what


def fuzz(strategy: st.SearchStrategy[Any], check: Callable[[Any], None]) -> None:
    """A fixed number of examples, the same ones each time; or new ones until the time is over."""
    begun, round_number = time.monotonic(), 0
    while True:
        run = given(strategy)(lambda value: check(value))
        examples = 300 if SECONDS else EXAMPLES
        phases = (Phase.generate, Phase.shrink)
        quiet = list(HealthCheck)
        run = settings(
            max_examples=examples, deadline=None, database=None, phases=phases, suppress_health_check=quiet,
        )(run)  # fmt: skip
        seed(round_number if not SECONDS else time.time_ns())(run)()
        round_number += 1
        if time.monotonic() - begun >= SECONDS:
            return


@pytest.fixture(scope="module", autouse=True)
def warm() -> None:
    """The body model takes seconds to load."""
    adult_body()


def keyframe_json() -> dict[str, Any]:
    given_arrays = {key: value.tolist() for key, value in keyframe_arrays().items()}
    return {**given_arrays, "fps": 30, "shape_model": "anny", "shape_names": ["height"], "shape_values": [0.5]}


def test_keyframe_tables(tmp_path: Path) -> None:
    good, path = keyframe_json(), tmp_path / "k.json"
    keys = st.sampled_from([*good, "valid", "T_world_root", "frame_time_s", "rest_joints_m", "axis_angle"])

    def check(changes: dict[str, Any]) -> None:
        path.write_text(json.dumps({**good, **changes}))
        only_own_errors(lambda: read_keyframes(path), changes)

    fuzz(st.dictionaries(keys, VALUES, min_size=1, max_size=3), check)


def test_keyframe_text(tmp_path: Path) -> None:
    data, path = json.dumps(keyframe_json()).encode(), tmp_path / "k.json"

    def check(edits: list[tuple[float, int, bytes]]) -> None:
        path.write_bytes(bent(data, edits))
        only_own_errors(lambda: read_keyframes(path), edits)

    fuzz(EDITS, check)


def test_keyframe_archives(tmp_path: Path) -> None:
    stored, packed, path = io.BytesIO(), io.BytesIO(), tmp_path / "k.npz"
    np.savez(stored, **keyframe_arrays())
    np.savez_compressed(packed, **keyframe_arrays())

    def check(drawn: tuple[bool, list[tuple[float, int, bytes]]]) -> None:
        path.write_bytes(bent((packed if drawn[0] else stored).getvalue(), drawn[1]))
        only_own_errors(lambda: read_keyframes(path), drawn)

    fuzz(st.tuples(st.booleans(), EDITS), check)


def test_keyframe_arrays_of_any_kind(tmp_path: Path) -> None:
    path = tmp_path / "k.npz"
    names = st.sampled_from([*keyframe_arrays(), "valid", "fps", "shape_model", "T_world_root", "rest_joints_m"])

    def check(drawn: tuple[str, str, list[int]]) -> None:
        name, dtype, shape = drawn
        np.savez(path, **{**keyframe_arrays(), name: np.zeros(shape, dtype)})  # type: ignore[arg-type]
        only_own_errors(lambda: read_keyframes(path), drawn)

    fuzz(st.tuples(names, DTYPES, SHAPES), check)


def test_bvh(tmp_path: Path) -> None:
    words, path = walk_bvh(tmp_path / "good.bvh", 12).read_text().split(" "), tmp_path / "w.bvh"

    def check(edits: list[tuple[float, str]]) -> None:
        some = list(words)
        for place, word in edits:
            some[int(place**3 * len(some))] = word  # the hierarchy comes first
        path.write_text(" ".join(some))
        only_own_errors(lambda: read_keyframes(path), edits)

    fuzz(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), WORDS), min_size=1, max_size=4), check)


def scenes() -> dict[str, bytes]:
    scene = trimesh.Scene([trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(1)])
    ball = trimesh.creation.icosphere(1)
    found = {".glb": scene.export(file_type="glb"), ".gltf": b'{"asset": {"version": "2.0"}, "nodes": [{"mesh": 0}]}'}
    for kind in ("ply", "stl", "obj"):
        data = ball.export(file_type=kind)
        found[f".{kind}"] = data.encode() if isinstance(data, str) else data
    found[".ply2"] = ball.export(file_type="ply", encoding="ascii")
    stream = io.BytesIO()
    np.savez(stream, vertices_m=ball.vertices, faces=ball.faces)
    return {**found, ".npz": stream.getvalue()}


def test_scenes(tmp_path: Path) -> None:
    good = scenes()

    def check(drawn: tuple[str, list[tuple[float, int, bytes]]]) -> None:
        suffix, edits = drawn
        path = tmp_path / f"scene{suffix.removesuffix('2')}"
        path.write_bytes(bent(good[suffix], edits))
        roots_m = np.array([[0.0, 0.9, 0.0], [0.0, 0.9, 1.0]])
        only_own_errors(lambda: geometry_of(read_scene(path).parts, roots_m), drawn)

    fuzz(st.tuples(st.sampled_from(sorted(good)), EDITS), check)


def test_motion_archives(tmp_path: Path) -> None:
    path = walk_archive(tmp_path / "c.npz", 12)
    with np.load(path, allow_pickle=False) as file:
        tables = {name: file[name] for name in file.files}

    def read() -> None:
        archive = MotionArchive.read(path)
        for name in archive.names:
            retarget(archive.clip(name), adult_body())

    def check(drawn: tuple[str, int, Any]) -> None:
        name, row, value = drawn
        array = tables[name].copy()
        try:
            with np.errstate(all="ignore"):
                array.reshape(-1)[row % max(1, array.size)] = value
        except (ValueError, TypeError, OverflowError, IndexError):
            array = np.asarray(str(value))
        np.savez(path, **{**tables, name: array})
        only_own_errors(read, drawn)

    fuzz(st.tuples(st.sampled_from(sorted(tables)), st.integers(0, 500), NUMBERS), check)


ASF = """:version 1.10
:name walker
:units
 mass 1.0
 length 0.45
 angle deg
:root
 order TX TY TZ RX RY RZ
 axis XYZ
 position 0 0 0
 orientation 0 0 0
:bonedata
 begin
 id 1
 name lfemur
 direction 0.3 -0.9 0
 length 7
 axis 0 0 20 XYZ
 dof rx ry rz
 end
:hierarchy
 begin
 root lfemur
 end
"""
AMC = ":DEGREES\n1\nroot 0 17 0 0 0 0\nlfemur 1 2 3\n2\nroot 0 17 0 0 0 0\nlfemur 1 2 3\n"


def test_asf_and_amc(tmp_path: Path) -> None:
    amc, asf = tmp_path / "1_1.amc", tmp_path / "1.asf"

    def check(drawn: tuple[bool, list[tuple[float, str]]]) -> None:
        texts = [ASF, AMC]
        words = texts[drawn[0]].split(" ")
        for place, word in drawn[1]:
            words[int(place * len(words))] = word
        texts[drawn[0]] = " ".join(words)
        asf.write_text(texts[0])
        amc.write_text(texts[1])
        only_own_errors(lambda: read_clips(amc), drawn)

    fuzz(st.tuples(st.booleans(), st.lists(st.tuples(st.floats(0, 1, exclude_max=True), WORDS), max_size=4)), check)


def test_training_settings() -> None:
    names = st.sampled_from(sorted(TrainConfig().to_json()))
    only = st.one_of(VALUES, st.dictionaries(st.sampled_from(["size", "width", "heads", "form"]), VALUES, max_size=2))
    fuzz(
        st.dictionaries(names, only, min_size=1, max_size=3),
        lambda values: only_own_errors(lambda: TrainConfig.from_json(values), values),
    )
