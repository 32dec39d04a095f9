"""Boxes, cylinders and prisms against trimesh, all shapes against what is inside them, and the meshes of all forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from video2anim.objects.furniture import FORMS, Form
from video2anim.objects.shapes import CUBE, CYLINDER, WEDGE, Prism, Shape
from video2anim.objects.solids import Solids

TURN_UP = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
"""Takes a cylinder of trimesh, along z, to an upright one."""


ARROW = np.array([[-1, -0.4], [0.2, -0.4], [0.2, -1], [1, 0.1], [0.2, 1], [0.2, 0.4], [-1, 0.4]])
SHAPES = (CUBE, CUBE, CUBE, CYLINDER, CYLINDER)


def some_solids(seed: int) -> Solids:
    """Two sets of a box, a leaning box, a plate, two cylinders, one of them flat, and an arrow cut out of a board."""
    rng = np.random.default_rng(seed)
    half = rng.uniform(0.05, 0.5, (2, 6, 3))
    half[:, 2, 1] = half[:, 4, 1] = 0.015
    half[:, 3:5, 2] = half[:, 3:5, 0]
    tilt = np.zeros((2, 6))
    tilt[:, 1] = rng.uniform(-0.6, 0.6, 2)
    arrows = Prism(np.stack([ARROW, ARROW[:, ::-1][::-1]]))
    return Solids(rng.uniform(-0.4, 0.4, (2, 6, 3)), half, tilt, (*SHAPES, arrows))


def as_mesh(solids: Solids, number: int, part: int) -> trimesh.Trimesh:
    """The same solid by trimesh."""
    half = solids.half_m[number, part]
    form = solids.shapes[part]
    if isinstance(form, Prism):
        corners = form.corners[number] * half[:2]
        shape = trimesh.creation.extrude_triangulation(corners, form.triangles, 2 * half[2])
        shape.apply_translation([0, 0, -half[2]])
    elif form is CYLINDER:
        shape = trimesh.creation.cylinder(half[0], 2 * half[1], sections=512)
        shape.apply_transform(TURN_UP)
    else:
        shape = trimesh.creation.box(2 * half)
        # A positive tilt leans the top towards -z.
        shape.apply_transform(trimesh.transformations.rotation_matrix(-solids.tilt_rad[number, part], [1, 0, 0]))
    shape.apply_translation(solids.center_m[number, part])
    return shape


def first_hit_of(shape: trimesh.Trimesh, origin_m: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Distance to the first triangle, in lengths of the ray."""
    at_m, which, _ = shape.ray.intersects_location(np.tile(origin_m, (len(ray), 1)), ray)
    found = np.full(len(ray), np.inf)
    np.minimum.at(found, which, np.linalg.norm(at_m - origin_m, axis=-1) / np.linalg.norm(ray[which], axis=-1))
    return found


def test_a_positive_tilt_leans_back() -> None:
    """Backs of chairs lean away from the front, which is +z."""
    back = Solids(np.zeros((1, 1, 3)), np.array([[[0.2, 0.5, 0.01]]]), np.full((1, 1), 0.3), (CUBE,))
    (vertices_m, _), *_ = back.meshes()
    upper = vertices_m[:, 1] > 0
    assert vertices_m[upper][:, 2].mean() < -0.1 < 0.1 < vertices_m[~upper][:, 2].mean()


@pytest.mark.parametrize("seed", [0, 1])
def test_signed_distance_is_that_of_trimesh(seed: int) -> None:
    solids = some_solids(seed)
    points_m = np.random.default_rng(seed).uniform(-1, 1, (2, 150, 3))
    found = solids.distance_m(points_m)
    assert found.shape == (2, 6, 150)
    for number in range(2):
        for part in range(6):
            truth = -trimesh.proximity.signed_distance(as_mesh(solids, number, part), points_m[number])
            np.testing.assert_allclose(found[number, part], truth, atol=1e-3)
    assert (found < 0).any()


def rays_of(solids: Solids, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """From two places outside, to and past the solids."""
    rng = np.random.default_rng(seed)
    origin_m = np.array([[0.4, 1.2, 3.0], [-2.0, 0.3, -2.0]])
    return origin_m, (rng.uniform(-1.2, 1.2, (2, 600, 3)) - origin_m[:, None]) * rng.uniform(0.3, 2.0, (2, 600, 1))


@pytest.mark.parametrize("seed", [0, 1])
def test_rays_hit_first_what_they_hit_first_by_trimesh(seed: int) -> None:
    solids = some_solids(seed)
    origin_m, ray = rays_of(solids, seed)
    found, missed = solids.first_hit(origin_m, ray), solids.miss_m(origin_m, ray)
    for number in range(2):
        shapes = [as_mesh(solids, number, part) for part in range(6)]
        truth = np.min([first_hit_of(shape, origin_m[number], ray[number]) for shape in shapes], axis=0)
        hits = np.isfinite(truth)
        assert 0.1 < hits.mean() < 0.95
        # A polygon of 512 sides is a little smaller than the circle: rays at its very rim may differ.
        same = hits == np.isfinite(found[number])
        assert same.mean() > 0.995
        np.testing.assert_allclose(found[number][hits & same], truth[hits & same], rtol=3e-3)
        np.testing.assert_array_equal(missed[number] == 0, np.isfinite(found[number]))


@pytest.mark.parametrize("shape", [CUBE, CYLINDER], ids=["cube", "cylinder"])
def test_a_ray_passes_by_how_far_it_passes(shape: Shape) -> None:
    """A plate 1 m wide; rays straight down beside it, and level ones above it."""
    plate = Solids(np.zeros((1, 1, 3)), np.array([[[0.5, 0.02, 0.5]]]), np.zeros((1, 1)), (shape,))
    down = np.array([[0.0, -1.0, 0.0]])
    for aside_m in (0.45, 0.55, 0.8):
        (missed,) = plate.miss_m(np.array([[aside_m, 2.0, 0.0]]), down[None])[0]
        assert missed == pytest.approx(max(aside_m - 0.5, 0), abs=1e-6)
    (over,) = plate.miss_m(np.array([[-3.0, 0.12, 0.0]]), np.array([[[1.0, 0.0, 0.0]]]))[0]
    assert over == pytest.approx(0.1, abs=1e-6)


def test_surface_points_lie_on_all_sides() -> None:
    solids = some_solids(3)
    points_m = solids.surface_points_m(5)
    assert points_m.shape[:2] == (2, 6 * (5**3 - 3**3)), "the outside of a lattice of 5 x 5 x 5"
    own = points_m.reshape(2, 6, -1, 3)
    for part in range(6):
        np.testing.assert_allclose(solids.distance_m(own[:, part])[:, part], 0, atol=1e-9)
        size = np.ptp(own[:, part], axis=1)
        if part not in (1, 5):
            np.testing.assert_allclose(size, 2 * solids.half_m[:, part], rtol=1e-9)


def inside(shape: Shape, points: np.ndarray) -> np.ndarray:
    """Points within the shape, in the cube from -1 to 1."""
    x, y, z = np.moveaxis(points, -1, 0)
    if shape is WEDGE:
        return (np.abs(points) < 1).all(-1) & (x + y < 0)
    if isinstance(shape, Prism):
        head = (x > 0.2) & (y > -1 + 1.1 * (x - 0.2) / 0.8) & (y < 1 - 0.9 * (x - 0.2) / 0.8)
        return (np.abs(z) < 1) & (head | ((np.abs(y) < 0.4) & (x > -1) & (x <= 0.2)))
    return (x**2 + z**2 < 1) & (np.abs(y) < 1)


@pytest.mark.parametrize("shape", [CYLINDER, WEDGE, Prism(ARROW[None])], ids=["cylinder", "wedge", "arrow"])
def test_rays_distances_and_surface_agree_with_what_is_inside(shape: Shape) -> None:
    half, at = np.array([[[0.5, 0.3, 0.5 if shape is CYLINDER else 0.2]]]), np.array([[[0.1, 0.4, -0.2]]])
    solids, rng = Solids(at, half, np.zeros((1, 1)), (shape,)), np.random.default_rng(0)
    points_m = at[0] + rng.uniform(-0.6, 0.6, (4000, 3))
    signed = solids.distance_m(points_m[None])[0, 0]
    within = inside(shape, (points_m - at[0]) / half[0])
    assert 0.02 < within.mean() < 0.98
    np.testing.assert_array_equal(signed < 0, within)
    on_m = solids.surface_points_m(9)[0]
    np.testing.assert_allclose(solids.distance_m(on_m[None]), 0, atol=1e-9)
    # A point is no farther from the surface than from any point on it.
    nearest_m = np.linalg.norm(points_m[:, None] - on_m, axis=-1).min(1)
    assert (np.abs(signed) <= nearest_m + 1e-9)[~within].all()
    origin_m = np.array([[0.3, 1.0, 2.0]])
    ray = points_m - origin_m
    first, missed = solids.first_hit(origin_m, ray[None])[0], solids.miss_m(origin_m, ray[None])[0]
    along = np.linspace(0.3, 2.0, 1500)
    hit = inside(shape, (origin_m + along[:, None, None] * ray - at[0]) / half[0])
    np.testing.assert_array_equal(missed == 0, np.isfinite(first))
    some = hit.any(0)
    assert (some == np.isfinite(first)).mean() > 0.99, "but for rays that graze it"
    both = some & np.isfinite(first)
    assert 0.1 < both.mean() < 0.9
    # A ray may cut a corner between two steps.
    assert (np.abs(along[hit.argmax(0)] - first)[both] < 0.003).mean() > 0.98


def volume_m3(solids: Solids, part: int) -> float:
    half, shape = solids.half_m[0, part], solids.shapes[part]
    filled = {CUBE: 8, CYLINDER: 2 * np.pi, WEDGE: 4}[shape]
    return float(filled * half.prod())


def some_sizes(form: Form) -> np.ndarray:
    """The usual ones, and all small, all large by two standard deviations."""
    steps = np.array([[0.0], [-2.0], [2.0]])
    return form.usual_m * np.exp(steps * form.spread)


@pytest.mark.parametrize("form", FORMS, ids=lambda form: f"{form.name} {form.variant}".strip())
def test_every_part_of_every_form_is_a_closed_surface(form: Form) -> None:
    for sizes_m in some_sizes(form):
        names, solids = form.build(sizes_m[None])
        pieces = solids.meshes()
        assert len(names) == len(pieces) == solids.half_m.shape[1]
        for part, (vertices_m, faces) in enumerate(pieces):
            mesh = trimesh.Trimesh(vertices_m, faces, process=False)
            assert mesh.is_watertight
            assert mesh.is_winding_consistent
            assert mesh.body_count == 1
            assert mesh.euler_number == 2
            # Round ones are polygons of two dozen sides.
            off = {CYLINDER: 0.02}.get(solids.shapes[part], 1e-6)
            assert mesh.volume == pytest.approx(volume_m3(solids, part), rel=off)
            np.testing.assert_allclose(solids.distance_m(vertices_m[None])[0, part], 0, atol=1e-9)
            assert len(np.unique(faces)) == len(vertices_m)


@pytest.mark.parametrize("form", FORMS, ids=lambda form: f"{form.name} {form.variant}".strip())
def test_every_form_rests_on_the_floor_in_one_piece(form: Form) -> None:
    """Its parts touch each other, but for cabinets on a wall; none goes through the floor."""
    sizes_m = some_sizes(form)
    names, solids = form.build(sizes_m)
    points_m = solids.surface_points_m(4)
    for one in sizes_m:
        lowest_m = min(vertices_m[:, 1].min() for vertices_m, _ in form.build(one[None])[1].meshes())
        assert lowest_m == pytest.approx(0, abs=1e-9)
    near_m = solids.distance_m(points_m).reshape(len(sizes_m), len(names), len(names), -1).min(-1)
    gap_m = np.minimum(near_m, near_m.transpose(0, 2, 1)) + np.where(np.eye(len(names), dtype=bool), np.inf, 0)
    if len(names) > 1 and "top cabinet" not in names:
        # What joins the back of an office chair to its seat is thin and left out.
        assert (gap_m.min(-1) < (0.1 if form.variant == "swivel" else 0.03)).all(), names


def test_sizes_are_those_of_the_form() -> None:
    """Width along x, depth along z, and a seat at its height."""
    for form in FORMS:
        names, solids = form.build(form.usual_m[None])
        sizes = {size.name: size.usual_m for size in form.sizes}
        main = solids.half_m[0, 0] * 2
        if form.variant != "round" and "depth" in sizes and form.name in ("chair", "table", "stool", "box", "cabinet"):
            np.testing.assert_allclose(main[[0, 2]], [sizes["width"], sizes["depth"]])
        if "back height" in sizes:
            seat = names.index("seat")
            top_m = solids.center_m[0, seat, 1] + solids.half_m[0, seat, 1]
            assert top_m == pytest.approx(sizes["seat height"])
            back = names.index("back")
            assert solids.center_m[0, back, 2] < solids.center_m[0, seat, 2], "the front is towards +z"
            over_m = solids.surface_points_m(4)[0, :, 1].max() - top_m
            assert over_m == pytest.approx(sizes["back height"], rel=0.1)
