"""Meshes of the user, of a program of theirs, and a scan of the room, in place of what the video shows."""

from __future__ import annotations

import functools
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scene_chain import all_finite
from synthetic_room import BOX, BOX_CENTER_M, BOX_SIZE_M, FLOOR, TRUE_RELIEF, WALL_Z_M, Room, make_room, true_depth
from trimesh.visual import ColorVisuals

from stages.reconstruct import ReconstructConfig, reconstruct_objects
from stages.scene import SceneConfig, build_scene
from video2anim.errors import InputError, StageError, UsageError
from video2anim.geometry.projection import transform_points
from video2anim.networks.amodal import object_picture
from video2anim.networks.external_mesh import object_square
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    BodyTracks,
    CompletedObject,
    CompletedObjects,
    DepthClip,
    InstanceMasks,
    ObjectInstance,
    ObjectMesh,
    PlacedObjects,
    SceneModel,
)

GREEN = (10, 200, 30)
NO_SAMPLES = np.zeros((0, 18, 32))
DEPTH = DepthClip(
    "depth",
    "truth",
    np.zeros(0, int),
    NO_SAMPLES,
    NO_SAMPLES,
    NO_SAMPLES > 0,
    np.ones((18, 32)),
    np.ones((18, 32), bool),
)
"""A scan needs none of it."""


def true_masks(room: Room, objects: int) -> InstanceMasks:
    """The box, found as often as one likes."""
    mask = room.surface_full == BOX
    instances = tuple(ObjectInstance(n, "box", 1.0, np.zeros(4), mask) for n in range(1, objects + 1))
    return InstanceMasks("truth", instances, room.surface_full == FLOOR)


def reconstruct(config: ReconstructConfig, ctx: StageContext | None = None, objects: int = 1) -> list[ObjectMesh]:
    room = make_room()
    masks = true_masks(room, objects)
    crop, corner = object_picture(room.background.background_rgb, masks.instances[0].mask, masks.instances[0].mask)
    completed = tuple(CompletedObject(i.object_id, i.label, i.mask, crop, corner) for i in masks.instances)
    made = reconstruct_objects(
        CompletedObjects(completed),
        masks,
        true_depth(room),
        room.background,
        replace(config, **TRUE_RELIEF),
        ctx or StageContext(Path()),
    )
    return list(made.objects)


@functools.cache
def own() -> ObjectMesh:
    """What the stage makes of the box by itself."""
    return reconstruct(ReconstructConfig())[0]


def chair(height: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """As wide and deep as high, with its back at the rear: in front (+Z) it is low. Its lowest place is `at`."""
    seat, back = trimesh.creation.box((1, 0.5, 1)), trimesh.creation.box((1, 0.5, 0.2))
    seat.apply_translation([0, 0.25, 0])
    back.apply_translation([0, 0.75, -0.4])
    shape = trimesh.util.concatenate([seat, back])
    assert isinstance(shape, trimesh.Trimesh)
    shape.apply_scale(height)
    shape.apply_translation(at)
    shape.visual = ColorVisuals(shape, vertex_colors=np.tile([*GREEN, 255], (len(shape.vertices), 1)))
    return shape


def folder_with(tmp_path: Path, name: str, shape: trimesh.Trimesh) -> ReconstructConfig:
    (tmp_path / "meshes").mkdir(exist_ok=True)
    shape.export(tmp_path / "meshes" / name)
    return ReconstructConfig(meshes=str(tmp_path / "meshes"))


def command_of(tmp_path: Path, code: str) -> str:
    program = tmp_path / "program.py"
    program.write_text(f"import shutil, sys\nimage, mesh = sys.argv[1:3]\n{code}\n")
    return shlex.join([sys.executable, str(program), "{image}", "{mesh}"])


def extents(found: ObjectMesh) -> np.ndarray:
    return np.ptp(found.mesh.vertices_m, axis=0)


def expect_own_frame(found: ObjectMesh) -> None:
    """Resting on y = 0, centered, and upright in the world."""
    low, high = found.mesh.vertices_m.min(0), found.mesh.vertices_m.max(0)
    assert low[1] == pytest.approx(0, abs=1e-5)
    np.testing.assert_allclose((low + high)[[0, 2]], 0, atol=1e-5)
    np.testing.assert_allclose(found.T_world_object[:3, 1], [0, 1, 0], atol=1e-9)
    assert np.linalg.det(found.T_world_object[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("unit", [0.01, 3.0, 100.0])
def test_a_users_mesh_takes_the_place_and_the_height_of_the_object(tmp_path: Path, unit: float) -> None:
    """In any unit, and anywhere in its file; it keeps its shape and its colors."""
    (found,) = reconstruct(folder_with(tmp_path, "1.glb", chair(unit, (7.0, -2.0, 3.0))))
    assert (found.object_id, found.label, found.method) == (1, "box", "user mesh")
    expect_own_frame(found)
    np.testing.assert_allclose(extents(found), BOX_SIZE_M[1], rtol=0.02)
    assert found.T_world_object[1, 3] == pytest.approx(0, abs=0.01), "on the floor"
    np.testing.assert_allclose(found.T_world_object[[0, 2], 3], BOX_CENTER_M[[0, 2]], atol=0.15)
    assert (found.mesh.vertex_rgb == GREEN).all()
    assert len(found.mesh.faces) == 24


@pytest.mark.parametrize(("height_m", "kept"), [(0.72, True), (0.9, True), (1.1, True), (0.6, False), (1.4, False)])
def test_a_mesh_of_nearly_the_right_size_keeps_it(tmp_path: Path, height_m: float, kept: bool) -> None:
    """Who brings a mesh in meters knows better than the video, unless it is far off."""
    (found,) = reconstruct(folder_with(tmp_path, "1.ply", chair(height_m)))
    assert extents(found)[1] == pytest.approx(height_m if kept else BOX_SIZE_M[1], abs=1e-4 if kept else 0.06)
    expect_own_frame(found)


def test_its_front_faces_the_camera(tmp_path: Path) -> None:
    """The back of the chair is farther from the camera than its middle, the seat's front is nearer."""
    (found,) = reconstruct(folder_with(tmp_path, "1.glb", chair(0.9)))
    camera_m = make_room().bodies.people[0].T_world_camera[0, :3, 3]
    parts_m = transform_points(found.T_world_object, np.array([[0, 0.8, -0.4], [0, 0.8, 0.0], [0, 0.8, 0.4]]))
    back, center, front = np.linalg.norm(parts_m - camera_m, axis=1)
    assert front < center - 0.25 < back - 0.5


def test_objects_without_a_mesh_of_the_user_are_made_as_before(tmp_path: Path) -> None:
    """Numbers of no object are told, other names are left alone."""
    config = folder_with(tmp_path, "2.obj", chair(0.9))
    for name in ("9.glb", "chair.glb", "notes.txt"):
        (tmp_path / "meshes" / name).write_bytes(b"")
    ctx = StageContext(Path())
    first, second = reconstruct(config, ctx, objects=2)
    assert (first.object_id, second.object_id) == (1, 2)
    assert second.method == "user mesh"
    assert first.method == own().method
    np.testing.assert_array_equal(first.mesh.vertices_m, own().mesh.vertices_m)
    told = {quality.key: quality.value for quality in ctx.qualities}
    assert told["meshes"] == 2
    (warning,) = ctx.warnings
    assert warning.startswith("9.glb in")
    assert "only [1, 2]" in warning


def test_bad_meshes_of_the_user_stop_the_stage(tmp_path: Path) -> None:
    config = folder_with(tmp_path, "1.glb", chair(0.9))
    (tmp_path / "meshes" / "1.glb").write_bytes(b"junk")
    with pytest.raises(InputError, match=r"1\.glb: cannot be read as a mesh: no binary glTF"):
        reconstruct(config)
    with pytest.raises(InputError, match="want a folder of meshes"):
        reconstruct(ReconstructConfig(meshes=str(tmp_path / "none")))


def test_a_program_makes_the_meshes_that_the_user_did_not_bring(tmp_path: Path) -> None:
    """It runs once for each other object and sees its picture."""
    config = folder_with(tmp_path, "1.glb", chair(0.9))
    chair(50.0).export(tmp_path / "made.glb")
    lines = f"shutil.copy({str(tmp_path / 'made.glb')!r}, mesh)\nopen({str(tmp_path / 'calls')!r}, 'a').write(image)"
    copied = f"shutil.copy(image, {str(tmp_path / 'seen.png')!r})"
    ctx = StageContext(Path())
    config = replace(config, command=command_of(tmp_path, f"{lines}\n{copied}"))
    brought, made = reconstruct(config, ctx, objects=2)
    assert (brought.method, made.method) == ("user mesh", "program")
    assert (tmp_path / "calls").read_text().count("object.png") == 1
    room = make_room()
    mask = true_masks(room, 1).instances[0].mask
    crop, _ = object_picture(room.background.background_rgb, mask, mask)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "seen.png"))[..., ::-1], object_square(crop))
    expect_own_frame(made)
    np.testing.assert_allclose(extents(made), BOX_SIZE_M[1], rtol=0.02)
    np.testing.assert_allclose(made.T_world_object, brought.T_world_object, atol=1e-9)
    assert (made.mesh.vertex_rgb == GREEN).all()
    assert ctx.warnings == []


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("print('no memory', file=sys.stderr); sys.exit(7)", "exit code 7: no memory"),
        ("pass", "found none"),
        ("open(mesh, 'w').write('junk')", "cannot be read as a mesh"),
    ],
)
def test_a_failing_program_leaves_a_warning_and_the_own_shape(tmp_path: Path, code: str, told: str) -> None:
    ctx = StageContext(Path())
    (found,) = reconstruct(ReconstructConfig(command=command_of(tmp_path, code)), ctx)
    assert found.method == own().method
    np.testing.assert_array_equal(found.mesh.vertices_m, own().mesh.vertices_m)
    (warning,) = ctx.warnings
    assert "object 1 is made of what is seen instead" in warning
    assert told in warning
    assert "\n" not in warning


def test_a_wrong_command_stops_the_stage() -> None:
    for command in ("no-such-program-here {image} {mesh}", f"{sys.executable} {{image}}"):
        with pytest.raises(UsageError, match=r"reconstruct\.command"):
            reconstruct(ReconstructConfig(command=command))


def test_a_flat_mesh_keeps_a_sensible_size(tmp_path: Path) -> None:
    """A rug: a square of 2 m without thickness."""
    rug = trimesh.Trimesh([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], [[0, 1, 2], [0, 2, 3]])
    (found,) = reconstruct(folder_with(tmp_path, "1.ply", rug))
    assert extents(found).max() < 20


# A scan in place of objects, floor and room surface.


def truth_mesh() -> trimesh.Trimesh:
    """Floor, back wall and box of the room; triangles face the free side, and no floor lies under the box."""
    (x0, _, z0), (x1, y1, z1) = BOX_CENTER_M - 0.5 * BOX_SIZE_M, BOX_CENTER_M + 0.5 * BOX_SIZE_M
    west, east, south = -2.6, 2.6, -2.5
    quads = [
        [(a, 0, c), (a, 0, d), (b, 0, d), (b, 0, c)]
        for a, c, b, d in [(west, WALL_Z_M, east, z0), (west, z1, east, south), (west, z0, x0, z1), (x1, z0, east, z1)]
    ]
    quads.append([(west, 0, WALL_Z_M), (east, 0, WALL_Z_M), (east, 2, WALL_Z_M), (west, 2, WALL_Z_M)])
    quads.append([(x0, y1, z0), (x0, y1, z1), (x1, y1, z1), (x1, y1, z0)])
    corners = [(x0, z0), (x0, z1), (x1, z1), (x1, z0)]
    quads += [
        [(a[0], 0, a[1]), (b[0], 0, b[1]), (b[0], y1, b[1]), (a[0], y1, a[1])]
        for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
    ]
    first = 4 * np.arange(len(quads))[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return trimesh.Trimesh(np.array(quads, float).reshape(-1, 3), faces, process=False)


def farthest_m(scene: SceneModel, near_m: float = np.inf) -> float:
    """Largest distance from a corner of the room, not farther from the box, to the scene's nearest vertex."""
    corners_m = np.asarray(truth_mesh().vertices)
    corners_m = corners_m[np.linalg.norm(corners_m - BOX_CENTER_M, axis=1) < near_m]
    gap_m = np.linalg.norm(corners_m[:, None] - scene.background[0].mesh.vertices_m[None], axis=-1)
    return float(gap_m.min(1).max())


def about_y(yaw_deg: float) -> np.ndarray:
    return np.asarray(trimesh.transformations.rotation_matrix(np.deg2rad(yaw_deg), [0, 1, 0]))


def scene_with(scan: trimesh.Trimesh, path: Path, ctx: StageContext | None = None, **options: object) -> SceneModel:
    scan.export(path)
    room = make_room(small=(32, 18))
    return build_scene(
        room.clip, room.camera, PlacedObjects(()), true_depth(room), DEPTH, true_masks(room, 1), room.background,
        SceneConfig(scan=str(path), sdf_spacing_m=0.35, **options), ctx or StageContext(Path()),  # type: ignore[arg-type]
    )  # fmt: skip


def expect_the_room(scene: SceneModel, tolerance_m: float) -> None:
    """Every node has its distance to floor, wall or box; behind, below and inside it is negative."""
    axes = [o + scene.sdf_spacing_m * np.arange(n) for o, n in zip(scene.sdf_origin_m, scene.sdf_m.shape, strict=True)]
    points_m = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    q = np.abs(points_m - [BOX_CENTER_M[0], 0.0, BOX_CENTER_M[2]]) - BOX_SIZE_M * [0.5, 1.0, 0.5]
    box_m = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)
    truth_m = np.minimum.reduce([points_m[..., 1], points_m[..., 2] - WALL_Z_M, box_m])
    low = (points_m[..., 1] > 0.02) & (points_m[..., 1] < 1.9)
    assert (truth_m[low] < -0.05).sum() > 10
    np.testing.assert_allclose(scene.sdf_m[low], truth_m[low], atol=tolerance_m)
    below = points_m[..., 1] < 0
    assert (scene.sdf_m[below] <= points_m[below][:, 1] + 1e-6).all()


def test_a_scan_in_place_is_the_scene(tmp_path: Path) -> None:
    scene = scene_with(truth_mesh(), tmp_path / "room.ply", scan_register=False)
    assert scene.objects == ()
    assert len(scene.floor.mesh.faces) == 0
    (scan,) = scene.background
    assert (scan.name, scan.textures) == ("scan", ())
    assert len(scan.mesh.faces) == len(truth_mesh().faces)
    assert farthest_m(scene) < 1e-6
    expect_the_room(scene, 0.03)
    joints_m = make_room().bodies.people[0].joints_world_m.reshape(-1, 3)
    high_m = scene.sdf_origin_m + scene.sdf_spacing_m * (np.array(scene.sdf_m.shape) - 1)
    assert ((joints_m > scene.sdf_origin_m) & (joints_m < high_m)).all()
    assert all_finite(scene)


def test_axis_turn_and_shift_bring_a_scan_into_the_world(tmp_path: Path) -> None:
    """A scan with +Z up, then turned by 40 degrees about the vertical, then shifted."""
    scan = truth_mesh()
    scan.apply_translation([-1.0, -0.5, 2.0])
    scan.apply_transform(about_y(-40.0))
    scan.vertices = np.asarray(scan.vertices)[:, [0, 2, 1]] * [1, -1, 1]
    scene = scene_with(
        scan, tmp_path / "room.glb", scan_register=False,
        scan_up="z", scan_yaw_deg=40.0, scan_shift_m=(1.0, 0.5, -2.0),
    )  # fmt: skip
    assert farthest_m(scene) < 1e-5
    expect_the_room(scene, 0.03)


def moved(yaw_deg: float, shift_m: tuple[float, float, float]) -> trimesh.Trimesh:
    """The room turned about its box, then shifted."""
    scan = truth_mesh()
    scan.apply_translation(-BOX_CENTER_M)
    scan.apply_transform(about_y(yaw_deg))
    scan.apply_translation(BOX_CENTER_M + shift_m)
    return scan


def test_a_scan_nearly_in_place_is_fitted_to_the_depth(tmp_path: Path) -> None:
    """Turned by 4 degrees and 0.2 m too far away: the box is back within 5 cm."""
    ctx = StageContext(Path())
    scene = scene_with(moved(4.0, (0.0, 0.05, -0.2)), tmp_path / "room.ply", ctx)
    assert farthest_m(scene, near_m=1.0) < 0.05
    told = {quality.key: quality.value for quality in ctx.qualities}
    assert told["scan_to_depth"] < 0.03 < 0.05 < told["scan_to_depth_before"]
    assert told["scan_faces"] == len(truth_mesh().faces)
    assert ctx.warnings == []


def test_a_scan_beside_its_place_is_fitted_to_the_depth(tmp_path: Path) -> None:
    """Floor and wall fit as they are; the box alone tells that the scan is 0.3 m to the left. Half of it is undone."""
    assert farthest_m(scene_with(moved(0.0, (-0.3, 0.0, 0.0)), tmp_path / "room.ply"), near_m=1.0) < 0.15


def test_a_scan_that_is_out_of_place_is_told(tmp_path: Path) -> None:
    scan = truth_mesh()
    scan.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    ctx = StageContext(Path())
    scene_with(scan, tmp_path / "room.ply", ctx)
    (warning,) = ctx.warnings
    for word in ("from the video's depth", "scene.scan_up", "scene.scan_yaw_deg", "scene.scan_shift_m"):
        assert word in warning


def test_a_scan_needs_a_readable_file_and_a_body(tmp_path: Path) -> None:
    (tmp_path / "junk.ply").write_bytes(b"junk")
    room = make_room(small=(32, 18))
    for name in ("none.ply", "junk.ply"):
        for bodies, kind in ((room.bodies, InputError), (BodyTracks(()), StageError)):
            with pytest.raises(kind):
                build_scene(
                    room.clip, room.camera, PlacedObjects(()), true_depth(room, bodies=bodies), DEPTH,
                    true_masks(room, 1), room.background, SceneConfig(scan=str(tmp_path / name)), StageContext(Path()),
                )  # fmt: skip
