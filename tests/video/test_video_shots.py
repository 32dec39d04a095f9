"""Cuts are found; flashes, pans and motion are not cuts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from video2anim.video.decode import DecodeReport, decode, probe
from video2anim.video.shots import ShotDetector


def scene(seed: int, width: int = 400) -> np.ndarray:
    """A wide picture with coarse structure and fine texture."""
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.integers(0, 256, (6, 26, 3), dtype=np.uint8), (width, 54), interpolation=cv2.INTER_CUBIC)
    fine = rng.normal(0, 6, (54, width, 3))
    return np.clip(0.7 * coarse + 40 + fine, 0, 255).astype(np.uint8)


def view(wide: np.ndarray, x: int) -> np.ndarray:
    return np.ascontiguousarray(wide[:, x : x + 96])


def cuts_of(pictures: Iterable[np.ndarray]) -> list[int]:
    detector = ShotDetector()
    for picture in pictures:
        detector.add(picture)
    return detector.finish()


def test_cuts_are_found_where_they_are() -> None:
    a, b, c = scene(1), scene(2), scene(3)
    pictures = [view(a, i // 2) for i in range(30)] + [view(b, 10)] * 25 + [view(c, i) for i in range(20)]
    assert cuts_of(pictures) == [30, 55]


def test_short_ends_are_judged_too() -> None:
    a, b = view(scene(1), 0), view(scene(2), 0)
    assert cuts_of([a] * 2 + [b] * 20) == [2]
    assert cuts_of([a] * 20 + [b] * 2) == [20]
    assert cuts_of([a] * 3 + [b] * 3) == [3]


def test_flashes_are_no_cuts() -> None:
    a = view(scene(1), 0)
    pictures = [a] * 60
    for index in (20, 21, 22, 40):
        pictures[index] = (0.25 * a).astype(np.uint8)
    pictures[30] = np.full_like(a, 255)
    pictures[50] = np.zeros_like(a)
    assert cuts_of(pictures) == []


def test_a_fast_pan_is_no_cut() -> None:
    wide = scene(1, 700)
    assert cuts_of(view(wide, 12 * i) for i in range(50)) == []


def test_few_pictures() -> None:
    a = view(scene(1), 0)
    assert cuts_of([]) == []
    assert cuts_of([a]) == []
    assert cuts_of([a, a, a]) == []


def test_memory_does_not_grow() -> None:
    """Pictures come from a generator and the detector keeps a dozen descriptors."""
    wide = scene(1)

    def stream() -> Iterator[np.ndarray]:
        for i in range(400):
            yield view(wide, i % 100 // 10)

    detector = ShotDetector()
    for picture in stream():
        detector.add(picture)
        assert len(detector._recent) <= 12


def cuts_of_file(path: Path) -> list[int]:
    header = probe(path)
    size = header.upright_size_px(96)
    return cuts_of(picture.rgb(*size) for picture in decode(path, header, DecodeReport()))


def test_real_cut_and_real_flare(shared_media: Path, demo_video: Path) -> None:
    assert cuts_of_file(shared_media / "bad" / "scene_cut.mp4") == [60]
    assert cuts_of_file(demo_video) == []
