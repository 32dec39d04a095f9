"""The export stage: which files it leaves, what it says when a library is missing, and what the preview shows."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pygltflib
import pytest
from walk_scene import room, room_with_carried_box, walk

from stages.export import ExportConfig, _write_pictures, export_scene
from video2anim.artifacts.codec import read_value, write_value
from video2anim.artifacts.motion_io import read_motion
from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import posed_vertices
from video2anim.errors import UsageError
from video2anim.export import FORMATS, ExportScene, write_format
from video2anim.export.preview import hidden_share, moment_picture, overlay_frame, side_viewpoint, write_preview
from video2anim.geometry.projection import project
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    BodyTracks,
    ExportedFiles,
    PayloadFile,
    RefinedMotion,
    SourceVideo,
    VideoClip,
)
from video2anim.types.skeleton import JOINT_INDEX
from video2anim.viewer.drawing import world_vertices

FRAMES = 8
HEIGHT_M = 1.7
"""Of the walking body, from its soles to the top of its head."""


def run_stage(clip: VideoClip, folder: Path, config: ExportConfig) -> tuple[ExportedFiles, StageContext]:
    people = (walk(FRAMES), walk(FRAMES, 7, side_m=-1.0))
    ctx = StageContext(folder)
    exported = export_scene(
        SourceVideo(clip.video.path, ""), clip,
        BodyTracks(people), RefinedMotion(people, ("scenemi",) * 2, (1.0,) * 2, people, room()), config, ctx,
    )  # fmt: skip
    return exported, ctx


def test_stage_leaves_all_files(gray_clip: VideoClip, tmp_path: Path) -> None:
    exported, ctx = run_stage(gray_clip, tmp_path, ExportConfig(overlay_frames=2))
    names = {str(file.path.relative_to(tmp_path)) for file in exported.files}
    assert names >= {
        "motion.npz", "motion_7.npz", "scene.glb", "scene.usdc", "motion.bvh", "motion_7.bvh", "motion_amass.npz",
        "motion_amass_7.npz", "objects/3.glb", "preview.mp4",
    }  # fmt: skip
    assert sum(name.startswith("overlay_") for name in names) == 2
    assert any(name.startswith("worst_jerk-max_") for name in names)
    assert ctx.warnings == []
    assert read_motion(tmp_path / "motion_7.npz").person_id == 7


def test_stage_tells_who_touches_what(gray_clip: VideoClip, tmp_path: Path) -> None:
    """A foot that the motion says to touch, at the height of the floor: in the value and in the GLB."""
    people = (walk(FRAMES), walk(FRAMES, 7, side_m=-1.0))
    contact = np.zeros_like(people[1].contact)
    contact[:, JOINT_INDEX["left_foot"]] = 1.0
    body = shaped_body(people[1].shape)
    foot = np.flatnonzero(body.vertex_part == JOINT_INDEX["left_foot"])
    low_m = posed_vertices(people[1], body, foot, np.arange(FRAMES))[..., 1].min(1)
    root_m = people[1].T_world_root[:, :3, 3] - np.outer(low_m, [0.0, 1.0, 0.0])
    lower = people[1].with_pose(translation_world_m=root_m, R_parent_joint=people[1].R_parent_joint)
    people = (people[0], replace(lower, contact=contact))
    refined = RefinedMotion(people, ("none",) * 2, (0.0,) * 2, people, room())
    config = ExportConfig(formats=("glb",), preview=False, overlay_frames=0, worst_moments=False)
    made = export_scene(
        SourceVideo(gray_clip.video.path, ""), gray_clip, BodyTracks(people), refined, config, StageContext(tmp_path)
    )
    (found,) = made.contacts
    assert (found.person_id, found.body_part, found.object_id, found.surface) == (7, "left foot", None, "floor")
    write_value(made, tmp_path)
    assert read_value(ExportedFiles, tmp_path).contacts == made.contacts
    document = pygltflib.GLTF2.load_binary(str(tmp_path / "scene.glb"))
    (told,) = next(node for node in document.nodes if node.name == "person_7").extras["contacts"]
    assert told["body_part"] == "left foot"


def test_missing_usd_library_is_a_warning(
    gray_clip: VideoClip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    monkeypatch.delitem(sys.modules, "video2anim.export.usd", raising=False)
    exported, ctx = run_stage(gray_clip, tmp_path, ExportConfig(preview=False, overlay_frames=0))
    assert len(ctx.warnings) == 1
    assert "pip install usd-core" in ctx.warnings[0]
    assert not any(file.path.suffix == ".usdc" for file in exported.files)


def test_unknown_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"want one of glb, usd, bvh, amass, fbx, fbx-ready, got 'obj'"):
        write_format("obj", ExportScene((walk(4),), None), tmp_path)
    with pytest.raises(UsageError, match="no person"):
        write_format("glb", ExportScene((), None), tmp_path)


def test_fbx_ready_is_a_mixamo_named_character(tmp_path: Path) -> None:
    character, script = write_format("fbx-ready", ExportScene((walk(4),), room()), tmp_path)
    document = pygltflib.GLTF2.load_binary(str(character))
    names = {node.name for node in document.nodes}
    assert {"mixamorig:Hips", "mixamorig:LeftToeBase", "person_1_body"} <= names
    assert not document.cameras
    compile(script.read_text(), script.name, "exec")
    assert set(FORMATS) == {"glb", "usd", "bvh", "amass", "fbx", "fbx-ready"}


TONE_FROM_S, TONE_HZ, SOURCE_RATE_HZ = 0.2, 1000.0, 44_100


@pytest.fixture
def source_with_sound(tmp_path: Path) -> Path:
    """A file as a phone makes it, as far as sound goes: silence, and from 0.2 s on a tone."""
    path = tmp_path / "source.mov"
    time_s = np.arange(SOURCE_RATE_HZ) / SOURCE_RATE_HZ
    tone = np.where(time_s < TONE_FROM_S, 0.0, 0.5 * np.sin(2 * np.pi * TONE_HZ * time_s))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=SOURCE_RATE_HZ, layout="mono")
        frame = av.AudioFrame.from_ndarray(tone[None].astype(np.float32), format="fltp", layout="mono")
        frame.sample_rate, frame.pts = SOURCE_RATE_HZ, 0
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def test_preview_has_the_sound_of_its_pictures_and_plays_while_it_loads(
    gray_clip: VideoClip, source_with_sound: Path, tmp_path: Path
) -> None:
    start_s = 0.1
    clip = replace(gray_clip, source_time_s=gray_clip.frame_time_s + start_s)
    made = [tmp_path / "preview.mp4", tmp_path / "again.mp4"]
    for path in made:
        write_preview(path, clip, (walk(FRAMES),), room(), 360, sound_from=source_with_sound)
    with av.open(str(made[0])) as container:
        pieces = [piece.to_ndarray() for piece in container.decode(audio=0)]
        rate_hz = container.streams.audio[0].rate
    with av.open(str(made[0])) as container:
        assert sum(1 for _ in container.decode(video=0)) == FRAMES
    heard = np.concatenate(pieces, axis=1)[0]
    assert len(heard) / rate_hz == pytest.approx(FRAMES / 30, abs=1024 / rate_hz), "AAC comes in blocks of 1024"
    loud_from_s = np.flatnonzero(np.abs(heard) > 0.25)[0] / rate_hz
    assert loud_from_s == pytest.approx(TONE_FROM_S - start_s, abs=0.012), "half a block"
    content = made[0].read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat"), "the index comes first"
    assert content == made[1].read_bytes(), "the same pictures and sound are the same bytes"
    assert {path.name for path in tmp_path.iterdir()} == {"preview.mp4", "again.mp4", "source.mov"}


def test_a_source_that_is_gone_is_told(gray_clip: VideoClip, tmp_path: Path) -> None:
    gone = replace(gray_clip, video=PayloadFile(tmp_path / "gone.mp4"))
    (tmp_path / "stage").mkdir()
    ctx = StageContext(tmp_path / "stage")
    _write_pictures(
        SourceVideo(gone.video.path, ""), gray_clip,
        RefinedMotion((walk(FRAMES),), ("none",), (0.0,), (walk(FRAMES),), room()), ExportConfig(overlay_frames=0), ctx,
    )  # fmt: skip
    assert ctx.warnings == [f"the preview has no sound: the video is no longer at {gone.video.path}"]


def test_preview_has_every_frame_and_both_panels(gray_clip: VideoClip, tmp_path: Path) -> None:
    write_preview(tmp_path / "preview.mp4", gray_clip, (walk(FRAMES),), room(), 360)
    with av.open(str(tmp_path / "preview.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert container.streams.video[0].average_rate == 30
    assert len(frames) == FRAMES
    assert frames[0].shape == (360, 2 * 640, 3)
    side = frames[3][:, 640:].astype(int)
    blue = (side[..., 2] - side[..., 0] > 60).mean()
    skin = (side[..., 0] - side[..., 2] > 35).mean()
    assert blue > 0.002, "the box is in the side view"
    assert skin > 0.002, "the body is in the side view"


def test_preview_and_moments_show_a_carried_box_where_it_is(gray_clip: VideoClip, tmp_path: Path) -> None:
    people, scene = (walk(FRAMES),), room_with_carried_box(FRAMES)
    write_preview(tmp_path / "preview.mp4", gray_clip, people, scene, 360)
    viewpoint, (placed,) = side_viewpoint(people, scene, 640, 360), scene.objects
    with av.open(str(tmp_path / "preview.mp4")) as container:
        pictures = [frame.to_ndarray(format="rgb24")[:, 640:].astype(int) for frame in container.decode(video=0)]
    at_px = []
    for frame in (0, 3, 7):
        rows, columns = np.nonzero(pictures[frame][..., 2] - pictures[frame][..., 0] > 60)
        center_m = world_vertices(placed, frame).mean(0)
        (expected,) = project(viewpoint.to_camera(center_m[None]), viewpoint.intrinsics)
        np.testing.assert_allclose([columns.mean(), rows.mean()], expected, atol=20)
        at_px.append(np.array([columns.mean(), rows.mean()]))
    assert np.linalg.norm(at_px[1] - at_px[0]) > 25
    moved, still = (moment_picture(gray_clip, *people, *people, where, 5, height_px=200) for where in (scene, room()))
    assert np.abs(moved.astype(int) - still).max(-1)[:, -200:].mean() > 5


def test_overlay_covers_the_joints_and_nothing_far_away(gray_clip: VideoClip) -> None:
    motion, frame = walk(FRAMES), 2
    picture = overlay_frame(gray_clip, (motion,), frame)
    changed = np.abs(picture.astype(int) - 128).max(-1) > 12
    pixels = np.rint(project(motion.joints_camera_m[frame], motion.intrinsics)).astype(int)
    inside = (pixels >= 0).all(1) & (pixels < [640, 360]).all(1)
    assert inside.sum() > 15
    assert changed[pixels[inside, 1], pixels[inside, 0]].all()
    rows, columns = np.nonzero(changed)
    reach_px = 0.35 * motion.intrinsics.fx_px / motion.joints_camera_m[frame, :, 2].min()
    low, high = pixels.min(0) - reach_px, pixels.max(0) + reach_px
    assert columns.min() >= low[0]
    assert columns.max() <= high[0]
    assert rows.min() >= low[1]
    assert rows.max() <= high[1]


def test_people_are_shown_from_their_first_to_their_last_measured_frame(gray_clip: VideoClip) -> None:
    """Measured in frames 2, 3, 5 and 6: gray in frame 4, and not shown before and after."""
    motion = replace(walk(FRAMES), valid=np.isin(np.arange(FRAMES), [2, 3, 5, 6]))
    shown, colored = [], []
    for frame in range(FRAMES):
        picture = overlay_frame(gray_clip, (motion,), frame).astype(int)
        shown.append((np.abs(picture - 128).max(-1) > 12).sum() > 1000)
        colored.append((picture[..., 0] - picture[..., 2] > 35).any())
    assert shown == [False, False, True, True, True, True, True, False]
    assert colored == [False, False, True, True, False, True, True, False]


def test_a_moment_is_shown_over_the_input_and_from_the_side(gray_clip: VideoClip) -> None:
    """Raw is in the middle panel and refined in the right one: the raw body was moved out of its panel's middle."""
    motion = walk(FRAMES)
    root_m = motion.T_world_root[:, :3, 3] + [0.0, 0.0, 1.0]
    raw = motion.with_pose(translation_world_m=root_m, R_parent_joint=motion.R_parent_joint)
    picture = moment_picture(gray_clip, raw, motion, room(), 3, height_px=200)
    assert picture.shape[0] == 200
    assert picture.shape[1] == pytest.approx(200 * 640 / 360 + 2 * 200, abs=1)
    center, right = picture[:, -400:-200].astype(int), picture[:, -200:].astype(int)
    skin = [np.argwhere(panel[..., 0] - panel[..., 2] > 35) for panel in (center, right)]
    height_px = [np.ptp(pixels[:, 0]) for pixels in skin]
    assert height_px[0] == pytest.approx(height_px[1], rel=0.15), "the same body in each, but for feet behind the box"
    apart_px = np.abs(skin[0].mean(0) - skin[1].mean(0))
    assert apart_px[1] / height_px[0] == pytest.approx(1.0 / HEIGHT_M, rel=0.2), "a meter apart"
    assert apart_px[0] < 0.1 * height_px[0]


def test_stage_module_is_light() -> None:
    code = (
        "import sys, stages.export, video2anim.export;"
        "heavy = {'torch', 'cv2', 'open3d', 'trimesh', 'scipy', 'av', 'matplotlib', 'anny', 'pygltflib', 'pxr'};"
        "sys.exit(', '.join(sorted(heavy & set(sys.modules))) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_side_view_is_not_from_behind_a_solid() -> None:
    """A wall between the body and the usual side: the view is from another one, whence the body is seen."""
    people, scene = (walk(FRAMES),), room()
    joints_m = people[0].joints_world_m.reshape(-1, 3)
    usual = side_viewpoint(people, scene, 320, 240)
    assert hidden_share(joints_m, usual, scene) == 0
    place_m = scene.sdf_origin_m + scene.sdf_spacing_m * np.stack(np.indices(scene.sdf_m.shape), -1)
    towards = usual.T_world_camera[:3, 3] - joints_m.mean(0)
    towards[1] = 0
    away_m = (place_m - joints_m.mean(0)) @ (towards / np.linalg.norm(towards))
    walled = replace(scene, sdf_m=np.minimum(scene.sdf_m, np.abs(away_m - 1.3) - 0.3))
    assert hidden_share(joints_m, usual, walled) > 0.5
    assert hidden_share(joints_m, side_viewpoint(people, walled, 320, 240), walled) == 0
