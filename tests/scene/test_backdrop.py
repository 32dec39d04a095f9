"""Rooms and streets rendered by ray and plane: what comes out must be where the planes are, and nowhere else."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from video2anim.geometry.projection import pixel_rays, project
from video2anim.scene.backdrop import Backdrop, BackdropConfig, backdrop
from video2anim.scene.ground import ground_mesh
from video2anim.scene.heading import room_heading
from video2anim.scene.view import relative_sigma
from video2anim.types import (
    BackgroundPlate,
    BodyMotion,
    BodyShape,
    BodyTracks,
    DepthClip,
    InstanceMasks,
    Intrinsics,
    Mesh,
    MetricDepth,
    ObjectInstance,
)

LENS = Intrinsics.centered(300.0, 480, 360)
EYE_M = 1.5
_FINER = 3
"""Rays to a pixel's side: steps of unsmoothed lines would be edges of their own."""
SKY_RGB = (150, 190, 240)
CONFIG = BackdropConfig(far_m=25.0)
Hit = tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray], tuple[int, int, int]]
"""Of points: signed distance behind the surface (linear), whether the surface reaches there; its color."""


def camera_pose(yaw_deg: float = 0.0, pitch_deg: float = 8.0) -> np.ndarray:
    """T_world_camera of a camera that looks along -z, turned by `yaw_deg` and tilted down."""
    pitch, yaw = np.deg2rad(pitch_deg), np.deg2rad(yaw_deg)
    down = np.array([[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]])
    turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ np.diag([1.0, -1.0, -1.0]) @ down
    pose[1, 3] = EYE_M
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
        self, surfaces: list[Hit], path_m: np.ndarray, yaw_deg: float = 0.0, things: tuple[int, ...] = ()
    ) -> None:
        self.pose = camera_pose(yaw_deg)
        fine = LENS.resized(_FINER * LENS.width_px, _FINER * LENS.height_px)
        ray = pixel_rays(fine) @ self.pose[:3, :3].T
        eye_m = self.pose[:3, 3]
        floor: Hit = (lambda p: -p[..., 1], lambda p: np.ones(p.shape[:-1], bool), (120, 90, 60))
        depth_m, surface = np.full(ray.shape[:2], np.inf), np.full(ray.shape[:2], -1)
        rgb = np.broadcast_to(np.array(SKY_RGB, float), ray.shape).copy()
        for number, (behind, reaches, color) in enumerate([floor, *surfaces]):
            start, along = behind(eye_m), behind(eye_m + ray) - behind(eye_m)
            hit_m = np.where(along > 1e-6, -start / np.where(along > 1e-6, along, 1.0), np.inf)
            points_m = eye_m + ray * np.minimum(hit_m, 1e3)[..., None]
            nearer = (hit_m > 0) & (hit_m < depth_m) & reaches(points_m)
            depth_m = np.where(nearer, hit_m, depth_m)
            surface[nearer] = number
            # Boards along the surface's own axes, so that there are edges to see.
            boards = np.sign(np.sin((points_m + 0.13) * 2 * np.pi / 0.9)).sum(-1, keepdims=True)
            rgb[nearer] = (np.array(color) + 12 * boards)[nearer]
        middle = slice(_FINER // 2, None, _FINER)
        self.depth_m, self.surface = depth_m[middle, middle], surface[middle, middle]
        rgb = cv2.resize(rgb, (LENS.width_px, LENS.height_px), interpolation=cv2.INTER_AREA)
        grain = np.random.default_rng(3).normal(0, 2, rgb.shape)
        self.plate = BackgroundPlate(
            np.clip(rgb + grain, 0, 255).astype(np.uint8), np.ones((90, 120)), np.zeros(1, int),
            np.zeros((1, 90, 120), bool), np.zeros((1, 90, 120), bool),
        )  # fmt: skip
        self.bodies = BodyTracks((walker(path_m, self.pose),))
        masks = [self.surface == number for number in things]
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

    def seen(self, config: BackdropConfig = CONFIG, off: np.ndarray | float = 1.0) -> Backdrop:
        return backdrop(self.metric(off), self.masks, self.plate, config)

    def before(self, mesh: Mesh, within_px: int = 9) -> np.ndarray:
        """Whether vertices in the picture are nearer, by 10 %, than all it shows around them."""
        things = np.logical_or.reduce([self.surface < -1, *(one.mask for one in self.masks.instances)])
        nearest_m = cv2.erode(np.where(things, 0.0, np.minimum(self.depth_m, 1e3)), np.ones((2 * within_px + 1,) * 2))
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
    return World([*walls, CEILING, board], WALK, yaw_deg, things=(5,))


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
        heading = room_heading(world.plate.plate_rgb, world.pose, LENS)
        assert heading is not None
        assert abs((np.rad2deg(heading.turn_rad) + 45) % 90 - 45) < 1.0


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


def test_walls_are_whole_behind_things() -> None:
    """The area of the back wall's triangles is that of its rectangle, though the board hides some of it."""
    (piece,) = [p for p in room_pieces().pieces if np.abs(p.mesh.vertices_m[:, 2] + 5.0).mean() < 0.1]
    a, b, c = (piece.mesh.vertices_m[piece.mesh.faces[:, k]].astype(float) for k in range(3))
    area_m2 = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert area_m2 == pytest.approx(4.9 * 2.6, rel=0.01)
    # Nothing of the board's blue is on the wall behind it.
    assert (piece.mesh.vertex_rgb[:, 2].astype(int) < piece.mesh.vertex_rgb[:, 0].astype(int)).mean() > 0.99


def test_triangles_face_the_camera_and_stay_within_budget() -> None:
    found = room_pieces()
    assert 0.5 * CONFIG.most_faces < len(found.mesh.faces) < 1.1 * CONFIG.most_faces
    for piece in found.pieces:
        a, b, c = (piece.mesh.vertices_m[piece.mesh.faces[:, k]].astype(float) for k in range(3))
        facing = (np.cross(b - a, c - a) * (room().pose[:3, 3] - a)).sum(1)
        assert (facing > -1e-9).all(), piece.name
    few = room().seen(replace(CONFIG, most_faces=2000))
    assert len(few.mesh.faces) < 2600


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
    """Two facades in line and a far one in their gap: no vertex is before what is seen, and no triangle is long."""
    near = upright(2, -4.0, -1, (180, 90, 70), (-9.0, -0.2, 4.0))
    other = upright(2, -4.0, -1, (180, 90, 70), (1.2, 9.0, 4.0))
    world = World([near, other, upright(2, -9.0, -1, (120, 140, 180))], WALK)
    found = world.seen()
    depths = sorted(float(np.median(-p.mesh.vertices_m[:, 2])) for p in found.pieces)
    assert depths == pytest.approx([4.0, 9.0], rel=0.02)
    for piece in found.pieces:
        # Outlines are smooth over three pixels of a view of 192.
        assert not world.before(piece.mesh).any(), piece.name
        edges = piece.mesh.vertices_m[piece.mesh.faces]
        assert np.linalg.norm(edges - np.roll(edges, 1, axis=1), axis=-1).max() < 0.4


def test_far_and_unsure_things_are_behind_everything_and_sky_is_left_out() -> None:
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
    pixel, _, inside = found.view.pixels(found.mesh.vertices_m)
    sky = cv2.erode(cv2.resize((world.surface == -1).astype(np.uint8), found.view.shape[::-1]), np.ones((9, 9)))
    column, row = np.round(pixel[inside]).astype(int).T
    assert sky.mean() > 0.1
    assert not sky[row, column].any()
    # A depth that is there but not known to 30 % counts as far.
    doubt = np.where(cv2.resize((world.surface == 1).astype(np.uint8), (240, 180)) > 0, 0.4, 0.0)
    unsure = backdrop(world.metric(), world.masks, world.plate, CONFIG, doubt)
    assert {piece.name for piece in unsure.pieces} == {"backdrop"}


def test_no_piece_is_before_people() -> None:
    """People walk 10 cm before the back wall: it gives way to their width. A post before the path is left out."""
    path_m = np.stack([np.linspace(-1.0, 1.0, 9), np.zeros(9), np.full(9, -4.9)], 1)
    post = upright(2, -1.5, -1, (80, 30, 30), (-0.3, 0.3, 2.4))
    world = World([upright(2, -5.0, -1, (190, 180, 150)), post], path_m)
    found = world.seen(off=np.where(world.surface == 1, 0.9, 1.0))
    assert vertices(found, "wall")[:, 2].max() < -5.15
    assert (found.mesh.vertices_m[:, 2] < -4.0).all()


def test_ground_goes_on_to_the_walls_and_no_farther() -> None:
    world, found = room(), room_pieces()
    ground = ground_mesh(found, world.plate, np.array([[-1.5, -4.0], [1.5, -2.0]]))
    points = ground.vertices_m
    assert (points[:, 1] == 0).all()
    assert points[:, 2].min() == pytest.approx(-5.0, abs=0.05)
    assert points[:, 0].min() == pytest.approx(-2.2, abs=0.05)
    assert points[:, 0].max() == pytest.approx(2.7, abs=0.05)
    a, b, c = (points[ground.faces[:, k]].astype(float) for k in range(3))
    assert (np.cross(b - a, c - a)[:, 1] > 0).all()
    # Brown all over, also where the board hides it and the picture does not reach.
    rgb = ground.vertex_rgb.astype(int)
    assert (rgb[:, 0] > rgb[:, 2] + 25).all()


def test_relative_sigma_of_both_kinds() -> None:
    metric = replace(room().metric(), scale=2.0, offset_m=0.1, scale_sigma=0.02, offset_sigma=0.03)
    none = np.zeros((1, 180, 240))
    clip = DepthClip("depth", "truth", np.zeros(1, int), none, none + 0.01, none == 0, none[0] + 4.0, none[0] == 0)
    by_depth = relative_sigma(metric, clip)
    sigma = np.sqrt((4 * 0.02) ** 2 + 0.03**2 + (2 * 0.01) ** 2)
    np.testing.assert_allclose(by_depth, sigma / metric.background_depth_m)
    by_disparity = relative_sigma(metric, replace(clip, kind="disparity"))
    np.testing.assert_allclose(by_disparity, sigma * metric.background_depth_m)
