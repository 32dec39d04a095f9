"""Files changed at random: readers take them or refuse them with an error of the project's own, in bounded memory.

`VIDEO2ANIM_FUZZ_EXAMPLES` sets how many files each test tries (CI: a few seconds).
"""

from __future__ import annotations

import functools
import json
import os
import tempfile
import tracemalloc
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from trimesh.exchange.gltf import export_gltf
from walk_scene import room, walk

from video2anim.artifacts.codec import read_value, write_value
from video2anim.artifacts.folder import value_digest
from video2anim.artifacts.images import read_picture
from video2anim.artifacts.manifest import Manifest, read_manifest
from video2anim.artifacts.motion_io import read_motion
from video2anim.artifacts.user_files import content_digest, read_mesh_file
from video2anim.errors import ArtifactError, InputError
from video2anim.mesh_file import MESH_SUFFIXES
from video2anim.types import (
    BodyTracks,
    InstanceMasks,
    KeyframedMotion,
    ObjectInstance,
    PersonQuality,
    SceneModel,
)
from video2anim.types.motion_arrays import motion_arrays
from video2anim.types.quality import Quality

EXAMPLES = int(os.environ.get("VIDEO2ANIM_FUZZ_EXAMPLES", "15"))
MAX_BYTES = 64 << 20
"""Of memory for files of some kilobytes."""
often = settings(
    max_examples=EXAMPLES, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)  # fmt: skip


def scene_value() -> SceneModel:
    return room()


def masks_value() -> InstanceMasks:
    mask = np.arange(120).reshape(10, 12) % 7 < 3
    return InstanceMasks("p", (ObjectInstance(1, "chair", 0.5, np.arange(4.0), mask),), ~mask)


def bodies_value() -> BodyTracks:
    return BodyTracks((walk(4), walk(4, 2)), (PersonQuality(2.5, 0.01, 160.0, 0.1, 0.04, 1.0, 1.55, 0.0),) * 2)


def keyframed_value() -> KeyframedMotion:
    return KeyframedMotion((walk(4),), (np.array([0, 2]),))


VALUES: dict[type, Callable[[], Any]] = {
    SceneModel: scene_value,
    InstanceMasks: masks_value,
    BodyTracks: bodies_value,
    KeyframedMotion: keyframed_value,
}


@functools.cache
def files_of(kind: type) -> dict[str, bytes]:
    """The files of a sound stage folder."""
    with tempfile.TemporaryDirectory() as name:
        write_value(VALUES[kind](), Path(name))
        return {path.name: path.read_bytes() for path in sorted(Path(name).iterdir())}


@functools.cache
def mesh_bytes(suffix: str) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / f"box{suffix}"
        if suffix == ".gltf":  # trimesh leaves the file open
            return export_gltf(trimesh.Scene(trimesh.creation.box()), embed_buffers=True)["model.gltf"]
        trimesh.creation.box().export(path)
        return path.read_bytes()


def survives(read: Callable[[], object]) -> bool:
    """Whether a file was taken; anything but a refusal or an answer in bounded memory fails."""
    refusal = ""
    tracemalloc.start()
    try:
        read()
    except (ArtifactError, InputError) as error:
        refusal = str(error) or "no message\n"
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < MAX_BYTES
    assert "\n" not in refusal
    assert len(refusal) < 2000
    return not refusal


SPECIAL = st.sampled_from(
    [b"\0", b"\xff" * 4, b"\x7f\xff\xff\xff", b"\n", b"-1", b"nan", b"1e309", b"9" * 30, b"PK\x01\x02"]
)


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """Bytes with some places overwritten, taken out, doubled or cut off."""
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        # The beginning and the end, with headers and tables, are where the readers decide.
        at = draw(st.sampled_from([at, at % 256, max(len(data) - 1 - at % 256, 0)]))
        piece = draw(st.one_of(SPECIAL, st.binary(min_size=1, max_size=8)))
        length = draw(st.integers(0, 64))
        data = draw(
            st.sampled_from(
                [
                    data[:at] + piece + data[at + len(piece) :],
                    data[:at] + piece + data[at:],
                    data[:at] + data[at + length :],
                    data[: at + length] + data[at:],
                    data[:at],
                ]
            )
        )
    return data


SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=20), st.just({}), st.just([]),
    st.sampled_from(["../x", "/dev/zero", "motion.npz", "arrays.npz", "value.json", 10**400, -1, 0, "a\0b"]),
)  # fmt: skip
TREES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
)
NEW = st.one_of(
    TREES,
    st.builds(
        lambda kind, name: {kind: name}, st.sampled_from(["$file", "$array", "$mesh", "$motion", "$image"]), SCALARS
    ),
)


def spots(tree: Any) -> list[tuple[Any, Any]]:
    """Every place in a document: its holder and key."""
    keys = list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else []
    return [spot for key in keys for spot in ((tree, key), *spots(tree[key]))]


@pytest.mark.parametrize("kind", VALUES)
@given(data=st.data())
@often
def test_stage_folders_with_damaged_files(kind: type, data: st.DataObject) -> None:
    files = files_of(kind)
    name = data.draw(st.sampled_from(sorted(files)))
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / "stages" / "01_x"
        folder.mkdir(parents=True)
        for other, content in files.items():
            (folder / other).write_bytes(content)
        (folder / name).write_bytes(data.draw(damaged(files[name])))
        survives(lambda: read_value(kind, folder))
        assert len(value_digest(folder)) == 64


@pytest.mark.parametrize("kind", VALUES)
@given(data=st.data())
@often
def test_stage_folders_with_other_fields(kind: type, data: st.DataObject) -> None:
    files = files_of(kind)
    document = json.loads(files["value.json"])
    for _ in range(data.draw(st.integers(1, 2))):
        holder, key = data.draw(st.sampled_from(range(len(spots(document))))), data.draw(NEW)
        where, at = spots(document)[holder]
        where[at] = key
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / "stages" / "01_x"
        folder.mkdir(parents=True)
        for other, content in files.items():
            (folder / other).write_bytes(content)
        (folder / "value.json").write_text(json.dumps(document))
        survives(lambda: read_value(kind, folder))
        assert len(value_digest(folder)) == 64


DTYPES = st.sampled_from(
    ["f2", "f4", "f8", ">f8", "g", "c16", "i1", "i8", "u8", "?", "U3", "S3", "M8[s]", "m8[s]", "V8", "f8,i4"]
)


@given(data=st.data())
@often
def test_motions_with_other_arrays(data: st.DataObject) -> None:
    arrays = motion_arrays(walk(3))
    for _ in range(data.draw(st.integers(1, 3))):
        key = data.draw(st.sampled_from(sorted(arrays)))
        same = data.draw(st.booleans())
        shape = arrays[key].shape if same else tuple(data.draw(st.lists(st.integers(0, 30), max_size=4)))
        raw = data.draw(st.binary(min_size=1, max_size=64))
        dtype = np.dtype(data.draw(DTYPES))
        count = int(np.prod(shape)) * dtype.itemsize
        arrays[key] = np.frombuffer((raw * (count // len(raw) + 1))[:count], dtype).reshape(shape)
    with tempfile.TemporaryDirectory() as root:
        np.savez(Path(root) / "m.npz", allow_pickle=False, **arrays)
        survives(lambda: read_motion(Path(root) / "m.npz"))


MANIFEST = Manifest("a", 1, "k", {"x": [1, {"y": None}]}, {"A": "d"}, {}, 0, "o", 0.5, 9.0,
                    [asdict(Quality("q", 1.0, "m"))], ["w"], {"numpy": "2"})  # fmt: skip


@given(data=st.data())
@often
def test_manifests(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as root:
        MANIFEST.write(Path(root))
        path = Path(root) / "manifest.json"
        document = json.loads(path.read_text())
        where, at = spots(document)[data.draw(st.integers(0, len(spots(document)) - 1))]
        where[at] = data.draw(TREES)
        whole = json.dumps(document).encode()
        path.write_bytes(data.draw(st.one_of(st.just(whole), damaged(whole))))
        survives(lambda: read_manifest(Path(root)))


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
@given(data=st.data())
@often
def test_meshes_that_users_bring(suffix: str, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as root:
        path = Path(root) / f"m{suffix}"
        path.write_bytes(data.draw(damaged(mesh_bytes(suffix))))
        survives(lambda: read_mesh_file(path))
        survives(lambda: content_digest(path))


@given(data=st.data())
@often
def test_photographs(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as root:
        path = Path(root) / "p.png"
        path.write_bytes(data.draw(damaged(files_of(InstanceMasks)["floor_mask.png"])))
        survives(lambda: read_picture(path))


@pytest.mark.parametrize("kind", VALUES)
def test_what_is_not_changed_is_taken(kind: type, tmp_path: Path) -> None:
    for name, content in files_of(kind).items():
        (tmp_path / name).write_bytes(content)
    assert survives(lambda: read_value(kind, tmp_path))
