"""Pictures without a window, and what the viewer says when something is missing."""

from __future__ import annotations

import importlib
import importlib.util
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest
from walk_scene import room, room_with_carried_box, walk

from video2anim.errors import InputError, UsageError
from video2anim.geometry.projection import project
from video2anim.types import BodyMotion, Mesh, RoomPiece, SceneModel
from video2anim.viewer import SceneView, screenshot, view
from video2anim.viewer.drawing import draw_static, world_vertices
from video2anim.viewer.raster import Canvas
from video2anim.viewer.software import oblique_viewpoint

FRAMES = 10


@pytest.fixture(scope="module")
def scene_view() -> SceneView:
    motion = walk(FRAMES)
    moved = motion.with_pose(
        translation_world_m=motion.T_world_root[:, :3, 3] + [0, 0, -1.0], R_parent_joint=motion.R_parent_joint
    )
    return SceneView({"raw": (moved,), "refined": (motion,)}, room())


def test_software_picture_shows_body_and_box(scene_view: SceneView, tmp_path: Path) -> None:
    screenshot(scene_view, 4, tmp_path / "shot.png", width_px=480, height_px=270)
    picture = cv2.imread(str(tmp_path / "shot.png"))
    assert picture.shape == (270, 480, 3)
    motion = scene_view.motions["refined"][0]
    viewpoint = oblique_viewpoint((motion,), scene_view.scene, 480, 270)
    joints_px = project(viewpoint.to_camera(motion.joints_world_m[4]), viewpoint.intrinsics)
    column, row = np.rint(joints_px).astype(int).T
    empty = Canvas.blank(480, 270)
    draw_static(empty, viewpoint, scene_view.scene, background=True, objects=True, frame=4)
    changed = np.abs(picture[..., ::-1].astype(int) - empty.rgb).max(-1) > 20
    _, part = cv2.connectedComponents(changed.astype(np.uint8))
    body = changed & (part == part[row[0], column[0]])
    assert body[row, column].mean() > 0.9, "the body is drawn over its joints"
    rows, columns = np.nonzero(body)
    assert np.ptp(rows) == pytest.approx(np.ptp(joints_px[:, 1]), rel=0.3), "and is not larger"
    assert np.ptp(columns) < np.ptp(rows)
    (placed,) = scene_view.scene.objects
    center_px = project(viewpoint.to_camera(world_vertices(placed, 4).mean(0)[None]), viewpoint.intrinsics)[0, ::-1]
    np.testing.assert_allclose(blue_pixels(picture).mean(0), center_px, atol=8)


def blue_pixels(picture_bgr: np.ndarray) -> np.ndarray:
    """Of the box, by row and column."""
    picture = picture_bgr.astype(int)
    return np.argwhere(picture[..., 0] - picture[..., 2] > 60)


def expected_px(people: tuple[BodyMotion, ...], scene: SceneModel, frame: int) -> np.ndarray:
    """Where the middle of the box is in the picture of a frame, row and column."""
    (placed,) = scene.objects
    viewpoint = oblique_viewpoint(people, scene, 480, 270)
    center_m = world_vertices(placed, frame).mean(0)
    return project(viewpoint.to_camera(center_m[None]), viewpoint.intrinsics)[0, ::-1]


def test_a_carried_box_is_drawn_where_it_is_in_each_frame(tmp_path: Path) -> None:
    people, scene = (walk(24, side_m=-1.0),), room_with_carried_box(24)
    shown, found = SceneView({"refined": people}, scene), []
    for frame in (2, 12, 22):
        screenshot(shown, frame, tmp_path / "shot.png", width_px=480, height_px=270)
        found.append(blue_pixels(cv2.imread(str(tmp_path / "shot.png"))))
        # The middle of what is seen of a box is not quite its own.
        np.testing.assert_allclose(found[-1].mean(0), expected_px(people, scene, frame), atol=8)
    assert np.linalg.norm(found[0].mean(0) - found[2].mean(0)) > 50


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Triangles of a grid of vertices; with x along columns and z along rows they face +y."""
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, :-1].ravel(), corner[1:, 1:].ravel()
    return np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])


def test_the_shadow_goes_with_the_carried_box() -> None:
    people, scene = (walk(24),), room_with_carried_box(24)
    x, z = np.meshgrid(np.linspace(-2, 2, 81), np.linspace(-2, 2, 81))
    cells_m = np.stack([x, 0 * x, z], -1).reshape(-1, 3)
    floor = RoomPiece("floor", Mesh(cells_m, grid_faces(81, 81), np.full(cells_m.shape, 200, np.uint8)))
    viewpoint = oblique_viewpoint(people, scene, 480, 270)
    (placed,) = scene.objects
    corners_m = [world_vertices(placed, frame) for frame in (0, 23)]
    beside_m = np.stack([[*one[one[:, 2].argmax(), [0]], 0.0, one[:, 2].max() + 0.03] for one in corners_m])
    column, row = np.rint(project(viewpoint.to_camera(beside_m), viewpoint.intrinsics)).astype(int).T
    light = []
    for frame in (0, 23):
        canvas = Canvas.blank(480, 270)
        draw_static(canvas, viewpoint, replace(scene, floor=floor), background=False, objects=True, frame=frame)
        light.append(canvas.rgb[row, column].mean(-1))
    assert light[0][0] < 198
    assert light[1][1] < 198
    assert light[0][1] == light[1][0] == 200, "there is none where the box is not"


def test_the_grid_of_a_huge_floor_fits_in_memory() -> None:
    """A path that drifts: a line every meter of 100 km would be cut into 10^11 pieces."""
    people, scene = (walk(24),), room_with_carried_box(24)
    x, z = np.meshgrid(np.linspace(-5e4, 5e4, 61), np.linspace(-5e4, 5e4, 61))
    corners_m = np.stack([x, 0 * x, z], -1).reshape(-1, 3)
    floor = RoomPiece("floor", Mesh(corners_m, grid_faces(61, 61), np.full(corners_m.shape, 200, np.uint8)))
    canvas = Canvas.blank(480, 270)
    viewpoint = oblique_viewpoint(people, scene, 480, 270)
    draw_static(canvas, viewpoint, replace(scene, floor=floor), background=False, objects=False)
    assert (canvas.rgb == 200).all(-1).any()


def test_the_window_moves_the_carried_box(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in for open3d, which needs a display."""

    class Triangles(SimpleNamespace):
        def compute_vertex_normals(self) -> None: ...

    library = MagicMock()
    library.utility.Vector3dVector = library.utility.Vector3iVector = np.array
    library.geometry.TriangleMesh = lambda vertices, triangles: Triangles(vertices=vertices, triangles=triangles)
    monkeypatch.setitem(sys.modules, "open3d", library)
    for module in ("geometry3d", "window"):
        monkeypatch.delitem(sys.modules, f"video2anim.viewer.{module}", raising=False)
    window = importlib.import_module("video2anim.viewer.window")
    scene, visualizer = room_with_carried_box(24), MagicMock()
    player = window.Player(visualizer, SceneView({"refined": (walk(24),)}, scene), 3)
    (box,), (placed,) = player.parts["objects"], scene.objects
    for frame in (12, 20, 0):
        visualizer.update_geometry.reset_mock()
        player.show(frame)
        np.testing.assert_allclose(box.vertices, world_vertices(placed, frame), atol=1e-6)
        assert any(call.args[0] is box for call in visualizer.update_geometry.call_args_list)
    player.toggle("objects")
    visualizer.update_geometry.reset_mock()
    player.show(12)
    assert not any(call.args[0] is box for call in visualizer.update_geometry.call_args_list), "it is hidden"
    np.testing.assert_allclose(box.vertices, world_vertices(placed, 12), atol=1e-6)
    for module in ("geometry3d", "window"):
        sys.modules.pop(f"video2anim.viewer.{module}")


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
