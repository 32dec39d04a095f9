"""Values refuse at their making what their annotations rule out, in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pytest
from unchecked import unchecked
from walk_scene import room, walk

from video2anim.errors import ArtifactError, StageError
from video2anim.types import (
    BackgroundImage,
    BodyMotion,
    BodyShape,
    BodyTracks,
    CameraEstimate,
    CompletedObject,
    Contact,
    DepthClip,
    Hold,
    InstanceMasks,
    Intrinsics,
    KeyframedMotion,
    Mesh,
    MetricDepth,
    ObjectInstance,
    ObjectMesh,
    ObjectPart,
    ObjectPath,
    PayloadFile,
    PersonTrack,
    PersonTracks,
    PlacedObject,
    RefinedMotion,
    SourceInfo,
    Texture,
    VideoClip,
    View,
)

FRAMES = 5
LENS = Intrinsics(500.0, 500.0, 319.5, 179.5, 640, 360)
SMALL = (3, 9, 16)
NAN = float("nan")
BOX = room().objects[0].mesh


def track() -> PersonTrack:
    """With one frame in which the person is not seen."""
    valid = np.array([True, False, True])
    gap = np.where(valid, 1.0, np.nan)
    return PersonTrack(
        1, valid, gap, gap[:, None] * np.ones((3, 4)), gap[:, None, None] * np.ones((3, 33, 2)),
        gap[:, None, None] * np.ones((3, 33, 3)), gap[:, None] * np.ones((3, 33)), np.zeros((3, 64, 64), np.uint8),
        gap[:, None, None] * np.ones((3, 2, 3)),
    )  # fmt: skip


def source() -> SourceInfo:
    return SourceInfo("h264", "yuv420p", 640, 360, 0, 1.0, 30.0, FRAMES, FRAMES, FRAMES / 30, 0.0)


def clip() -> VideoClip:
    time_s = np.arange(FRAMES) / 30
    return VideoClip(PayloadFile(Path("v.mp4")), 640, 360, 30.0, time_s, time_s, source(), ((0.0, 1.0),), 0, ())


def depth() -> DepthClip:
    value, known = np.full(SMALL, np.nan, np.float32), np.zeros(SMALL, bool)
    return DepthClip("depth", "truth", np.array([0, 2, 4]), value, value, known, value[0], known[0])


def metric() -> MetricDepth:
    value, known = np.full(SMALL, np.nan, np.float32), np.zeros(SMALL, bool)
    return MetricDepth(
        1.0, 0.0, NAN, NAN, None, None, False, "why", np.array([0, 2, 4]), value, known, value[0], known[0],
        {"1": 0.1}, BodyTracks((walk(FRAMES),)),
    )  # fmt: skip


def background() -> BackgroundImage:
    masks = np.zeros(SMALL, bool)
    return BackgroundImage(np.zeros((360, 640, 3), np.uint8), np.ones(SMALL[1:]), np.array([0, 2, 4]), masks, masks)


def camera() -> CameraEstimate:
    return CameraEstimate(LENS, "user", 0.1, np.array([0.0, -1.0, 0.0]), 0.1, True, np.tile(np.eye(4), (FRAMES, 1, 1)))


def path() -> ObjectPath:
    return ObjectPath(np.tile(np.eye(4), (FRAMES, 1, 1)), (Hold(1, "left hand", 1, 3),))


def placed() -> PlacedObject:
    return PlacedObject(1, "box", BOX, 1.0, np.eye(4), None, None, True, "")


def contact() -> Contact:
    return Contact(1, "seat", None, "floor", "floor", 0.0, 1.0, 0.01, -0.02)


def instance() -> ObjectInstance:
    return ObjectInstance(1, "box", 0.5, np.zeros(4), np.ones((9, 16), bool))


MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
FAR = np.eye(4) + np.array([[0, 0, 0, 2e4]] + [[0.0] * 4] * 3)

WRONG: list[tuple[Any, dict[str, Any], str]] = [
    (LENS, {"fx_px": 0.0}, "Intrinsics.fx_px: want greater than 0, got 0.0"),
    (LENS, {"cx_px": NAN}, "Intrinsics.cx_px: want finite number, got nan"),
    (LENS, {"width_px": -1}, "Intrinsics.width_px: want greater than 0, got -1"),
    (View(np.eye(4), LENS), {"T_world_camera": np.eye(3)}, r"View.T_world_camera: want shape \(4, 4\), got \(3, 3\)"),
    (View(np.eye(4), LENS), {"T_world_camera": MIRROR}, "View.T_world_camera: want rigid transforms"),
    (View(np.eye(4), LENS), {"T_world_camera": FAR}, "View.T_world_camera: want rigid transforms"),
    (View(np.eye(4), LENS), {"T_world_camera": None}, "View.T_world_camera: want an array, got NoneType"),
    (camera(), {"up_camera": np.array([0.0, -2.0, 0.0])}, "CameraEstimate.up_camera: want vectors of length 1"),
    (camera(), {"T_first_camera": np.ones((5, 4, 4))}, "CameraEstimate.T_first_camera: want rigid transforms"),
    (source(), {"pixel_aspect": 0.0}, "SourceInfo.pixel_aspect: want greater than 0"),
    (clip(), {"frame_time_s": np.zeros(FRAMES)}, "VideoClip.frame_time_s: want numbers that rise"),
    (clip(), {"source_time_s": np.zeros(3)}, r"VideoClip.source_time_s: want shape \(5,\), got \(3,\)"),
    (clip(), {"shots_s": ((0.0, NAN),)}, r"VideoClip.shots_s: want finite number, got nan at \[0\]\[1\]"),
    (contact(), {"start_s": float("inf")}, "Contact.start_s: want finite number, got inf"),
    (depth(), {"kind": "metric"}, "DepthClip.kind: want "),
    (depth(), {"frame_index": np.array([2, 0, 4])}, "DepthClip.frame_index: want numbers of frames"),
    (depth(), {"valid": np.zeros((2, 9, 16), bool)}, r"DepthClip.valid: want shape \(3, 9, 16\), got \(2, 9, 16\)"),
    (metric(), {"scale": -1.0}, "MetricDepth.scale: want greater than 0"),
    (metric(), {"object_sigma": {"1": -0.1}}, "MetricDepth.object_sigma: want greater than or equal to 0, got -0.1"),
    (metric(), {"chamfer_after_m": -1.0}, "MetricDepth.chamfer_after_m: want greater than or equal to 0"),
    (BodyShape("anny", {}), {"parameters": {"height": NAN}}, "BodyShape.parameters: want finite number, got nan"),
    (walk(FRAMES), {"valid": np.ones(4, bool)}, r"BodyMotion.valid: want shape \(5,\), got \(4,\)"),
    (walk(FRAMES), {"joints_world_m": np.full((5, 22, 3), np.nan)}, "BodyMotion.joints_world_m: want finite"),
    (walk(FRAMES), {"R_parent_joint": np.zeros((5, 22, 3, 3))}, r"BodyMotion.R_parent_joint: .* at \[0, 0\]"),
    (walk(FRAMES), {"contact": np.full((5, 22), 2.0)}, "BodyMotion.contact: want numbers from 0 to 1"),
    (walk(FRAMES), {"rest_joints_m": np.ones((22, 3))}, "BodyMotion.rest_joints_m: want the origin in the first row"),
    (
        BodyTracks(()),
        {"people": (walk(5), walk(4, 2))},
        r"BodyTracks.people: want equal .*, got \[5, 4\]",
    ),
    (
        KeyframedMotion((), ()),
        {"people": (walk(5),)},
        "KeyframedMotion.keyframe_index: want one of each",
    ),
    (
        KeyframedMotion((walk(5),), (np.array([1]),)),
        {"keyframe_index": (np.array([-1]),)},
        "index: want numbers",
    ),
    (RefinedMotion((), (), (), (), room()), {"prior": ("none",)}, "RefinedMotion.prior: want one of each of the 0"),
    (track(), {"score": np.ones(2)}, r"PersonTrack.score: want shape \(3,\), got \(2,\)"),
    (PersonTracks((track(),), (1,)), {"selected_ids": (2,)}, r"PersonTracks.selected_ids: want numbers among \[1\]"),
    (BOX, {"vertex_rgb": np.zeros((3, 3), np.uint8)}, r"Mesh.vertex_rgb: want shape \(8, 3\), got \(3, 3\)"),
    (BOX, {"faces": np.array([[0, 1, 8]])}, "Mesh.faces: want triangles of 8 vertices, got numbers 0 to 8"),
    (background(), {"person_mask": np.zeros((3, 9, 15), bool)}, "BackgroundImage.person_mask: want shape"),
    (instance(), {"mask": np.zeros((9, 16), bool)}, "ObjectInstance.mask: want at least one pixel"),
    (InstanceMasks("x", (), np.zeros((9, 16), bool)), {"floor_mask": np.zeros(9, bool)}, "InstanceMasks.floor_mask"),
    (
        CompletedObject(1, "box", np.ones((9, 16), bool), np.zeros((2, 2, 3), np.uint8)),
        {"completed_ratio": NAN},
        "CompletedObject.completed_ratio: want finite number",
    ),
    (Texture(np.zeros((2, 2, 3), np.uint8), np.zeros((1, 3, 2))), {"corner_uv": np.zeros((1, 3))}, "Texture.corner_uv"),
    (ObjectPart("seat", 0, 2), {"first_face": -1}, "ObjectPart.first_face: want greater than or equal to 0"),
    (
        ObjectMesh(1, "box", "program", BOX, np.eye(4)),
        {"mesh": Mesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8))},
        "ObjectMesh.mesh: want at least one pixel or triangle, got none",
    ),
    (Hold(1, "left hand", 1, 3), {"last_frame": 0}, "Hold.last_frame: want 1 or later, got 0"),
    (path(), {"holds": (Hold(1, "left hand", 1, 5),)}, "ObjectPath.holds: want frames of the 5, got 5"),
    (placed(), {"scale": 0.0}, "PlacedObject.scale: want greater than 0"),
    (placed(), {"T_world_object": 2 * np.eye(4)}, "PlacedObject.T_world_object: want rigid"),
    (room(), {"sdf_spacing_m": 0.0}, "SceneModel.sdf_spacing_m: want greater than 0"),
    (room(), {"sdf_m": np.full((2, 2, 2), np.inf)}, "SceneModel.sdf_m: want finite numbers"),
    (room(), {"objects": 2 * room().objects}, r"SceneModel.objects: want a number of its own .* got \[3, 3\]"),
]


@pytest.mark.parametrize(("value", "change", "told"), WRONG, ids=[f"{type(v).__name__}-{min(c)}" for v, c, _ in WRONG])
def test_a_wrong_field_is_refused_in_one_line(value: Any, change: dict[str, Any], told: str) -> None:
    with pytest.raises(ValueError, match=told) as caught:
        unchecked(value, **change).__post_init__()
    assert "\n" not in str(caught.value)


def test_what_is_documented_as_unknown_is_taken() -> None:
    """NaN where nobody is seen or depth is unknown; whole numbers and numpy's scalars for fractions."""
    assert np.isnan(track().whole(7).score[3:]).all()
    assert replace(LENS, fx_px=np.float64(500)) is not None
    assert replace(placed(), scale=1) is not None


def test_a_track_beyond_the_clip_is_refused_in_one_line() -> None:
    """As after an edit of `first_frame` by hand."""
    late = replace(track(), first_frame=5)
    assert late.whole(5 + len(late.valid)).valid[5:].tolist() == late.valid.tolist()
    with pytest.raises(ArtifactError, match=r"stage track, person \d+: want rows for frames 0 to 5 .* got 5 to"):
        late.whole(6)
    assert late.frames_in(5 + len(late.valid)) == slice(5, 5 + len(late.valid))
    with pytest.raises(ArtifactError, match="correct first_frame"):
        late.frames_in(6)


def test_the_main_person_is_the_first_one_and_must_be_seen() -> None:
    first, second = walk(FRAMES), walk(FRAMES, 2)
    bodies = BodyTracks((first, second))
    assert bodies.main is first
    np.testing.assert_array_equal(bodies.main_view.T_world_camera, first.T_world_camera[0])
    np.testing.assert_array_equal(first.view(3).T_world_camera, first.T_world_camera[3])
    assert bodies.main_view.resized(320, 180).intrinsics == first.intrinsics.resized(320, 180)
    for nobody in ((), (replace(first, valid=np.zeros(FRAMES, bool)), second)):
        with pytest.raises(StageError, match=r"^want a fitted body with .* frame, got none; "):
            _ = BodyTracks(nobody).main_view


def test_checks_cost_little() -> None:
    """A hundred seconds of one person: nothing beside what a stage does with them."""
    short = walk(30)

    def long(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values] * 100)

    arrays = ("valid", "T_world_root", "R_parent_joint", "T_world_camera", "contact", "joints_world_m")
    fields = {name: long(getattr(short, name)) for name in arrays} | {"frame_time_s": np.arange(3000) / 30}
    started = perf_counter()
    motion: BodyMotion = replace(short, **fields)
    assert perf_counter() - started < 2.0
    assert motion.frame_count == 3000
