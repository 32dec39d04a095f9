"""Pictures without a window, and what the viewer says when something is missing."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from walk_scene import room, walk

from video2anim.errors import InputError, UsageError
from video2anim.viewer import SceneView, screenshot, view

FRAMES = 10


@pytest.fixture(scope="module")
def scene_view() -> SceneView:
    motion = walk(FRAMES)
    moved = motion.with_pose(
        translation_world_m=motion.T_world_root[:, :3, 3] + [0, 0, -1.0], R_parent_joint=motion.R_parent_joint
    )
    return SceneView({"raw": (moved,), "refined": (motion,)}, room())


def skin_share(picture_bgr: np.ndarray) -> float:
    picture = picture_bgr.astype(int)
    return float((picture[..., 2] - picture[..., 0] > 35).mean())


def test_software_picture_shows_body_and_box(scene_view: SceneView, tmp_path: Path) -> None:
    screenshot(scene_view, 4, tmp_path / "shot.png", width_px=480, height_px=270)
    picture = cv2.imread(str(tmp_path / "shot.png"))
    assert picture.shape == (270, 480, 3)
    assert skin_share(picture) > 0.005
    blue = picture[..., 0].astype(int) - picture[..., 2] > 60
    assert blue.mean() > 0.005


def test_stages_differ(scene_view: SceneView, tmp_path: Path) -> None:
    pictures = []
    for stage in ("raw", "refined", None):
        screenshot(scene_view, 4, tmp_path / "shot.png", stage=stage, width_px=240, height_px=136)
        pictures.append(cv2.imread(str(tmp_path / "shot.png")))
    assert np.abs(pictures[0].astype(int) - pictures[1]).max() > 20
    np.testing.assert_array_equal(pictures[1], pictures[2])


@pytest.mark.parametrize(
    ("frame", "stage", "message"),
    [(FRAMES, None, f"want 0 to {FRAMES - 1}, got {FRAMES}"), (-1, None, "got -1"), (0, "keyframes", "raw, refined")],
)
def test_wrong_requests_are_refused(
    scene_view: SceneView, tmp_path: Path, frame: int, stage: str | None, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        screenshot(scene_view, frame, tmp_path / "shot.png", stage=stage)


def test_a_picture_is_a_png(scene_view: SceneView, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"ends in \.png, got .*shot\.jpg"):
        screenshot(scene_view, 0, tmp_path / "shot.jpg")


def test_unwritable_picture_is_an_input_error(scene_view: SceneView, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot write picture"):
        screenshot(scene_view, 0, tmp_path / "absent" / "shot.png", width_px=64, height_px=36)


def test_missing_open3d_names_what_to_install(scene_view: SceneView, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    for module in ("geometry3d", "window"):
        monkeypatch.delitem(sys.modules, f"video2anim.viewer.{module}", raising=False)
    with pytest.raises(UsageError, match=r"libusb-1\.0-0 libgl1 libegl1 libgomp1"):
        view(scene_view)


def test_missing_display_names_xvfb(scene_view: SceneView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    with pytest.raises(UsageError, match="apt-get install xvfb"):
        screenshot(scene_view, 0, tmp_path / "shot.png", renderer="open3d")


@pytest.mark.skipif(
    importlib.util.find_spec("open3d") is None or shutil.which("Xvfb") is None, reason="open3d or Xvfb not installed"
)
def test_open3d_draws_the_same_scene(scene_view: SceneView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The two renderers share the view, so silhouettes of the body agree."""
    monkeypatch.delenv("DISPLAY", raising=False)
    masks = []
    for renderer in ("software", "open3d"):
        out = tmp_path / f"{renderer}.png"
        try:
            screenshot(scene_view, 4, out, renderer=renderer, width_px=480, height_px=270)
        except UsageError as error:
            if "libGL" in str(error) or "libusb" in str(error) or "system libraries" in str(error):
                pytest.skip(str(error))
            raise
        picture = cv2.imread(str(out)).astype(int)
        masks.append(picture[..., 0] - picture[..., 2] > 40)
    assert (masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum() > 0.9


def test_a_window_without_a_display_is_one_line(scene_view: SceneView, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "video2anim.viewer.window", SimpleNamespace(run_window=None))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(UsageError, match="--screenshot"):
        view(scene_view)
