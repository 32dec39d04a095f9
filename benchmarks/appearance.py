"""Distances of appearance descriptors: of one person over time, and between different people.

    python benchmarks/appearance.py SCENE...

Scenes are folders of `video2anim run` (stage track at least). The first and the last third of tracks are compared by
`AppearanceDescriptor.distance`: within one track, and between different tracks of all scenes. The thresholds in
`video2anim/tracking/tracker.py` come from this script.
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np

from video2anim.artifacts.codec import read_value
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.tracking.appearance import AppearanceDescriptor, clothing_histogram
from video2anim.types import PersonTracks, VideoClip
from video2anim.video import read_frames

EVERY = 5


def main() -> None:
    """Read the tracks, compare descriptors, print quantiles."""
    people: dict[str, tuple[AppearanceDescriptor, AppearanceDescriptor]] = {}
    for scene in map(Path, sys.argv[1:]):
        clip = read_value(VideoClip, stage_folder(scene, "ingest"))
        tracks = read_value(PersonTracks, stage_folder(scene, "track"))
        thirds = {track.person_id: (AppearanceDescriptor(), AppearanceDescriptor()) for track in tracks.people}
        for frame, image in enumerate(read_frames(clip)):
            if frame % EVERY:
                continue
            for track in tracks.people:
                row = track.row(frame)
                third = 3 * (frame - track.first_frame) // len(track.valid)
                if row is not None and third != 1:
                    seen = clothing_histogram(image, track.landmarks_px[row], track.visibility[row])
                    thirds[track.person_id][third // 2].add(seen)
        people |= {f"{scene.name}/{number}": looks for number, looks in thirds.items()}
    same = {name: first.distance(last) for name, (first, last) in people.items()}
    other = {(a, b): people[a][0].distance(people[b][1]) for a, b in itertools.permutations(people, 2)}
    for title, values in (("same person", same), ("different people", other)):
        known = np.array([value for value in values.values() if np.isfinite(value)])
        quantiles = np.quantile(known, (0.0, 0.05, 0.5, 0.95, 1.0))
        sys.stdout.write(
            f"{title}: {len(known)} pairs, least, 5 %, median, 95 %, largest: "
            + ", ".join(f"{q:.2f}" for q in quantiles) + "\n"
        )  # fmt: skip
    for name, value in sorted(same.items(), key=lambda item: -np.nan_to_num(item[1])):
        sys.stdout.write(f"{name} {value:.2f}\n")


if __name__ == "__main__":
    main()
