"""Lens, light, textures, tone and sensor, each against an independent answer."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import trimesh

from video2anim.lab.synth.render import Sensor, distort, sampling, tone, undistort
from video2anim.lab.synth.render.caster import RayCaster
from video2anim.lab.synth.render.denoise import Links, link, smooth_tiles
from video2anim.lab.synth.render.lens import covers_picture, pixel_directions, project_distorted
from video2anim.lab.synth.render.lighting import AMBIENT_REACH_M, ambient_visibility, light_visibility
from video2anim.lab.synth.render.texture import KINDS, Spot, groups, material_rgb
from video2anim.lab.synth.world import Light, Material, SensorModel
from video2anim.types import Intrinsics

K1, K2 = -0.18, 0.05


def test_distortion_agrees_with_opencv() -> None:
    xy = np.random.default_rng(0).uniform(-0.7, 0.7, (200, 2))
    points = np.concatenate([xy, np.ones((200, 1))], 1)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array([K1, K2, 0, 0]))
    assert np.abs(distort(xy, K1, K2) - expected[:, 0]).max() < 1e-12
    assert np.abs(undistort(distort(xy, K1, K2), K1, K2) - xy).max() < 1e-9
    seen = distort(xy, K1, K2)
    theirs = cv2.undistortPoints(seen[:, None], np.eye(3), np.array([K1, K2, 0, 0]))[:, 0]
    assert np.abs(undistort(seen, K1, K2) - theirs).max() < 1e-3  # OpenCV stops after five steps


def test_pixels_and_directions_are_inverse() -> None:
    intrinsics = Intrinsics.centered(250, 320, 240)
    pixels = np.random.default_rng(1).uniform(0, 239, (50, 2))
    rays = pixel_directions(pixels, intrinsics, K1, K2)
    assert np.abs(project_distorted(3.3 * rays, intrinsics, K1, K2) - pixels).max() < 1e-6


def brute_force(triangles: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> tuple[int, float]:
    """First hit of one ray by solving for every triangle."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    system = np.stack([b - a, c - a, np.broadcast_to(-direction, a.shape)], -1)
    u, v, t = np.linalg.solve(system, (origin - a)[..., None])[..., 0].T
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    return int(t.argmin()), float(t.min())


def test_caster_finds_the_hits_of_a_brute_force_search() -> None:
    mesh = trimesh.creation.icosphere(3, 0.5)
    rng = np.random.default_rng(2)
    origins = rng.normal(size=(100, 3)) * 0.3 + [0, 0, -2]
    directions = rng.normal(size=(100, 3)) * 0.2 + [0, 0, 1]
    hits = RayCaster(mesh.vertices, mesh.faces).first_hits(origins, directions)
    triangles = np.asarray(mesh.triangles)
    for ray in range(100):
        face, distance = brute_force(triangles, origins[ray], directions[ray])
        assert hits.distance[ray] == pytest.approx(distance, rel=1e-5)
        if np.isfinite(distance):
            assert hits.face[ray] == face
            b1, b2 = hits.barycentric[ray]
            at = np.array([1 - b1 - b2, b1, b2]) @ triangles[face]
            assert np.abs(at - origins[ray] - distance * directions[ray]).max() < 1e-5
    assert 20 < np.isfinite(hits.distance).sum() < 100


def test_caster_of_nothing() -> None:
    empty = RayCaster(np.zeros((0, 3)), np.zeros((0, 3), int))
    rays = np.ones((4, 3), np.float32)
    assert (empty.first_hits(rays, rays).face == -1).all()
    assert not empty.blocked(rays, rays).any()


def tilted(tiles: int = 16) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points at the origin that look up, one for each place of the tile."""
    return np.zeros((tiles, 3), np.float32), np.tile(np.float32([0, 1, 0]), (tiles, 1)), np.arange(tiles)


def wall(x0: float, y: float) -> RayCaster:
    """A level sheet at height y from x0 to far right."""
    vertices = np.array([[x0, y, -50], [50, y, -50], [50, y, 50], [x0, y, 50]], float)
    return RayCaster(vertices, np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.mark.parametrize(("edge", "share"), [(0.0, 0.5), (-1.0, 0.0), (1.0, 1.0), (0.05, 0.8045)])
def test_soft_shadow_is_the_visible_share_of_the_lamp(edge: float, share: float) -> None:
    start, normal, tile = tilted()
    light = Light((0.0, 2.0, 0.0), (1.0, 1.0, 1.0), 0.2)  # 0.05 at half the height covers the disc from x = 0.1 on
    seen = light_visibility(start, normal, light, tile, [wall(edge, 1.0)], 8)
    assert seen.mean() == pytest.approx(share, abs=0.02)


def test_sun_comes_from_against_its_direction() -> None:
    start, normal, tile = tilted()
    down = Light((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.1, direction=(0.0, -1.0, 0.0))
    assert light_visibility(start, normal, down, tile, [wall(-1.0, 3.0)], 4).max() == 0
    assert light_visibility(start, normal, down, tile, [wall(1.0, 3.0)], 4).min() == 1


def test_ambient_light_is_open_under_the_sky_and_closed_under_a_lid() -> None:
    start, normal, tile = tilted()
    assert ambient_visibility(start, normal, tile, [wall(-50, -0.1)], 8).min() == 1
    assert ambient_visibility(start, normal, tile, [wall(-50, 0.001)], 8).max() == 0
    half = ambient_visibility(start, normal, tile, [wall(0, 0.001)], 8).mean()
    assert half == pytest.approx(0.5, abs=0.03)
    assert ambient_visibility(start, normal, tile, [wall(-50, AMBIENT_REACH_M)], 8).min() > 0.99


def test_pattern_is_even_over_a_tile() -> None:
    pixel = np.arange(16) // 4 * 640 + np.arange(16) % 4
    assert sorted(sampling.tile_of(pixel, 640)) == list(range(16))
    lobe = sampling.cosine_lobe(sampling.sample_points(4)).reshape(-1, 3)
    assert np.abs(np.linalg.norm(lobe, axis=1) - 1).max() < 1e-5
    assert lobe.mean(0) == pytest.approx([0, 0, 2 / 3], abs=0.03)


def test_denoising_averages_a_tile_and_respects_edges() -> None:
    y, x = np.mgrid[:24, :24]
    noise = sampling.sample_points(1)[sampling.tile_of(y.ravel() * 24 + x.ravel(), 24), 0, 0].reshape(24, 24)
    values = np.where(x < 12, noise, 5 + noise).astype(np.float32)[..., None]
    right, down = np.ones((24, 23), bool), np.ones((23, 24), bool)
    right[:, 11] = False
    smooth = smooth_tiles(values, Links(right, down))[..., 0]
    assert smooth[4:-4, 2:10].std() < 0.01
    assert smooth[:, :12].max() < 1.01
    assert smooth[:, 12:].min() > 4.99


def test_links_part_surfaces_by_label_normal_and_plane() -> None:
    label = np.array([[1, 1, 2, 2, 2, 0, 0]])
    normal = np.zeros((1, 7, 3), np.float32)
    normal[0, :3], normal[0, 3:5] = (0, 1, 0), (1, 0, 0)
    position = np.zeros((1, 7, 3), np.float32)
    position[0, 4, 0] = 0.5
    links = link(label, normal, position, np.ones((1, 7), np.float32))
    assert links.right[0].tolist() == [True, False, False, False, False, True]


def spot(footprint: float, count: int = 4000) -> Spot:
    rng = np.random.default_rng(3)
    u, v = rng.uniform(-2, 2, (2, count)).astype(np.float32)
    return Spot(u, v, np.full(count, footprint, np.float32), (u > 0).astype(np.float32))


@pytest.mark.parametrize("kind", KINDS)
def test_texture_has_color_and_averages_out_at_a_distance(kind: str) -> None:
    material = Material(kind, (0.7, 0.5, 0.3), (0.2, 0.25, 0.3), 0.05, stain=0.3, seed=4)
    near, far = material_rgb(material, spot(1e-4)), material_rgb(material, spot(0.5))
    assert near.shape == (4000, 3)
    assert np.isfinite(near).all()
    assert near.min() >= 0
    assert near.max() <= 1
    assert near.std(0).max() > 1e-3
    if kind not in ("picture", "screen", "paper"):  # their content is as large as they are
        assert far.std(0).max() < 0.6 * near.std(0).max() + 0.01
    assert np.array_equal(near, material_rgb(material, spot(1e-4)))


def test_stripes_have_their_period() -> None:
    v = np.linspace(0, 1, 2001).astype(np.float32)
    still = Spot(0 * v, v, np.full(2001, 1e-4, np.float32), 0 * v)
    rgb = material_rgb(Material("stripes", (0.9, 0.9, 0.9), (0.1, 0.1, 0.1), 0.1, seed=0), still)
    rises = np.flatnonzero(np.diff((rgb[:, 0] > 0.3).astype(int)) == 1)
    assert np.diff(v[rises]) == pytest.approx(0.1, abs=2e-3)


def test_groups_cover_every_row_once() -> None:
    numbers = np.array([3, -1, 3, 0, -1])
    found = groups(numbers)
    assert [n for n, _ in found] == [-1, 0, 3]
    assert sorted(np.concatenate([rows for _, rows in found])) == [0, 1, 2, 3, 4]


def test_tone_curve_is_monotonic_and_invertible() -> None:
    light = np.linspace(0, 6, 4000)
    coded = tone.encode(light).astype(int)
    assert (np.diff(coded) >= 0).all()
    assert coded[0] == 0
    assert coded[-1] == 255
    every = np.arange(256, dtype=np.uint8)
    assert np.abs(tone.encode(tone.decode(every)).astype(int) - every).max() <= 1


def test_exposure_brings_any_light_to_the_same_picture() -> None:
    light = np.random.default_rng(5).uniform(0.05, 0.4, (1000, 3)).astype(np.float32)
    assert tone.auto_exposure(20 * light) * 20 == pytest.approx(tone.auto_exposure(light), rel=1e-4)
    assert 70 < np.median(tone.encode(light * tone.auto_exposure(light))) < 160


def gray(value: int = 128) -> np.ndarray:
    return np.full((120, 160, 3), value, np.uint8)


def test_plain_sensor_changes_nothing() -> None:
    ramp = np.tile(np.arange(160, dtype=np.uint8)[None, :, None], (120, 1, 3))
    out = Sensor(SensorModel(), np.random.default_rng(0)).apply(ramp, 0)
    assert np.abs(out.astype(int) - ramp).max() <= 1


def test_noise_has_the_strength_asked_for_and_repeats() -> None:
    sensor = Sensor(SensorModel(noise_steps=4.0), np.random.default_rng(1))
    first = sensor.apply(gray(), 7)
    assert first.astype(float).std() == pytest.approx(4.0, rel=0.06)
    assert abs(first.mean() - 128) < 0.5
    sensor.apply(gray(), 8)
    assert np.array_equal(sensor.apply(gray(), 7), first)
    assert not np.array_equal(sensor.apply(gray(), 8), first)
    assert not np.array_equal(Sensor(SensorModel(noise_steps=4.0), np.random.default_rng(2)).apply(gray(), 7), first)


def test_exposure_vignette_white_balance_and_jpeg() -> None:
    def out(model: SensorModel) -> np.ndarray:
        return Sensor(model, np.random.default_rng(0)).apply(gray(100), 0).astype(int)

    assert out(SensorModel(exposure=2.0)).mean() == pytest.approx(139, abs=2)  # twice the linear light of 100
    dark = out(SensorModel(vignette=0.5))
    assert dark[60, 80, 0] == pytest.approx(100, abs=1)
    assert dark[0, 0, 0] < 80
    warm = out(SensorModel(white_balance=(1.2, 1.0, 0.8)))[0, 0]
    assert warm[0] > 100 > warm[2]
    assert np.abs(out(SensorModel(jpeg_quality=90)) - 100).max() <= 2


@pytest.mark.parametrize(
    ("fov_deg", "k1", "k2", "whole"), [(35, -0.12, 0.0, True), (90, -0.35, 0.0, False), (60, 0.1, 0.02, True)]
)
def test_lens_that_covers_the_picture(fov_deg: float, k1: float, k2: float, whole: bool) -> None:
    """A cubic turns back at r = 1 / sqrt(-3 k1); beyond that a corner has no ray."""
    lens = Intrinsics.centered(240 / np.tan(np.deg2rad(fov_deg) / 2), 640, 480)
    assert covers_picture(lens, k1, k2) == whole
    if whole:
        corner = np.array([[lens.cx_px / lens.fx_px, lens.cy_px / lens.fy_px]])
        np.testing.assert_allclose(distort(undistort(corner, k1, k2), k1, k2), corner, atol=1e-9)
