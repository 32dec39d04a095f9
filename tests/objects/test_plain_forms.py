"""Forms for objects of no known kind, each against rendered objects of its own kind, with noise in depth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from furnished import Furnished, chair, furnished, moved, turned_by
from seen_boxes import LENS, Block, Piece, edges_of, table
from trimesh.creation import box, extrude_triangulation
from trimesh.transformations import rotation_matrix

from video2anim.geometry.projection import transform_points
from video2anim.objects.extrusion import OUTLINE, outline_form
from video2anim.objects.form_fit import FitSigmas, FormFit
from video2anim.objects.meshing import ObjectPicture, form_mesh
from video2anim.objects.observed import DepthErrors
from video2anim.objects.recognize import log_prior, recognized
from video2anim.objects.shapes import triangulated
from video2anim.types import View

LETTER = np.array([[-0.4, 0.0], [0.4, 0.0], [0.4, 0.25], [-0.1, 0.25], [-0.1, 1.2], [-0.4, 1.2]])
"""An L, which is a stack of two boxes."""
SIGN = np.array([[0.0, 0.0], [0.5, 0.6], [0.0, 1.2], [-0.5, 0.6]])
TRIANGLE = np.array([[-0.6, 0.0], [0.6, 0.0], [0.0, 1.0]])


def at(mesh: trimesh.Trimesh, yaw_rad: float, x_m: float = 0.1, z_m: float = -3.0) -> list[Piece]:
    mesh = mesh.copy()
    mesh.apply_transform(rotation_matrix(yaw_rad, [0, 1, 0]))
    mesh.apply_translation([x_m, 0, z_m])
    return [Piece(mesh)]


def ramp(run_m: float, across_m: float, rise_m: float) -> trimesh.Trimesh:
    """Falls towards +x."""
    x, z = 0.5 * run_m, 0.5 * across_m
    return trimesh.convex.convex_hull(
        np.array([[a, b, c] for a, b in ((-x, 0), (x, 0), (-x, rise_m)) for c in (-z, z)])
    )


def leaning(width_m: float, length_m: float, lean_rad: float) -> trimesh.Trimesh:
    """A board whose top leans back."""
    mesh = box((width_m, length_m, 0.03))
    mesh.apply_transform(rotation_matrix(-lean_rad, [1, 0, 0]))
    mesh.apply_translation([0, -mesh.bounds[0, 1], 0])
    return mesh


def cut_out(corners: np.ndarray, thick_m: float) -> trimesh.Trimesh:
    mesh = extrude_triangulation(corners, triangulated(corners), thick_m)
    mesh.apply_translation([0, 0, -0.5 * thick_m])
    return mesh


def boxes(*blocks: Block) -> list[Piece]:
    made = []
    for block in blocks:
        mesh = box(block.size_m)
        mesh.apply_transform(rotation_matrix(block.yaw_rad, [0, 1, 0]))
        mesh.apply_translation(block.center_m)
        made.append(Piece(mesh))
    return made


THINGS = {
    "slope: ramp": ("slope", at(ramp(1.2, 0.9, 0.4), -1.2)),
    "slope: bank": ("slope", at(ramp(0.9, 2.0, 0.6), 2.6 + np.pi, z_m=-4.0)),
    "board: leaning": ("board", at(leaning(0.7, 1.5, 0.5), 0.4)),
    "board: plank": ("board", at(leaning(0.5, 1.8, 1.1), -0.9)),
    "board: curtain": ("board", boxes(Block((0.2, 1.4, -5.8), (1.3, 2.0, 0.06)))),
    "stack": (
        "stack",
        boxes(Block((0.1, 0.2, -3.0), (1.0, 0.4, 0.6), 0.4), Block((0.0, 0.65, -3.0), (0.4, 0.5, 0.4), 0.4)),
    ),
    "stack: letter": ("stack", at(cut_out(LETTER, 0.1), -0.4)),
    "outline: sign": ("outline", at(cut_out(SIGN, 0.1), -0.4)),
    "outline: triangle": ("outline", at(cut_out(TRIANGLE, 0.1), 0.2)),
}


def noisy(parts: list, seed: int = 0) -> Furnished:
    """Depth errs by 2 % from place to place and by 0.5 % from pixel to pixel."""
    rng = np.random.default_rng(seed)
    slow = cv2.GaussianBlur(rng.normal(size=(LENS.height_px, LENS.width_px)), (0, 0), 8)
    factor = np.exp(0.02 * slow / slow.std() + rng.normal(0, 0.005, slow.shape))
    return furnished(parts, depth_factor=factor, depth_sigma=0.02)


def chamfer_m(fit: FormFit, parts: list[Piece]) -> float:
    """Of the surfaces of fit and truth, both ways."""
    pieces = [
        trimesh.Trimesh(transform_points(fit.T_world_object, vertices), faces)
        for vertices, faces in fit.solids()[1].meshes()
    ]
    sampled = [
        trimesh.sample.sample_surface(trimesh.util.concatenate(meshes), 3000, seed=0)[0]
        for meshes in (pieces, [part.mesh for part in parts])
    ]
    away = np.linalg.norm(sampled[0][:, None] - sampled[1][None], axis=-1)
    return float(0.5 * (away.min(0).mean() + away.min(1).mean()))


@pytest.mark.parametrize("name", THINGS)
def test_each_form_is_found_among_all_and_nearer_than_a_box(name: str) -> None:
    wanted, parts = THINGS[name]
    room = noisy(parts)
    best = recognized(room.seen, log_prior("object"))[0]
    plain = recognized(room.seen, {"box": 0.0})[0]
    assert best.form.name == wanted
    assert best.log_evidence > plain.log_evidence + 3
    if name != "board: curtain":
        # Of what is thin and far, the error of distance is all.
        assert chamfer_m(best, parts) < 0.8 * chamfer_m(plain, parts)
    expect_closed(best, room)


def expect_closed(fit: FormFit, room: Furnished) -> None:
    """Few faces, each part closed, all of it in the texture."""
    rgb = np.full((LENS.height_px, LENS.width_px, 3), 90, np.uint8)
    rgb[room.seen.own] = 200, 30, 30
    view = View(room.shot.T_world_camera, LENS)
    mesh, parts, texture = form_mesh(fit, ObjectPicture(rgb, room.seen.own, view))
    assert len(mesh.faces) < 300
    assert texture.corner_uv.shape == (len(mesh.faces), 3, 2)
    for part in parts:
        faces = mesh.faces[part.first_face : part.first_face + part.face_count]
        piece = trimesh.Trimesh(mesh.vertices_m, faces, process=False)
        assert piece.is_watertight
        assert piece.is_winding_consistent
        assert piece.volume > 0
    assert mesh.vertices_m[:, 1].min() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("seed", [1, 2])
def test_boxes_chairs_and_tables_stay_what_they_are(seed: int) -> None:
    """More forms do not take what the old ones explain."""
    for parts, names in (
        (moved(chair(), (0.2, -2.8), 0.5), {"chair"}),
        (table(1.3, 0.74, 0.8, (0.1, -3.2), 0.5), {"table"}),
        ([Block((0.2, 0.25, -3.0), (0.7, 0.5, 0.4), 0.4)], {"box", "cabinet"}),
    ):
        assert recognized(noisy(parts, seed).seen, log_prior("object"))[0].form.name in names


def test_an_outline_of_four_corners_loses_to_the_box_that_it_is() -> None:
    """Its corners are sizes that explain nothing more."""
    room = noisy([Block((0.2, 0.5, -3.0), (0.7, 1.0, 0.4), 0.1)])
    plain, own = (recognized(room.seen, {name: 0.0})[0] for name in ("box", OUTLINE))
    assert own.log_evidence < plain.log_evidence - 3


def test_nothing_has_no_outline() -> None:
    room = noisy([Block((0.2, 0.25, -3.0), (0.7, 0.5, 0.4), 0.4)])
    empty = replace(room.seen, outline=np.zeros_like(room.seen.own))
    assert outline_form(empty, room.seen.box(), 0.0, FitSigmas()) is None


def test_what_is_below_its_base_has_no_outline() -> None:
    """Held above a support at 2 m, the polygon of a crate of 0.5 m is a line, which has no triangles."""
    seen = noisy([Block((0.2, 0.25, -3.0), (0.7, 0.5, 0.4), 0.4)]).seen
    assert outline_form(seen, seen.box(), 0.1, FitSigmas()) is not None
    assert outline_form(seen, seen.box(), 2.0, FitSigmas()) is None


COLUMN = (np.arange(LENS.width_px) - LENS.cx_px) / LENS.fx_px


@pytest.mark.parametrize("yaw_rad", [0.1, -0.5])
def test_straight_edges_tell_the_yaw_where_depth_is_askew(yaw_rad: float) -> None:
    """Depth that grows to the right by a third of a meter for each meter."""
    crate = Block((0.1, 0.4, -3.0), (1.2, 0.8, 0.7), yaw_rad)
    errors = DepthErrors(0.03, 0.65, 0.4)
    askew = [
        furnished([crate], depth_factor=np.exp(0.3 * COLUMN), edges_m=edges_m, errors=errors)
        for edges_m in ((), edges_of(crate))
    ]
    blind, told = (
        turned_by(recognized(room.seen, {"box": 0.0})[0].values[2], yaw_rad, np.pi / 2) for room in askew
    )  # fmt: skip
    assert told < np.deg2rad(2)
    assert blind > 2 * told


@pytest.mark.parametrize("curved", [2.0, 4.0])
def test_a_box_whose_depth_is_a_bowl_is_not_round(curved: float) -> None:
    """Networks see the middle of a plain front nearer than its ends: with 4, nearly as of a drum."""
    shed = Block((0.0, 0.9, -5.0), (2.3, 1.8, 1.5), 0.1)
    room = furnished(
        [shed], depth_factor=np.exp(curved * COLUMN**2), edges_m=edges_of(shed), errors=DepthErrors(0.03, 0.65, 0.4),
        distance_sigma=0.05,
    )  # fmt: skip
    best = recognized(room.seen, log_prior("object"))[0]
    assert best.form.name in ("box", "cabinet", OUTLINE)
    assert turned_by(best.values[2], 0.1, np.pi / 2) < np.deg2rad(3)
    assert dict(zip((size.name for size in best.form.sizes), best.sizes_m, strict=True))["height"] == pytest.approx(
        1.8, abs=0.1
    )


def test_a_roof_that_is_seen_too_near_stands_behind_who_passes_before_it() -> None:
    """Somebody stands on it. Started where it is seen, among the joints, it becomes a thin board in front of them."""
    shed = Block((0.0, 0.9, -5.0), (2.3, 1.8, 1.5), 0.1)
    path_m = np.linspace(-0.9, 0.9, 12)
    joints_m = np.stack([np.repeat(path_m, 3), np.tile([0.5, 0.95, 1.4], 12), np.full(36, -4.05)], -1)
    rng = np.random.default_rng(0)
    stood_m = np.stack([rng.uniform(0.3, 0.9, 60), np.full(60, 1.8), rng.uniform(-5.4, -4.8, 60)], -1)
    room = furnished(
        [shed], depth_factor=0.82 * np.exp(4 * COLUMN**2), edges_m=edges_of(shed), body_m=joints_m,
        rested_m=stood_m,
        errors=DepthErrors(0.03, 0.65, 0.4), distance_sigma=0.06,
    )  # fmt: skip
    best = recognized(room.seen, log_prior("object"))[0]
    assert best.form.name in ("box", "cabinet")
    assert best.values[1] < -4.3, "its middle, behind the joints"
