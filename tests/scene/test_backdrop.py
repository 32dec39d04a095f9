"""Rooms and streets rendered by ray and plane: what comes out must be where the planes are, and nowhere else."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from video2anim.artifacts.codec import read_value, write_value
from video2anim.geometry.heading import EdgeHeadings
from video2anim.geometry.projection import pixel_rays, project
from video2anim.geometry.scene_mesh import colored, joined
from video2anim.scene.backdrop import Backdrop, backdrop
from video2anim.scene.extent import cornered
from video2anim.scene.ground import ground
from video2anim.scene.view import nearer_than, relative_sigma
from video2anim.types import (
    BackgroundImage,
    BodyMotion,
    BodyShape,
    BodyTracks,
    DepthClip,
    InstanceMasks,
    Intrinsics,
    Mesh,
    MetricDepth,
    ObjectInstance,
    PlacedObject,
    RoomPiece,
    SceneModel,
    View,
)

LENS = Intrinsics.centered(300.0, 480, 360)
EYE_M = 1.5
_FINER = 3
"""Rays to a pixel's side: steps of unsmoothed lines would be edges of their own."""
SKY_RGB = (150, 190, 240)
FAR_M = 25.0
Hit = tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray], tuple[int, int, int]]
"""Of points: signed distance behind the surface (linear), whether the surface reaches there; its color."""


def camera_pose(yaw_deg: float = 0.0, pitch_deg: float = 8.0, eye_m: float = EYE_M) -> np.ndarray:
    """T_world_camera of a camera that looks along -z, turned by `yaw_deg` and tilted down."""
    pitch, yaw = np.deg2rad(pitch_deg), np.deg2rad(yaw_deg)
    down = np.array([[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]])
    turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ np.diag([1.0, -1.0, -1.0]) @ down
    pose[1, 3] = eye_m
    return pose


def walker(path_m: np.ndarray, T_world_camera: np.ndarray) -> BodyMotion:
    """A post of 22 joints up to 1.7 m that glides along a path on the floor."""
    frames = len(path_m)
    joints = np.repeat(path_m[:, None], 22, axis=1) + np.stack([np.zeros(22), np.linspace(0, 1.7, 22), np.zeros(22)], 1)
    still = np.tile(np.eye(4), (frames, 1, 1))
    turns = np.tile(np.eye(3), (frames, 22, 1, 1))
    return BodyMotion(
        1, np.arange(frames) / 30, np.ones(frames, bool), still, turns, np.tile(T_world_camera, (frames, 1, 1)), LENS,
        np.zeros((frames, 22)), BodyShape("anny", {}), np.zeros((22, 3)), joints,
    )  # fmt: skip


class World:
    """Floor and surfaces, seen by one camera."""

    def __init__(
        self, surfaces: list[Hit], path_m: np.ndarray, yaw_deg: float = 0.0, objects: tuple[int, ...] = (),
        pitch_deg: float = 8.0, eye_m: float = EYE_M,
    ) -> None:  # fmt: skip
        self.pose = camera_pose(yaw_deg, pitch_deg, eye_m)
        fine = LENS.resized(_FINER * LENS.width_px, _FINER * LENS.height_px)
        ray = pixel_rays(fine) @ self.pose[:3, :3].T
        camera_m = self.pose[:3, 3]
        floor: Hit = (lambda p: -p[..., 1], lambda p: np.ones(p.shape[:-1], bool), (120, 90, 60))
        depth_m, surface = np.full(ray.shape[:2], np.inf), np.full(ray.shape[:2], -1)
        rgb = np.broadcast_to(np.array(SKY_RGB, float), ray.shape).copy()
        for number, (behind, reaches, color) in enumerate([floor, *surfaces]):
            start, along = behind(camera_m), behind(camera_m + ray) - behind(camera_m)
            hit_m = np.where(along > 1e-6, -start / np.where(along > 1e-6, along, 1.0), np.inf)
            points_m = camera_m + ray * np.minimum(hit_m, 1e3)[..., None]
            nearer = (hit_m > 0) & (hit_m < depth_m) & reaches(points_m)
            depth_m = np.where(nearer, hit_m, depth_m)
            surface[nearer] = number
            # Boards along the surface's own axes, so that there are edges to see.
            boards = np.sign(np.sin((points_m + 0.13) * 2 * np.pi / 0.9)).sum(-1, keepdims=True)
            rgb[nearer] = (np.array(color) + 12 * boards)[nearer]
        center = slice(_FINER // 2, None, _FINER)
        self.depth_m, self.surface = depth_m[center, center], surface[center, center]
        rgb = cv2.resize(rgb, (LENS.width_px, LENS.height_px), interpolation=cv2.INTER_AREA)
        grain = np.random.default_rng(3).normal(0, 2, rgb.shape)
        self.background = BackgroundImage(
            np.clip(rgb + grain, 0, 255).astype(np.uint8), np.ones((90, 120)), np.zeros(1, int),
            np.zeros((1, 90, 120), bool), np.zeros((1, 90, 120), bool),
        )  # fmt: skip
        self.bodies = BodyTracks((walker(path_m, self.pose),))
        masks = [self.surface == number for number in objects]
        instances = tuple(ObjectInstance(n, "object", 1.0, np.zeros(4), mask) for n, mask in enumerate(masks, 1))
        self.masks = InstanceMasks("truth", instances, self.surface == 0)

    def metric(self, off: np.ndarray | float = 1.0) -> MetricDepth:
        """Depth at half size, times `off`; what is hit nowhere is at 200 m."""
        depth_m = cv2.resize(np.minimum(self.depth_m * off, 200.0), (240, 180), interpolation=cv2.INTER_NEAREST_EXACT)
        none = np.zeros((0, 180, 240))
        return MetricDepth(
            1.0, 0.0, 0.0, 0.0, None, None, True, "truth", np.zeros(0, int), none, none.astype(bool), depth_m,
            np.ones(depth_m.shape, bool), {}, self.bodies,
        )  # fmt: skip

    def seen(self, off: np.ndarray | float = 1.0) -> Backdrop:
        return backdrop(self.metric(off), self.masks, self.background, FAR_M)

    def before(self, mesh: Mesh, within_px: int = 9) -> np.ndarray:
        """Whether vertices in the picture are nearer, by 10 %, than all it shows around them."""
        objects = np.logical_or.reduce([self.surface < -1, *(one.mask for one in self.masks.instances)])
        nearest_m = cv2.erode(np.where(objects, 0.0, np.minimum(self.depth_m, 1e3)), np.ones((2 * within_px + 1,) * 2))
        camera_m = (mesh.vertices_m - self.pose[:3, 3]) @ self.pose[:3, :3]
        column, row = np.round(project(camera_m, LENS)).astype(int).T
        inside = (camera_m[:, 2] > 0) & (column >= 0) & (column < 480) & (row >= 0) & (row < 360)
        return camera_m[inside, 2] < 0.9 * nearest_m[row[inside], column[inside]]


def upright(axis: int, at: float, side: float, color: tuple[int, int, int], within: tuple[float, ...] = ()) -> Hit:
    """A wall at x (axis 0) or z (axis 2) = `at`, seen along `side`; `within` = least and largest of the other
    horizontal axis and its height."""

    def reaches(p: np.ndarray) -> np.ndarray:
        if not within:
            return p[..., 1] > 0
        other = p[..., 2 - axis]
        return (p[..., 1] > 0) & (p[..., 1] < within[2]) & (other > within[0]) & (other < within[1])

    return (lambda p: side * (p[..., axis] - at), reaches, color)


WALK = np.stack([np.linspace(-0.8, 0.8, 9), np.zeros(9), np.full(9, -3.0)], 1)
CEILING: Hit = (lambda p: p[..., 1] - 2.6, lambda p: p[..., 1] > 0, (235, 235, 230))


@functools.cache
def room(yaw_deg: float = 3.0) -> World:
    """4.9 m wide, a back wall at 5 m, ceiling at 2.6 m, and a board on the floor before the back wall."""
    board = upright(2, -3.8, -1, (30, 60, 160), (0.3, 1.1, 0.9))
    walls = [
        upright(2, -5.0, -1, (190, 180, 150)),
        upright(0, -2.2, -1, (150, 185, 170)),
        upright(0, 2.7, 1, (185, 150, 165)),
    ]
    return World([*walls, CEILING, board], WALK, yaw_deg, objects=(5,))


@functools.cache
def room_pieces() -> Backdrop:
    return room().seen()


def vertices(found: Backdrop, name: str) -> np.ndarray:
    return np.concatenate([p.mesh.vertices_m for p in found.pieces if p.name.startswith(name)])


def walls_by_axis(found: Backdrop) -> dict[str, np.ndarray]:
    """Vertices of the walls of `room`, by the name of the nearest of its walls."""
    named = {}
    for piece in found.pieces:
        if piece.name.startswith("wall"):
            points = piece.mesh.vertices_m
            off = {"back": points[:, 2] + 5.0, "left": points[:, 0] + 2.2, "right": points[:, 0] - 2.7}
            named[min(off, key=lambda name, off=off: np.abs(off[name]).mean())] = points  # type: ignore[misc]
    return named


def test_edges_tell_the_heading_of_walls() -> None:
    for yaw_deg in (0.0, 8.0, 33.0):
        world = room(yaw_deg)
        heading = EdgeHeadings(world.background.background_rgb, View(world.pose, LENS)).of_room()
        assert heading is not None
        assert abs((np.rad2deg(heading.angle_rad) + 45) % 90 - 45) < 1.0


def test_walls_and_ceiling_are_where_they_are() -> None:
    found = room_pieces()
    walls = walls_by_axis(found)
    assert set(walls) == {"back", "left", "right"}
    np.testing.assert_allclose(walls["back"][:, 2], -5.0, atol=0.02)
    np.testing.assert_allclose(walls["left"][:, 0], -2.2, atol=0.02)
    np.testing.assert_allclose(walls["right"][:, 0], 2.7, atol=0.02)
    np.testing.assert_allclose(vertices(found, "ceiling")[:, 1], 2.6, atol=0.02)


def test_walls_reach_floor_ceiling_and_each_other() -> None:
    walls = walls_by_axis(room_pieces())
    for points in walls.values():
        assert points[:, 1].min() == pytest.approx(0.0, abs=1e-3)
        assert points[:, 1].max() == pytest.approx(2.6, abs=0.02)
    assert walls["back"][:, 0].min() == pytest.approx(-2.2, abs=0.03)
    assert walls["back"][:, 0].max() == pytest.approx(2.7, abs=0.03)


def test_a_part_without_pixels_within_its_corners_is_left_out() -> None:
    """Pixels at the bottom of the picture meet the back wall's plane below the floor."""
    found = room_pieces()
    wall = next(part for part in found.parts if part.plane.kind == "wall")
    low = np.zeros_like(wall.own)
    low[-1] = True
    (kept,) = cornered([wall, replace(wall, own=low)], found.view)
    np.testing.assert_array_equal(kept.own, wall.own)


def test_walls_are_whole_behind_things() -> None:
    """The area of the back wall's triangles is that of its rectangle, though the board hides some of it."""
    (piece,) = [p for p in room_pieces().pieces if np.abs(p.mesh.vertices_m[:, 2] + 5.0).mean() < 0.1]
    a, b, c = (piece.mesh.vertices_m[piece.mesh.faces[:, k]].astype(float) for k in range(3))
    area_m2 = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert area_m2 == pytest.approx(4.9 * 2.6, rel=0.01)
    # Nothing of the board's blue is on the wall behind it.
    rgb = piece.textures[0].image_rgb.astype(int)
    assert (rgb[..., 2] < rgb[..., 0]).mean() > 0.99


def test_pieces_are_few_flat_triangles_that_face_the_camera() -> None:
    found = room_pieces()
    assert {piece.name for piece in found.pieces} == {"wall 1", "wall 2", "wall 3", "ceiling"}
    for piece in found.pieces:
        assert len(piece.mesh.faces) <= (2 if piece.name.startswith("wall") else 8), piece.name
        a, b, c = (piece.mesh.vertices_m[piece.mesh.faces[:, k]].astype(float) for k in range(3))
        normal = np.cross(b - a, c - a)
        assert ((normal * (room().pose[:3, 3] - a)).sum(1) > 0).all(), piece.name
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        assert (normal @ normal[0] > 1 - 1e-6).all(), piece.name
        expect_simple(piece)


def expect_simple(piece: RoomPiece) -> None:
    """No edge of more than two triangles, and those two run along it in opposite directions."""
    edges = np.concatenate([piece.mesh.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    assert len(np.unique(edges, axis=0)) == len(edges), piece.name


def test_pictures_of_pieces_are_the_plate() -> None:
    """Texels whose place the background image shows have its color; there are no more of them than the picture has
    pixels."""
    world, found = room(), room_pieces()
    floor = ground(found, world.background, np.array([[-1.5, -4.0], [1.5, -2.0]]))
    assert sum(p.textures[0].image_rgb[..., 0].size for p in (*found.pieces, floor)) < 1.5 * 480 * 360
    for piece, surface in ((floor, 0), *((p, None) for p in found.pieces)):
        mesh, texture = piece.mesh, piece.textures[0]
        weight = np.random.default_rng(0).dirichlet(np.ones(3), size=(len(mesh.faces), 500))
        points_m = (weight @ mesh.vertices_m[mesh.faces].astype(float)).reshape(-1, 3)
        uv = (weight @ texture.corner_uv.astype(float)).reshape(-1, 2)
        texel = (uv * texture.image_rgb.shape[1::-1]).astype(int)
        camera_m = (points_m - world.pose[:3, 3]) @ world.pose[:3, :3]
        ahead = camera_m[:, 2] > 0.2
        column, row = np.round(project(camera_m[ahead], LENS)).astype(int).T
        inside = (column >= 0) & (column < 480) & (row >= 0) & (row < 360)
        column, row, texel = column[inside], row[inside], texel[ahead][inside]
        same = np.abs(world.depth_m[row, column] / camera_m[ahead][inside][:, 2] - 1) < 0.01
        same &= (world.surface[row, column] == 0) == (surface == 0)
        assert same.sum() > 100
        off = world.background.background_rgb[row, column].astype(int) - texture.image_rgb[texel[:, 1], texel[:, 0]]
        assert np.median(np.abs(off[same])) <= 4, piece.name


@pytest.mark.parametrize("is_round", [False, True])
def test_a_door_is_a_rectangle_of_the_wall_and_shows_what_is_behind(is_round: bool) -> None:
    """A wall at 4 m with a hole, 1.1 by 2 m, through which another at 7 m is seen; a round hole off the floor, as by
    errors of depth, is none."""

    def reaches(p: np.ndarray) -> np.ndarray:
        hole = (np.abs(p[..., 0] - 0.4) < 0.55) & (p[..., 1] < 2.0)
        if is_round:
            hole = np.hypot(p[..., 0] - 0.4, p[..., 1] - 1.1) < 0.9
        return (p[..., 1] > 0) & ~hole

    wall: Hit = (lambda p: -(p[..., 2] + 4.0), reaches, (190, 180, 150))
    found = World([wall, upright(2, -7.0, -1, (90, 120, 160))], WALK).seen()
    (near,) = [p for p in found.pieces if abs(p.mesh.vertices_m[:, 2].mean() + 4.0) < 0.2]
    (far,) = [p for p in found.pieces if abs(p.mesh.vertices_m[:, 2].mean() + 7.0) < 0.3]
    expect_simple(near)
    assert far.openings == ()
    if is_round:
        assert near.openings == ()
        assert len(near.mesh.faces) == 2
        return
    (corners_m,) = near.openings
    low, high = corners_m.min(0), corners_m.max(0)
    np.testing.assert_allclose([low[0], high[0], high[1]], [-0.15, 0.95, 2.0], atol=0.08)
    assert low[1] == pytest.approx(0.0, abs=0.01)
    assert len(near.mesh.faces) == 6
    gap_m = np.linalg.norm(near.mesh.vertices_m[:, None] - corners_m, axis=-1)
    assert gap_m.min(0).max() < 1e-3


def test_pieces_come_back_from_disk(tmp_path: Path) -> None:
    floor = ground(room_pieces(), room().background, np.array([[-1.5, -4.0], [1.5, -2.0]]))
    pieces = (replace(room_pieces().pieces[0], openings=(np.eye(4, 3), np.ones((4, 3)))), *room_pieces().pieces[1:])
    scene = SceneModel((), floor, pieces, np.ones((2, 2, 2)), np.zeros(3), 1.0)
    write_value(scene, tmp_path)
    again = read_value(SceneModel, tmp_path)
    for one, other in zip((scene.floor, *scene.background), (again.floor, *again.background), strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.mesh.vertices_m, other.mesh.vertices_m)
        np.testing.assert_array_equal(one.mesh.faces, other.mesh.faces)
        np.testing.assert_array_equal(one.textures[0].image_rgb, other.textures[0].image_rgb)
        np.testing.assert_array_equal(one.textures[0].corner_uv, other.textures[0].corner_uv)
        assert len(one.openings) == len(other.openings)
        for mine, its in zip(one.openings, other.openings, strict=True):
            np.testing.assert_array_equal(mine, its)


def test_edges_and_foot_correct_depth_that_slopes() -> None:
    """Depth whose slope turns walls by 10 degrees and that is 15 % too near: walls stand square where floor ends."""
    world = room()
    slope = np.linspace(0.75, 0.97, 480)[None].repeat(360, 0)
    walls = walls_by_axis(world.seen(off=np.where(world.surface == 0, 1.0, slope)))
    back = walls["back"]
    assert np.ptp(back[:, 2]) < 0.05
    assert np.median(back[:, 2]) == pytest.approx(-5.0, rel=0.04)
    assert back[:, 0].min() == pytest.approx(np.median(walls["left"][:, 0]), abs=0.01)
    assert walls["left"][:, 2].min() == pytest.approx(np.median(back[:, 2]), abs=0.01)


def test_nothing_spans_a_step() -> None:
    """Two facades in line and a far one in their gap: no place of a piece is before what is seen."""
    near = upright(2, -4.0, -1, (180, 90, 70), (-9.0, -0.2, 4.0))
    other = upright(2, -4.0, -1, (180, 90, 70), (1.2, 9.0, 4.0))
    world = World([near, other, upright(2, -9.0, -1, (120, 140, 180))], WALK)
    found = world.seen()
    depths = sorted(float(np.median(-p.mesh.vertices_m[:, 2])) for p in found.pieces)
    assert depths == pytest.approx([4.0, 4.0, 9.0], rel=0.02), "each facade is a piece of its own"
    for piece in found.pieces:
        if np.median(-piece.mesh.vertices_m[:, 2]) < 5.0:
            across_m = piece.mesh.vertices_m[:, 0]
            assert across_m.max() < -0.1 or across_m.min() > 1.1, "it ends at its own edge"
        # Outlines are smooth over three pixels of a view of 192.
        assert not world.before(colored(piece)).any(), piece.name


def test_a_wall_goes_on_behind_a_column() -> None:
    """The column cuts the wall's pixels into two regions."""
    column = upright(2, -3.6, -1, (40, 60, 150), (0.9, 1.3, 4.0))
    found = World([column, upright(2, -5.0, -1, (190, 180, 150))], WALK).seen()
    depths = [float(np.median(-p.mesh.vertices_m[:, 2])) for p in found.pieces]
    assert sum(depth == pytest.approx(5.0, rel=0.05) for depth in depths) == 1, depths


def test_far_and_unsure_things_and_sky_are_behind_everything() -> None:
    near = upright(2, -6.0, -1, (60, 110, 50), (-12.0, -1.0, 2.2))
    mountain = upright(2, -60.0, -1, (110, 100, 120), (-200.0, 200.0, 14.0))
    world = World([near, mountain], WALK)
    found = world.seen()
    names = [piece.name for piece in found.pieces]
    assert names.count("backdrop") == 1
    eye_m, ahead = world.pose[:3, 3], world.pose[:3, 2]
    reach = {p.name: (p.mesh.vertices_m - eye_m) @ ahead for p in found.pieces}
    others = [depth_m.max() for name, depth_m in reach.items() if name != "backdrop"]
    assert reach["backdrop"].min() > max(*others, 3.0)
    sky = cv2.erode(cv2.resize((world.surface == -1).astype(np.uint8), found.view.shape[::-1]), np.ones((9, 9)))
    assert sky.mean() > 0.1
    for piece in found.pieces:
        pixel, _, inside = found.view.pixels(colored(piece).vertices_m)
        column, row = np.round(pixel[inside]).astype(int).T
        assert sky[row, column].any() == (piece.name == "backdrop")
    # A depth that is there but not known to 30 % counts as far.
    doubt = np.where(cv2.resize((world.surface == 1).astype(np.uint8), (240, 180)) > 0, 0.4, 0.0)
    unsure = backdrop(world.metric(), world.masks, world.background, FAR_M, doubt)
    assert {piece.name for piece in unsure.pieces} == {"backdrop"}


def test_no_piece_is_before_people() -> None:
    """People walk 10 cm before the back wall: it gives way to their width. A post before the path is left out."""
    path_m = np.stack([np.linspace(-1.0, 1.0, 9), np.zeros(9), np.full(9, -4.9)], 1)
    post = upright(2, -1.5, -1, (80, 30, 30), (-0.3, 0.3, 2.4))
    world = World([upright(2, -5.0, -1, (190, 180, 150)), post], path_m)
    found = world.seen(off=np.where(world.surface == 1, 0.9, 1.0))
    assert vertices(found, "wall")[:, 2].max() < -5.15
    assert (joined([piece.mesh for piece in found.pieces]).vertices_m[:, 2] < -4.0).all()


def test_ground_goes_on_to_the_walls_and_no_farther() -> None:
    world, found = room(), room_pieces()
    floor = ground(found, world.background, np.array([[-1.5, -4.0], [1.5, -2.0]]))
    points = floor.mesh.vertices_m
    assert len(floor.mesh.faces) < 20
    assert (points[:, 1] == 0).all()
    assert points[:, 2].min() == pytest.approx(-5.0, abs=0.05)
    assert points[:, 0].min() == pytest.approx(-2.2, abs=0.05)
    assert points[:, 0].max() == pytest.approx(2.7, abs=0.05)
    a, b, c = (points[floor.mesh.faces[:, k]].astype(float) for k in range(3))
    assert (np.cross(b - a, c - a)[:, 1] > 0).all()
    # Brown all over, also where the board hides it and the picture does not reach.
    rgb = floor.textures[0].image_rgb.astype(int)
    assert (rgb[..., 0] > rgb[..., 2] + 25).all()


@pytest.mark.parametrize(("eye_m", "pitch_deg"), [(1.5, 8.0), (7.0, 40.0), (7.0, 25.0)])
def test_open_ground_is_covered_by_floor_and_backdrop(eye_m: float, pitch_deg: float) -> None:
    """From a high camera the floor is known far away; it ends where 1 degree of gravity is 30 % of its distance."""
    world = World([], WALK, pitch_deg=pitch_deg, eye_m=eye_m)
    found = world.seen()
    floor = ground(found, world.background, np.array([[-1.5, -4.0], [1.5, -2.0]]))
    eyes_m = np.broadcast_to(found.view.camera_m, (found.view.depth_m.size, 3))
    below = (found.view.direction[..., 1] < -0.01).reshape(-1)
    pieces = [trimesh.Trimesh(one.mesh.vertices_m, one.mesh.faces) for one in (floor, *found.pieces)]
    met = [mesh.ray.intersects_any(eyes_m, found.view.direction.reshape(-1, 3)) for mesh in pieces]
    assert np.logical_or.reduce(met)[below].mean() > 0.99
    fall = -found.view.direction[..., 1] / np.linalg.norm(found.view.direction[..., [0, 2]], axis=-1)
    known = (fall > 1.1 * np.deg2rad(1.0) / 0.3).reshape(-1)
    assert met[0][known].mean() > 0.99
    ahead = found.view.direction[fall > np.deg2rad(1.0) / 0.3]
    assert floor.mesh.vertices_m[:, 2].min() == pytest.approx(-eye_m * (ahead[:, 2] / ahead[:, 1]).max(), rel=0.05)


def test_a_wall_without_depth_is_shown_behind_everything_down_to_its_foot() -> None:
    """A plain screen: the network knows no depth there."""
    world = World([upright(2, -4.0, -1, (20, 30, 200))], WALK)
    unknown = cv2.resize((world.surface == 1).astype(np.uint8), (240, 180), interpolation=cv2.INTER_NEAREST) > 0
    metric = world.metric()
    found = backdrop(replace(metric, background_valid=~unknown), world.masks, world.background, FAR_M)
    (screen,) = found.pieces
    assert screen.name == "backdrop"
    wall = cv2.resize(unknown.astype(np.uint8), found.view.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    ray = found.view.direction[wall]
    assert (ray[:, 1] < 0).mean() > 0.3
    met = trimesh.Trimesh(screen.mesh.vertices_m, screen.mesh.faces).ray.intersects_any(
        np.broadcast_to(found.view.camera_m, ray.shape), ray
    )
    assert met.mean() > 0.99


def test_ground_goes_on_behind_objects() -> None:
    board = upright(2, -4.0, -1, (30, 60, 160), (-1.0, 1.5, 1.2))
    world = World([board], WALK, objects=(1,))
    found = world.seen()
    floor = ground(found, world.background, np.array([[-1.5, -3.5], [1.5, -2.0]])).mesh
    seen = trimesh.Trimesh(floor.vertices_m, floor.faces)
    behind = found.view.direction[found.view.objects & (found.view.floor_depth_m() < 12.0)]
    assert len(behind) > 500
    assert seen.ray.intersects_any(np.broadcast_to(found.view.camera_m, behind.shape), behind).mean() > 0.99


def test_ground_reaches_below_objects_before_all_that_was_seen_of_it() -> None:
    """A chest at the lower image border hides the floor around it."""
    chest = upright(2, -1.5, -1, (30, 60, 160), (-9.0, 9.0, 0.9))
    world = World([chest], WALK, objects=(1,))
    found = world.seen()
    around_m, corners_m = np.array([[-1.5, -4.5], [1.5, -4.0]]), np.array([[0, 0, -2], [1, 0, -2], [1, 0, -3]])
    chest_mesh = Mesh(corners_m.astype(np.float32), np.array([[0, 1, 2]], np.int32), np.zeros((3, 3), np.uint8))
    without, below = (ground(found, world.background, around_m, one).mesh.vertices_m for one in ((), (chest_mesh,)))
    assert without[:, 2].max() < -3.4
    assert below[:, 2].max() > -2.1


def test_objects_beyond_the_far_limit_are_not_objects() -> None:
    face = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), np.zeros((3, 3), np.uint8))
    items = []
    for number, z_m in enumerate((-5.0, -24.0, -27.0)):
        pose = np.eye(4)
        pose[2, 3] = z_m
        items.append(PlacedObject(number, "object", face, 1.0, pose, None, None, True, ""))
    view = View(camera_pose(pitch_deg=0.0), LENS)
    assert [one.object_id for one in nearer_than(items, view, FAR_M)] == [0, 1]


def test_relative_sigma_of_both_kinds() -> None:
    metric = replace(room().metric(), scale=2.0, offset_m=0.1, scale_sigma=0.02, offset_sigma=0.03)
    none = np.zeros((1, 180, 240))
    clip = DepthClip("depth", "truth", np.zeros(1, int), none, none + 0.01, none == 0, none[0] + 4.0, none[0] == 0)
    by_depth = relative_sigma(metric, clip)
    sigma = np.sqrt((4 * 0.02) ** 2 + 0.03**2 + (2 * 0.01) ** 2)
    np.testing.assert_allclose(by_depth, sigma / metric.background_depth_m)
    by_disparity = relative_sigma(metric, replace(clip, kind="disparity"))
    np.testing.assert_allclose(by_disparity, sigma * metric.background_depth_m)
