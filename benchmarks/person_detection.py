"""Who is found in single images by BlazePose's detector, and who more by Objectron's.

    python benchmarks/person_detection.py SCENE... --sheet people.png --crops crops.png

Scenes are folders of `video2anim run` (stage ingest at least). Prints for each, over images a second apart, how many
people the first finds, and the scores of those that only the second finds (the landmark network confirms both); draws
these into a contact sheet, one row a scene, on which to see whether they are people. `MIN_OBJECT_SCORE` in
`video2anim/tracking/person_detection.py` comes from this sheet, `MAX_DISAGREEMENT` from the other: all crops that
converge, by disagreement, with presence and disagreement; red where the presence is too low for somebody new.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from stages.track import TrackConfig
from video2anim.artifacts.codec import read_value
from video2anim.networks import load_model
from video2anim.networks.blazepose import BlazePose, PoseEstimate
from video2anim.networks.objectron import ObjectFinder
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.tracking.person_detection import (
    MIN_PRESENCE_NEW,
    confirm,
    converged,
    overlaps,
    roi_of_box,
    same_person,
    scan,
)
from video2anim.types import VideoClip
from video2anim.video import read_frames

MIN_OBJECT_SCORE = 0.2
"""Of Objectron's detections here, below that of stage track."""
IMAGES = 10
"""Most images of a scene."""
TILE_PX = (90, 150)
COLUMNS = 14
"""Of the contact sheet."""


def main() -> None:
    """Find, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--sheet", type=Path, help="PNG of the people that only Objectron's detector finds")
    parser.add_argument("--crops", type=Path, help="PNG of all crops that converge, people or not")
    options = parser.parse_args()
    pose, objects = load_model("blazepose-heavy"), load_model("objectron")
    rows: list[np.ndarray] = []
    crops: list[tuple[float, float, np.ndarray]] = []
    for scene in options.scenes:
        clip = read_value(VideoClip, stage_folder(scene, "ingest"))
        first, scores, row = 0, [], np.zeros((TILE_PX[1], COLUMNS * TILE_PX[0], 3), np.uint8)
        for image in read_frames(clip, stop=round(IMAGES * clip.fps), step=round(clip.fps)):
            known: list[PoseEstimate] = []
            for roi in scan(pose, image, min_score=TrackConfig().min_detection_score):
                found = confirm(pose, image, roi)
                if found is not None and not any(same_person(found, other) for other in known):
                    known.append(found)
            if options.crops:
                crops += all_crops(pose, objects, image)
            first += len(known)
            for score, found in more_people(pose, objects, image, known):
                if len(scores) < COLUMNS:
                    row[:, TILE_PX[0] * len(scores) :][:, : TILE_PX[0]] = tile(image, found, f"{score:.2f}")
                scores.append(score)
        rows.append(row)
        sys.stdout.write(f"{scene.name}: {first}, more: {' '.join(f'{score:.2f}' for score in scores)}\n")
        sys.stdout.flush()
    if options.sheet:
        cv2.imwrite(str(options.sheet), np.vstack(rows)[..., ::-1])
    if options.crops:
        crops.sort(key=lambda crop: crop[0])
        doubts = " ".join(f"{doubt:.3f}" for doubt, presence, _ in crops if presence >= MIN_PRESENCE_NEW)
        sys.stdout.write(f"disagreement of crops with a presence of somebody new: {doubts}\n")
        tiles = [shown for _, _, shown in crops]
        tiles += [np.zeros((TILE_PX[1], TILE_PX[0], 3), np.uint8)] * (-len(tiles) % COLUMNS)
        lines = [np.hstack(tiles[at : at + COLUMNS]) for at in range(0, len(tiles), COLUMNS)]
        cv2.imwrite(str(options.crops), np.vstack(lines)[..., ::-1])


def all_crops(pose: BlazePose, objects: ObjectFinder, image: np.ndarray) -> Iterator[tuple[float, float, np.ndarray]]:
    """Disagreement, presence and picture of every crop of both detectors that converges, one of each body."""
    known: list[PoseEstimate] = []
    for roi in scan(pose, image, min_score=TrackConfig().min_detection_score, objects=objects):
        found = converged(pose, image, roi)
        if found is None or any(same_person(found, other) for other in known):
            continue
        known.append(found)
        color = (255, 255, 0) if found.presence >= MIN_PRESENCE_NEW else (255, 0, 0)
        yield found.doubt, found.presence, tile(image, found, f"{found.presence:.2f} {found.doubt:.3f}", color)


def more_people(
    pose: BlazePose, objects: ObjectFinder, image: np.ndarray, known: list[PoseEstimate]
) -> Iterator[tuple[float, PoseEstimate]]:
    """Confirmed people of Objectron's detector who are not known yet, and their scores; they become known."""
    for item in objects.find(image, min_score=MIN_OBJECT_SCORE):
        roi = roi_of_box(item.box_px)
        if item.label != "person" or any(overlaps(roi, other.next_roi) for other in known):
            continue
        found = confirm(pose, image, roi)
        if found is not None and not any(same_person(found, other) for other in known):
            known.append(found)
            yield item.score, found


def tile(image: np.ndarray, found: PoseEstimate, text: str, color: tuple[int, int, int] = (255, 255, 0)) -> np.ndarray:
    """A person's box with a text."""
    x0, y0, x1, y1 = np.maximum(found.box_px(), 0).astype(int)
    inside = image[y0 : y1 + 1, x0 : x1 + 1]
    shown = cv2.resize(inside, TILE_PX) if inside.size else np.zeros((TILE_PX[1], TILE_PX[0], 3), np.uint8)
    return cv2.putText(shown, text, (2, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, color)


if __name__ == "__main__":
    main()
