"""Depth by a network whose answers are right up to a scale and offset that change with every picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from synthetic_room import BOX, FLOOR, WALL, Room, make_room

from stages.depth import DepthConfig, estimate_depth
from stages.metric import MetricConfig, fit_metric
from stages.segment import SegmentConfig, segment_background
from video2anim.depth import network_depth
from video2anim.geometry.projection import backproject, transform_points
from video2anim.networks.segmentation import CLASSES, SeenInstance, Segmentation
from video2anim.pipeline.stage import StageContext
from video2anim.types import DepthClip, InstanceMasks, MetricDepth

PLATE = 255
"""Red value of the background image's first pixel; a frame has its sample's number there."""


class TrueUpToALine:
    """Disparity of the room and of the person in the picture, each time under another scale and offset."""

    kind = "disparity"

    def __init__(self, room: Room, moody: bool = True) -> None:
        self._room, self._moody = room, moody
        self._rng = np.random.default_rng(3)
        self._line = (1.0, 0.0)

    def infer(self, image_rgb: np.ndarray) -> np.ndarray:
        room, number = self._room, int(image_rgb[0, 0, 0])
        depth_m = room.depth_m.copy()
        if number != PLATE:
            frame = int(room.background.frame_index[number])
            joints = room.bodies.people[0].joints_camera_m[frame, :, 2]
            depth_m[room.background.selected_mask[number]] = np.median(joints)
        scale, offset = (self._rng.uniform(0.6, 1.5), self._rng.uniform(-0.2, 0.3)) if self._moody else (1.0, 0.0)
        disparity = scale / depth_m + offset
        return cv2.resize(disparity, image_rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST)


class TrueClasses:
    """Floor, wall and the box as they are."""

    def __init__(self, room: Room) -> None:
        self._room = room

    def segment(self, image_rgb: np.ndarray) -> Segmentation:
        surface = cv2.resize(
            self._room.surface.astype(np.uint8), image_rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST
        )
        semantic = np.full(surface.shape, CLASSES.index("other"), np.uint8)
        for number, name in ((FLOOR, "floor"), (WALL, "wall"), (BOX, "furniture")):
            semantic[surface == number] = CLASSES.index(name)
        box = SeenInstance("cabinet", "furniture", 0.9, surface == BOX)
        return Segmentation(semantic, (box,) if box.mask.any() else ())


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Room:
    """A room whose pictures name themselves by their first pixel."""
    made = make_room()
    background_rgb = made.background.background_rgb.copy()
    background_rgb[:24, :24, 0] = PLATE
    made = replace(made, background=replace(made.background, background_rgb=background_rgb))

    def frames(clip: Any, start: int, end: int) -> Iterator[np.ndarray]:
        samples = {int(frame): sample for sample, frame in enumerate(made.background.frame_index)}
        for frame in range(start, end):
            picture = made.background.background_rgb.copy()
            picture[:24, :24, 0] = samples.get(frame, 0)
            yield picture

    monkeypatch.setattr(network_depth, "read_frames", frames)
    return made


def _context(room: Room, moody: bool = True) -> StageContext:
    models = {"fake": TrueUpToALine(room, moody), "floor": TrueClasses(room)}
    return StageContext(Path(), load_model=models.__getitem__)


def _depth(room: Room, ctx: StageContext) -> DepthClip:
    config = DepthConfig(provider="fake", hue_shifts_rad=(), frame_hue_shifts_rad=())
    return estimate_depth(room.clip, room.background, room.camera, config, ctx)


def _stages(
    room: Room, ctx: StageContext, depth: DepthClip | None = None, config: MetricConfig | None = None
) -> tuple[InstanceMasks, MetricDepth]:
    """Segment and metric."""
    depth = depth or _depth(room, ctx)
    segment = SegmentConfig(provider="floor", finder="none")
    masks = segment_background(room.clip, room.background, depth, room.bodies, segment, ctx)
    metric = fit_metric(
        room.clip, depth, room.background, room.camera, room.bodies, masks, config or MetricConfig(), ctx
    )
    return masks, metric


def _quality(ctx: StageContext, name: str) -> float:
    return next(q.value for q in ctx.qualities if q.key == name)


def test_the_background_of_a_still_camera_is_the_plates(room: Room) -> None:
    ctx = _context(room)
    depth = _depth(room, ctx)
    assert depth.kind == "disparity"
    for sample, people in enumerate(room.background.person_mask):
        np.testing.assert_array_equal(depth.value[sample][~people], depth.background_value[~people])
    assert _quality(ctx, "flicker_before") > 0.02
    assert _quality(ctx, "flicker_after") == 0


@pytest.mark.parametrize(("kind", "stored"), [("depth", "depth"), ("metric", "depth"), ("Depth", None)])
def test_the_kind_of_the_network_decides_that_of_the_clip(room: Room, kind: str, stored: str | None) -> None:
    ctx = _context(room)
    ctx.model("fake").kind = kind
    if stored is None:
        with pytest.raises(KeyError):
            _depth(room, ctx)
    else:
        assert _depth(room, ctx).kind == stored


def test_people_come_from_their_own_picture_in_the_plates_units(room: Room) -> None:
    steady, moody = _depth(room, _context(room, moody=False)), _depth(room, _context(room))
    for sample, people in enumerate(room.background.person_mask):
        at = people & moody.valid[sample]
        assert at.any()
        line = np.polyfit(steady.background_value.ravel(), moody.background_value.ravel(), 1)
        np.testing.assert_allclose(moody.value[sample][at], np.polyval(line, steady.value[sample][at]), atol=2e-3)


def test_a_moving_camera_keeps_every_pictures_own_answer(room: Room) -> None:
    still = replace(room, camera=replace(room.camera, is_static=False))
    ctx = _context(still)
    depth = _depth(still, ctx)
    assert not any(q.key.startswith("flicker") for q in ctx.qualities)
    assert (
        np.ptp([value[~people].mean() for value, people in zip(depth.value, room.background.person_mask, strict=True)])
        > 0
    )


def _seen_nearer(room: Room, depth: DepthClip, right: MetricDepth, factor: float) -> DepthClip:
    """The network sees people at `factor` times their distance, in the background image's units."""
    value = depth.value.copy()
    for sample, people in enumerate(room.background.person_mask):
        line = right.scale * value[sample][people] + right.offset_m
        value[sample][people] = (line / factor - right.offset_m) / right.scale
    return replace(depth, value=value)


def _off(room: Room, metric: MetricDepth) -> np.ndarray:
    """Errors of the background image's depth as shares of it."""
    known = metric.background_valid & (room.depth_m < 8)
    return np.abs(metric.background_depth_m / room.depth_m - 1)[known]


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_people_are_where_their_bodies_are_though_the_network_sees_them_elsewhere(room: Room, factor: float) -> None:
    """A network that puts people before or behind the floor they stand on; the floor stays what it is."""
    depth = _depth(room, _context(room, moody=False))
    ctx, right_ctx = _context(room), _context(room)
    _, right = _stages(room, right_ctx, depth)
    _, metric = _stages(room, ctx, _seen_nearer(room, depth, right, factor))
    told = [_quality(one, "person_over_their_depth") for one in (ctx, right_ctx)]
    # Network and floor are believed both: a quarter of the difference is the floor's.
    assert told[0] / told[1] == pytest.approx(1 / factor, abs=0.05)
    people = room.background.person_mask & metric.valid & right.valid
    assert np.median(metric.depth_m[people] / right.depth_m[people]) == pytest.approx(1.0, abs=0.03)
    assert np.median(_off(room, metric)) < 0.03


def test_with_a_moving_camera_only_people_are_moved_to_their_bodies(room: Room) -> None:
    """No pixel of its frames equals the background image's, so equality tells nobody apart; the masks do."""
    depth = _depth(room, _context(room, moody=False))
    _, right = _stages(room, _context(room), depth)
    ctx = _context(room)
    bent = _seen_nearer(room, replace(depth, value=depth.value * np.float32(1.0001)), right, 1.15)
    _, metric = _stages(room, ctx, bent)
    assert _quality(ctx, "person_over_their_depth") < 0.95
    people, known = room.background.person_mask, metric.background_valid & (room.depth_m < 8) & (room.surface == FLOOR)
    others = np.broadcast_to(known, people.shape) & ~people
    assert np.median((metric.depth_m / metric.background_depth_m)[others]) == pytest.approx(1.0, abs=0.005)
    there = people & metric.valid & right.valid
    assert np.median(metric.depth_m[there] / right.depth_m[there]) == pytest.approx(1.0, abs=0.03)


def test_floor_and_body_give_scale_and_offset(room: Room) -> None:
    _, metric = _stages(room, _context(room))
    assert metric.trusted, metric.reason
    assert np.median(_off(room, metric)) < 0.03


def test_recognised_floor_lies_on_the_floor(room: Room) -> None:
    _, metric = _stages(room, _context(room))
    body = metric.bodies.people[0]
    height, width = room.depth_m.shape
    camera_m = backproject(metric.background_depth_m, body.intrinsics.resized(width, height))
    floor = (room.surface == FLOOR) & metric.background_valid & (room.depth_m < 8)
    heights_m = transform_points(body.T_world_camera[0], camera_m[floor])[:, 1]
    assert np.median(np.abs(heights_m)) < 0.03
    assert np.quantile(np.abs(heights_m), 0.95) < 0.08


def test_what_only_seems_a_floor_does_not_outweigh_the_body(room: Room) -> None:
    """The wall is called floor: nothing brings it there, and the body by itself is enough."""

    class Walls(TrueClasses):
        def segment(self, image_rgb: np.ndarray) -> Segmentation:
            seen = super().segment(image_rgb)
            return Segmentation(np.where(seen.semantic == CLASSES.index("wall"), 1, 0).astype(np.uint8), ())

    assert CLASSES[1] == "floor"
    ctx = StageContext(Path(), load_model={"fake": TrueUpToALine(room, moody=False), "floor": Walls(room)}.__getitem__)
    depth = _depth(room, ctx)
    wall = InstanceMasks("walls", (), room.surface_full == WALL)
    metric = fit_metric(room.clip, depth, room.background, room.camera, room.bodies, wall, MetricConfig(), ctx)
    people = room.background.person_mask & metric.valid
    center_m = metric.bodies.people[0].joints_camera_m[room.background.frame_index].mean(1)[:, 2]
    off = [np.median(d[p]) / m for d, p, m in zip(metric.depth_m, people, center_m, strict=True) if p.any()]
    assert np.median(off) == pytest.approx(1.0, abs=0.05)
    assert metric.bodies.people[0].T_world_camera[0, 1, 3] == pytest.approx(1.6, rel=0.05)
    masks, _ = _stages(room, ctx, depth)
    assert (masks.floor_mask & wall.floor_mask).sum() < 0.2 * wall.floor_mask.sum(), "stage segment asks depth too"


def test_beyond_its_limit_the_scale_is_not_trusted(room: Room) -> None:
    ctx = _context(room)
    _, metric = _stages(room, ctx, config=MetricConfig(conflict_sigmas=500.0))
    assert not metric.trusted
    assert "known to" in metric.reason
    assert any("not trusted" in text for text in ctx.warnings)


def test_recognised_furniture_has_its_name_and_a_clean_floor(room: Room) -> None:
    masks, metric = _stages(room, _context(room))
    assert [instance.label for instance in masks.instances] == ["cabinet"]
    assert list(metric.object_sigma) == [str(masks.instances[0].object_id)]
    truth = room.surface_full == BOX
    found = masks.instances[0].mask
    assert (found & truth).sum() / (found | truth).sum() > 0.8
    floor = room.surface_full == FLOOR
    assert (masks.floor_mask & floor).sum() / (masks.floor_mask | floor).sum() > 0.9
    assert masks.provider == "floor"
