"""Depth in meters and calibrated people by the fit of stage metric."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_chain import all_finite, depth_of, masks_of
from synthetic_room import FLOOR, Room, make_room

from stages.metric import MetricConfig, fit_metric
from stages.segment import SegmentConfig
from video2anim.calibration.line import metric_depth
from video2anim.errors import StageError
from video2anim.geometry.line_of_sight import visible_vertices
from video2anim.pipeline.stage import StageContext
from video2anim.types import BodyTracks, DepthClip, InstanceMasks, Intrinsics, MetricDepth


def metric_of(
    room: Room, depth: DepthClip, ctx: StageContext | None = None, masks: InstanceMasks | None = None
) -> MetricDepth:
    """Stages segment (unless there are masks) and metric."""
    ctx = ctx or StageContext(Path())
    masks = masks or masks_of(room, depth, SegmentConfig(provider="geometric", finder="none"), ctx)
    return fit_metric(room.clip, depth, room.background, room.camera, room.bodies, masks, MetricConfig(), ctx)


def floor_ratio(room: Room, found: MetricDepth) -> float:
    """Found over true depth of the floor."""
    floor = found.background_valid & (room.surface == FLOOR)
    return float(np.median(found.background_depth_m[floor] / room.depth_m[floor]))


def test_the_factor_of_relative_depth_does_not_matter() -> None:
    room = make_room()
    depth = depth_of(room)
    found = []
    for factor in (0.2, 1.0, 7.0):
        scaled = replace(
            depth, value=depth.value * np.float32(factor), background_value=depth.background_value * factor
        )
        found.append(metric_of(room, scaled))
        assert found[-1].trusted, found[-1].reason
        assert found[-1].chamfer_after_m <= found[-1].chamfer_before_m
        # The person's height is known to 1 cm, and so is the room's size.
        assert floor_ratio(room, found[-1]) == pytest.approx(1.0, abs=0.02)
        assert found[-1].scale * factor == pytest.approx(found[0].scale * 0.2, rel=0.005)
    for other in found[1:]:
        np.testing.assert_allclose(other.background_depth_m, found[0].background_depth_m, rtol=0.005)
        np.testing.assert_allclose(
            other.bodies.people[0].joints_world_m, found[0].bodies.people[0].joints_world_m, atol=0.01
        )


def test_people_and_camera_come_with_the_depth() -> None:
    """The same person, on the floor under the camera of the fit; each object says how sure its distance is."""
    room = make_room()
    found = metric_of(room, depth_of(room))
    body, before = found.bodies.people[0], room.bodies.people[0]
    assert found.bodies.quality == room.bodies.quality
    assert body.T_world_camera[0, 1, 3] == pytest.approx(1.6, rel=0.02)
    np.testing.assert_allclose(body.joints_world_m[:, :, 1], before.joints_world_m[:, :, 1], atol=0.05)
    np.testing.assert_allclose(body.joints_world_m[0, 0, [0, 2]], 0.0, atol=1e-9)
    assert list(found.object_sigma) == ["1"]
    assert 0.01 < found.object_sigma["1"] < 0.13


def test_depth_behind_the_camera_is_not_a_number_but_never_leaves() -> None:
    assert np.isnan(metric_depth("disparity", np.array([-1.0]), 1.0, 0.0)).all()
    assert np.isnan(metric_depth("depth", np.array([1.0]), 1.0, -2.0)).all()
    np.testing.assert_allclose(metric_depth("disparity", np.array([1.0, 4.0]), 0.5, 0.0), [2.0, 0.5])
    np.testing.assert_allclose(metric_depth("depth", np.array([1.0, 4.0]), 0.5, 1.0), [1.5, 3.0])


def test_without_person_depth_the_floor_gives_the_scale() -> None:
    room = make_room()
    depth = depth_of(room)
    found = metric_of(room, replace(depth, valid=depth.valid & ~room.background.selected_mask))
    assert found.trusted, found.reason
    assert found.chamfer_after_m is None
    assert floor_ratio(room, found) == pytest.approx(1.0, abs=0.02)


def test_without_person_and_floor_nothing_is_metric() -> None:
    room = make_room(pitch_deg=-20.0)
    ctx = StageContext(Path())
    depth = depth_of(room)
    nothing = replace(depth, valid=np.zeros_like(depth.valid), background_valid=np.zeros_like(depth.background_valid))
    found = metric_of(room, nothing, ctx)
    assert not found.trusted
    assert "no depth is metric" in found.reason
    assert any("not trusted" in warning for warning in ctx.warnings)
    assert not found.valid.any()
    assert not found.background_valid.any()
    assert all_finite(found)


def test_nobody_in_any_frame_is_an_error() -> None:
    room = make_room()
    depth = depth_of(room)
    body = room.bodies.people[0]
    config = SegmentConfig(provider="geometric", finder="none")
    unseen = BodyTracks((replace(body, valid=np.zeros_like(body.valid)),), room.bodies.quality)
    for bodies in (BodyTracks(()), unseen):
        with pytest.raises(StageError, match="at least one valid frame"):
            metric_of(replace(room, bodies=bodies), depth, masks=InstanceMasks("none", (), room.surface_full == FLOOR))
        with pytest.raises(StageError, match="at least one valid frame"):
            masks_of(replace(room, bodies=bodies), depth, config, StageContext(Path()))


def test_evidence_that_contradicts_the_rest_is_named() -> None:
    """The floor's depth rises where it should fall."""
    room = make_room()
    depth = depth_of(room)
    floor = room.surface == FLOOR
    upside_down = depth.background_value.copy()
    upside_down[floor] = np.ptp(upside_down[floor]) + 2 * upside_down[floor].min() - upside_down[floor]
    ctx = StageContext(Path())
    labeled = InstanceMasks("none", (), room.surface_full == FLOOR)
    metric_of(room, replace(depth, background_value=upside_down), ctx, labeled)
    assert any("floor pixels" in warning and "contradicts" in warning for warning in ctx.warnings)
    told = {quality.key: quality.value for quality in ctx.qualities}
    assert told["residual_floor_pixels"] > 3


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


def test_a_person_whose_depth_is_noise_does_not_flatten_the_scene() -> None:
    """Disparity whose person shows nothing but error: the best scale for them alone is near 0."""
    room = make_room()
    plain = depth_of(room)
    rng = np.random.default_rng(0)
    disparity = 1 / np.maximum(plain.value, 0.1)
    noise = np.where(room.background.person_mask, rng.normal(0, 1.0, (len(disparity), 1, 1)), 0.0)
    usual = 1.25  # of the shipped network in the rooms of V2A-Bench
    background = 1 / np.maximum(plain.background_value, 0.1)
    shift = usual / (1 + usual) * float(np.median(background))
    depth = replace(
        plain, kind="disparity", provider="room-depth", value=(disparity - shift + noise).astype(np.float32),
        background_value=background - shift,
    )  # fmt: skip
    nowhere = InstanceMasks("none", (), np.zeros(room.surface_full.shape, bool))
    found = metric_of(room, depth, masks=nowhere)
    far, near = np.quantile(found.background_depth_m[found.background_valid], [0.95, 0.05])
    true_far, true_near = np.quantile(room.depth_m[found.background_valid], [0.95, 0.05])
    assert far / near > 0.7 * true_far / true_near
