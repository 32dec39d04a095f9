"""Black bars: margins of pictures and the area inside of them by hand; ingest of videos with and without bars."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from stages.ingest import IngestConfig, ingest
from video2anim.pipeline.stage import StageContext
from video2anim.types import SourceVideo, VideoClip
from video2anim.video import read_frames
from video2anim.video.black_bars import Crop, dark_margins, has_dark_edges, picture_area

SIZE_PX = (200, 100)


def picture(top: int, bottom: int, left: int = 0, right: int = 0) -> np.ndarray:
    """Luminance with noise in its bars."""
    width, height = SIZE_PX
    luminance = np.random.default_rng(0).integers(0, 24, (height, width)).astype(np.uint8)
    luminance[top : height - bottom, left : width - right] = 90
    return luminance


def test_margins_by_hand() -> None:
    np.testing.assert_allclose(dark_margins(picture(12, 13)), [0.12, 0.13, 0, 0])
    np.testing.assert_allclose(dark_margins(picture(0, 0, 50, 49)), [0, 0, 0.25, 0.245])
    np.testing.assert_allclose(dark_margins(picture(5, 0, 0, 0)), [0.05, 0, 0, 0])
    np.testing.assert_allclose(dark_margins(picture(0, 0)), 0)
    np.testing.assert_allclose(dark_margins(np.zeros((4, 6), np.uint8)), 1)


def test_a_dark_corner_is_no_margin() -> None:
    luminance = picture(0, 0)
    luminance[:30, :150] = 0
    np.testing.assert_allclose(dark_margins(luminance), 0)


def test_edges_are_dark_only_in_pairs() -> None:
    for rows, columns, wanted in ((3, 0, True), (0, 1, True), (0, 0, False)):
        thumbnail = np.pad(np.full((20, 30, 3), 120, np.uint8), ((rows, rows), (columns, columns), (0, 0)))
        assert has_dark_edges(thumbnail) is wanted
    assert not has_dark_edges(np.pad(np.full((20, 30, 3), 120, np.uint8), ((5, 0), (5, 0), (0, 0))))


@pytest.mark.parametrize(
    ("margins", "wanted"),
    [
        # 12.5 rows and the blurred one, made even.
        ([[0.125, 0.125, 0, 0]], Crop(0, 14, 200, 72)),
        # 12 rows at the top, 12.5 at the bottom.
        ([[0.12, 0.125, 0, 0]], Crop(0, 14, 200, 72)),
        ([[0, 0, 0.25, 0.25]], Crop(52, 0, 96, 100)),
        ([[0.1, 0.1, 0.1, 0.1]], Crop(22, 12, 156, 76)),
        # The video fades in from black, and a hand is dark in one picture.
        ([[1, 1, 1, 1], [0.3, 0.1, 0, 0], [0.1, 0.1, 0, 0]], Crop(0, 12, 200, 76)),
        # Thin bars, a dark ceiling, a picture without bars, black pictures only, none at all.
        ([[0.019, 0.019, 0, 0]], Crop(0, 0, *SIZE_PX)),
        ([[0.2, 0.05, 0, 0]], Crop(0, 0, *SIZE_PX)),
        ([[0.1, 0.1, 0, 0], [0, 0, 0, 0]], Crop(0, 0, *SIZE_PX)),
        ([[1, 1, 1, 1]], Crop(0, 0, *SIZE_PX)),
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
    """A bright wall with a moving mark, RGB 96 x 128."""
    image = np.full((96, 128, 3), 150, np.uint8)
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
    assert not any("black bars" in text for text in clip.warnings)
