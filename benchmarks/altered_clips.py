"""Errors of the motion on real clips with motion capture, as other cameras and editors would have made them.

    python benchmarks/altered_clips.py --media ../shared/media --work altered_work

Of each clip the first seconds are altered (`ALTERED`) and the pipeline runs on the result. Motions of the camera are
rotations about its center, which are exact for any scene; the focal lengths of the clips are those that the pipeline
finds on them. `eval_mocap.py` of the media scores the results. Writes `benchmarks/results/altered_clips-<date>.json`
and prints a table.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from frame_rate import TICKS, pictures
from real_clips import mocap_report
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from v2a_bench import call, number

from video2anim.lab.lifter.hidden import board
from video2anim.types.skeleton import MIRROR_JOINT

FOCAL_PX = {"ocv_sts": 949.0, "ocv_walk": 932.0}
STEP = 2
"""Every so many pictures one is kept: 30 a second."""
SEED = 1
STRAIGHT = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 50, 1e-6)
"""When the undistortion of a pixel ends."""
SCORES = {
    "pa_mpjpe_mm": "PA-MPJPE, mm", "mpjpe_root_mm": "root-relative, mm", "whole_mpjpe_mm": "one alignment, mm",
    "gravity_tilt_deg": "gravity, deg", "accel_error_m_s2": "acceleration, m/s2",
}  # fmt: skip
"""Of the report of `eval_mocap.py`."""

Images = list[np.ndarray]


def main() -> None:
    """Make the clips, run the pipeline and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--media", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="folder of the clips and scene folders, kept")
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--kinds", nargs="+", default=list(ALTERED), choices=list(ALTERED))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    rows = []
    for clip, focal_px in FOCAL_PX.items():
        source = options.media / "videos" / f"{clip}.mp4"
        for kind in options.kinds:
            video = options.work / f"{clip}_{kind.replace(' ', '_')}.mp4"
            if not video.is_file():
                images = [rgb for tick, rgb in pictures(source) if tick % STEP == 0 and tick < TICKS * options.seconds]
                write(video, ALTERED[kind].images(images, focal_px), ALTERED[kind].crf)
            scene_dir = options.work / video.stem
            call("run", str(video), "--out", str(scene_dir))
            motion = scene_dir / "motion.npz"
            if kind == "mirrored":
                motion = mirrored_back(motion, options.work / f"{video.stem}_back.npz")
            found = mocap_report(motion, clip, options.media)
            rows.append({"clip": clip, "kind": kind, **{key: found[key] for key in SCORES}})
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "seed": SEED, "seconds": options.seconds, "rows": rows,
    }  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"altered_clips-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    lines = [[row["clip"], row["kind"], *(number(row[key]) for key in SCORES)] for row in rows]
    head = ["clip", "altered", *SCORES.values()]
    table = "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *lines))
    sys.stdout.write(f"{table}\n{target}\n")


def write(target: Path, images: Images, crf: int) -> None:
    """H.264 at 30 pictures a second."""
    with av.open(str(target), "w") as container:
        stream = container.add_stream("libx264", rate=TICKS // STEP, options={"crf": str(crf)})
        stream.pix_fmt, (height, width) = "yuv420p", images[0].shape[:2]
        stream.height, stream.width = height // 2 * 2, width // 2 * 2
        for tick, image in enumerate(images):
            even = np.ascontiguousarray(image[: stream.height, : stream.width])
            frame = av.VideoFrame.from_ndarray(even, format="rgb24")
            frame.pts, frame.time_base = tick, Fraction(STEP, TICKS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def mirrored_back(motion: Path, target: Path) -> Path:
    """The motion in the plane x = 0 reflected, left and right exchanged, as far as `eval_mocap.py` looks at it."""
    arrays = dict(np.load(motion))
    for name, value in arrays.items():
        if name.startswith("joints") and value.ndim == 3:
            arrays[name] = value[:, MIRROR_JOINT] * [-1, 1, 1]
    np.savez(target, **arrays)
    return target


def rotated(images: Images, focal_px: float, turned_rad: np.ndarray, zoom: float) -> Images:
    """As a camera at the same place shows them that is turned (rotation vectors, frames x 3) and has a longer lens."""
    height, width = images[0].shape[:2]
    before = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    after = before * [[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]]
    homographies = after @ Rotation.from_rotvec(turned_rad).as_matrix() @ np.linalg.inv(before)
    return [
        cv2.warpPerspective(image, H, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        for image, H in zip(images, homographies, strict=True)
    ]


def swaying_rad(frames: int, parts: Sequence[tuple[float, float]]) -> np.ndarray:
    """Rotation vectors of a hand-held camera: smooth noise of (standard deviation in degrees, hertz) each."""
    rng, sway = np.random.default_rng(SEED), np.zeros((frames, 3))
    for sigma_deg, rate_hz in parts:
        width = TICKS / STEP / (2 * np.pi * rate_hz)
        pad = int(4 * TICKS / STEP / rate_hz)
        smooth = gaussian_filter1d(rng.normal(size=(frames + 2 * pad, 3)), width, axis=0)[pad : pad + frames]
        sway += np.radians(sigma_deg) * smooth / smooth.std(0)
    return sway


def hand_held(images: Images, focal_px: float) -> Images:
    """By hand: 1.5 degrees at 0.3 Hz and 0.12 at 3 Hz."""
    return rotated(images, focal_px, swaying_rad(len(images), ((1.5, 0.3), (0.12, 3.0))), 1.25)


def panned(images: Images, focal_px: float) -> Images:
    """12 degrees from left to right, by hand."""
    turned = swaying_rad(len(images), ((0.4, 0.5), (0.06, 3.0)))
    turned[:, 1] += np.radians(np.linspace(-6, 6, len(images)))
    return rotated(images, focal_px, turned, 1.3)


def rolled(images: Images, focal_px: float) -> Images:
    """By 20 degrees; corners show reflections."""
    return rotated(images, focal_px, np.tile([0.0, 0.0, np.radians(20)], (len(images), 1)), 1.12)


def barreled(images: Images, focal_px: float) -> Images:
    """By a wide lens (k1 = -0.25), its black corners cut off."""
    height, width = images[0].shape[:2]
    lens = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2).astype(float)
    straight = cv2.undistortPoints(pixels, lens, np.array([-0.25, 0, 0, 0]), P=lens, criteria=STRAIGHT)
    at = straight.reshape(height, width, 2).astype(np.float32)
    inner = slice(height // 16, -height // 16), slice(width // 20, -width // 20)
    return [cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC)[inner] for image in images]


def dark(images: Images, _: float) -> Images:
    """At 28 % of the light, with the noise of a small sensor."""
    rng = np.random.default_rng(SEED)
    return [np.clip(0.28 * image + rng.normal(0, 7, image.shape), 0, 255).astype(np.uint8) for image in images]


def small(images: Images, _: float) -> Images:
    """Short side 360 px."""
    scale = 360 / min(images[0].shape[:2])
    return [cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for image in images]


def filled(images: Images, _: float) -> Images:
    """In a picture of 16:9 whose sides are filled with the blurred picture."""
    height, width = images[0].shape[:2]
    wide, found = height * 16 // 9, []
    for image in images:
        whole = cv2.resize(image, (wide, height * wide // width))
        top = (len(whole) - height) // 2
        whole = cv2.GaussianBlur(whole[top : top + height], (0, 0), wide / 90)
        whole[:, (wide - width) // 2 :][:, :width] = image
        found.append(whole)
    return found


def captioned(images: Images, _: float) -> Images:
    """With a line of white text over the floor."""
    height, width = images[0].shape[:2]
    at, scale = (width // 12, height * 93 // 100), width / 380
    for image in images:
        for color, thick in (((0, 0, 0), 14), ((255, 255, 255), 5)):
            cv2.putText(image, "HOW TO DO IT RIGHT", at, cv2.FONT_HERSHEY_DUPLEX, scale, color, thick * width // 720)
    return images


def cut(top: float, bottom: float) -> Callable[[Images, float], Images]:
    """Rows between two shares of the height."""
    return lambda images, _: [image[int(len(image) * top) : int(len(image) * bottom) // 2 * 2] for image in images]


def behind(left: float, top: float, right: float, bottom: float) -> Callable[[Images, float], Images]:
    """A board before the person, its sides at these shares of the picture."""

    def covered(images: Images, _: float) -> Images:
        height, width = images[0].shape[:2]
        rows = slice(int(height * top), int(height * bottom))
        columns = slice(int(width * left), int(width * right))
        look = board(np.random.default_rng(SEED), rows.stop - rows.start, columns.stop - columns.start)
        for image in images:
            image[rows, columns] = look
        return images

    return covered


@dataclass(frozen=True)
class Alteration:
    """How pictures are changed and coded."""

    images: Callable[[Images, float], Images]
    """Of pictures and focal length (px)."""
    crf: int = 16
    """Of H.264: higher is worse."""


ALTERED = {
    "none": Alteration(lambda images, _: images),
    "hand-held": Alteration(hand_held),
    "panned": Alteration(panned),
    "rolled": Alteration(rolled),
    "wide lens": Alteration(barreled),
    "small": Alteration(small, 36),
    "dark": Alteration(dark, 30),
    "mirrored": Alteration(lambda images, _: [np.ascontiguousarray(image[:, ::-1]) for image in images]),
    "blurred bars": Alteration(filled),
    "captioned": Alteration(captioned),
    "cut at the knees": Alteration(cut(0.15, 0.70)),
    "cut at the hips": Alteration(cut(0.10, 0.62)),
    "behind a counter": Alteration(behind(0.15, 0.66, 0.80, 1.0)),
    "behind a post": Alteration(behind(0.47, 0.2, 0.56, 0.93)),
}


if __name__ == "__main__":
    main()
