"""Evaluation of a scene folder: no error gives no error, and known errors give the numbers worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reading import row, value
from tiny_truth import CLIP, FRAMES, Tiny, people_edit, shifted, write_scene, write_truth
from unchecked import unchecked

from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.lab.eval.evaluate import evaluate
from video2anim.lab.eval.model import Evaluation
from video2anim.types import (
    BackgroundImage,
    BodyMotion,
    BodyTracks,
    CameraEstimate,
    DepthClip,
    InstanceMasks,
    KeyframedMotion,
    MetricDepth,
    PersonTracks,
    PlacedObjects,
    RefinedMotion,
    SceneModel,
    VideoClip,
)


def evaluated(tmp_path: Path, truth_dir: Path, tiny: Tiny, edits: dict[type, Any]) -> Evaluation:
    return evaluate(write_scene(tmp_path / "scene", tiny, edits=edits), truth_dir)


ZERO = {
    "camera": ("focal_error", "fov_error", "gravity_error", "height_error"),
    "motion": ("mpjpe", "pa_mpjpe", "w_mpjpe", "wa_mpjpe", "rte", "root_error", "acceleration_error"),
    "background": ("error", "error_behind"),
    "track": ("id_switches",),
    "objects": ("chamfer", "center_error"),
}
ONE = {
    "ingest": ("kept",),
    "camera": ("static",),
    "track": ("recall", "main_recall", "precision", "box_iou"),
    "motion": ("covered", "root_depth_bias", "contact_precision", "contact_recall", "contact_f1"),
    "background": ("mask_iou",),
    "depth": ("delta1", "delta1_person", "covered", "covered_person"),
    "segment": ("floor_iou", "precision", "recall", "f1", "best_iou"),
    "complete": ("amodal_iou", "visible_iou"),
    "objects": ("reconstructed", "box_iou", "size_ratio"),
}


def test_no_error_gives_no_error(scene_dir: Path, truth_dir: Path) -> None:
    found = evaluate(scene_dir, truth_dir)
    for group, keys in ZERO.items():
        for key in keys:
            assert row(found, group, key).values == pytest.approx((0.0,) * len(row(found, group, key).values), abs=1e-5)
    for group, keys in ONE.items():
        for key in keys:
            assert row(found, group, key).values == pytest.approx((1.0,) * len(row(found, group, key).values), abs=1e-5)
    # True depth is stored in millimeters.
    assert value(found, "depth", "abs_rel", 0) < 2e-4
    assert value(found, "depth", "abs_rel", 1) < 2e-4
    assert found.notes == ()
    assert len(found.people) == 1


def test_numbers_of_the_truth_stand_beside_the_estimate(scene_dir: Path, truth_dir: Path) -> None:
    found = evaluate(scene_dir, truth_dir)
    for key in ("jerk", "skating_gmd", "skating_kimodo", "skating_rohm", "contact_ratio"):
        assert row(found, "motion", key).truth == pytest.approx(value(found, "motion", key))
    for key in ("collision_frames", "penetration_max", "floating"):
        assert row(found, "true_scene", key).truth == pytest.approx(value(found, "true_scene", key), abs=1e-6)
    assert row(found, "motion", "mpjpe").truth is None


def test_scene_without_error_agrees_as_far_as_its_grid_allows(scene_dir: Path, truth_dir: Path) -> None:
    found = evaluate(scene_dir, truth_dir)
    # The estimated field has nodes every 6 cm: a layer of about 1 cm around solids may differ.
    assert value(found, "space", "occupancy_iou") > 0.75
    assert value(found, "space", "free_recall") > 0.99
    assert value(found, "space", "sdf_error") < 0.01


def test_shifted_motion(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """30 cm sideways and 40 cm away: 50 cm of root error, no root-relative error, stage by stage."""
    shift = people_edit(lambda person: shifted(person, [0.3, 0.0, 0.4]))
    found = evaluated(tmp_path, truth_dir, tiny, {BodyTracks: shift, KeyframedMotion: shift})
    assert row(found, "motion", "root_error").values == pytest.approx((0.5, 0.5, 0.0), abs=1e-9)
    for key in ("mpjpe", "pa_mpjpe", "w_mpjpe", "wa_mpjpe", "rte", "acceleration_error"):
        assert row(found, "motion", key).values == pytest.approx((0, 0, 0), abs=1e-9)
    assert value(found, "motion", "jerk") == pytest.approx(row(found, "motion", "jerk").truth)


def test_lifted_motion_floats_and_sunk_motion_collides(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    edits = {
        BodyTracks: people_edit(lambda person: shifted(person, [0, 0.105, 0])),
        RefinedMotion: people_edit(lambda person: shifted(person, [0, -0.05, 0])),
    }
    found = evaluated(tmp_path, truth_dir, tiny, edits)
    # Soles lie on the floor in the truth but for the sampled vertices, so the gap beyond 5 mm is 10 cm.
    for group in ("true_scene", "own_scene"):
        assert value(found, group, "floating", 0) == pytest.approx(0.1, abs=0.008)
        assert value(found, group, "collision_frames", 0) == 0
        assert row(found, group, "collision_frames_1cm").values == pytest.approx((0, 0, 1))
        assert value(found, group, "penetration_max", 2) == pytest.approx(0.05, abs=0.008)
        assert value(found, group, "collision_vertices", 2) > 0


def test_a_wall_of_the_room_is_solid(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """3 m along the path everybody is behind the wall at x = 2.5 m; the estimated scene has no walls."""
    through = people_edit(lambda person: shifted(person, person.T_world_camera[0, :3, 0] * 3.6))
    found = evaluated(tmp_path, truth_dir, tiny, {RefinedMotion: through})
    assert value(found, "true_scene", "collision_frames_1cm", 2) == 1
    assert value(found, "true_scene", "penetration_max", 2) > 0.5
    assert value(found, "true_scene", "collision_frames_1cm", 0) == 0


def test_a_body_aligned_with_the_true_path_on_the_floor(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """A wrong place and heading do not count there, a wrong height does."""
    turn = matrix_from_axis_angle(np.array([0.0, 0.7, 0.0]))

    def elsewhere(person: BodyMotion) -> BodyMotion:
        R = person.R_parent_joint.copy()
        R[:, 0] = turn @ R[:, 0]
        root_m = person.T_world_root[:, :3, 3] @ turn.T + [0.7, 0.0, -0.4]
        return person.with_pose(translation_world_m=root_m, R_parent_joint=R)

    edits = {BodyTracks: people_edit(elsewhere), RefinedMotion: people_edit(lambda p: shifted(p, [0, 0.205, 0]))}
    found = evaluated(tmp_path, truth_dir, tiny, edits)
    for key in ("collision_frames", "penetration_max", "floating", "collision_vertices"):
        truth = row(found, "true_scene_laid", key).truth
        assert row(found, "true_scene_laid", key).values[:2] == pytest.approx((truth, truth), abs=1e-5)
    assert value(found, "true_scene_laid", "floating", 2) == pytest.approx(0.2, abs=0.008)
    assert value(found, "motion", "root_error", 0) > 0.3


def test_rotated_body(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """A quarter turn about the pelvis is root-relative error but none after Procrustes."""
    quarter = matrix_from_axis_angle(np.array([0.0, 0.5 * np.pi, 0.0]))

    def turn(person: BodyMotion) -> BodyMotion:
        R = person.R_parent_joint.copy()
        R[:, 0] = quarter @ R[:, 0]
        return person.with_pose(translation_world_m=person.T_world_root[:, :3, 3], R_parent_joint=R)

    found = evaluated(tmp_path, truth_dir, tiny, {BodyTracks: people_edit(turn)})
    relative_m = tiny.people[0].joints_world_m - tiny.people[0].joints_world_m[:, :1]
    # A quarter turn moves a point at distance r from the axis by sqrt(2) r.
    expected_m = math.sqrt(2) * np.linalg.norm(relative_m[..., [0, 2]], axis=-1).mean()
    assert value(found, "motion", "mpjpe") == pytest.approx(expected_m, rel=1e-6)
    assert value(found, "motion", "pa_mpjpe") == pytest.approx(0, abs=1e-9)
    assert value(found, "motion", "root_error") == pytest.approx(0, abs=1e-9)


def test_a_wrong_up_direction_of_the_estimated_world_is_no_body_error(
    tmp_path: Path, truth_dir: Path, tiny: Tiny
) -> None:
    """Camera and body tilt together: in the camera nothing has changed."""
    tilt = np.eye(4)
    tilt[:3, :3] = matrix_from_axis_angle(np.array([0.1, 0.0, 0.05]))

    def tilted(person: BodyMotion) -> BodyMotion:
        R = person.R_parent_joint.copy()
        R[:, 0] = tilt[:3, :3] @ R[:, 0]
        moved = replace(person, T_world_camera=tilt @ person.T_world_camera)
        root_m = person.T_world_root[:, :3, 3] @ tilt[:3, :3].T
        return moved.with_pose(translation_world_m=root_m, R_parent_joint=R)

    edits = {kind: people_edit(tilted) for kind in (BodyTracks, KeyframedMotion, RefinedMotion)}
    edits[MetricDepth] = lambda depth: replace(depth, bodies=edits[BodyTracks](depth.bodies))
    found = evaluated(tmp_path, truth_dir, tiny, edits)
    for key in ("mpjpe", "root_error", "acceleration_error"):
        assert row(found, "motion", key).values == pytest.approx((0, 0, 0), abs=1e-9)


def test_twice_as_far_and_large(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """Twice the distance from the camera: the picture is the same, the depth is not."""

    def doubled(person: BodyMotion) -> BodyMotion:
        eye = person.T_world_camera[0, :3, 3]
        bigger = replace(person, rest_joints_m=2 * person.rest_joints_m)
        root_m = eye + 2 * (person.T_world_root[:, :3, 3] - eye)
        return bigger.with_pose(translation_world_m=root_m, R_parent_joint=person.R_parent_joint)

    found = evaluated(tmp_path, truth_dir, tiny, {BodyTracks: people_edit(doubled)})
    assert found.people[0].distance_px == pytest.approx(0, abs=1e-6)
    assert value(found, "motion", "root_depth_bias") == pytest.approx(2)
    relative_m = tiny.people[0].joints_world_m - tiny.people[0].joints_world_m[:, :1]
    assert value(found, "motion", "mpjpe") == pytest.approx(np.linalg.norm(relative_m, axis=-1).mean(), rel=1e-6)
    assert value(found, "motion", "wa_mpjpe") == pytest.approx(0, abs=1e-9)


def test_bridged_frames_are_evaluated_separately(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """Frames 10 to 19 were not measured and are held: they count as bridged, at every stage."""

    def held(person: BodyMotion) -> BodyMotion:
        valid = person.valid.copy()
        valid[10:20] = False
        R, root_m = person.R_parent_joint.copy(), person.T_world_root[:, :3, 3].copy()
        R[10:20], root_m[10:20] = R[9], root_m[9]
        return replace(person.with_pose(translation_world_m=root_m, R_parent_joint=R), valid=valid)

    found = evaluated(tmp_path, truth_dir, tiny, {BodyTracks: people_edit(held)})
    assert value(found, "motion", "covered") == pytest.approx(30 / 40)
    assert value(found, "motion", "mpjpe") == pytest.approx(0, abs=1e-9)
    assert value(found, "motion", "bridged_mpjpe") > 0.001
    assert value(found, "motion", "bridged_mpjpe", 2) == pytest.approx(0, abs=1e-9)


def test_contact_scores(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """Claiming contact always: every true one is found, half of the claims are wrong."""
    always = people_edit(lambda person: replace(person, contact=np.ones_like(person.contact)))
    found = evaluated(tmp_path, truth_dir, tiny, {BodyTracks: always})
    assert value(found, "motion", "contact_recall") == 1
    assert value(found, "motion", "contact_precision") == pytest.approx(0.5)
    assert value(found, "motion", "contact_f1") == pytest.approx(2 / 3)
    assert value(found, "motion", "contact_ratio") == 1
    assert row(found, "motion", "contact_ratio").truth == pytest.approx(0.5)


def test_camera_numbers(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    def wrong(camera: CameraEstimate) -> CameraEstimate:
        lens = camera.intrinsics
        longer = type(lens).centered(1.2 * lens.fy_px, *CLIP)
        tilt = matrix_from_axis_angle(np.array([math.radians(3.0), 0, 0]))
        return replace(camera, intrinsics=longer, up_camera=tilt @ camera.up_camera)

    found = evaluated(tmp_path, truth_dir, tiny, {CameraEstimate: wrong})
    assert value(found, "camera", "focal_error") == pytest.approx(20.0)
    fov = [math.degrees(2 * math.atan(0.5 * CLIP[1] / f)) for f in (300.0, 360.0)]
    assert value(found, "camera", "fov_error") == pytest.approx(fov[0] - fov[1])
    assert value(found, "camera", "gravity_error") == pytest.approx(3.0)
    assert value(found, "camera", "focal_sigmas") == pytest.approx(0.2 / (1.2 * 0.1))
    assert value(found, "camera", "gravity_sigmas") == pytest.approx(math.radians(3.0) / 0.05)


def test_depth_numbers(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """Everything 1.3 times too far: AbsRel 0.3, nothing within a factor of 1.25, scale error 30 %."""

    def far(depth: MetricDepth) -> MetricDepth:
        return replace(depth, depth_m=1.3 * depth.depth_m, background_depth_m=1.3 * depth.background_depth_m)

    found = evaluated(tmp_path, truth_dir, tiny, {MetricDepth: far})
    for key in ("abs_rel", "abs_rel_person"):
        assert value(found, "depth", key, 1) == pytest.approx(0.3, abs=1e-3)
        assert value(found, "depth", key, 0) < 1e-3
    for key in ("delta1", "delta1_person"):
        assert row(found, "depth", key).values == pytest.approx((1, 0))
    assert value(found, "depth", "scale_ratio", 1) == pytest.approx(1.3, abs=1e-3)
    assert value(found, "depth", "scale_error", 1) == pytest.approx(30, abs=0.1)
    assert "fitted" in row(found, "depth", "scale_ratio").reasons[0]


def test_disparity_is_fitted_as_disparity(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    def disparity(clip: DepthClip) -> DepthClip:
        meters, bare = 4 * clip.value + 0.5, 4 * clip.background_value + 0.5
        return replace(clip, kind="disparity", value=3 / meters - 0.2, background_value=3 / bare - 0.2)

    found = evaluated(tmp_path, truth_dir, tiny, {DepthClip: disparity})
    assert value(found, "depth", "abs_rel") < 1e-3
    assert value(found, "depth", "delta1_person") == 1


def test_background_image_numbers(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """Ten steps too bright everywhere: error 10, PSNR 20 log10(255 / 10)."""

    def brighter(background: BackgroundImage) -> BackgroundImage:
        return replace(
            background, background_rgb=background.background_rgb + 10, person_mask=np.zeros_like(background.person_mask)
        )

    found = evaluated(tmp_path, truth_dir, tiny, {BackgroundImage: brighter})
    assert value(found, "background", "error") == pytest.approx(10)
    assert value(found, "background", "error_behind") == pytest.approx(10)
    assert value(found, "background", "psnr") == pytest.approx(20 * math.log10(25.5))
    assert value(found, "background", "mask_iou") == 0


def test_one_of_two_pieces_of_furniture_found(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    def first_only(masks: InstanceMasks) -> InstanceMasks:
        nonsense = replace(masks.instances[1], mask=masks.floor_mask)
        return replace(masks, instances=(masks.instances[0], nonsense))

    found = evaluated(tmp_path, truth_dir, tiny, {InstanceMasks: first_only})
    for key in ("precision", "recall", "f1"):
        assert value(found, "segment", key) == pytest.approx(0.5)
    assert value(found, "segment", "best_iou") == pytest.approx(0.5, abs=0.02)
    assert value(found, "complete", "amodal_iou") == pytest.approx(1)
    # The shape of the other is still matched, by its place.
    assert row(found, "objects", "reconstructed").values == pytest.approx((1, 1, 1))


def test_moved_object(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """The table 0.25 m along its own width of 1 m: IoU (0.75 / 1.25), middle off by 0.25 m; the other is right."""

    def moved(placed: PlacedObjects) -> PlacedObjects:
        first = placed.objects[0]
        T = first.T_world_object.copy()
        T[:3, 3] += 0.25 * T[:3, 0]
        return PlacedObjects((replace(first, T_world_object=T), placed.objects[1]))

    found = evaluated(tmp_path, truth_dir, tiny, {PlacedObjects: moved})
    assert row(found, "objects", "center_error").values == pytest.approx((0, 0.125, 0), abs=1e-6)
    assert row(found, "objects", "box_iou").values == pytest.approx((1, 0.5 * (1 + 0.6), 1), abs=1e-6)
    assert 0.02 < value(found, "objects", "chamfer", 1) < 0.125


def test_a_scene_without_objects_misses_all_solids(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    def bare(scene: SceneModel) -> SceneModel:
        floor = scene.sdf_origin_m[1] + scene.sdf_spacing_m * np.arange(scene.sdf_m.shape[1])
        return replace(scene, objects=(), sdf_m=np.broadcast_to(floor[None, :, None], scene.sdf_m.shape).copy())

    def refined(motion: RefinedMotion) -> RefinedMotion:
        return replace(motion, scene=bare(motion.scene))

    found = evaluated(tmp_path, truth_dir, tiny, {RefinedMotion: refined})
    assert value(found, "space", "occupancy_iou") == 0
    assert value(found, "space", "occupied_recall") == 0
    assert value(found, "space", "free_recall") == 1
    assert row(found, "space", "occupied_precision").values == (None,)
    assert row(found, "space", "occupied_precision").reasons == ("nothing solid was estimated there",)
    assert value(found, "objects", "reconstructed", 2) == 0


def test_persons_are_matched_by_their_pictures(tmp_path: Path, two: Tiny) -> None:
    """The estimate lists them the other way round; each is compared with its own truth, and the mean is reported."""
    truth = write_truth(tmp_path / "truth", two)
    turned = {kind: lambda v: replace(v, people=v.people[::-1]) for kind in (BodyTracks, KeyframedMotion)}
    found = evaluate(write_scene(tmp_path / "scene", two, edits=turned), truth)
    assert [(p.true_person_id, p.person_id) for p in found.people] == [(0, 1), (1, 2)]
    assert value(found, "motion", "root_error") == pytest.approx(0, abs=1e-9)
    one_shifted = {BodyTracks: lambda v: replace(v, people=(v.people[0], shifted(v.people[1], [0.1, 0, 0])))}
    found = evaluate(write_scene(tmp_path / "scene2", two, edits=one_shifted), truth)
    assert value(found, "motion", "root_error") == pytest.approx(0.05)
    errors = [next(r for r in p.groups[0].rows if r.key == "root_error").values[0] for p in found.people]
    assert errors == pytest.approx([0, 0.1], abs=1e-9)


def test_a_person_without_a_partner_is_named(tmp_path: Path, two: Tiny) -> None:
    truth = write_truth(tmp_path / "truth", two)
    main_only = {
        kind: lambda v: unchecked(v, people=v.people[:1]) for kind in (BodyTracks, KeyframedMotion, RefinedMotion)
    }
    found = evaluate(write_scene(tmp_path / "scene", two, edits=main_only), truth)
    assert "true person 1 has no estimated motion" in found.notes
    assert len(found.people) == 1


def test_nobody_near_a_true_person_is_no_match(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    far = people_edit(lambda person: shifted(person, person.T_world_camera[0, :3, 0] * 5.0))
    found = evaluated(tmp_path, truth_dir, tiny, {BodyTracks: far})
    assert found.people == ()
    assert row(found, "motion", "mpjpe").values == (None, None, None)
    assert "matched" in row(found, "motion", "mpjpe").reasons[0]
    assert "estimated person 1 was matched to nobody" in found.notes


def test_tracks_that_change_places_are_switches(tmp_path: Path, two: Tiny) -> None:
    truth = write_truth(tmp_path / "truth", two)

    def swapped(tracks: PersonTracks) -> PersonTracks:
        first, second = tracks.people
        a, b = first.box_px.copy(), second.box_px.copy()
        a[20:], b[20:] = second.box_px[20:], first.box_px[20:]
        lost = first.valid.copy()
        lost[:10] = False
        return replace(tracks, people=(replace(first, box_px=a, valid=lost), replace(second, box_px=b)))

    found = evaluate(write_scene(tmp_path / "scene", two, edits={PersonTracks: swapped}), truth)
    assert value(found, "track", "id_switches") == 2
    assert value(found, "track", "recall") == pytest.approx(1 - 10 / 80)
    assert value(found, "track", "main_recall") == pytest.approx(30 / 40)
    assert value(found, "track", "precision") == 1


def test_shorter_cut_is_compared_by_source_time(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """A clip that was cut to its second half is compared with the second half of the truth."""
    start = FRAMES // 2

    def cut(clip: VideoClip) -> VideoClip:
        time_s = clip.frame_time_s[: FRAMES - start]
        return replace(clip, frame_time_s=time_s, source_time_s=clip.source_time_s[start:])

    def later(person: BodyMotion) -> BodyMotion:
        names = ("valid", "T_world_root", "R_parent_joint", "T_world_camera", "contact", "joints_world_m")
        kept = {name: getattr(person, name)[start:] for name in names}
        return replace(person, frame_time_s=person.frame_time_s[: FRAMES - start], **kept)

    edits = {kind: people_edit(later) for kind in (BodyTracks, KeyframedMotion, RefinedMotion)}
    scene = write_scene(
        tmp_path / "scene", tiny, edits=edits | {VideoClip: cut},
        leave_out=(PersonTracks, BackgroundImage, DepthClip, MetricDepth),
    )  # fmt: skip
    found = evaluate(scene, truth_dir)
    assert value(found, "ingest", "kept") == pytest.approx(0.5)
    assert value(found, "motion", "root_error") == pytest.approx(0, abs=1e-9)
    assert value(found, "motion", "covered") == pytest.approx(0.5)
