"""The preview's last step: its pictures with the sound of the input, laid out so that it plays while it loads."""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
from av.audio.stream import AudioStream
from av.container import InputContainer
from av.error import FFmpegError
from av.packet import Packet
from jaxtyping import Float

from video2anim.video.container import open_video
from video2anim.video.encode import write_error

RATE_HZ = 48_000
_LAYOUT, _CHANNELS, _SAMPLES = "stereo", 2, "fltp"


def finish_video(path: Path, silent: Path, source: Path | None, start_s: float) -> bool:
    """Copy an H.264 file's pictures, with the index at the start of the file, and add the source's sound as AAC.

    Args:
        path: File to make, `.mp4`.
        silent: The pictures, from time 0 on, none reordered.
        source: File that has the sound, or None.
        start_s: Time in the source of the first picture; the sound ends with the pictures.

    Returns:
        Whether there is sound. Parts of it that the source lacks or that do not decode are silent.

    Raises:
        InputError: the disk is full.
        StageError: the source cannot be opened, or the file cannot be written.
    """
    try:
        with contextlib.ExitStack() as open_files:
            pictures = open_files.enter_context(av.open(str(silent)))
            heard = None if source is None else open_files.enter_context(open_video(source))
            made = open_files.enter_context(av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}))
            packets = [_copied(pictures, made.add_stream_from_template(pictures.streams.video[0]))]
            has_sound = heard is not None and bool(heard.streams.audio)
            if heard is not None and has_sound:
                voice = made.add_stream("aac", rate=RATE_HZ, layout=_LAYOUT)
                duration_s = float(pictures.duration or 0) / av.time_base
                packets.append(_encoded(_chunks(heard, start_s, duration_s), voice))
            for packet in heapq.merge(*packets, key=_time_s):
                made.mux(packet)
        return has_sound
    except (FFmpegError, OSError) as error:
        raise write_error(path, error) from error


def _time_s(packet: Packet) -> float:
    assert packet.dts is not None
    return float(packet.dts * packet.time_base)


def _copied(pictures: InputContainer, stream: av.VideoStream) -> Iterator[Packet]:
    for packet in pictures.demux(pictures.streams.video[0]):
        if packet.dts is not None:  # the last one only marks the end
            packet.stream = stream
            yield packet


def _encoded(chunks: Iterator[np.ndarray], voice: AudioStream) -> Iterator[Packet]:
    done = 0
    for chunk in chunks:
        frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(chunk), format=_SAMPLES, layout=_LAYOUT)
        frame.sample_rate, frame.pts = RATE_HZ, done
        done += chunk.shape[1]
        yield from voice.encode(frame)
    yield from voice.encode(None)


def _chunks(
    heard: InputContainer, start_s: float, duration_s: float
) -> Iterator[Float[np.ndarray, "channels samples"]]:
    """Samples from `start_s` on without holes: what is missing is 0, what comes twice is left out."""
    total, done = round(duration_s * RATE_HZ), 0
    for first, samples in _decoded(heard, start_s):
        if first >= total:
            break
        if first > done:
            yield np.zeros((_CHANNELS, first - done), np.float32)
            done = first
        fresh = samples[:, done - first : total - first]
        if fresh.shape[1]:
            yield fresh
            done += fresh.shape[1]
    if done < total:
        yield np.zeros((_CHANNELS, total - done), np.float32)


def _decoded(heard: InputContainer, start_s: float) -> Iterator[tuple[int, Float[np.ndarray, "channels samples"]]]:
    """Decoded sound at `RATE_HZ`, each piece with the number of its first sample, counted from `start_s`."""
    resampler = av.AudioResampler(format=_SAMPLES, layout=_LAYOUT, rate=RATE_HZ)
    for packet in heard.demux(heard.streams.audio[0]):
        try:
            frames = packet.decode()
        except FFmpegError:
            continue  # a damaged piece
        for frame in frames:
            for piece in resampler.resample(frame):
                if piece.time is not None:
                    yield round((piece.time - start_s) * RATE_HZ), piece.to_ndarray()
