"""Writing and frame-exact reading of clips."""

from __future__ import annotations

import errno
from pathlib import Path

import av
import numpy as np
import pytest

from video2anim.errors import InputError, StageError
from video2anim.types import PayloadFile, SourceInfo, VideoClip
from video2anim.video import FrameWriter, read_frame, read_frames

COUNT = 75
BITS = 7


def numbered(index: int, width: int, height: int) -> np.ndarray:
    """A picture that says its number in black and white blocks."""
    picture = np.full((height, width, 3), (90, 120, 60), np.uint8)
    for bit in range(BITS):
        picture[:20, 20 * bit : 20 * bit + 20] = 255 * (index >> bit & 1)
    return picture


def number_of(picture: np.ndarray) -> int:
    return sum(int(picture[10, 20 * bit + 10].mean() > 128) << bit for bit in range(BITS))


def make_clip(path: Path, count: int = COUNT, width: int = 160, height: int = 96) -> VideoClip:
    with FrameWriter(path, width_px=width, height_px=height) as writer:
        for index in range(count):
            writer.write(numbered(index, width, height))
    info = SourceInfo("h264", "yuv420p", width, height, 0, 1.0, 30.0, count, count, count / 30, 0.0)
    time_s = np.arange(count) / 30
    path_file = PayloadFile(path)
    return VideoClip(path_file, width, height, 30.0, time_s, time_s, info, ((0.0, count / 30),), 0, ())


@pytest.mark.parametrize(
    ("start", "stop", "step"),
    [(0, None, 1), (29, None, 1), (30, 50, 1), (31, 75, 7), (74, 75, 1), (59, 61, 1), (0, 75, 40), (70, 999, 2)],
)
def test_frames_are_the_ones_asked_for(tmp_path: Path, start: int, stop: int | None, step: int) -> None:
    clip = make_clip(tmp_path / "clip.mp4")
    found = [number_of(picture) for picture in read_frames(clip, start, stop, step)]
    assert found == list(range(COUNT))[start:stop:step]


@pytest.mark.parametrize(("width", "height"), [(160, 96), (161, 97), (141, 98)])
def test_sizes_even_and_odd_survive(tmp_path: Path, width: int, height: int) -> None:
    clip = make_clip(tmp_path / "clip.mp4", 5, width, height)
    picture = read_frame(clip, 3)
    assert picture.shape == (height, width, 3)
    assert picture.dtype == np.uint8
    assert number_of(picture) == 3
    assert np.abs(picture[40:].astype(int) - (90, 120, 60)).max() <= 3


@pytest.mark.parametrize("rgb", [(200, 30, 30), (20, 200, 40), (10, 20, 220), (255, 255, 255), (0, 0, 0)])
def test_colours_survive(tmp_path: Path, rgb: tuple[int, int, int]) -> None:
    path = tmp_path / "clip.mp4"
    with FrameWriter(path, width_px=64, height_px=64) as writer:
        writer.write(np.tile(np.uint8(rgb), (64, 64, 1)))
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        assert (frame.colorspace, frame.color_range) == (1, 1)
        assert container.streams.video[0].average_rate == 30
        assert np.abs(frame.to_ndarray(format="rgb24")[32, 32].astype(int) - rgb).max() <= 3


def test_reading_stops_at_missing_frames(tmp_path: Path) -> None:
    short = make_clip(tmp_path / "short.mp4", 10)
    claims_more = make_clip(tmp_path / "long.mp4", 20)
    broken = VideoClip(
        short.video, short.width_px, short.height_px, 30.0, claims_more.frame_time_s, claims_more.source_time_s,
        short.source, short.shots_s, 0, (),
    )  # fmt: skip
    with pytest.raises(InputError, match="want frame 10"):
        list(read_frames(broken))


def test_reading_a_missing_or_broken_video_is_an_input_error(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "clip.mp4", 5)
    clip.video.path.write_bytes(b"not a video")
    with pytest.raises(InputError, match="cannot read"):
        list(read_frames(clip))
    clip.video.path.unlink()
    with pytest.raises(InputError, match="cannot read"):
        list(read_frames(clip))


def test_bad_ranges(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "clip.mp4", 5)
    assert list(read_frames(clip, 5)) == []
    with pytest.raises(ValueError, match="step"):
        read_frames(clip, 0, 5, 0)
    with pytest.raises(IndexError):
        read_frame(clip, 5)


def test_frames_of_another_shape_are_refused(tmp_path: Path) -> None:
    with FrameWriter(tmp_path / "clip.mp4", width_px=64, height_px=32) as writer:
        with pytest.raises(ValueError, match="want uint8 frames"):
            writer.write(np.zeros((64, 32, 3), np.uint8))
        writer.write(np.zeros((32, 64, 3), np.uint8))


def write_noise(path: Path) -> None:
    rng = np.random.default_rng(0)
    with FrameWriter(path, width_px=320, height_px=240) as writer:
        for _ in range(20):
            writer.write(rng.integers(0, 256, (240, 320, 3), dtype=np.uint8))


def test_full_disk_is_named(tmp_path: Path) -> None:
    device = Path("/dev/full")
    if not device.exists():
        pytest.skip("no /dev/full here")
    link = tmp_path / "clip.mp4"
    link.symlink_to(device)
    with pytest.raises(InputError, match="no space left on device at") as caught:
        write_noise(link)
    assert isinstance(caught.value.__cause__, OSError)
    assert caught.value.__cause__.errno == errno.ENOSPC


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with (
        pytest.raises(StageError, match="cannot write video"),
        FrameWriter(tmp_path / "none" / "clip.mp4", width_px=64, height_px=64) as writer,
    ):
        writer.write(np.zeros((64, 64, 3), np.uint8))


def test_no_frames_leave_no_error(tmp_path: Path) -> None:
    with FrameWriter(tmp_path / "clip.mp4", width_px=64, height_px=64) as writer:
        assert writer.frame_count == 0
