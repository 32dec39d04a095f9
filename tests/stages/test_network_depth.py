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

import video2anim.video
from stages.depth import DepthConfig, estimate_depth
from stages.metric import MetricConfig, fit_metric
from stages.segment import SegmentConfig, segment_plate
from video2anim.geometry.depth_fit import DepthFit
from video2anim.models.segmentation import CLASSES, SeenInstance, Segmentation
from video2anim.pipeline.stage import StageContext
from video2anim.types import DepthClip, MetricDepth

PLATE = 255
"""Red value of the plate's first pixel; a frame has its sample's number there."""


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
            frame = int(room.plate.frame_index[number])
            joints = room.bodies.people[0].joints_camera_m[frame, :, 2]
            depth_m[room.plate.selected_mask[number]] = np.median(joints)
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
    plate_rgb = made.plate.plate_rgb.copy()
    plate_rgb[:24, :24, 0] = PLATE
    made = replace(made, plate=replace(made.plate, plate_rgb=plate_rgb))

    def frames(clip: Any, start: int, end: int) -> Iterator[np.ndarray]:
        samples = {int(frame): sample for sample, frame in enumerate(made.plate.frame_index)}
        for frame in range(start, end):
            picture = made.plate.plate_rgb.copy()
            picture[:24, :24, 0] = samples.get(frame, 0)
            yield picture

    monkeypatch.setattr(video2anim.video, "read_frames", frames)
    return made


def _context(room: Room, moody: bool = True) -> StageContext:
    models = {"fake": TrueUpToALine(room, moody), "floor": TrueClasses(room)}
    return StageContext(Path(), load_model=models.__getitem__)


def _depth(room: Room, ctx: StageContext) -> DepthClip:
    config = DepthConfig(provider="fake", hue_shifts_rad=(), frame_hue_shifts_rad=())
    return estimate_depth(None, room.plate, room.bodies, room.camera, config, ctx)  # type: ignore[arg-type]


def _metric(room: Room, ctx: StageContext, **changes: Any) -> MetricDepth:
    config = MetricConfig(segment_model="floor", **changes)
    return fit_metric(_depth(room, ctx), room.plate, room.bodies, config, ctx)


def _quality(ctx: StageContext, name: str) -> float:
    return next(q.value for q in ctx.qualities if q.name == name)


def test_the_background_of_a_still_camera_is_the_plates(room: Room) -> None:
    ctx = _context(room)
    depth = _depth(room, ctx)
    assert depth.kind == "disparity"
    for sample, people in enumerate(room.plate.person_mask):
        np.testing.assert_array_equal(depth.value[sample][~people], depth.background_value[~people])
    assert _quality(ctx, "flicker_before") > 0.02
    assert _quality(ctx, "flicker_after") == 0


def test_people_come_from_their_own_picture_in_the_plates_units(room: Room) -> None:
    steady, moody = _depth(room, _context(room, moody=False)), _depth(room, _context(room))
    for sample, people in enumerate(room.plate.person_mask):
        at = people & moody.valid[sample]
        assert at.any()
        line = np.polyfit(steady.background_value.ravel(), moody.background_value.ravel(), 1)
        np.testing.assert_allclose(moody.value[sample][at], np.polyval(line, steady.value[sample][at]), atol=2e-3)


def test_a_moving_camera_keeps_every_pictures_own_answer(room: Room) -> None:
    still = replace(room, camera=replace(room.camera, is_static=False))
    ctx = _context(still)
    depth = _depth(still, ctx)
    assert not any(q.name.startswith("flicker") for q in ctx.qualities)
    assert (
        np.ptp([value[~people].mean() for value, people in zip(depth.value, room.plate.person_mask, strict=True)]) > 0
    )


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_people_are_where_their_bodies_are_though_the_network_sees_them_nearer(room: Room, factor: float) -> None:
    """A network that puts people before or behind the floor they stand on; the floor stays what it is."""
    depth, config = _depth(room, _context(room, moody=False)), MetricConfig(segment_model="floor")
    ctx, right_ctx = _context(room), _context(room)
    right = fit_metric(depth, room.plate, room.bodies, config, right_ctx)
    value = depth.value.copy()
    for sample, people in enumerate(room.plate.person_mask):
        line = right.scale * value[sample][people] + right.offset_m
        value[sample][people] = (line / factor - right.offset_m) / right.scale
    metric = fit_metric(replace(depth, value=value), room.plate, room.bodies, config, ctx)
    told = [_quality(one, "body over people's depth") for one in (ctx, right_ctx)]
    assert told[0] / told[1] == pytest.approx(1 / factor, rel=0.02)
    people = room.plate.person_mask & metric.valid & right.valid
    assert np.median(metric.depth_m[people] / right.depth_m[people]) == pytest.approx(1.0, abs=0.02)
    known = metric.background_valid & (room.depth_m < 8)
    assert np.median(np.abs(metric.background_depth_m / room.depth_m - 1)[known]) < 0.01


def test_with_a_moving_camera_only_people_are_moved_to_their_bodies(room: Room) -> None:
    """No pixel of its frames equals the plate's, so equality tells nobody apart; the masks do."""
    depth, config = _depth(room, _context(room, moody=False)), MetricConfig(segment_model="floor")
    right = fit_metric(depth, room.plate, room.bodies, config, _context(room))
    value = depth.value * np.float32(1.0001)
    for sample, people in enumerate(room.plate.person_mask):
        line = right.scale * value[sample][people] + right.offset_m
        value[sample][people] = (line / 1.15 - right.offset_m) / right.scale
    ctx = _context(room)
    metric = fit_metric(replace(depth, value=value), room.plate, room.bodies, config, ctx)
    assert _quality(ctx, "body over people's depth") < 0.95
    people, known = room.plate.person_mask, metric.background_valid & (room.depth_m < 8)
    others = np.broadcast_to(known, people.shape) & ~people
    assert np.median((metric.depth_m / metric.background_depth_m)[others]) == pytest.approx(1.0, abs=0.005)
    there = people & metric.valid & right.valid
    assert np.median(metric.depth_m[there] / right.depth_m[there]) == pytest.approx(1.0, abs=0.02)


def test_a_fault_in_the_fit_is_no_lack_of_evidence(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only evidence that contradicts every scale is answered by the next best fit; a fault ends the stage."""

    def faulty(*args: Any, **options: Any) -> DepthFit:
        raise ValueError("operands could not be broadcast together")

    depth = _depth(room, _context(room))
    monkeypatch.setattr("video2anim.geometry.depth_fit.fit_depth", faulty)
    for config in (MetricConfig(evidence="body"), MetricConfig(segment_model="floor")):
        with pytest.raises(ValueError, match="broadcast"):
            fit_metric(depth, room.plate, room.bodies, config, _context(room))


def test_floor_and_body_give_scale_and_offset(room: Room) -> None:
    metric = _metric(room, _context(room))
    assert metric.trusted, metric.reason
    ratio = metric.background_depth_m / room.depth_m
    known = metric.background_valid & (room.depth_m < 8)
    assert np.median(np.abs(ratio[known] - 1)) < 0.03
    assert "floor" in metric.reason


def test_recognised_floor_lies_on_the_floor(room: Room) -> None:
    """With a still camera in frames too; people and furniture keep their own depth."""
    snapped, free = _metric(room, _context(room)), _metric(room, _context(room), snap_ratio=0.0)
    floor = (room.surface == FLOOR) & free.background_valid & (room.depth_m < 8)
    off = np.abs(snapped.background_depth_m - room.depth_m)
    assert off[floor].max() < 0.05
    assert (snapped.background_depth_m == free.background_depth_m)[room.surface == BOX].all()
    for sample, people in enumerate(room.plate.person_mask):
        assert (snapped.depth_m[sample] == free.depth_m[sample])[people].all()
        seen = floor & ~people
        np.testing.assert_allclose(snapped.depth_m[sample][seen], snapped.background_depth_m[seen])


def test_the_floor_alone_does_too(room: Room) -> None:
    metric = _metric(room, _context(room), evidence="ground")
    assert metric.trusted, metric.reason
    known = metric.background_valid & (room.depth_m < 8)
    assert np.median(np.abs(metric.background_depth_m / room.depth_m - 1)[known]) < 0.03


def test_a_floor_that_contradicts_itself_is_not_trusted(room: Room) -> None:
    class Walls(TrueClasses):
        def segment(self, image_rgb: np.ndarray) -> Segmentation:
            seen = super().segment(image_rgb)
            swapped = np.where(seen.semantic == CLASSES.index("wall"), CLASSES.index("floor"), 0).astype(np.uint8)
            return Segmentation(swapped, ())

    models = {"fake": TrueUpToALine(room), "floor": Walls(room)}
    ctx = StageContext(Path(), load_model=models.__getitem__)
    metric = _metric(room, ctx, evidence="ground", largest_ground_miss_m=0.05)
    assert not metric.trusted
    assert any("not trusted" in text for text in ctx.warnings)


def test_what_only_seems_a_floor_does_not_outweigh_the_body(room: Room) -> None:
    """The wall is called floor: no scale brings it there, and the body by itself is enough."""

    class Walls(TrueClasses):
        def segment(self, image_rgb: np.ndarray) -> Segmentation:
            seen = super().segment(image_rgb)
            return Segmentation(np.where(seen.semantic == CLASSES.index("wall"), 1, 0).astype(np.uint8), ())

    ctx = StageContext(Path(), load_model={"fake": TrueUpToALine(room, moody=False), "floor": Walls(room)}.__getitem__)
    metric = _metric(room, ctx, largest_ground_miss_m=0.05)
    assert metric.trusted, metric.reason
    assert "floor" not in metric.reason
    people = room.plate.person_mask & metric.valid
    middle_m = room.bodies.people[0].joints_camera_m[room.plate.frame_index].mean(1)[:, 2]
    off = [np.median(d[p]) / m for d, p, m in zip(metric.depth_m, people, middle_m, strict=True) if p.any()]
    assert np.median(off) == pytest.approx(1.0, abs=0.05)


def test_floor_and_body_are_equals_where_the_deciding_floor_cannot_be_trusted(room: Room) -> None:
    """The network sees people far nearer than the floor they stand on; between the two a fit exists that both allow."""
    depth, config = _depth(room, _context(room, moody=False)), MetricConfig(segment_model="floor")
    right = fit_metric(depth, room.plate, room.bodies, config, _context(room))
    value = depth.value.copy()
    for sample, people in enumerate(room.plate.person_mask):
        line = right.scale * value[sample][people] + right.offset_m
        value[sample][people] = (1.6 * line - right.offset_m) / right.scale
    bent = replace(depth, value=value)
    limits = replace(config, largest_chamfer_m=0.4, largest_ground_miss_m=2.0)
    ctx = _context(room)
    metric = fit_metric(bent, room.plate, room.bodies, limits, ctx)
    assert metric.trusted, metric.reason
    assert "person and floor" in metric.reason
    # A floor that decides would be met to the millimetre, and the body not at all.
    assert _quality(ctx, "ground_miss") > 0.1


def test_recognised_furniture_has_its_name_and_a_clean_floor(room: Room) -> None:
    ctx = _context(room)
    metric = _metric(room, ctx)
    masks = segment_plate(room.plate, metric, room.bodies, SegmentConfig(provider="floor"), ctx)
    assert [instance.label for instance in masks.instances] == ["cabinet"]
    truth = room.surface_full == BOX
    found = masks.instances[0].mask
    assert (found & truth).sum() / (found | truth).sum() > 0.8
    floor = room.surface_full == FLOOR
    assert (masks.floor_mask & floor).sum() / (masks.floor_mask | floor).sum() > 0.9
    assert masks.provider == "floor"
