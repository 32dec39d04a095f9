"""Closed, colored meshes of objects in their own frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scene_chain import run_chain
from synthetic_room import BOX, BOX_CENTER_M, BOX_SIZE_M, FLOOR, TRUE_RELIEF, Room, camera_pose, make_room, true_depth

from stages.reconstruct import ReconstructConfig, reconstruct_objects
from video2anim.geometry.projection import transform_points
from video2anim.networks.amodal import object_picture
from video2anim.objects.furniture import BOX as BOX_FORM
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    BodyTracks,
    CompletedObject,
    CompletedObjects,
    InstanceMasks,
    ObjectInstance,
    ObjectMesh,
    ObjectMeshes,
)

ROOM_RGB, RIM_RGB, THING_RGB = (80, 90, 80), (0, 250, 0), (200, 30, 30)


def reconstruct(
    room: Room,
    masks: list[np.ndarray],
    *,
    depth_m: np.ndarray | None = None,
    floor: np.ndarray | None = None,
    config: ReconstructConfig | None = None,
    ctx: StageContext | None = None,
    label: str = "object",
) -> ObjectMeshes:
    """The stage on objects whose outlines are known and not hidden."""
    instances, completed = [], []
    for number, mask in enumerate(masks, 1):
        instances.append(ObjectInstance(number, label, 1.0, np.zeros(4), mask))
        crop, corner = object_picture(room.background.background_rgb, mask, mask)
        completed.append(CompletedObject(number, label, mask, crop, corner, 0.0))
    return reconstruct_objects(
        CompletedObjects(tuple(completed)),
        InstanceMasks("truth", tuple(instances), room.surface_full == FLOOR if floor is None else floor),
        true_depth(room, depth_m),
        room.background,
        replace(config or ReconstructConfig(), **TRUE_RELIEF),
        ctx or StageContext(Path()),
    )


def checked(found: ObjectMesh) -> trimesh.Trimesh:
    """The mesh, if it is closed and lies in its own frame: +Y up, resting on y = 0."""
    mesh = trimesh.Trimesh(found.mesh.vertices_m, found.mesh.faces, process=False)
    assert np.isfinite(found.mesh.vertices_m).all()
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.bounds[0, 1] == pytest.approx(0, abs=1e-6)
    R_world_object = found.T_world_object[:3, :3]
    np.testing.assert_allclose(R_world_object @ R_world_object.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R_world_object) == pytest.approx(1.0)
    np.testing.assert_allclose(R_world_object[:, 1], [0, 1, 0], atol=1e-9)
    assert found.mesh.vertex_rgb.shape == found.mesh.vertices_m.shape
    return mesh


def level_room() -> Room:
    """A level camera one meter above the floor."""
    room = make_room()
    body = room.bodies.people[0]
    level = replace(body, T_world_camera=np.tile(camera_pose(1.0, 0.0), (body.frame_count, 1, 1)))
    return replace(room, bodies=BodyTracks((level,)))


def facing_plane(
    room: Room, z_m: float = 4.0, *, wall_z_m: float = 40.0, below_z_m: float = 2.0
) -> tuple[np.ndarray, np.ndarray]:
    """Outline, at the clip's size, and depth of an upright rectangle across the view.

    It is 1.2 m wide and reaches from 0.7 m to 1.5 m above the floor. What is seen below it is as far as `below_z_m`,
    what is seen around it as far as `wall_z_m`.
    """
    k = room.bodies.people[0].intrinsics
    x = (np.arange(k.width_px) - k.cx_px) / k.fx_px * z_m
    y = 1.0 - (np.arange(k.height_px) - k.cy_px) / k.fy_px * z_m
    mask = (np.abs(x) < 0.6)[None] & ((y > 0.7) & (y < 1.5))[:, None]
    height, width = room.depth_m.shape
    small = mask.reshape(height, mask.shape[0] // height, width, -1).mean((1, 3)) > 0.5
    rows, columns = np.nonzero(small)
    depth_m = np.where(small, z_m, wall_z_m)
    depth_m[rows.max() + 1 :, columns.min() : columns.max() + 1] = below_z_m
    return mask, depth_m


def test_box_of_the_chain_is_closed_blue_and_stands_in_its_frame() -> None:
    found = run_chain(make_room(pitch_deg=14.0, roll_deg=0.0)).meshes.objects[0]
    mesh = checked(found)
    assert found.method.startswith("form: ")
    assert found.T_world_object[1, 3] == pytest.approx(0, abs=0.005)
    assert mesh.extents[0] == pytest.approx(BOX_SIZE_M[0], rel=0.25)
    assert mesh.extents[1] == pytest.approx(BOX_SIZE_M[1], rel=0.15)
    # The outline is a few pixels too wide, so some of its rim has the wall's and the floor's colors.
    rgb = found.mesh.vertex_rgb.astype(int)
    assert (rgb[:, 2] > rgb[:, 0] + 20).mean() > 0.8


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(14.0, 0.0), (22.0, 12.0)])
def test_true_outline_and_depth_give_the_true_box(pitch_deg: float, roll_deg: float) -> None:
    """Side and top are seen at a slant from 4.4 m: up to 0.2 m of the far edge is lost."""
    room = make_room(pitch_deg=pitch_deg, roll_deg=roll_deg)
    (found,) = reconstruct(room, [room.surface_full == BOX], label="box").objects
    mesh = checked(found)
    assert found.object_id == 1
    assert (found.label, found.method) == ("box", "form: box")
    assert [part.name for part in found.parts] == ["body"]
    yaw = np.arctan2(found.T_world_object[0, 2], found.T_world_object[2, 2])
    assert abs(np.sin(2 * yaw)) < 0.06, "a multiple of a quarter turn"
    size_m = mesh.extents if abs(np.cos(yaw)) > 0.5 else mesh.extents[[2, 1, 0]]
    np.testing.assert_allclose(size_m[:2], BOX_SIZE_M[:2], atol=0.06)
    assert size_m[2] == pytest.approx(BOX_SIZE_M[2], abs=0.22)
    center_m = transform_points(found.T_world_object, np.array([[0.0, 0.5 * mesh.extents[1], 0.0]]))[0]
    np.testing.assert_allclose(center_m[:2], BOX_CENTER_M[:2], atol=0.05)
    assert center_m[2] == pytest.approx(BOX_CENTER_M[2], abs=0.12)
    rgb = found.mesh.vertex_rgb.astype(int)
    assert (rgb[:, 2] > rgb[:, 0] + 20).mean() > 0.95


def test_a_fitted_form_says_how_well_it_fits() -> None:
    """A box of true depth and outline lies on its depth and fills its outline; how deep it is, is hardly seen."""
    room = make_room(pitch_deg=22.0, roll_deg=12.0)
    (found,) = reconstruct(room, [room.surface_full == BOX], label="box").objects
    assert found.chamfer_m < 0.02
    assert found.outline_iou > 0.9
    offset_m = found.T_world_object[[0, 2], 3] - BOX_CENTER_M[[0, 2]]
    assert np.linalg.norm(offset_m) < 3 * found.position_sigma_m < 1.0
    assert 0 < found.yaw_sigma_rad < 0.5
    assert 0.02 < found.size_sigma < 0.5


def test_names_of_networks_are_kept_and_unknown_things_get_that_of_their_form() -> None:
    room = make_room()
    mask = room.surface_full == BOX
    labels = ("chest of drawers", "object", "ottoman")
    (kept,), (named,), (rejected,) = (reconstruct(room, [mask], label=label).objects for label in labels)
    assert kept.label == "chest of drawers"
    assert named.label != "object"
    assert rejected.label == named.label, "no ottoman is as large as the box"
    assert named.method.startswith(f"form: {named.label}")


def test_a_front_alone_is_a_closed_thing_behind_it() -> None:
    """Something near hides its lower end, so it reaches down to the floor: 1.2 m wide, 1.5 m high."""
    room = level_room()
    mask, depth_m = facing_plane(room)
    (found,) = reconstruct(room, [mask], depth_m=depth_m, floor=np.zeros_like(mask)).objects
    world_m = transform_points(found.T_world_object, checked(found).vertices)
    assert world_m[:, 1].min() == pytest.approx(0, abs=0.02)
    assert world_m[:, 1].max() == pytest.approx(1.5, abs=0.08)
    assert np.ptp(world_m[:, 0]) == pytest.approx(1.2, abs=0.1)
    assert world_m[:, 2].max() == pytest.approx(-4.0, abs=0.1), "the front is seen"


def test_a_window_in_the_mask_does_not_stretch_an_object_to_the_wall() -> None:
    """A third of the mask shows the wall, 3 m behind, through the object."""
    room = level_room()
    mask, depth_m = facing_plane(room, wall_z_m=7.0)
    rows, columns = (np.flatnonzero((depth_m == 4.0).any(axis)) for axis in (1, 0))
    center, width = (columns[0] + columns[-1]) // 2, len(columns) // 6
    depth_m[rows[0] + 2 : rows[-1] - 1, center - width : center + width] = 7.0
    (found,) = reconstruct(room, [mask], depth_m=depth_m, floor=np.zeros_like(mask)).objects
    world_m = transform_points(found.T_world_object, checked(found).vertices)
    assert np.ptp(world_m[:, 0]) == pytest.approx(1.2, abs=0.15)
    assert np.ptp(world_m[:, 2]) < 0.6


def test_a_raised_object_keeps_its_height_in_the_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its lower edge, 0.7 m high, touches the front of what stands under it; the mesh itself rests on y = 0. Only boxes
    are tried: a board on legs explains the same picture."""
    monkeypatch.setattr("video2anim.objects.recognize.FORMS", (BOX_FORM,))
    room = level_room()
    mask, depth_m = facing_plane(room, below_z_m=3.95)
    (found,) = reconstruct(room, [mask], depth_m=depth_m, floor=np.zeros_like(mask), label="box").objects
    mesh = checked(found)
    assert found.T_world_object[1, 3] == pytest.approx(0.7, abs=0.05)
    assert mesh.extents[1] == pytest.approx(0.8, abs=0.08)


@pytest.mark.parametrize("label", ["chair", "box", "table"])
def test_forms_have_few_faces_all_in_parts_and_in_the_texture(label: str) -> None:
    room, ctx = make_room(pitch_deg=22.0, roll_deg=12.0), StageContext(Path())
    (found,) = reconstruct(room, [room.surface_full == BOX], ctx=ctx, label=label).objects
    checked(found)
    assert 12 <= len(found.mesh.faces) < 300
    (texture,) = found.textures
    assert texture.corner_uv.shape == (len(found.mesh.faces), 3, 2)
    assert sum(part.face_count for part in found.parts) == len(found.mesh.faces)
    told = {quality.key: quality.value for quality in ctx.qualities}
    assert told["max_faces"] == len(found.mesh.faces)


def painted(mask: np.ndarray, rim_px: int) -> Room:
    """An object of one color in a room of another; its outermost pixels have a third one."""
    room = level_room()
    rows, columns = np.nonzero(mask)
    picture = np.full_like(room.background.background_rgb, ROOM_RGB)
    picture[mask] = RIM_RGB
    inside = np.zeros_like(mask)
    inside[rows.min() + rim_px : rows.max() + 1 - rim_px, columns.min() + rim_px : columns.max() + 1 - rim_px] = True
    picture[inside] = THING_RGB
    return replace(room, background=replace(room.background, background_rgb=picture))


def test_colors_come_from_the_picture() -> None:
    """Hidden parts have the colors of the seen ones; nothing has those of the room."""
    mask, depth_m = facing_plane(level_room())
    (found,) = reconstruct(painted(mask, 0), [mask], depth_m=depth_m, floor=np.zeros_like(mask)).objects
    assert (found.mesh.vertex_rgb == THING_RGB).all()


def test_colors_of_the_outline_are_those_further_in() -> None:
    mask, depth_m = facing_plane(level_room())
    (found,) = reconstruct(painted(mask, 2), [mask], depth_m=depth_m, floor=np.zeros_like(mask)).objects
    assert not (found.mesh.vertex_rgb == RIM_RGB).all(1).any()


def test_objects_without_depth_are_dropped_and_told() -> None:
    room = make_room()
    whole = room.surface_full == BOX
    small = np.zeros_like(whole)
    rows, columns = np.nonzero(whole)
    small[rows.min() : rows.min() + 4, columns.min() : columns.min() + 8] = True
    unknown = np.where(room.surface == BOX, 0.0, room.depth_m)
    ctx = StageContext(Path())
    assert reconstruct(room, [whole, small], depth_m=unknown, ctx=ctx).objects == ()
    assert ["too little reliable depth" in warning for warning in ctx.warnings] == [True, True]
    ctx = StageContext(Path())
    (kept,) = reconstruct(room, [small, whole], ctx=ctx).objects
    assert kept.object_id == 2
    told = {quality.key: quality.value for quality in ctx.qualities}
    assert (told["meshes"], told["dropped"]) == (1, 1)
    assert len(ctx.warnings) == 1
    assert "object 1" in ctx.warnings[0]


def test_no_objects() -> None:
    room = make_room()
    assert reconstruct(room, []).objects == ()
