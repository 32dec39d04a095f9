"""Ingest: real clips, broken inputs, rotation, odd shapes, variable frame rate, trimming, errors."""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.stream import Disposition

from stages.ingest import IngestConfig, ingest
from video2anim.cli.compose import pipeline_nodes
from video2anim.errors import InputError, UsageError, Video2AnimError
from video2anim.pipeline.config import resolve
from video2anim.pipeline.stage import StageContext
from video2anim.types import SourceVideo, VideoClip
from video2anim.video import FrameWriter, read_frames


@pytest.fixture
def run(tmp_path: Path) -> Callable[..., VideoClip]:
    """Ingest a file into a fresh folder."""

    def run_ingest(path: Path, **options: object) -> VideoClip:
        work = tmp_path / f"work_{len(list(tmp_path.iterdir()))}"
        work.mkdir()
        ctx = StageContext(work)
        clip = ingest(SourceVideo(path, "0" * 64), IngestConfig(**options), ctx)
        assert tuple(ctx.warnings) == clip.warnings
        check(clip)
        return clip

    return run_ingest


def check(clip: VideoClip) -> None:
    """What holds for every clip."""
    assert clip.fps == 30.0
    assert np.allclose(clip.frame_time_s, np.arange(clip.frame_count) / 30)
    assert clip.source_time_s.shape == clip.frame_time_s.shape
    assert np.all(np.isfinite(clip.source_time_s))
    assert np.all(np.diff(clip.source_time_s) >= 0)
    with av.open(str(clip.video.path)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == (clip.width_px, clip.height_px)
        assert stream.average_rate == 30
        assert stream.frames == clip.frame_count
        assert (stream.sample_aspect_ratio or 1) == 1
    first = next(read_frames(clip))
    assert first.shape == (clip.height_px, clip.width_px, 3)


def write_video(
    path: Path, pictures: list[np.ndarray], stamps: list[int], *, time_base: Fraction = Fraction(1, 90)
) -> Path:
    """A source with the given time stamps, in units of `time_base`."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=int(1 / time_base))
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv444p"
        stream.codec_context.time_base = time_base
        stream.codec_context.options = {"crf": "10", "preset": "ultrafast"}
        for picture, stamp in zip(pictures, stamps, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format="yuv444p")
            frame.pts, frame.time_base = stamp, time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def gray(value: int, width: int = 96, height: int = 64) -> np.ndarray:
    """A checkered wall over a floor of one gray value, with a corner that tells up from down."""
    y, x = np.indices((height, width))
    checker = np.where((x // 8 + y // 8) % 2, 60, 180).astype(np.uint8)
    picture = np.repeat(checker[..., None], 3, axis=2)
    picture[height // 2 :] = value
    picture[: height // 4, : width // 4] = (220, 30, 30)
    return picture


BAD = {
    "zero_bytes": "empty",
    "text_named": "not a readable video",
    "jpeg_named": "still image",
    "audio_only": "no video stream",
    "truncated_no_index": "cut off before its index",
    "one_frame": "want at least 5 frames",
    "three_frames": "want at least 5 frames",
}


@pytest.mark.parametrize(("name", "message"), BAD.items())
def test_what_cannot_work_is_an_input_error(
    shared_media: Path, run: Callable[..., VideoClip], name: str, message: str
) -> None:
    path = shared_media / "bad" / f"{name}.mp4"
    with pytest.raises(InputError, match=message) as caught:
        run(path)
    assert caught.value.exit_code == 3
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


# name: (width, height, frames, parts of the warnings)
WORKING = {
    "truncated_midstream": (540, 960, range(18, 21), ["header claims 100 frames"]),
    "corrupted_payload": (540, 960, range(11, 51), ["header claims 100 frames", "damaged data"]),
    "rotation_metadata_90": (540, 960, range(50, 51), []),
    "anamorphic_sar_2_1": (960, 540, range(90, 91), []),
    "variable_frame_rate": (884, 498, range(119, 122), ["a gap of 0.4"]),
    "hevc_10bit": (540, 960, range(50, 51), []),
    "odd_641x363_vp9": (641, 363, range(90, 91), []),
    "odd_641x363_yuv444": (641, 363, range(90, 91), []),
    "grayscale": (640, 360, range(90, 91), []),
    "low_frame_rate_5fps": (640, 360, range(150, 151), ["low frame rate: 5.0 fps"]),
    "scene_cut": (640, 360, range(60, 61), ["2 shots found"]),
    "no_person_moving_camera_4x3": (640, 480, range(150, 151), []),
    "no_person_static_camera": (640, 360, range(90, 91), []),
    "small_portrait_216x384": (216, 384, range(50, 51), ["small picture"]),
    "small_4x3_320x240": (320, 240, range(120, 121), []),
}


@pytest.mark.parametrize("name", WORKING)
def test_what_can_work_works_and_says_what_is_wrong(
    shared_media: Path, run: Callable[..., VideoClip], name: str
) -> None:
    width, height, frames, warnings = WORKING[name]
    clip = run(shared_media / "bad" / f"{name}.mp4")
    assert (clip.width_px, clip.height_px) == (width, height)
    assert clip.frame_count in frames
    assert len(clip.warnings) == len(warnings) or name == "corrupted_payload"
    for text in warnings:
        assert any(text in warning for warning in clip.warnings), (text, clip.warnings)


def test_every_bad_file_is_covered(shared_media: Path) -> None:
    assert {path.stem for path in (shared_media / "bad").glob("*.mp4")} == {*BAD, *WORKING}


def test_large_pictures_are_reduced(shared_media: Path, run: Callable[..., VideoClip]) -> None:
    clip = run(shared_media / "videos" / "sam2_bedroom.mp4", max_long_side_px=480)
    assert (clip.width_px, clip.height_px) == (480, 270)


def test_cut_is_exact_and_the_other_shot_can_be_chosen(shared_media: Path, run: Callable[..., VideoClip]) -> None:
    path = shared_media / "bad" / "scene_cut.mp4"
    clip = run(path, shot=1)
    assert clip.shots_s == ((0.0, pytest.approx(2.0)), (pytest.approx(2.0), pytest.approx(4.0)))
    assert clip.shot_index == 1
    assert clip.source_time_s[0] == pytest.approx(2.0)
    with pytest.raises(InputError, match="no shot 2; 2 found"):
        run(path, shot=2)


def test_rotation_makes_the_picture_upright(shared_media: Path, run: Callable[..., VideoClip]) -> None:
    """The rotated file shows the same scene as the 10 bit one, which is stored upright."""
    turned = next(read_frames(run(shared_media / "bad" / "rotation_metadata_90.mp4", max_long_side_px=320)))
    upright = next(read_frames(run(shared_media / "bad" / "hevc_10bit.mp4", max_long_side_px=320)))
    assert np.abs(turned.astype(int) - upright).mean() < 5
    assert np.abs(turned[::-1, ::-1].astype(int) - upright).mean() > 30


def test_variable_rate_uses_time_stamps(tmp_path: Path, run: Callable[..., VideoClip]) -> None:
    # At 1/90 s: pictures at 0, 3, 6, ... (30 fps), then a hole of 12 frames, then irregular ones.
    stamps = [*range(0, 45, 3), *[81, 84, 88, 91, 93, 96]]
    values = [20 + 10 * i for i in range(len(stamps))]
    path = write_video(tmp_path / "vfr.mkv", [gray(v) for v in values], stamps)
    clip = run(path)
    shown = [round(float(np.median(picture[32:, 32:]))) for picture in read_frames(clip)]
    assert clip.frame_count == 33
    assert np.abs(np.array(shown[:15]) - values[:15]).max() <= 2
    assert np.abs(np.array(shown[15:27]) - values[14]).max() <= 2
    assert abs(shown[27] - values[15]) <= 2
    assert clip.source_time_s[14:27] == pytest.approx(42 / 90, abs=1.1e-3)
    assert np.all(np.diff(shown) >= -2)
    assert any("a gap of 0.43 s" in warning for warning in clip.warnings)


def test_start_offset_of_time_stamps(tmp_path: Path, run: Callable[..., VideoClip]) -> None:
    stamps = [900 + 3 * i for i in range(20)]
    clip = run(write_video(tmp_path / "late.mkv", [gray(60 + 5 * i) for i in range(20)], stamps))
    assert clip.frame_count == 20
    assert clip.frame_time_s[0] == 0.0


def test_a_long_hole_ends_the_shot(tmp_path: Path, run: Callable[..., VideoClip]) -> None:
    stamps = [*range(0, 30, 3), *range(900, 960, 3)]
    clip = run(write_video(tmp_path / "hole.mkv", [gray(90)] * len(stamps), stamps))
    assert len(clip.shots_s) == 2
    assert clip.shot_index == 1
    assert clip.frame_count == 20


def test_pictures_too_far_apart_are_no_film(tmp_path: Path, run: Callable[..., VideoClip]) -> None:
    """Each hole is short enough to be held, but the clip would be frames that repeat one another."""
    stamps = [171 * i for i in range(40)]  # 1.9 s
    path = write_video(tmp_path / "slides.mkv", [gray(90)] * len(stamps), stamps)
    with pytest.raises(InputError, match="want a video of at least 2 pictures a second, got 40 pictures in 76 s"):
        run(path)
    dense = [45 * i for i in range(40)]  # 0.5 s
    assert run(write_video(tmp_path / "slow.mkv", [gray(90)] * len(dense), dense)).frame_count == 600


def test_more_streams_than_one_are_said(tmp_path: Path, run: Callable[..., VideoClip]) -> None:
    path = tmp_path / "two.mkv"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("libx264", rate=30) for _ in range(2)]
        for number, stream in enumerate(streams):
            stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv444p"
            stream.disposition = Disposition.default if number else Disposition(0)
        for number, stream in enumerate(streams):
            for _ in range(10):
                picture = av.VideoFrame.from_ndarray(gray(60 + 120 * number), format="rgb24")
                container.mux(stream.encode(picture.reformat(format="yuv444p")))
            container.mux(stream.encode(None))
    clip = run(path)
    assert any("2 video streams found; stream 1 is used" in warning for warning in clip.warnings)
    assert float(np.median(next(read_frames(clip))[32:, 32:])) == pytest.approx(180, abs=3)


def test_high_dynamic_range_is_said(tmp_path: Path, run: Callable[..., VideoClip]) -> None:
    path = tmp_path / "hdr.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv444p10le"
        stream.codec_context.color_trc, stream.codec_context.color_primaries = 16, 9
        for _ in range(10):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(gray(90), format="rgb24")))
        container.mux(stream.encode(None))
    assert any("high dynamic range (PQ)" in warning for warning in run(path).warnings)


def test_decode_order_is_said(tmp_path: Path, run: Callable[..., VideoClip]) -> None:
    path = tmp_path / "clip.avi"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.codec_context.options = {"bf": "3", "b-adapt": "0", "crf": "5"}
        for index in range(60):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(gray(20 + 3 * index), format="rgb24")))
        container.mux(stream.encode(None))
    clip = run(path)
    shown = [float(np.median(picture[32:, 32:])) for picture in read_frames(clip)]
    assert shown == pytest.approx([20 + 3 * index for index in range(60)], abs=2)
    assert any("presentation times do not increase" in warning for warning in clip.warnings)
    assert not any("cut off" in warning or "left out" in warning for warning in clip.warnings)


@pytest.mark.parametrize("end", ["mkv", "webm"])
def test_a_film_that_counts_no_frames_is_cut_off(tmp_path: Path, run: Callable[..., VideoClip], end: str) -> None:
    path = tmp_path / f"clip.{end}"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264" if end == "mkv" else "libvpx-vp9", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for index in range(60):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(gray(20 + 3 * index), format="rgb24")))
        container.mux(stream.encode(None))
    assert not any("cut off" in warning for warning in run(path).warnings)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert any("the header claims 2.00 s, the pictures end at" in warning for warning in run(path).warnings)


def test_trimming(tmp_path: Path, run: Callable[..., VideoClip]) -> None:
    values = [20 + 3 * i for i in range(60)]
    path = write_video(tmp_path / "long.mp4", [gray(v) for v in values], [3 * i for i in range(60)])
    clip = run(path, start_s=0.5, stop_s=1.0)
    shown = [float(np.median(picture[32:, 32:])) for picture in read_frames(clip)]
    assert shown == pytest.approx(values[15:30], abs=2)
    assert not any("header claims" in warning for warning in clip.warnings)
    with pytest.raises(InputError, match="no picture between"):
        run(path, start_s=10.0)


@pytest.mark.parametrize(("width", "height"), [(97, 65), (96, 64), (65, 129)])
def test_large_pictures_shrink_to_even_sizes(
    tmp_path: Path, run: Callable[..., VideoClip], width: int, height: int
) -> None:
    path = write_video(tmp_path / "clip.mp4", [gray(90, width, height)] * 10, list(range(0, 30, 3)))
    assert (run(path).width_px, run(path).height_px) == (width, height)
    small = run(path, max_long_side_px=50)
    assert max(small.width_px, small.height_px) == 50
    assert small.width_px % 2 == small.height_px % 2 == 0
    assert small.width_px / small.height_px == pytest.approx(width / height, rel=0.05)
    corner = next(read_frames(small))[2, 2].astype(int)
    assert np.abs(corner - (220, 30, 30)).max() < 25


def test_paths_that_are_no_files(tmp_path: Path, run: Callable[..., VideoClip]) -> None:
    with pytest.raises(InputError, match="found nothing at"):
        run(tmp_path / "nothing.mp4")
    with pytest.raises(InputError, match="got a folder at"):
        run(tmp_path)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may read everything")
def test_unreadable_file(tmp_path: Path, run: Callable[..., VideoClip]) -> None:
    path = write_video(tmp_path / "clip.mp4", [gray(90)] * 10, list(range(0, 30, 3)))
    path.chmod(0)
    with pytest.raises(InputError, match="permission denied"):
        run(path)


def test_permission_error_is_named(
    tmp_path: Path, run: Callable[..., VideoClip], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_video(tmp_path / "clip.mp4", [gray(90)] * 10, list(range(0, 30, 3)))

    def refuse(*args: object, **options: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(av, "open", refuse)
    with pytest.raises(InputError, match="permission denied"):
        run(path)


def test_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Callable[..., VideoClip]) -> None:
    path = write_video(tmp_path / "clip.mp4", [gray(90)] * 10, list(range(0, 30, 3)))
    device = Path("/dev/full")
    if not device.exists():
        pytest.skip("no /dev/full here")
    opened = FrameWriter.__init__

    def open_full(self: FrameWriter, _path: Path, **options: int) -> None:
        link = tmp_path / "full.mp4"
        link.symlink_to(device)
        opened(self, link, **options)

    monkeypatch.setattr(FrameWriter, "__init__", open_full)
    with pytest.raises(Video2AnimError, match="no space left on device at"):
        run(path)


@pytest.mark.parametrize(
    "options",
    [
        {"shot": "first"},
        {"shot": -1},
        {"start_s": 2.0, "stop_s": 1.0},
        {"max_long_side_px": 0},
        {"start_s": math.nan},
        {"start_s": math.inf},
        {"stop_s": math.nan},
    ],
)
def test_config_is_checked(options: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="ingest"):
        resolve(pipeline_nodes(), "p", [("test", {"ingest": options})])
