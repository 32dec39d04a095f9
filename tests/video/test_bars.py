"""Bars: margins of pictures and the area inside of them by hand; ingest of videos with and without bars."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from stages.ingest import IngestConfig, ingest
from video2anim.pipeline.stage import StageContext
from video2anim.types import SourceVideo, VideoClip
from video2anim.video import read_frames
from video2anim.video.bars import EVERY, Crop, bar_margins, picture_area
from video2anim.video.decode import DecodeReport
from video2anim.video.source_scan import SourceScan

SIZE_PX = (200, 100)


def picture(top: int, bottom: int, left: int = 0, right: int = 0, bar: int = 0) -> np.ndarray:
    """Luminance with detail inside of bars, which have the noise of compression."""
    width, height = SIZE_PX
    rng = np.random.default_rng(0)
    luminance = bar + rng.integers(0, 2, (height, width))
    inside = (slice(top, height - bottom), slice(left, width - right))
    luminance[inside] = rng.integers(60, 200, luminance[inside].shape)
    return luminance.astype(np.uint8)


@pytest.mark.parametrize("bar", [0, 16, 120, 235])
def test_margins_by_hand(bar: int) -> None:
    # The last line of a bar is where detail begins; there may be one more.
    for around in ((12, 13, 0, 0), (0, 0, 50, 49), (5, 0, 0, 0), (20, 20, 20, 20), (0, 0, 0, 0)):
        shares = np.array(around) / np.repeat(SIZE_PX[::-1], 2)
        found = bar_margins(picture(*around, bar))
        assert ((shares - 1e-9 <= found) & (found <= shares + 0.011 * (shares > 0))).all(), (around, found)


def test_margins_of_a_picture_at_night() -> None:
    luminance = picture(12, 12) // 8
    luminance[:12] = luminance[-12:] = 0
    np.testing.assert_allclose(bar_margins(luminance), [0.12, 0.12, 0, 0], atol=0.011)


def test_bars_of_the_blurred_picture_with_a_caption_on_them() -> None:
    luminance = picture(0, 0)
    blurred = cv2.GaussianBlur(luminance, (0, 0), 12)
    blurred[15:20, 5:40] = luminance[15:20, 5:40]
    blurred[:, 60:140] = luminance[:, 60:140]
    np.testing.assert_allclose(bar_margins(blurred), [0, 0, 0.3, 0.3], atol=0.006)


@pytest.mark.parametrize(
    "luminance",
    [
        np.zeros((100, 200), np.uint8),
        np.zeros((2, 1), np.uint8),
        np.tile(np.linspace(0, 255, 200).astype(np.uint8), (100, 1)),
    ],
)
def test_a_picture_without_detail_has_no_bars(luminance: np.ndarray) -> None:
    np.testing.assert_array_equal(bar_margins(luminance), 0)


def test_somebody_in_the_middle_of_a_plain_backdrop_has_no_bars_beside_them() -> None:
    luminance = np.full(SIZE_PX[::-1], 110, np.uint8)
    body = np.zeros_like(luminance)
    cv2.ellipse(body, (100, 50), (20, 45), 0, 0, 360, 1, -1)
    luminance[body > 0] = picture(0, 0)[body > 0]
    np.testing.assert_array_equal(bar_margins(luminance), 0)


def test_a_dark_corner_is_no_margin() -> None:
    luminance = picture(0, 0)
    luminance[:30, :110] = 0
    np.testing.assert_array_equal(bar_margins(luminance), 0)


@pytest.mark.parametrize(
    ("margins", "wanted"),
    [
        # 12.5 rows and the blurred one, made even.
        ([[0.125, 0.125, 0, 0]], Crop(0, 14, 200, 72)),
        # 12 rows at the top, 12.5 at the bottom.
        ([[0.12, 0.125, 0, 0]], Crop(0, 14, 200, 72)),
        ([[0, 0, 0.25, 0.25]], Crop(52, 0, 96, 100)),
        ([[0.1, 0.1, 0.1, 0.1]], Crop(22, 12, 156, 76)),
        # The video fades in from black, and one picture is dark at the edge of a bar.
        ([[0, 0, 0, 0], [0.1, 0.1, 0, 0], [0, 0.1, 0, 0], [0.1, 0.1, 0, 0], [0.1, 0.1, 0, 0]], Crop(0, 12, 200, 76)),
        # Thin bars, one bar, bars in a few pictures, bars without picture, none at all.
        ([[0.019, 0.019, 0, 0]], Crop(0, 0, *SIZE_PX)),
        ([[0.2, 0.05, 0, 0]], Crop(0, 0, *SIZE_PX)),
        ([[0.1, 0.1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]], Crop(0, 0, *SIZE_PX)),
        ([[0.5, 0.5, 0.5, 0.5]], Crop(0, 0, *SIZE_PX)),
        ([], Crop(0, 0, *SIZE_PX)),
    ],
)
def test_area_by_hand(margins: list[list[float]], wanted: Crop) -> None:
    assert picture_area(np.array(margins, np.float64).reshape(-1, 4), SIZE_PX) == wanted


@pytest.mark.parametrize("height", range(60, 700, 7))
def test_whole_rows_stay_whole(height: int) -> None:
    """Shares of whole rows do not become a row more by rounding: 9 rows and the blurred one are 10."""
    area = picture_area(np.array([[9 / height, 1 - (height - 9) / height, 0, 0]]), (80, height))
    assert area == (Crop(0, 10, 80, height - 20) if 9 / height >= 0.02 else Crop(0, 0, 80, height))


def wall(number: int) -> np.ndarray:
    """A wall of bricks with a moving mark, RGB 96 x 128."""
    image = np.full((96, 128, 3), 150, np.uint8)
    image[:, ::7] = image[::5] = 110
    image[20:40, 5 + 4 * number : 25 + 4 * number] = (200, 60, 40)
    return image


def with_bars(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    return np.pad(image, ((rows, rows), (columns, columns), (0, 0)))


def ingested(folder: Path, images: list[np.ndarray]) -> VideoClip:
    folder.mkdir()
    path = folder / "source.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.codec_context.time_base = "yuv420p", Fraction(1, 30)
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return ingest(SourceVideo(path, "0" * 64), IngestConfig(), StageContext(folder))


@pytest.mark.parametrize(("rows", "columns"), [(24, 0), (0, 60), (10, 20)])
def test_the_clip_is_the_picture_inside(tmp_path: Path, rows: int, columns: int) -> None:
    images = [wall(number) for number in range(8)]
    clip = ingested(tmp_path / "bars", [with_bars(image, rows, columns) for image in images])
    margin = [2 * bool(rows), 2 * bool(columns)]
    assert (clip.height_px, clip.width_px) == (96 - 2 * margin[0], 128 - 2 * margin[1])
    crop = f"{clip.width_px}:{clip.height_px}:{columns + margin[1]}:{rows + margin[0]}"
    assert any(f"crop={crop} " in text for text in clip.warnings)
    for image, found in zip(images, read_frames(clip), strict=True):
        inside = image[margin[0] : 96 - margin[0], margin[1] : 128 - margin[1]]
        assert np.abs(found.astype(int) - inside).mean() < 4


def test_a_video_without_bars_stays_whole(tmp_path: Path) -> None:
    clip = ingested(tmp_path / "whole", [wall(number) for number in range(8)])
    assert (clip.height_px, clip.width_px) == (96, 128)
    assert not any("bars around" in text for text in clip.warnings)


def test_each_shot_has_the_bars_of_its_own_pictures() -> None:
    looked_at = np.arange(0, 20, EVERY)
    scan = SourceScan(np.arange(20) / 30, (0, 7, 8), DecodeReport(), True, np.repeat(looked_at[:, None] / 100.0, 4, 1))
    for shot, wanted in enumerate(([0, 5], [], [10, 15])):
        np.testing.assert_allclose(scan.shot_margins(shot)[:, 0] * 100, wanted)
