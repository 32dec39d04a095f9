"""Whatever lies in the folders that are compared, or is asked for: one line and the documented exit code, soon."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command import Answer, video2anim
from tiny_truth import CLIP, FRAMES, STAGES, TABLE_ID

from video2anim.artifacts.folder import folder_digest
from video2anim.errors import ArtifactError, Video2AnimError
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.true_scene import read_glb
from video2anim.lab.eval.truth import read_truth
from video2anim.types import VideoClip

Damage = Callable[[Path], Any]


def _replaced(path: Path, make: Callable[[Path], Any]) -> None:
    path.unlink()
    make(path)


SPOILS: dict[str, Damage] = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "garbled": lambda path: path.write_bytes(np.random.default_rng(0).bytes(5000)),
    "zeros inside": lambda path: path.write_bytes(path.read_bytes()[:60] + bytes(path.stat().st_size - 60)),
    "no UTF-8": lambda path: path.write_bytes(b'{"name": "\xff\xfe"}'),
    "deep": lambda path: path.write_text("[" * 200_000),
    "a list": lambda path: path.write_text("[]"),
    "a folder": lambda path: _replaced(path, Path.mkdir),
    "a pipe": lambda path: _replaced(path, os.mkfifo),
    "a device": lambda path: _replaced(path, lambda path: path.symlink_to("/dev/zero")),
    "a circle": lambda path: _replaced(path, lambda path: path.symlink_to(path.name)),
}
"""Of a file, whatever it should hold."""


def meta(**changes: Any) -> Damage:
    """Entries of `meta.json` changed, or taken out by None."""

    def damage(folder: Path) -> None:
        path = folder / "meta.json"
        entries = json.loads(path.read_text()) | changes
        path.write_text(json.dumps({key: value for key, value in entries.items() if value is not None}))

    return damage


def obj(**changes: Any) -> Damage:
    """The same of one object in it."""

    def damage(folder: Path) -> None:
        objects = json.loads((folder / "meta.json").read_text())["objects"]
        objects[2] = {key: value for key, value in (objects[2] | changes).items() if value is not ...}
        meta(objects=objects)(folder)

    return damage


def arrays(name: str = "truth.npz", **changes: Callable[[np.ndarray], Any] | None) -> Damage:
    """Arrays of an archive changed, or taken out by None."""

    def damage(folder: Path) -> None:
        with np.load(folder / name, allow_pickle=False) as archive:
            found = dict(archive)
        found = {key: changes.get(key, lambda same: same) and changes.get(key, lambda same: same)(found[key])
                 for key in found if changes.get(key, ...) is not None}  # fmt: skip
        np.savez(folder / name, **found)

    return damage


def at(*place: Any, value: Any) -> Callable[[np.ndarray], np.ndarray]:
    """An array with another value in one place."""

    def edit(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array[place] = value
        return array

    return edit


EYE = np.eye(4)
WRONG: dict[str, tuple[Damage, str]] = {
    "version": (meta(format_version=99), "format_version: input should be 1, got 99"),
    "no version": (meta(format_version=None), "format_version"),
    "fps 0": (meta(fps=0), "fps: input should be greater"),
    "fps -30": (meta(fps=-30), "fps: input should be greater"),
    "fps 1e300": (meta(fps=1e300), "fps: input should be less"),
    "fps NaN": (meta(fps=float("nan")), "fps"),
    "fps text": (meta(fps="30"), "fps: input should be a valid number"),
    "fps list": (meta(fps=[30]), "fps"),
    "fps true": (meta(fps=True), "fps"),
    "nobody": (meta(persons=[]), "persons"),
    "persons text": (meta(persons="two"), "persons"),
    "person negative": (meta(persons=[{"person_id": -1}]), "persons.0.person_id"),
    "person huge": (meta(persons=[{"person_id": 10**30}]), "persons"),
    "a stranger": (meta(persons=[{"person_id": 5}]), "persons: want [0], got [5]"),
    "person without motion": (meta(persons=[{"person_id": 0}, {"person_id": 1}]), "truth_1.npz"),
    "twice": (meta(persons=[{"person_id": 0}, {"person_id": 0}]), "truth_0.npz"),
    "room huge": (meta(room={"bounds_m": [-1e300, 1, -1, 1]}), "room.bounds_m.0"),
    "body huge": (arrays(rest_joints_m=lambda a: 1e200 * a), "points within 10 km"),
    "frames": (meta(frames=FRAMES + 1), f"({FRAMES + 1},), got ({FRAMES},)"),
    "no frames": (meta(frames=None), "frames"),
    "objects object": (meta(objects={}), "objects"),
    "room text": (meta(room={"bounds_m": "wide"}), "room.bounds_m"),
    "room short": (meta(room={"bounds_m": [0, 1, 2]}), "room.bounds_m.3"),
    "room endless": (meta(room={"bounds_m": [-1, float("inf"), -1, 1]}), "room.bounds_m.1"),
    "name number": (meta(name=3), "name: input should be a valid string"),
    "pose gone": (obj(T_world_object=...), "T_world_object"),
    "pose text": (obj(T_world_object="here"), "T_world_object"),
    "pose flat": (obj(T_world_object=EYE.ravel().tolist()), "T_world_object"),
    "pose NaN": (obj(T_world_object=(EYE * np.nan).tolist()), "T_world_object.0.0: input should be a finite number"),
    "pose mirrored": (obj(T_world_object=np.diag([-1.0, 1, 1, 1]).tolist()), f"object {TABLE_ID}: want rigid"),
    "pose scaled": (obj(T_world_object=np.diag([2.0, 2, 2, 1]).tolist()), "want rigid transforms"),
    "pose far": (obj(T_world_object=(EYE + 1e300 * np.eye(4, k=3)).tolist()), "want rigid transforms"),
    "file outside": (obj(file="../../clip/meta.json"), "want files inside"),
    "file absolute": (obj(file="/etc/passwd"), "want files inside"),
    "file NUL": (obj(file="a\0b"), "want the name of a file"),
    "file long": (obj(file="a" * 5000), "want the name of a file"),
    "label number": (obj(label=7), "objects.2.label"),
    "no instance": (arrays(instance=None), "want key instance"),
    "no motion": (arrays(R_parent_joint=None), "want key R_parent_joint"),
    "maps cut": (arrays(depth_mm=lambda a: a[:-1]), "depth_mm: want shape"),
    "maps narrow": (arrays(instance=lambda a: a[..., :-1]), "instance: want shape"),
    "maps of fractions": (arrays(instance=lambda a: a.astype(float)), "instance: want uint16"),
    "maps of text": (arrays(instance=lambda a: a.astype(str)), "instance: want uint16"),
    "maps pickled": (arrays(instance=lambda a: a.astype(object)), "truth.npz is damaged"),
    "maps late": (arrays(label_frame_index=lambda a: a + FRAMES), "label_frame_index"),
    "maps before": (arrays(label_frame_index=lambda a: a - 1), "label_frame_index"),
    "maps endless": (arrays(label_frame_index=at(-1, value=2**62)), "label_frame_index"),
    "no background": (arrays(background_depth_mm=lambda a: a[:0]), "background_depth_mm"),
    "empty background": (arrays(background_depth_mm=np.zeros_like), "background_depth_mm"),
    "no pixel": (arrays(depth_mm=lambda a: a[:, :0]), "depth_mm: want at least one"),
    "outlines cut": (arrays(amodal=lambda a: a[:-1]), "amodal"),
    "counts cut": (arrays(object_visible_px=lambda a: a[:-1]), "object_visible_px"),
    "boxes of two": (arrays(person_box_px=lambda a: np.tile(a, (2, 1, 1))), "person_box_px: want shape (1"),
    "up NaN": (arrays(up_camera=at(3, value=np.nan)), "up_camera: want finite numbers"),
    "up long": (arrays(up_camera=at(3, value=9.0)), "up_camera: want vectors of length 1, got something else at [3]"),
    "static text": (arrays(is_static=lambda a: np.array("yes")), "is_static: want bool"),
    "camera mirrored": (arrays(T_world_camera=lambda a: a @ np.diag([-1.0, 1, 1, 1])), "T_world_camera: want rigid"),
    "joints scaled": (arrays(R_parent_joint=lambda a: 1.1 * a), "R_parent_joint: want rotation"),
    "times still": (arrays(frame_time_s=np.zeros_like), "frame_time_s: want numbers that rise"),
    "lens negative": (arrays(intrinsics=at(0, value=-300.0)), "intrinsics.fx_px"),
    "no frame at all": (arrays(**dict.fromkeys(("frame_time_s", "valid"), lambda a: a[:0])), "frame_time_s"),
}  # fmt: skip
"""Damage to a truth folder, and what is said of it."""


@pytest.fixture
def truth(tmp_path: Path, truth_dir: Path) -> Path:
    return Path(shutil.copytree(truth_dir, tmp_path / "clip"))


@pytest.fixture
def scene(tmp_path: Path, scene_dir: Path) -> Path:
    return Path(shutil.copytree(scene_dir, tmp_path / "scene"))


def expect_one_line(answer: Answer, code: int, *said: str) -> None:
    assert answer.code == code, answer
    assert len(answer.err.splitlines()) == 1, answer.err
    for part in ("video2anim: ", *said):
        assert part in answer.err


def expect_refused(work: Callable[[], Any], code: int, *said: str) -> None:
    """What the command line prints in one line."""
    with pytest.raises(Video2AnimError) as caught:
        work()
    assert caught.value.exit_code == code
    text = str(caught.value)
    assert len(text) < 600
    assert "\n" not in text
    for part in said:
        assert part in text


@pytest.mark.parametrize("spoil", SPOILS)
def test_a_damaged_file_of_the_truth(truth: Path, spoil: str) -> None:
    mesh = truth / "objects" / f"{TABLE_ID}.glb"
    SPOILS[spoil](mesh)
    expect_refused(lambda: read_glb(mesh), 3, str(mesh))
    for name in ("truth.npz", "meta.json"):
        SPOILS[spoil](truth / name)
        expect_refused(lambda: read_truth(truth), 3, str(truth / name), "make the clip again")


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_value_of_the_truth(truth: Path, case: str) -> None:
    damage, said = WRONG[case]
    damage(truth)
    expect_refused(lambda: read_truth(truth), 3, said, str(truth), "make the clip again")


@pytest.mark.parametrize("spoil", SPOILS)
def test_a_damaged_background_image_has_a_reason(truth: Path, spoil: str) -> None:
    SPOILS[spoil](truth / "plate.png")
    with pytest.raises(ArtifactError, match=r"plate\.png"):
        _ = read_truth(truth).background_rgb


@pytest.mark.parametrize("image", [np.zeros((2, 2, 3)), np.zeros((CLIP[1], CLIP[0], 4)), np.zeros((9, 9))])
def test_a_background_image_of_another_size_or_with_holes_has_a_reason(truth: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(truth / "plate.png"), image.astype(np.uint8))
    with pytest.raises(ArtifactError, match=r"plate\.png: want"):
        _ = read_truth(truth).background_rgb


@pytest.mark.parametrize("spoil", SPOILS)
def test_a_damaged_scene_folder(scene: Path, spoil: str) -> None:
    """What no number can be had without: the first stage, and the record."""
    for name in ("arrays.npz", "value.json", "manifest.json"):
        SPOILS[spoil](scene / "stages" / STAGES[VideoClip] / name)
        expect_refused(lambda: SceneResult(scene), 3, "stage ingest is unreadable", name)
    SPOILS[spoil](scene / "run.json")
    code = 3 if spoil in ("missing", "a folder", "a pipe", "a device", "a circle") else 5
    expect_refused(lambda: SceneResult(scene), code, "run.json", str(scene))


def test_every_other_stage_damaged(scene: Path, truth_dir: Path, tmp_path: Path) -> None:
    """One eval for all: each stage in a way of its own."""
    ways = [way for way in SPOILS if way != "missing"]
    for number, kind in enumerate(kind for kind in STAGES if kind is not VideoClip):
        files = sorted(path for path in (scene / "stages" / STAGES[kind]).iterdir() if path.suffix in (".npz", ".png"))
        SPOILS[ways[number % len(ways)]](files[0])
    answer = video2anim("eval", scene, "--truth", truth_dir, "--json", tmp_path / "all.json")
    assert (answer.code, answer.err) == (0, "")
    groups = json.loads((tmp_path / "all.json").read_text())["groups"]
    rows = [row for group in groups if group["key"] != "ingest" for row in group["rows"]]
    assert all(quality["value"] is None for row in rows for quality in row["qualities"])
    assert answer.out.count("is unreadable") >= len(STAGES) - 1


def test_missing_folders_and_names_nobody_can_mean(tmp_path: Path, truth_dir: Path, scene_dir: Path) -> None:
    (tmp_path / "file").touch()
    for odd in (tmp_path / "nowhere", tmp_path / "file", tmp_path / ("x" * 300), "/dev/null", tmp_path):
        expect_one_line(video2anim("eval", scene_dir, "--truth", odd), 3, "truth")
        expect_one_line(video2anim("eval", odd, "--truth", truth_dir), 3, "want a scene folder")
        expect_one_line(video2anim("eval-set", odd, "--truth", truth_dir.parent), 3)
        expect_one_line(video2anim("eval-set", scene_dir.parent, "--truth", odd), 3)


def test_outputs_that_cannot_be_written(tmp_path: Path, truth_dir: Path, scene_dir: Path) -> None:
    """Refused before the work; what is there stays."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "to_device").symlink_to("/dev/null")
    (tmp_path / "circle").symlink_to("circle")
    before = folder_digest(truth_dir), folder_digest(scene_dir), sorted(tmp_path.iterdir())
    odd = [tmp_path, tmp_path / "no" / "x.json", tmp_path / "pipe", tmp_path / "to_device", tmp_path / "circle",
           tmp_path / ("x" * 300), "/proc/x.json", scene_dir / "run.json" / "x"]  # fmt: skip
    for option in ("--json", "--html"):
        for path in odd:
            expect_one_line(video2anim("eval", scene_dir, "--truth", truth_dir, option, path), 3, "want a file")
            words = ("eval-set", scene_dir.parent, "--truth", truth_dir.parent, option, path)
            expect_one_line(video2anim(*words), 3, "want a file")
    same = tmp_path / "both"
    expect_one_line(video2anim("eval", scene_dir, "--truth", truth_dir, "--json", same, "--html", same), 2, "--html")
    assert before == (folder_digest(truth_dir), folder_digest(scene_dir), sorted(tmp_path.iterdir()))
