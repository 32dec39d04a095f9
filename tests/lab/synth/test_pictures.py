"""Training pictures: what varies between those of one room, and what may not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from video2anim.lab.synth.compose import ComposeOptions
from video2anim.lab.synth.pictures import _opened, _with_sky, repainted, room_pictures
from video2anim.lab.synth.presets import clip_specs
from video2anim.lab.synth.render.texture import KINDS
from video2anim.lab.synth.world import LABELS, Material, Room, SceneObject

SPEC = clip_specs("random", 1, 5)[0]
OPTIONS = ComposeOptions(96, 64)


@pytest.fixture(scope="module")
def pictures() -> list[dict[str, np.ndarray]]:
    return list(room_pictures(SPEC, OPTIONS, 6))


def test_same_specification_same_pictures(pictures: list[dict[str, np.ndarray]]) -> None:
    again = next(iter(room_pictures(SPEC, OPTIONS, 1)))
    for name, value in again.items():
        np.testing.assert_array_equal(value, pictures[0][name])


def test_labels_go_with_depth_and_normals(pictures: list[dict[str, np.ndarray]]) -> None:
    """Floor pixels look up, in the frame of gravity, and lie the camera's height under it."""
    checked = 0
    for picture in pictures:
        height, width = picture["depth_mm"].shape
        fx, fy, cx, cy = picture["intrinsics"]
        floor = (picture["label"] == LABELS.index("floor")) & (picture["depth_mm"] > 0)
        if floor.sum() < 50 or np.abs(picture["distortion"]).max() > 0.08:
            continue
        up = np.asarray(picture["up_camera"])
        assert np.median(picture["normal_camera"][floor] / 127 @ up) > 0.98
        y, x = np.mgrid[:height, :width]
        rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x, float)], -1)
        heights = (rays * (picture["depth_mm"] / 1000)[..., None])[floor] @ up + picture["camera_height_m"]
        assert np.abs(np.median(heights)) < 0.03
        checked += 1
    assert checked


def test_cameras_differ(pictures: list[dict[str, np.ndarray]]) -> None:
    focal = [picture["intrinsics"][1] for picture in pictures]
    assert np.ptp(np.log(focal)) > 0.1
    assert len({float(picture["camera_height_m"]) for picture in pictures}) == len(pictures)


def test_repainting_keeps_what_glows_and_the_share() -> None:
    rng = np.random.default_rng(0)
    materials = tuple(Material("plain", (0.5, 0.5, 0.5), emission=float(i % 2), seed=i) for i in range(400))
    assert repainted(materials, 0.0, rng) == materials
    painted = repainted(materials, 0.5, rng)
    changed = np.mean([a != b for a, b in zip(materials, painted, strict=True)])
    assert changed == pytest.approx(0.5, abs=0.08)
    assert [m.emission for m in painted] == [m.emission for m in materials]
    assert {m.kind for m in painted} <= set(KINDS)
    assert all(0 <= channel <= 1 for m in painted for channel in (*m.rgb, *m.rgb2))


def test_some_rooms_are_open() -> None:
    """Furniture always stays; without a ceiling in about a sixth of the rooms."""
    obj = SceneObject(1, "floor", (), np.eye(4))
    structure = tuple(
        replace(obj, object_id=n, label=label) for n, label in enumerate(("floor", "ceiling", *["wall"] * 4), 1)
    )
    chair = replace(obj, object_id=9, label="chair")
    room = Room((0, 4, 0, 4), 2.5, structure, (chair,), (), (1.0, 1.0, 1.0))
    opened = [_opened(room, np.random.default_rng(seed)) for seed in range(400)]
    labels = [[obj.label for obj in one.structure] for one in opened]
    assert all("floor" in names for names in labels)
    assert all(one.furniture == (chair,) for one in opened)
    assert np.mean(["ceiling" not in names for names in labels]) == pytest.approx(0.18, abs=0.06)
    assert np.mean([names.count("wall") < 4 for names in labels]) == pytest.approx(0.08, abs=0.04)


def test_sky_fills_only_what_is_empty() -> None:
    rgb = np.full((20, 30, 3), 7, np.uint8)
    empty = np.zeros((20, 30), bool)
    empty[:8] = True
    filled = _with_sky(rgb, empty, np.random.default_rng(1))
    assert (filled[8:] == 7).all()
    assert (filled[:8] != 7).any()
    assert _with_sky(rgb, np.zeros_like(empty), np.random.default_rng(1)) is rgb
