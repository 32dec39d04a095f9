"""Frames of a source at given times, and warnings about the source."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from video2anim.errors import StageError
from video2anim.types import SourceInfo
from video2anim.video.bars import Crop
from video2anim.video.cfr import max_gap_s
from video2anim.video.decode import DecodeReport, SourceHeader, Stamps, decode
from video2anim.video.source_scan import SourceScan

_LOW_FPS = 20.0
"""Below this rate fast motion is lost."""
_SMALL_SIDE_PX = 240
"""Below this short side people are detected less reliably."""
_LONG_GAP_S = 0.25
"""Longer gaps of the time stamps, in which an image is held, are visible."""
_CUT_OFF_S = 0.5
"""Seconds by which a header may be wrong about the end of an intact file."""


def frames_at(
    path: Path,
    header: SourceHeader,
    stamps: Stamps,
    wanted_s: Float[np.ndarray, "frames"],
    size_px: tuple[int, int],
) -> Iterator[tuple[np.ndarray, bool]]:
    """One RGB image per wanted time stamp, and whether it is the image of that time.

    Where the decoder, on damaged input, does not return an image that it returned on the first pass, the last one is
    held.

    Raises:
        StageError: no picture decodes at all.
    """
    position = 0
    held: np.ndarray | None = None
    for picture in decode(path, header, DecodeReport(), stamps):
        if picture.time_s < wanted_s[position]:
            continue
        rgb: np.ndarray | None = None
        while position < len(wanted_s) and wanted_s[position] <= picture.time_s:
            found = wanted_s[position] == picture.time_s
            if rgb is None and (found or held is None):
                rgb = picture.rgb(*size_px)
            held = rgb if rgb is not None else held
            assert held is not None
            yield held, bool(found)
            position += 1
        if position == len(wanted_s):
            return
    if held is None:
        raise StageError(f"{path}: pictures decoded on the first pass but not on the second; is the file changing?")
    for _ in range(len(wanted_s) - position):
        yield held, False


def source_warnings(
    header: SourceHeader,
    source_scan: SourceScan,
    shot: int,
    shot_time_s: Float[np.ndarray, "shot_pictures"],
    size_px: tuple[int, int],
    area: Crop,
) -> list[str]:
    """One line for each property of the source that may make results worse."""
    texts = []
    shots_s, report = source_scan.shots_s(), source_scan.report
    if len(shots_s) > 1:
        start_s, end_s = shots_s[shot]
        texts.append(
            f"{len(shots_s)} shots found; shot {shot} ({start_s:.2f} to {end_s:.2f} s) is used, "
            f"--set ingest.shot=N (0 to {len(shots_s) - 1}) chooses another"
        )
    if header.video_streams > 1:
        texts.append(
            f"{header.video_streams} video streams found; stream {header.stream_index} is used, the one marked as "
            "default, else the first; for another, copy it to a file of its own"
        )
    if header.hdr:
        texts.append(
            f"high dynamic range ({header.hdr}) is not tone mapped: images are dark and pale; "
            "convert the video to standard range (BT.709) first"
        )
    if source_scan.stamps == "dts":
        texts.append("the file's presentation times do not increase; decode times are used")
    if source_scan.reached_end and header.claimed_frames > report.frames:
        texts.append(
            f"the header claims {header.claimed_frames} frames, {report.frames} decode: the file is cut off or damaged"
        )
    end_s = source_scan.time_s[-1] + source_scan.period_s
    if source_scan.reached_end and header.claimed_s > end_s + _CUT_OFF_S:
        texts.append(
            f"the header claims {header.claimed_s:.2f} s, the pictures end at {end_s:.2f} s: the file is cut off or "
            "damaged"
        )
    if report.damaged_packets or report.damaged_frames or report.stopped_by:
        stopped = f"; decoding stopped early: {report.stopped_by}" if report.stopped_by else ""
        texts.append(
            f"damaged data: {report.damaged_packets} packets did not decode, "
            f"{report.damaged_frames} pictures are marked corrupt{stopped}"
        )
    if report.dropped_stamps:
        texts.append(f"{report.dropped_stamps} pictures left out: their time stamps do not advance")
    if len(shot_time_s) > 1:
        fps = 1.0 / float(np.median(np.diff(shot_time_s)))
        if fps < _LOW_FPS:
            texts.append(f"low frame rate: {fps:.1f} fps (want {_LOW_FPS:.0f} or more); fast motion will be lost")
        elif max_gap_s(shot_time_s) > _LONG_GAP_S:
            texts.append(f"the source has a gap of {max_gap_s(shot_time_s):.2f} s; the image before is held")
    return texts + _size_warnings(header, size_px, area)


def _size_warnings(header: SourceHeader, size_px: tuple[int, int], area: Crop) -> list[str]:
    texts = []
    if (area.width_px, area.height_px) != size_px:
        whole, scale = header.upright_size_px(), header.upright_size_px()[0] / size_px[0]
        part = [round(scale * px) for px in (area.width_px, area.height_px, area.left_px, area.top_px)]
        texts.append(
            f"bars around the picture are left out ({whole[0]}x{whole[1]} px -> {part[0]}x{part[1]}): to lay the "
            f"scene over your footage, cut that too: ffmpeg -i VIDEO -vf crop={':'.join(map(str, part))} CUT"
        )
    if min(area.width_px, area.height_px) < _SMALL_SIDE_PX:
        texts.append(
            f"small picture: {area.width_px}x{area.height_px} px (want a short side of {_SMALL_SIDE_PX} or more); "
            "people will be found less reliably"
        )
    return texts


def source_info(header: SourceHeader, source_scan: SourceScan) -> SourceInfo:
    """Properties of the source by container and decoder."""
    time_s = source_scan.time_s
    span_s = float(time_s[-1] - time_s[0])
    return SourceInfo(
        codec=header.codec,
        pixel_format=header.pixel_format,
        stored_width_px=header.stored_width_px,
        stored_height_px=header.stored_height_px,
        rotation_deg=header.rotation_deg,
        pixel_aspect=header.pixel_aspect,
        average_fps=(len(time_s) - 1) / span_s if span_s > 0 else header.nominal_fps,
        decoded_frames=source_scan.report.frames,
        claimed_frames=header.claimed_frames,
        duration_s=span_s + source_scan.period_s,
        focal_35mm=header.focal_35mm,
    )
