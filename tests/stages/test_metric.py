"""Scale and offset from the body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_chain import all_finite, depth_of
from synthetic_room import FLOOR, make_room

from stages.metric import MetricConfig, fit_metric
from video2anim.geometry.depth_fit import FrameEvidence, fit_depth, metric_depth
from video2anim.geometry.flat_depth import USUAL_OFFSET
from video2anim.geometry.visible import visible_vertices
from video2anim.pipeline.stage import StageContext
from video2anim.types import Intrinsics


@pytest.mark.parametrize("factor", [0.2, 1.0, 7.0])
def test_scale_recovered_under_unknown_factor(factor: float) -> None:
    room = make_room()
    depth = depth_of(room, StageContext(Path()))
    scaled = replace(depth, value=depth.value * np.float32(factor), background_value=depth.background_value * factor)
    found = fit_metric(scaled, room.plate, room.bodies, MetricConfig(), StageContext(Path()))
    assert found.trusted
    assert found.chamfer_after_m <= found.chamfer_before_m
    floor = found.background_valid & (room.surface == FLOOR)
    # A flat figure stands at the near edge of the feet, a few centimetres before the body's middle: 6 % band.
    assert np.median(found.background_depth_m[floor] / room.depth_m[floor]) == pytest.approx(1.0, abs=0.06)


def _evidence(kind: str, scale: float, offset: float, middles: list[float]) -> list[FrameEvidence]:
    """Curved bodies and exact relative depth of the same surface on other pixels."""
    rng = np.random.default_rng(3)
    frames = []
    for middle in middles:
        parts = []
        for _ in range(2):
            angle, up = rng.uniform(-1.3, 1.3, 250), rng.uniform(-0.9, 0.9, 250)
            parts.append(np.stack([0.3 * np.sin(angle), up, middle - 0.3 * np.cos(angle)], -1))
        body, surface = parts
        metric = surface[:, 2] if kind == "depth" else 1 / surface[:, 2]
        frames.append(FrameEvidence(body, surface / surface[:, 2:], (metric - offset) / scale))
    return frames


@pytest.mark.parametrize(("kind", "scale", "offset"), [("depth", 2.5, 0.8), ("disparity", 0.4, 0.05)])
def test_fit_recovers_scale_and_offset(kind: str, scale: float, offset: float) -> None:
    frames = _evidence(kind, scale, offset, [2.5, 3.5, 5.0, 6.0])
    fit = fit_depth(frames, kind, with_offset=True, rng=np.random.default_rng(0))
    assert fit.scale == pytest.approx(scale, rel=0.03)
    assert fit.offset == pytest.approx(offset, abs=0.06 if kind == "depth" else 0.01)
    assert fit.chamfer_after_m < 0.5 * fit.chamfer_before_m


def test_depth_behind_the_camera_is_not_a_number_but_never_leaves() -> None:
    assert np.isnan(metric_depth("disparity", np.array([-1.0]), 1.0, 0.0)).all()
    assert np.isnan(metric_depth("depth", np.array([1.0]), 1.0, -2.0)).all()


def test_without_person_depth_the_floor_gives_an_untrusted_scale() -> None:
    room = make_room()
    depth = depth_of(room, StageContext(Path()))
    blind = replace(depth, valid=depth.valid & ~room.plate.selected_mask)
    ctx = StageContext(Path())
    found = fit_metric(blind, room.plate, room.bodies, MetricConfig(), ctx)
    assert not found.trusted
    assert "floor below the camera" in found.reason
    assert ctx.warnings
    good = found.background_valid & (room.surface == FLOOR)
    assert np.median(found.background_depth_m[good] / room.depth_m[good]) == pytest.approx(1.0, abs=0.02)


def test_without_person_and_floor_nothing_is_metric() -> None:
    room = make_room(pitch_deg=-20.0)
    depth = depth_of(room, StageContext(Path()))
    found = fit_metric(depth, room.plate, room.bodies, MetricConfig(), StageContext(Path()))
    assert not found.trusted
    assert not found.valid.any()
    assert not found.background_valid.any()
    assert all_finite(found)


def test_standing_still_fixes_the_offset() -> None:
    room = make_room()
    depth = depth_of(room, StageContext(Path()))
    config = MetricConfig(least_range_ratio=0.9)
    found = fit_metric(depth, room.plate, room.bodies, config, StageContext(Path()))
    assert found.trusted
    assert found.offset_m == 0.0
    assert "offset fixed at 0" in found.reason


def test_visibility_keeps_the_near_side_only() -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    from scipy.spatial import ConvexHull

    hull = ConvexHull(directions)
    faces = hull.simplices.copy()
    a, b, c = (directions[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    near, far = directions * 0.5 + [0, 0, 3.0], directions * 0.5 + [0, 0, 5.0]
    seen = visible_vertices(
        np.concatenate([near, far]), np.concatenate([faces, faces + 2000]), Intrinsics.centered(300.0, 320, 240)
    )
    assert (near[seen[:2000], 2] < 3.0).all()
    assert seen[:2000].sum() > 0.8 * (near[:, 2] < 2.9).sum()
    # The far ball shows its rim only where it is not behind the near one; from this camera it is hidden.
    assert seen[2000:].sum() < 0.05 * 1000


def test_a_person_at_one_distance_does_not_flatten_the_scene() -> None:
    """Disparity whose person shows nothing but error: the best scale for it is near 0, and is not taken."""
    room = make_room()
    plain = depth_of(room, StageContext(Path()))
    rng = np.random.default_rng(0)
    disparity = 1 / np.maximum(plain.value, 0.1)
    noise = np.where(room.plate.person_mask, rng.normal(0, 1.0, (len(disparity), 1, 1)), 0.0)
    usual = USUAL_OFFSET["room-depth"]
    background = 1 / np.maximum(plain.background_value, 0.1)
    shift = usual / (1 + usual) * float(np.median(background))
    depth = replace(
        plain, kind="disparity", provider="room-depth", value=(disparity - shift + noise).astype(np.float32),
        background_value=background - shift,
    )  # fmt: skip
    config = MetricConfig(evidence="body", least_range_ratio=0.0)
    found = fit_metric(depth, room.plate, room.bodies, config, StageContext(Path()))
    far, near = np.quantile(found.background_depth_m[found.background_valid], [0.95, 0.05])
    true_far, true_near = np.quantile(room.depth_m[found.background_valid], [0.95, 0.05])
    assert found.offset_m == pytest.approx(found.scale * usual * np.median(depth.background_value), rel=1e-6)
    assert far / near > 0.7 * true_far / true_near
    unknown = replace(depth, provider="of-the-user")
    flat = fit_metric(unknown, room.plate, room.bodies, config, StageContext(Path()))
    assert not flat.trusted
    assert "flat" in flat.reason
