"""Closed, colored meshes of fitted forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from furnished import furnished
from seen_boxes import LENS, Block, about_y, looking, shoot

from video2anim.geometry.scene_mesh import with_vertex_colors
from video2anim.objects.form_fit import POSE, FormFit
from video2anim.objects.furniture import FORMS, Form
from video2anim.objects.meshing import ObjectPicture, form_mesh, outline_iou
from video2anim.types import Mesh, ObjectPart, View

FRONT_RGB, SIDE_RGB, TOP_RGB, ROOM_RGB = (0, 0, 250), (250, 0, 0), (0, 250, 0), (90, 90, 90)
BLOCK = Block((0.2, 0.4, -3.0), (1.0, 0.8, 0.6), -0.5)
BOX = next(form for form in FORMS if form.name == "box")


def fit_of(form: Form, sizes_m: np.ndarray, at_m: tuple[float, float] = (0.0, -3.0), yaw_rad: float = 0.0) -> FormFit:
    """The form with these sizes in this place."""
    values = np.array([*at_m[:1], at_m[1], yaw_rad, 0.0, 0.0, 0.0, *np.log(sizes_m)])
    return FormFit(form, values, 0.0, np.full(len(values), 0.01), 0.01)


def true_fit(block: Block = BLOCK) -> FormFit:
    x, _, z = block.center_m
    return fit_of(BOX, np.array(block.size_m)[[0, 2, 1]], (x, z), block.yaw_rad)


def painted(scale: int = 1, others: tuple[Block, ...] = ()) -> ObjectPicture:
    """The block before a camera that sees front, top and one side of it, with a color for each."""
    shot = shoot([BLOCK, *others], looking((0.0, 1.6, 0.0), (0.1, 0.4, -3.0)))
    own = np.abs(shot.normal @ BLOCK.R_world_block)
    rgb = np.full((*shot.shown.shape, 3), ROOM_RGB, np.uint8)
    for axis, color in ((0, SIDE_RGB), (1, TOP_RGB), (2, FRONT_RGB)):
        rgb[shot.mask(0) & (own[..., axis] > 0.9)] = color
    mask = shot.mask(0)
    rgb, mask = (image.repeat(scale, 0).repeat(scale, 1) for image in (rgb, mask))
    lens = LENS.resized(scale * LENS.width_px, scale * LENS.height_px)
    return ObjectPicture(rgb, mask, View(shot.T_world_camera, lens))


def dense(fit: FormFit, picture: ObjectPicture) -> Mesh:
    """The form's mesh with its texture as colors of many vertices."""
    mesh, _, texture = form_mesh(fit, picture)
    return with_vertex_colors(mesh, (texture,))


def side(mesh: Mesh, axis: int, sign: int) -> np.ndarray:
    """Colors of the vertices on one side, off its edges."""
    half = 0.5 * np.array(BLOCK.size_m)
    own = mesh.vertices_m - [0, half[1], 0]
    rest = [k for k in range(3) if k != axis]
    on = np.isclose(own[:, axis], sign * half[axis], atol=1e-5) & (np.abs(own[:, rest]) < half[rest] - 0.06).all(1)
    assert on.sum() > 50
    return mesh.vertex_rgb[on]


def share(rgb: np.ndarray, wanted: tuple[int, int, int]) -> float:
    return float((rgb == wanted).all(1).mean())


def seen_side() -> int:
    """Which of the two sides along the block's x the camera sees."""
    towards = BLOCK.R_world_block.T @ (np.array([0.0, 1.6, 0.0]) - BLOCK.center_m)
    return int(np.sign(towards[0]))


@pytest.mark.parametrize("scale", [1, 3])
def test_seen_sides_have_the_colors_of_the_picture_at_any_size(scale: int) -> None:
    mesh = dense(true_fit(), painted(scale))
    assert mesh.vertex_rgb.dtype == np.uint8
    assert share(side(mesh, 0, seen_side()), SIDE_RGB) > 0.99
    assert share(side(mesh, 1, 1), TOP_RGB) > 0.99
    assert share(side(mesh, 2, 1), FRONT_RGB) > 0.99
    assert share(mesh.vertex_rgb, ROOM_RGB) < 0.02, "only the outline may mix with the room"


def test_hidden_sides_have_the_colors_of_their_mirror_images() -> None:
    mesh = dense(true_fit(), painted())
    assert share(side(mesh, 0, -seen_side()), SIDE_RGB) > 0.9
    assert share(side(mesh, 2, -1), FRONT_RGB) > 0.9


def test_what_stands_before_the_thing_does_not_color_it() -> None:
    """A post hides the middle of the front: vertices there have the color of the front beside it."""
    picture = painted(1, (Block((0.1, 0.5, -2.2), (0.08, 1.0, 0.08)),))
    assert share(picture.rgb[picture.own], ROOM_RGB) == 0
    mesh = dense(true_fit(), picture)
    assert share(side(mesh, 2, 1), FRONT_RGB) > 0.97


def test_parts_behind_parts_do_not_have_their_colors() -> None:
    """A chair seen from behind: its back is blue, and hides the seat's rear; what is seen of the seat is red."""
    chair = next(form for form in FORMS if form.name == "chair")
    fit = fit_of(chair, chair.usual_m, (0.0, -2.5), np.pi)
    camera = looking((0.3, 1.9, 0.0), (0.0, 0.5, -2.5))
    names, solids = fit.solids()
    T_object_camera = np.linalg.inv(fit.T_world_object) @ camera
    row, column = np.mgrid[: LENS.height_px, : LENS.width_px]
    local = np.stack([(column - LENS.cx_px) / LENS.fx_px, (row - LENS.cy_px) / LENS.fy_px, np.ones_like(row)], -1)
    ray = (local.reshape(-1, 3) @ T_object_camera[:3, :3].T)[None]
    first = [
        replace(
            solids, center_m=solids.center_m[:, k : k + 1], half_m=solids.half_m[:, k : k + 1],
            tilt_rad=solids.tilt_rad[:, k : k + 1], shapes=solids.shapes[k : k + 1],
        ).first_hit(T_object_camera[None, :3, 3], ray)[0]
        for k in range(len(names))
    ]  # fmt: skip
    nearest = np.argmin(first, 0).reshape(row.shape)
    own = np.isfinite(np.min(first, 0)).reshape(row.shape)
    rgb = np.where(own[..., None], np.where((nearest == names.index("back"))[..., None], (0, 0, 250), (250, 0, 0)), 90)
    mesh, parts, texture = form_mesh(fit, ObjectPicture(rgb.astype(np.uint8), own, View(camera, LENS)))
    for part in parts:
        faces = slice(part.first_face, part.first_face + part.face_count)
        piece = replace(mesh, faces=mesh.faces[faces])
        piece = with_vertex_colors(piece, (replace(texture, corner_uv=texture.corner_uv[faces]),))
        wanted = (0, 0, 250) if part.name == "back" else (250, 0, 0)
        if part.name in ("seat", "back"):
            assert share(piece.vertex_rgb, wanted) > 0.7, part.name


def test_what_no_pixel_shows_has_the_middle_color_of_the_object_or_gray() -> None:
    """A fit beside the picture."""
    picture, beside = painted(), fit_of(BOX, np.array([0.5, 0.5, 0.5]), (0.0, 4.0))
    mesh = dense(beside, picture)
    assert share(mesh.vertex_rgb, tuple(np.median(picture.rgb[picture.own], axis=0).astype(int))) == 1
    gray = dense(beside, replace(picture, own=np.zeros_like(picture.own)))
    assert share(gray.vertex_rgb, (127, 127, 127)) == 1


@pytest.mark.parametrize("form", FORMS, ids=lambda form: f"{form.name} {form.variant}".strip())
def test_every_form_has_few_faces_and_its_parts_are_all_of_them(form: Form) -> None:
    mesh, parts, texture = form_mesh(fit_of(form, form.usual_m), painted())
    assert 8 <= len(mesh.faces) < 300
    assert texture.corner_uv.shape == (len(mesh.faces), 3, 2)
    assert all(isinstance(part, ObjectPart) for part in parts)
    ends = [part.first_face + part.face_count for part in parts]
    assert [part.first_face for part in parts] == [0, *ends[:-1]]
    assert ends[-1] == len(mesh.faces)
    names, solids = fit_of(form, form.usual_m).solids()
    assert tuple(part.name for part in parts) == names
    for number, part in enumerate(parts):
        faces = mesh.faces[part.first_face : part.first_face + part.face_count]
        piece = trimesh.Trimesh(mesh.vertices_m, faces, process=False)
        piece.remove_unreferenced_vertices()
        assert piece.is_watertight
        assert piece.volume > 0
        distance_m = solids.distance_m(mesh.vertices_m[np.unique(faces)][None].astype(float))[0, number]
        np.testing.assert_allclose(distance_m, 0, atol=1e-5)


def test_the_outline_of_the_truth_is_that_of_the_object() -> None:
    room = furnished([BLOCK])
    assert outline_iou(true_fit(), room.seen.evidence, room.seen.own) > 0.98
    aside = true_fit(replace(BLOCK, center_m=(0.7, 0.4, -3.0)))
    assert 0.3 < outline_iou(aside, room.seen.evidence, room.seen.own) < 0.7
    away = true_fit(replace(BLOCK, center_m=(0.0, 0.4, 5.0)))
    assert outline_iou(away, room.seen.evidence, room.seen.own) == 0


def test_hidden_parts_of_the_outline_are_not_asked_for() -> None:
    """The lower half is behind a chest, which may hide any part of the form."""
    room = furnished([BLOCK], [Block((0.2, 0.25, -2.2), (1.8, 0.5, 0.2))])
    seen = shoot([BLOCK], room.shot.T_world_camera).mask(0)
    assert room.seen.own.sum() < 0.8 * seen.sum()
    assert outline_iou(true_fit(), room.seen.evidence, room.seen.own) > 0.97


def test_pose_of_a_fit() -> None:
    fit = true_fit()
    np.testing.assert_allclose(fit.T_world_object[:3, :3], about_y(BLOCK.yaw_rad))
    np.testing.assert_allclose(fit.T_world_object[:3, 3], [0.2, 0, -3.0])
    assert len(fit.values) == len(POSE) + len(fit.sizes_m)
