"""The background image recovers a known background; masks recover known people."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.background import BackgroundConfig, make_background
from video2anim.cli.compose import pipeline_nodes
from video2anim.errors import ArtifactError, UsageError
from video2anim.pipeline.config import resolve
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    CameraEstimate,
    Intrinsics,
    PayloadFile,
    PersonTrack,
    PersonTracks,
    SourceInfo,
    VideoClip,
)
from video2anim.video import FrameWriter

WIDTH, HEIGHT, COUNT = 320, 200, 48
PERSON_W, PERSON_H, TOP = 36, 110, 60
MASK_IOU = 0.87
"""One pixel all around such a person is 7 % of the area, and the clip's chroma bleeds that far."""


def textured(seed: int, width: int, height: int) -> np.ndarray:
    """A gray wall, since the clip's chroma is stored at half the resolution."""
    rng = np.random.default_rng(seed)
    picture = np.full((height, width, 3), 110, np.uint8)
    for _ in range(width * height // 300):
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        w, h = (int(v) for v in rng.integers(4, 30, 2))
        cv2.rectangle(picture, (x, y), (x + w, y + h), [int(rng.integers(40, 180))] * 3, -1)
    return cv2.GaussianBlur(picture, (0, 0), 1.0)


def track_of(lefts: list[int | None], person_id: int, *, with_mask: bool = True) -> PersonTrack:
    """A track whose masks are a little too small and blurred, as a network's are."""
    count = len(lefts)
    valid = np.array([left is not None for left in lefts])
    boxes = np.full((count, 4), np.nan)
    masks = np.zeros((count, 64, 64), np.uint8)
    T_image_crop = np.full((count, 2, 3), np.nan)
    side = 160.0
    for frame, left in enumerate(lefts):
        if left is None:
            continue
        boxes[frame] = (left, TOP, left + PERSON_W - 1, TOP + PERSON_H - 1)
        x0, y0 = left + PERSON_W / 2 - side / 2, TOP + PERSON_H / 2 - side / 2
        T_image_crop[frame] = [[side, 0, x0 - 0.5], [0, side, y0 - 0.5]]
        if with_mask:
            scale = 64 / side
            cx, half_w, half_h = 32.0, scale * PERSON_W / 2, scale * PERSON_H / 2
            crop = np.zeros((64, 64), np.float32)
            crop[round(32 - half_h) : round(32 + half_h), round(cx - half_w) : round(cx + half_w)] = 255
            masks[frame] = cv2.GaussianBlur(crop, (0, 0), 1.5).astype(np.uint8)
    landmarks = np.full((count, 33, 2), np.nan)
    return PersonTrack(
        person_id=person_id,
        valid=valid,
        score=np.where(valid, 0.9, np.nan),
        box_px=boxes,
        landmarks_px=landmarks,
        landmarks_m=np.full((count, 33, 3), np.nan),
        visibility=np.zeros((count, 33)),
        mask_crop=masks,
        T_image_crop=T_image_crop,
    )


def make_clip(
    path: Path, wall: np.ndarray, people: list[list[int | None]], *, shift_px: float = 0.0
) -> tuple[VideoClip, list[np.ndarray]]:
    """A clip of people walking before a wall, and the truth of each person's mask, (people, frames, H, W)."""
    colors = [(210, 40, 40), (40, 60, 210)]
    rng = np.random.default_rng(11)
    count = len(people[0])
    truth = [np.zeros((count, HEIGHT, WIDTH), bool) for _ in people]
    with FrameWriter(path, width_px=WIDTH, height_px=HEIGHT) as writer:
        for frame in range(count):
            M = np.array([[1, 0, -shift_px * frame], [0, 1, 0.0]])
            picture = cv2.warpAffine(wall, M, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
            for person, lefts in enumerate(people):
                left = lefts[frame]
                if left is not None:
                    truth[person][frame, TOP : TOP + PERSON_H, max(left, 0) : left + PERSON_W] = True
                    picture[truth[person][frame]] = colors[person]
            writer.write(np.clip(picture + rng.normal(0, 2, picture.shape), 0, 255).astype(np.uint8))
    info = SourceInfo("h264", "yuv420p", WIDTH, HEIGHT, 0, 1.0, 30.0, count, count, count / 30, 0.0)
    time_s = np.arange(count) / 30
    clip = VideoClip(
        PayloadFile(path), WIDTH, HEIGHT, 30.0, time_s, time_s, info, ((0.0, count / 30),), 0, ()
    )  # fmt: skip
    return clip, truth


def camera_of(clip: VideoClip, turn: np.ndarray | None = None, center: np.ndarray | None = None) -> CameraEstimate:
    """A static camera, or one with rotation matrices and positions in units of the wall's distance."""
    lens = Intrinsics.centered(float(WIDTH), clip.width_px, clip.height_px)
    T = np.tile(np.eye(4), (clip.frame_count, 1, 1))
    T[:, :3, :3] = np.eye(3) if turn is None else turn
    T[:, :3, 3] = 0 if center is None else center
    still = turn is None and center is None
    return CameraEstimate(lens, "user", 0.0, np.array([0.0, -1.0, 0.0]), 0.0, still, T)


def walk(start: int, stop: int, count: int = COUNT) -> list[int | None]:
    return [round(x) for x in np.linspace(start, stop, count)]


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


@pytest.mark.parametrize("with_mask", [True, False])
def test_plate_and_masks_of_one_walker(tmp_path: Path, with_mask: bool) -> None:
    wall = textured(1, WIDTH, HEIGHT)
    lefts = walk(10, 270)
    clip, truth = make_clip(tmp_path / "clip.mp4", wall, [lefts])
    tracks = PersonTracks((track_of(lefts, 1, with_mask=with_mask),), (1,))
    ctx = StageContext(tmp_path)
    found = make_background(clip, tracks, camera_of(clip), BackgroundConfig(), ctx)
    assert np.abs(found.background_rgb.astype(int) - wall).mean() < 2.0
    assert np.percentile(np.abs(found.background_rgb.astype(int) - wall), 99) < 8
    assert found.frame_index.tolist() == [0, 5, 10, 15, 20, 25, 30, 35, 40, 45, 47]
    assert found.person_mask.shape == found.selected_mask.shape == (11, HEIGHT, WIDTH)
    assert iou(found.person_mask, truth[0][found.frame_index]) > MASK_IOU
    assert np.array_equal(found.person_mask, found.selected_mask)
    some = found.of_frames(np.array([5, 20, 47]))
    assert some.frame_index.tolist() == [5, 20, 47]
    np.testing.assert_array_equal(some.selected_mask, found.selected_mask[[1, 4, 10]])
    np.testing.assert_array_equal(some.person_mask, some.selected_mask)
    with pytest.raises(ArtifactError, match="want sampled frames"):
        found.of_frames(np.array([0, 21]))
    assert found.seen_ratio.min() > 0
    assert found.seen_ratio[:30].min() == 1.0
    assert ctx.warnings == []


def test_other_people_leave_the_plate_but_are_not_selected(tmp_path: Path) -> None:
    wall = textured(2, WIDTH, HEIGHT)
    main, other = walk(0, 120), walk(280, 170)
    clip, truth = make_clip(tmp_path / "clip.mp4", wall, [main, other])
    tracks = PersonTracks((track_of(main, 4), track_of(other, 7)), (7, 4))
    found = make_background(clip, tracks, camera_of(clip), BackgroundConfig(), StageContext(tmp_path))
    index = found.frame_index
    assert np.abs(found.background_rgb.astype(int) - wall).mean() < 2.0
    assert iou(found.selected_mask, truth[1][index]) > MASK_IOU
    assert iou(found.person_mask, truth[0][index] | truth[1][index]) > MASK_IOU
    assert not np.any(found.selected_mask & ~found.person_mask)


def test_a_person_who_never_moves_leaves_a_hole_that_is_marked(tmp_path: Path) -> None:
    wall = textured(3, WIDTH, HEIGHT)
    lefts = walk(100, 100, 12)
    clip, truth = make_clip(tmp_path / "clip.mp4", wall, [lefts])
    ctx = StageContext(tmp_path)
    found = make_background(clip, PersonTracks((track_of(lefts, 1),), (1,)), camera_of(clip), BackgroundConfig(), ctx)
    hidden = truth[0][0]
    assert np.mean(found.seen_ratio[hidden] == 0) > 0.99
    assert np.mean(found.seen_ratio[~hidden] == 1) > 0.9
    assert iou(found.person_mask[0], hidden) > 0.8
    # Painted from the surroundings: no red person left.
    red = np.abs(found.background_rgb.astype(int) - (210, 40, 40)).max(axis=-1) < 40
    assert red[hidden].mean() < 0.02
    assert any("never seen" in text for text in ctx.warnings)


def test_frames_without_the_person(tmp_path: Path) -> None:
    wall = textured(4, WIDTH, HEIGHT)
    lefts: list[int | None] = [None] * 20 + [round(x) for x in np.linspace(0, 200, 21)]
    clip, truth = make_clip(tmp_path / "clip.mp4", wall, [lefts])
    tracks = PersonTracks((track_of(lefts, 1),), (1,))
    found = make_background(clip, tracks, camera_of(clip), BackgroundConfig(), StageContext(tmp_path))
    absent = found.frame_index < 20
    assert not found.person_mask[absent].any()
    assert iou(found.person_mask[~absent], truth[0][found.frame_index][~absent]) > MASK_IOU


def test_nobody(tmp_path: Path) -> None:
    wall = textured(5, WIDTH, HEIGHT)
    clip, _ = make_clip(tmp_path / "clip.mp4", wall, [[None] * 7])
    found = make_background(clip, PersonTracks((), ()), camera_of(clip), BackgroundConfig(), StageContext(tmp_path))
    assert not found.person_mask.any()
    assert np.all(found.seen_ratio == 1)
    assert np.abs(found.background_rgb.astype(int) - wall).mean() < 2.0


def test_a_turning_camera_is_aligned_to_the_first_frame(tmp_path: Path) -> None:
    """Every frame of the clip is a wide picture seen in another direction."""
    wide = textured(6, 2 * WIDTH, HEIGHT)
    turn = Rotation.from_rotvec(np.linspace(0, 0.15, COUNT)[:, None] * [0.0, 1.0, 0.0]).as_matrix()
    clip, _ = make_clip(tmp_path / "clip.mp4", wide[:, :WIDTH], [[None] * COUNT])
    camera = camera_of(clip, turn)
    K = camera.intrinsics.matrix()
    with FrameWriter(tmp_path / "turning.mp4", width_px=WIDTH, height_px=HEIGHT) as writer:
        for R in turn:
            writer.write(cv2.warpPerspective(wide, K @ R.T @ np.linalg.inv(K), (WIDTH, HEIGHT)))
    clip = replace(clip, video=PayloadFile(tmp_path / "turning.mp4"))
    ctx = StageContext(tmp_path)
    found = make_background(clip, PersonTracks((), ()), camera, BackgroundConfig(), ctx)
    assert np.abs(found.background_rgb.astype(int) - wide[:, :WIDTH]).mean() < 3.0
    assert ctx.warnings == []


def test_a_traveling_camera_is_aligned_to_the_first_frame(tmp_path: Path) -> None:
    wall = textured(6, 2 * WIDTH, HEIGHT)
    lefts = walk(20, 260)
    clip, truth = make_clip(tmp_path / "clip.mp4", wall, [lefts], shift_px=1.0)
    ctx = StageContext(tmp_path)
    center = np.arange(COUNT)[:, None] / WIDTH * [1.0, 0.0, 0.0]
    camera = camera_of(clip, center=center)
    found = make_background(clip, PersonTracks((track_of(lefts, 1),), (1,)), camera, BackgroundConfig(), ctx)
    seen = found.seen_ratio > 0.2
    assert seen.mean() > 0.9
    assert np.abs(found.background_rgb.astype(int) - wall[:, :WIDTH])[seen].mean() < 3.0
    assert iou(found.person_mask, truth[0][found.frame_index]) > MASK_IOU
    assert any("the camera travels" in text for text in ctx.warnings)


def test_a_traveling_camera_leaves_the_first_frame_sharp(tmp_path: Path) -> None:
    """Twice as far as the wall is, so that no frame can be aligned: what nobody hides is the first frame's own."""
    wall = textured(6, 2 * WIDTH, HEIGHT)
    clip, _ = make_clip(tmp_path / "clip.mp4", wall, [walk(20, 260)], shift_px=3.0)
    center = np.arange(COUNT)[:, None] / WIDTH * [1.5, 0.0, 0.0]
    tracks = PersonTracks((track_of(walk(20, 260), 1),), (1,))
    found = make_background(clip, tracks, camera_of(clip, center=center), BackgroundConfig(), StageContext(tmp_path))
    away = np.arange(WIDTH) > 20 + 2 * PERSON_W
    assert np.abs(found.background_rgb.astype(int) - wall[:, :WIDTH])[:, away].mean() < 3.0


def test_frames_of_another_perspective_are_not_aligned(tmp_path: Path) -> None:
    clip, _ = make_clip(tmp_path / "clip.mp4", textured(6, WIDTH, HEIGHT), [[None] * 3])
    H = camera_of(clip, center=np.array([[0.0, 0, 0], [0, 0, 0.49], [0, 0, 0.51]])).H_first_frame(np.arange(3))
    # A camera half of the way to the wall sees it twice as large.
    assert np.allclose(H[1] / H[1, 2, 2], [[0.51, 0, 0.49 * 159.5], [0, 0.51, 0.49 * 99.5], [0, 0, 1]])
    assert np.isnan(H[2]).all()


def test_work_is_done_at_reduced_size_and_in_few_samples(tmp_path: Path) -> None:
    wall = textured(7, WIDTH, HEIGHT)
    lefts = walk(10, 270)
    clip, _ = make_clip(tmp_path / "clip.mp4", wall, [lefts])
    tracks = PersonTracks((track_of(lefts, 1),), (1,))
    ctx = StageContext(tmp_path)
    found = make_background(
        clip, tracks, camera_of(clip), BackgroundConfig(frame_step=2, max_samples=9, long_side_px=96), ctx
    )
    assert found.person_mask.shape == (25, 60, 96)
    assert found.seen_ratio.shape == (60, 96)
    assert found.background_rgb.shape == (HEIGHT, WIDTH, 3)
    assert next(q.value for q in ctx.qualities if q.key == "background_samples") == 9
    assert np.abs(found.background_rgb.astype(int) - wall).mean() < 3.0


@pytest.mark.parametrize("options", [{"frame_step": 0}, {"max_samples": 256}, {"long_side_px": 1}])
def test_config_is_checked(options: dict[str, int]) -> None:
    with pytest.raises(UsageError, match=r"background\.\w+: want"):
        resolve(pipeline_nodes(), "p", [("test", {"background": options})])
