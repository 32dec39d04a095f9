"""Writes one frame of every clip of a synthetic set into one PNG.

python benchmarks/contact_sheet.py bench_work/truth docs/synthetic_clips.png
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path

import av
import cv2
import numpy as np

from video2anim.artifacts.images import write_png

TILE = (256, 192)
COLUMNS = 6


def main() -> None:
    """Read the middle frame of each video and write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--at", type=float, default=0.55, help="share of the clip")
    options = parser.parse_args()
    names = [clip["name"] for clip in json.loads((options.folder / "set.json").read_text())["clips"]]
    tiles = [tile(options.folder / name, options.at) for name in names]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
    rows = [np.concatenate(tiles[k : k + COLUMNS], 1) for k in range(0, len(tiles), COLUMNS)]
    write_png(options.out, np.concatenate(rows, 0))


def tile(folder: Path, at: float) -> np.ndarray:
    """A frame at the size of a tile."""
    frames = json.loads((folder / "meta.json").read_text())["frames"]
    with av.open(str(folder / "video.mp4")) as container:
        frame = next(itertools.islice(container.decode(video=0), int(at * (frames - 1)), None))
        return cv2.resize(frame.to_ndarray(format="rgb24"), TILE, interpolation=cv2.INTER_AREA)


if __name__ == "__main__":
    main()
