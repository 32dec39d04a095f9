"""Whether the camera moves, on clips whose motion is known and on real ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.ingest import IngestConfig, ingest
from video2anim.camera.background_tracks import background_motion
from video2anim.digest import file_digest
from video2anim.pipeline.stage import StageContext
from video2anim.types import PayloadFile, PersonTracks, SourceInfo, SourceVideo, VideoClip
from video2anim.video import FrameWriter

WIDTH, HEIGHT = 480, 300
NOBODY = PersonTracks((), ())


@pytest.fixture(scope="module")
def wall() -> np.ndarray:
    """A textured wall larger than the picture."""
    rng = np.random.default_rng(5)
    wall = np.full((600, 1400, 3), 120, np.uint8)
    for _ in range(900):
        x, y = rng.integers(0, 1400), rng.integers(0, 600)
        w, h = rng.integers(4, 40, 2)
        cv2.rectangle(wall, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 256, 3).tolist(), -1)
    return cv2.GaussianBlur(wall, (0, 0), 1.0)


def clip_of(path: Path, frames: int, picture: Callable[[int], np.ndarray]) -> VideoClip:
    with FrameWriter(path, width_px=WIDTH, height_px=HEIGHT) as writer:
        for frame in range(frames):
            writer.write(picture(frame))
    info = SourceInfo("h264", "yuv420p", WIDTH, HEIGHT, 0, 1.0, 30.0, frames, frames, frames / 30, 0.0)
    time_s = np.arange(frames) / 30
    return VideoClip(PayloadFile(path), WIDTH, HEIGHT, 30.0, time_s, time_s, info, ((0.0, frames / 30),), 0, ())


def seen(wall: np.ndarray, shift_px: float, person_x: int | None = None) -> np.ndarray:
    """The wall through a noisy camera that has moved; an untracked person covers a fifth of the picture."""
    M = np.array([[1, 0, -200 - shift_px], [0, 1, -100.0]])
    picture = cv2.warpAffine(wall, M, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
    if person_x is not None:
        picture[40:290, person_x : person_x + 100] = wall[300:550, 20:120]
    noise = np.random.default_rng(int(100 * shift_px)).normal(0, 2, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("frames", [12, 60], ids=["every frame", "a few frames"])
def test_static_camera_with_a_moving_person(wall: np.ndarray, tmp_path: Path, frames: int) -> None:
    clip = clip_of(tmp_path / "a.mp4", frames, lambda t: seen(wall, 0.0, 20 + 300 * t // frames))
    motion = background_motion(clip, NOBODY)
    assert motion.is_static
    assert motion.drift_ratio < 0.0005
    assert motion.warnings() == []


def test_static_camera_with_a_colorful_person_whom_nobody_tracks(wall: np.ndarray, tmp_path: Path) -> None:
    person = cv2.resize(np.random.default_rng(9).integers(0, 256, (40, 15, 3), dtype=np.uint8), (100, 250))

    def picture(t: int) -> np.ndarray:
        shown = seen(wall, 0.0)
        shown[40:290, 20 + 5 * t : 120 + 5 * t] = person
        return shown

    assert background_motion(clip_of(tmp_path / "a.mp4", 60, picture), NOBODY).is_static


def test_what_moves_before_a_plain_backdrop_is_not_the_camera(wall: np.ndarray, tmp_path: Path) -> None:
    """A green screen: all corners are on the person and on what is swung."""

    def picture(t: int) -> np.ndarray:
        shown = np.full((HEIGHT, WIDTH, 3), (20, 255, 20), np.uint8)
        shown[110:270, 180 + t : 260 + t] = wall[300:460, 20:100]
        return shown

    motion = background_motion(clip_of(tmp_path / "a.mp4", 40, picture), NOBODY)
    assert motion.is_static
    assert math.isnan(motion.drift_ratio)
    assert "camera motion is unknown" in motion.warnings()[0]


def test_what_moves_in_most_of_the_picture_but_not_in_all_of_it_is_not_the_camera(
    wall: np.ndarray, tmp_path: Path
) -> None:
    """Points on a backdrop with little texture follow the edge of a dancer; the left and upper edges stay."""

    def picture(t: int) -> np.ndarray:
        shown = seen(wall, 0.5 * t)
        shown[:, : WIDTH // 4] = seen(wall, 0.0)[:, : WIDTH // 4]
        shown[: HEIGHT // 4] = seen(wall, 0.0)[: HEIGHT // 4]
        return shown

    assert background_motion(clip_of(tmp_path / "a.mp4", 40, picture), NOBODY).is_static


def test_drift_is_measured(wall: np.ndarray, tmp_path: Path) -> None:
    clip = clip_of(tmp_path / "a.mp4", 40, lambda t: seen(wall, 0.5 * t))
    motion = background_motion(clip, NOBODY)
    assert motion.drift_ratio == pytest.approx(0.5 * 39 / WIDTH, rel=0.1)
    assert "the camera moves: the background drifts by 4" in motion.warnings()[0]


def test_a_camera_that_leaves_the_first_view_moves(wall: np.ndarray, tmp_path: Path) -> None:
    """From one of the few frames to the next it shows another part of the wall."""
    clip = clip_of(tmp_path / "a.mp4", 60, lambda t: seen(wall, 12.0 * t))
    motion = background_motion(clip, NOBODY)
    assert not motion.is_static
    assert motion.tracks.frame.max() == 59


def test_nothing_to_see_is_unknown_and_said(tmp_path: Path) -> None:
    clip = clip_of(tmp_path / "a.mp4", 8, lambda t: np.full((HEIGHT, WIDTH, 3), 127, np.uint8))
    motion = background_motion(clip, NOBODY)
    assert motion.is_static
    assert math.isnan(motion.drift_ratio)
    assert "camera motion is unknown" in motion.warnings()[0]


REAL = {
    "anamorphic_sar_2_1": False,
    "hevc_10bit": True,
    "low_frame_rate_5fps": False,
    "no_person_moving_camera_4x3": False,
    "no_person_static_camera": True,
    "small_portrait_216x384": True,
    "small_4x3_320x240": False,
}
"""Whether the camera of a clip is static."""


@pytest.mark.parametrize("name", REAL)
def test_real_clips(shared_media: Path, tmp_path: Path, name: str) -> None:
    """People are not even masked."""
    path = shared_media / "bad" / f"{name}.mp4"
    clip = ingest(SourceVideo(path, file_digest(path)), IngestConfig(), StageContext(tmp_path))
    assert background_motion(clip, NOBODY).is_static is REAL[name]
