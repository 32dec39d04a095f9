"""One picture of finished scenes: for each scene an input frame and two views, or four views of its objects.

    make demo
    python benchmarks/v2a_bench.py --count 1 --motion cmu.npz deepmimic.npz --work v2a
    python benchmarks/scene_sheet.py demo_out v2a/results/00_walk --out docs/scene.jpg
    python benchmarks/scene_sheet.py scenes/* --views 4 --out sheet.png

The frame is at 60 % of the clip (`--at`).
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import av
import cv2
import numpy as np

from video2anim.lab.eval.results import SceneResult
from video2anim.viewer.software import render_software

SIZE_PX = (480, 270)
TURNS = {2: (0.6, -0.6), 4: (0.0, np.pi / 2, np.pi, -np.pi / 2)}


def main() -> None:
    """Render every scene and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--at", type=float, default=0.6, help="share of the clip")
    parser.add_argument("--views", type=int, choices=sorted(TURNS), default=2)
    options = parser.parse_args()
    rows = [np.concatenate(row(folder, options.at, TURNS[options.views]), 1) for folder in options.scenes]
    cv2.imwrite(str(options.out), np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


def row(folder: Path, at: float, turns: tuple[float, ...]) -> list[np.ndarray]:
    """Input frame and views of one scene."""
    result = SceneResult(folder)
    people = result.motions()["refined"]
    valid = np.flatnonzero(people[0].valid)
    frame = int(valid[int(at * (len(valid) - 1))])
    touches = result.record.contacts
    views = [render_software(people, result.scene, frame, *SIZE_PX, contacts=touches, turn_rad=turn) for turn in turns]
    return [fitted(input_frame(result, frame)), *views]


def input_frame(result: SceneResult, number: int) -> np.ndarray:
    """Frame of the clip as stage ingest stored it."""
    with av.open(str(result.clip.video.path)) as container:
        frame = next(itertools.islice(container.decode(video=0), number, None))
        return frame.to_ndarray(format="rgb24")


def fitted(picture: np.ndarray) -> np.ndarray:
    """The picture scaled to fit a white tile of `SIZE_PX`."""
    scale = min(SIZE_PX[0] / picture.shape[1], SIZE_PX[1] / picture.shape[0])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    canvas = np.full((SIZE_PX[1], SIZE_PX[0], 3), 255, np.uint8)
    y, x = (SIZE_PX[1] - small.shape[0]) // 2, (SIZE_PX[0] - small.shape[1]) // 2
    canvas[y : y + small.shape[0], x : x + small.shape[1]] = small
    return canvas


if __name__ == "__main__":
    main()
