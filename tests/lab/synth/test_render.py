"""Pictures against geometry worked out by hand, and against themselves."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from render_room import HALF_M, look_at, make_room, make_shot, standing

from video2anim.body.anny_body import shaped_body
from video2anim.errors import UsageError
from video2anim.geometry.projection import project
from video2anim.lab.synth.render import Picture, Renderer
from video2anim.lab.synth.render.lens import pixel_directions
from video2anim.lab.synth.world import PERSON_ID, Material, MovingObject, Part, SceneObject, SensorModel, Shot
from video2anim.types import Intrinsics
from video2anim.types.skeleton import forward_kinematics


@pytest.fixture(scope="module")
def shot() -> Shot:
    return make_shot(people=2)


@pytest.fixture(scope="module")
def renderer(shot: Shot) -> Renderer:
    return Renderer(shot)


@pytest.fixture(scope="module")
def picture(renderer: Renderer) -> Picture:
    return renderer.frame(1)


def plane_depth(shot: Shot, axis: int, value: float) -> np.ndarray:
    """z-depth of an axis-aligned plane through every pixel, by hand."""
    height, width = shot.intrinsics.height_px, shot.intrinsics.width_px
    y, x = np.mgrid[:height, :width]
    rays = pixel_directions(np.stack([x, y], -1), shot.intrinsics, shot.sensor.k1, shot.sensor.k2)
    T = shot.T_world_camera[0]
    return (value - T[axis, 3]) / (rays @ T[axis, :3])


@pytest.mark.parametrize("sensor", [SensorModel(), SensorModel(k1=-0.12, k2=0.03)])
def test_depth_of_floor_and_walls_is_that_of_their_planes(sensor: SensorModel) -> None:
    shot = make_shot(people=0, sensor=sensor)
    background = Renderer(shot).background()
    for number, axis, value in ((1, 1, 0.0), (2, 2, -HALF_M), (3, 0, -HALF_M), (7, 1, 0.012)):
        seen = (background.instance == number) & ((background.normal_camera @ shot.T_world_camera[0, axis, :3]) > 0.99)
        assert seen.sum() > 100
        assert np.abs(background.depth_m - plane_depth(shot, axis, value))[seen].max() < 1e-4


def test_normals_are_unit_and_face_the_camera(picture: Picture, shot: Shot) -> None:
    seen = picture.instance > 0
    assert seen.all()
    assert np.abs(np.linalg.norm(picture.normal_camera[seen], axis=-1) - 1).max() < 1e-4
    y, x = np.mgrid[: shot.intrinsics.height_px, : shot.intrinsics.width_px]
    rays = pixel_directions(np.stack([x, y], -1), shot.intrinsics)
    assert ((picture.normal_camera * rays).sum(-1) < 1e-5).all()
    up = picture.normal_camera[picture.instance == 1] @ shot.T_world_camera[0, 1, :3]
    assert np.median(up) == pytest.approx(1, abs=1e-4)


def test_amodal_masks_contain_the_visible_ones(renderer: Renderer, picture: Picture) -> None:
    numbers = np.unique(picture.instance)
    assert {PERSON_ID, PERSON_ID + 1} <= set(numbers.tolist())
    for number in numbers.tolist():
        whole = renderer.amodal(number, 1)
        assert not ((picture.instance == number) & ~whole).any()
    table = renderer.amodal(10, 1)
    assert table.sum() > (picture.instance == 10).sum() + 50  # the second person stands before it


def test_labels_outside_the_people_are_those_of_the_background_image(renderer: Renderer, picture: Picture) -> None:
    background = renderer.background()
    room = picture.instance < PERSON_ID
    assert np.array_equal(picture.depth_m[room], background.depth_m[room])
    assert np.array_equal(picture.instance[room], background.instance[room])
    assert (picture.depth_m[~room] < background.depth_m[~room]).all()
    assert (background.instance < PERSON_ID).all()


def test_same_shot_same_bytes_in_any_order(shot: Shot, picture: Picture) -> None:
    again = Renderer(shot)
    again.frame(3)
    other = again.frame(1)
    for field in dataclasses.fields(Picture):
        assert np.array_equal(getattr(picture, field.name), getattr(other, field.name)), field.name


def test_body_lies_where_its_skeleton_says(renderer: Renderer, picture: Picture, shot: Shot) -> None:
    for number, actor in enumerate(shot.actors):
        mask = picture.instance == PERSON_ID + number
        camera = actor.motion.joints_camera_m[1]
        pixel = np.round(project(camera, shot.intrinsics)).astype(int)
        inside = (pixel >= 0).all(1) & (pixel < [shot.intrinsics.width_px, shot.intrinsics.height_px]).all(1)
        whole = renderer.amodal(PERSON_ID + number, 1)
        assert whole[pixel[inside, 1], pixel[inside, 0]].mean() >= 0.95
        motion = actor.motion
        joints, R = forward_kinematics(
            motion.R_parent_joint[1:2], motion.T_world_root[1:2, :3, 3], motion.rest_joints_m
        )
        vertices = shaped_body(motion.shape).vertices(R, joints)[0]
        points = (vertices - shot.T_world_camera[1, :3, 3]) @ shot.T_world_camera[1, :3, :3]
        at = project(points, shot.intrinsics)
        near = np.round(at).astype(int)
        kept = (np.abs(at - near).max(1) < 0.05) & (near >= 0).all(1)
        kept &= (near < [shot.intrinsics.width_px, shot.intrinsics.height_px]).all(1)
        near, points = near[kept], points[kept]
        ours = mask[near[:, 1], near[:, 0]]
        off = points[ours, 2] - picture.depth_m[near[ours, 1], near[ours, 0]]
        assert len(off) > 20
        assert off.min() > -0.006  # nothing of the body lies before what is seen
        assert (np.abs(off) < 0.006).mean() > 0.3  # the near side lies on it


def test_people_darken_the_floor_at_their_feet_and_nothing_far_away(renderer: Renderer, picture: Picture) -> None:
    background = renderer.background()
    floor = (picture.instance == 1) | (picture.instance == 7)
    change = picture.rgb.astype(int).sum(-1) - background.rgb.astype(int).sum(-1)
    assert (change[floor] < -20).mean() > 0.02
    people = cv2.dilate((picture.instance >= PERSON_ID).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert change[~people].max() <= 0
    assert (change[:40, :] == 0).mean() > 0.8  # upper wall


def test_edges_of_people_are_mixed_with_the_room() -> None:
    shot = make_shot(people=1)
    black = Material("plain", (0.0, 0.0, 0.0))
    actor = dataclasses.replace(shot.actors[0], materials=(black,), face_material=0 * shot.actors[0].face_material)
    renderer = Renderer(dataclasses.replace(shot, actors=(actor,)))
    background, frame = renderer.background(), renderer.frame(0)
    above_table = slice(60, 110), slice(130, 260)
    share = frame.rgb[above_table].mean(-1) / np.maximum(background.rgb[above_table].mean(-1), 1)
    assert ((share > 0.3) & (share < 0.85)).sum() > 30
    assert (share < 0.05).sum() > 300


def test_moving_camera_draws_the_same_room() -> None:
    still, moving = make_shot(people=1, frames=2), make_shot(people=1, frames=2, handheld=True)
    a, b = Renderer(still).frame(0), Renderer(moving).frame(0)
    assert np.array_equal(a.instance, b.instance)
    assert np.array_equal(a.depth_m, b.depth_m)
    assert np.abs(a.rgb.astype(int) - b.rgb).mean() < 3


def test_blur_spreads_a_moving_person_and_leaves_labels_alone() -> None:
    sharp = make_shot(people=1, frames=3)
    fast = standing(3, sharp.intrinsics, sharp.T_world_camera, step_m=0.25, x=-0.2, z=0.2)
    sharp = dataclasses.replace(sharp, actors=(fast,))
    blurred = dataclasses.replace(sharp, sensor=SensorModel(blur_s=1 / 40))
    a, b = Renderer(sharp).frame(1), Renderer(blurred).frame(1)
    assert np.array_equal(a.instance, b.instance)
    assert np.array_equal(a.depth_m, b.depth_m)
    border = np.diff((a.instance >= PERSON_ID).astype(int), axis=1) != 0
    steep_a, steep_b = (np.abs(np.diff(p.rgb.mean(-1), axis=1))[border].mean() for p in (a, b))
    assert steep_b < 0.5 * steep_a


def test_blur_of_a_moving_camera() -> None:
    sharp = make_shot(people=0, frames=3, handheld=True)
    for t in range(3):
        sharp.T_world_camera[t] = look_at((0.9 + 0.05 * t, 1.5, 2.3), (-0.1 + 0.05 * t, 0.85, -0.6))
    blurred = dataclasses.replace(sharp, sensor=SensorModel(blur_s=1 / 31))
    a, b = Renderer(sharp).frame(1), Renderer(blurred).frame(1)
    steep_a, steep_b = (np.abs(np.diff(p.rgb.astype(int).mean(-1), axis=1)).mean() for p in (a, b))
    assert steep_b < 0.8 * steep_a
    assert abs(a.rgb.mean() - b.rgb.mean()) < 2


def test_carried_objects_move_and_are_not_in_the_background_image() -> None:
    shot = make_shot(people=1, frames=2)
    obj = make_room().furniture[-1]
    carried = SceneObject(900, "box", obj.parts, np.eye(4))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [[-0.2, 1.0, 0.8], [0.3, 1.1, 0.8]]
    renderer = Renderer(
        dataclasses.replace(shot, moving=(MovingObject(carried, poses, np.ones((len(poses), 2), bool)),))
    )
    assert 900 not in renderer.background().instance
    columns = []
    for t in (0, 1):
        seen = renderer.frame(t).instance == 900
        assert not (seen & ~renderer.amodal(900, t)).any()
        columns.append(np.nonzero(seen)[1].mean())
    assert columns[1] > columns[0] + 20


def test_baked_colors_are_used() -> None:
    shot = make_shot(people=0)
    part = make_room().furniture[-1].parts[0]
    red = np.tile(np.array([230, 10, 10], np.uint8), (len(part.vertices_m), 1))
    box = SceneObject(77, "mesh", (Part(part.vertices_m, part.faces, part.material, vertex_rgb=red),), np.eye(4))
    room = dataclasses.replace(shot.room, furniture=(*shot.room.furniture, box))
    background = Renderer(dataclasses.replace(shot, room=room)).background()
    shown = background.rgb[background.instance == 77].astype(float)
    assert len(shown) > 100
    assert (shown[:, 0] > 3 * shown[:, 1]).mean() > 0.95


def test_person_who_is_absent_is_not_drawn() -> None:
    shot = make_shot(people=1, frames=2)
    motion = dataclasses.replace(shot.actors[0].motion, valid=np.array([True, False]))
    renderer = Renderer(dataclasses.replace(shot, actors=(dataclasses.replace(shot.actors[0], motion=motion),)))
    assert (renderer.frame(0).instance >= PERSON_ID).any()
    assert np.array_equal(renderer.frame(1).rgb, renderer.background().rgb)


def test_person_close_to_the_camera_and_behind_it_is_drawn_without_harm() -> None:
    intrinsics = Intrinsics.centered(100, 120, 90)
    poses = np.tile(look_at((0.0, 1.5, 0.35), (0, 1.4, -1)), (1, 1, 1))
    near = standing(1, intrinsics, poses, z=0.3)
    behind = standing(1, intrinsics, poses, z=1.6, person_id=1)
    frame = Renderer(Shot("near", make_room(), (near, behind), intrinsics, poses, True, SensorModel())).frame(0)
    assert np.isfinite(frame.depth_m).all()
    assert PERSON_ID + 1 not in frame.instance


@pytest.mark.parametrize("t", [-1, 4])
def test_frames_outside_the_clip_are_refused(renderer: Renderer, t: int) -> None:
    with pytest.raises(UsageError, match=f"frame {t} of 0 to 3"):
        renderer.frame(t)


def test_unknown_object_is_refused(renderer: Renderer) -> None:
    with pytest.raises(UsageError, match="no object 4711"):
        renderer.amodal(4711)
