"""What is let in as a video: one regular file that opens no other; which of its frames and streams count."""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import av.logging
import numpy as np
import pytest
from av.error import BlockingIOError as NoThread
from av.stream import Disposition
from test_video_clips import make_clip, number_of, numbered

from video2anim.cli.compose import source_video
from video2anim.errors import InputError, is_memory_shortage
from video2anim.video import read_frames
from video2anim.video.container import open_video
from video2anim.video.decode import DecodeReport, decode, probe
from video2anim.video.source_scan import scan_source

WIDTH, HEIGHT = 160, 96


def write(path: Path, count: int, *, b_frames: int = 0, first: int = 0, **options: int) -> Path:
    """Numbered pictures at 30 fps; with B-frames, decode order differs from the order shown."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for name, value in options.items():
            setattr(stream.codec_context, name, value)
        stream.codec_context.options = {"crf": "10", "bf": str(b_frames), "b-adapt": "0", "g": "30"}
        for index in range(first, first + count):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(numbered(index, WIDTH, HEIGHT), format="rgb24")))
        container.mux(stream.encode(None))
    return path


def decoded(path: Path) -> list[int]:
    """Numbers of the pictures, as the stage reads them."""
    header = probe(path)
    source_scan = scan_source(path, header)
    pictures = decode(path, header, DecodeReport(), source_scan.stamps)
    return [number_of(picture.rgb(WIDTH, HEIGHT)) for picture in pictures]


# What opens other files, or is no file.

PLAYLISTS = {
    "hls.m3u8": "#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:4.0,\nsegment.ts\n#EXT-X-ENDLIST\n",
    "address.m3u8": "#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:4.0,\nhttp://localhost:9/a.ts\n#EXT-X-ENDLIST\n",
    "concat_named.mp4": "ffconcat version 1.0\nfile segment.ts\n",
    "session.sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\n",
}


@pytest.mark.parametrize("name", PLAYLISTS)
def test_files_that_open_others_are_refused(tmp_path: Path, name: str) -> None:
    write(tmp_path / "segment.ts", 20)
    path = tmp_path / name
    path.write_text(PLAYLISTS[name])
    kind = {"h": "hls", "a": "hls", "c": "concat", "s": "sdp"}[name[0]]
    with pytest.raises(InputError, match=f"is of the format '{kind}'; want a video file") as caught:
        probe(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    assert av.logging.get_level() is None, "FFmpeg's log stays off"


def test_a_numbered_picture_does_not_open_its_neighbors(tmp_path: Path) -> None:
    from PIL import Image

    for index in range(3):
        Image.fromarray(numbered(index, WIDTH, HEIGHT)).save(tmp_path / f"p{index}.png")
    (tmp_path / "p%d.png").write_bytes((tmp_path / "p0.png").read_bytes())
    with pytest.raises(InputError, match="still image"):
        probe(tmp_path / "p%d.png")


def test_a_clip_replaced_by_a_playlist_is_not_read(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "clip.mp4", 5)
    (tmp_path / "other.mp4").write_bytes(clip.video.path.read_bytes())
    clip.video.path.write_text("ffconcat version 1.0\nfile other.mp4\n")
    with pytest.raises(InputError, match="cannot read the clip's video"):
        list(read_frames(clip))


@pytest.fixture
def never_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Opening a FIFO blocks and a device may never end: a test must not find that out by hanging."""

    def opened(*args: object, **options: object) -> None:
        raise AssertionError("opened")

    monkeypatch.setattr(av, "open", opened)
    monkeypatch.setattr(Path, "open", opened)


def fifo(path: Path) -> Path:
    os.mkfifo(path)
    return path


def link_to(target: str) -> Callable[[Path], Path]:
    def made(path: Path) -> Path:
        path.symlink_to(target)
        return path

    return made


@pytest.mark.usefixtures("never_opened")
@pytest.mark.parametrize("read", [source_video, open_video])
@pytest.mark.parametrize(
    ("make", "said"),
    [
        (fifo, "got a pipe at"),
        (link_to("/dev/zero"), "got a device or socket at"),
        (link_to("link.mp4"), "got Too many levels of symbolic links at"),
        (lambda path: path.parent / ("n" * 300), "got File name too long at"),
        (lambda path: path.parent, "got a folder at"),
        (lambda path: path, "found nothing at"),
        (lambda path: Path("https://example.org/a.mp4"), "got the address https://example.org/a.mp4; download"),
    ],
)
def test_what_is_no_regular_file_is_refused_unopened(
    tmp_path: Path, make: Callable[[Path], Path], said: str, read: Callable[[Path], object]
) -> None:
    with pytest.raises(InputError, match=said):
        read(make(tmp_path / "link.mp4"))


# Which frames count.


@pytest.mark.parametrize("b_frames", [0, 3])
def test_frames_hidden_by_an_edit_list_are_not_missed(tmp_path: Path, b_frames: int) -> None:
    data = bytearray(write(tmp_path / "whole.mp4", 90, b_frames=b_frames).read_bytes())

    def field(box: bytes, offset: int) -> int:
        return struct.unpack_from(">I", data, data.index(box) + offset)[0]

    movie_scale, media_scale = field(b"mvhd", 16), field(b"mdhd", 16)
    # Entry: duration in the movie's scale, first time in the media's.
    struct.pack_into(">Ii", data, data.index(b"elst") + 12, movie_scale * 25 // 30, media_scale * 40 // 30)
    path = tmp_path / "edited.mp4"
    path.write_bytes(data)
    assert probe(tmp_path / "whole.mp4").claimed_frames == 90
    header = probe(path)
    source_scan = scan_source(path, header)
    assert source_scan.report.frames == header.claimed_frames == 25


def test_a_cut_file_still_claims_all_its_frames(tmp_path: Path) -> None:
    """The index stands before the pictures here, so that it is whole where they are not."""
    path = tmp_path / "cut.mp4"
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.options = {"g": "5", "crf": "1"}
        for index in range(60):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(numbered(index, WIDTH, HEIGHT), format="rgb24")))
        container.mux(stream.encode(None))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    header = probe(path)
    assert header.claimed_frames == 60
    assert scan_source(path, header).report.frames < 60


@pytest.mark.parametrize("suffix", ["avi", "h264", "mp4", "ts"])
@pytest.mark.parametrize("b_frames", [0, 3])
def test_no_picture_is_lost_and_the_order_is_that_shown(tmp_path: Path, suffix: str, b_frames: int) -> None:
    """AVI and raw H.264 carry no presentation times."""
    path = write(tmp_path / f"clip.{suffix}", 103, b_frames=b_frames)
    assert decoded(path) == list(range(103))
    source_scan = scan_source(path, probe(path))
    assert source_scan.report.dropped_stamps == 0
    assert np.diff(source_scan.time_s) == pytest.approx(1 / 30, abs=1e-4)
    assert source_scan.stamps == ("dts" if (suffix, b_frames) == ("avi", 3) else "pts")


# Which stream counts.


@pytest.fixture
def two_streams(tmp_path: Path) -> Path:
    """Streams of numbers from 0 and from 64; the second is the default one."""
    path = tmp_path / "two.mkv"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("libx264", rate=30) for _ in range(2)]
        for number, stream in enumerate(streams):
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
            stream.disposition = Disposition.default if number else Disposition(0)
        for index in range(20):
            for number, stream in enumerate(streams):
                picture = numbered(index + 64 * number, WIDTH, HEIGHT)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        for stream in streams:
            container.mux(stream.encode(None))
    return path


def test_the_default_stream_is_taken(two_streams: Path) -> None:
    header = probe(two_streams)
    assert (header.stream_index, header.video_streams) == (1, 2)
    assert decoded(two_streams) == list(range(64, 84))


def test_sound_with_a_cover_is_no_video(tmp_path: Path) -> None:
    from PIL import Image

    cover, path = tmp_path / "cover.png", tmp_path / "song.m4a"
    Image.fromarray(numbered(1, WIDTH, HEIGHT)).save(cover)
    with av.open(str(path), "w", format="mp4") as container, av.open(str(cover)) as picture:
        sound = container.add_stream("aac", rate=44100)
        image = container.add_stream_from_template(picture.streams.video[0])
        image.disposition = Disposition.attached_pic
        packet = next(picture.demux(video=0))
        packet.stream, packet.pts, packet.dts = image, 0, 0
        container.mux(packet)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(sound.encode(frame))
        container.mux(sound.encode(None))
    with pytest.raises(InputError, match=r"no video stream \(it holds: audio, a cover picture\)"):
        probe(path)


@pytest.mark.parametrize(("transfer", "name"), [(16, "PQ"), (18, "HLG"), (1, "")])
def test_high_dynamic_range_is_named(tmp_path: Path, transfer: int, name: str) -> None:
    assert probe(write(tmp_path / "clip.mp4", 6, color_trc=transfer, color_primaries=9, colorspace=9)).hdr == name


# Want of memory.


@pytest.mark.parametrize(
    ("error", "shortage"),
    [
        (MemoryError(), True),
        (BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"), True),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), True),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"), True),
        (OSError(errno.ENOSPC, "No space left on device"), False),
        (ValueError("other"), False),
    ],
)
def test_signs_of_want_of_memory(error: Exception, shortage: bool) -> None:
    assert is_memory_shortage(error) is shortage


def test_want_of_memory_is_not_taken_for_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "clip.mp4", 20)
    header, real = probe(path), open_video

    class Packet:
        def decode(self) -> list[av.VideoFrame]:
            raise NoThread(errno.EAGAIN, "Resource temporarily unavailable")

    class Container:
        def __init__(self, path: Path) -> None:
            self.real = real(path)
            self.streams = self.real.streams

        def __enter__(self) -> Container:
            return self

        def __exit__(self, *args: object) -> None:
            self.real.close()

        def demux(self, stream: av.VideoStream) -> Iterator[Packet]:
            yield Packet()

    monkeypatch.setattr("video2anim.video.decode.open_video", Container)
    with pytest.raises(BlockingIOError):
        list(decode(path, header, DecodeReport()))
