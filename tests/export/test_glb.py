"""The GLB says what the motion says: read back by independent code."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pygltflib as gltf
import pytest
import trimesh
from walk_scene import room, room_with_carried_box, walk

from video2anim.body.anny_body import shaped_body
from video2anim.export.character import character_of, strongest_influences
from video2anim.export.frames import linear_from_srgb
from video2anim.export.glb import write_object_glb, write_scene_glb
from video2anim.geometry.projection import project, transform_points
from video2anim.geometry.rotations import matrix_from_quaternion
from video2anim.types import BodyMotion, Contact
from video2anim.types.skeleton import JOINT_NAMES, forward_kinematics

COMPONENTS = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
JOINT_TOLERANCE_M = 1e-5
"""float32 positions at a few meters."""
SKIN_TOLERANCE_M = 4e-3
"""What dropping the fifth and later joints of a vertex may move it; only a few vertices have so many."""


class Reread:
    """A GLB as a viewer would evaluate it."""

    def __init__(self, path: Path) -> None:
        self.document = gltf.GLTF2.load_binary(str(path))
        self.blob = self.document.binary_blob()

    def array(self, index: int) -> np.ndarray:
        accessor = self.document.accessors[index]
        view = self.document.bufferViews[accessor.bufferView]
        start = view.byteOffset + accessor.byteOffset
        width = WIDTHS[accessor.type]
        kind = COMPONENTS[accessor.componentType]
        return np.frombuffer(self.blob, kind, accessor.count * width, start).reshape(accessor.count, width)

    def node(self, name: str) -> int:
        return next(i for i, node in enumerate(self.document.nodes) if node.name == name)

    def channels(self, node: int) -> dict[str, np.ndarray]:
        animation = self.document.animations[0]
        return {
            channel.target.path: self.array(animation.samplers[channel.sampler].output)
            for channel in animation.channels
            if channel.target.node == node
        }

    def world(self, frame: int) -> dict[int, np.ndarray]:
        """Global matrices of all nodes at a frame, by walking down from the roots."""
        matrices: dict[int, np.ndarray] = {}

        def visit(index: int, parent: np.ndarray) -> None:
            node, moved = self.document.nodes[index], self.channels(index)
            local = np.eye(4)
            xyzw = moved["rotation"][frame] if "rotation" in moved else np.array(node.rotation or (0, 0, 0, 1.0))
            local[:3, :3] = matrix_from_quaternion(np.roll(xyzw.astype(float), 1)[None])[0] * (node.scale or [1.0])[0]
            local[:3, 3] = moved["translation"][frame] if "translation" in moved else node.translation or (0, 0, 0)
            matrices[index] = parent @ local
            for child in node.children or []:
                visit(child, matrices[index])

        for root in self.document.scenes[0].nodes:
            visit(root, np.eye(4))
        return matrices


@pytest.fixture(scope="module")
def people() -> tuple[BodyMotion, BodyMotion]:
    return walk(12, 1, camera_moves=True), walk(12, 7, camera_moves=True, side_m=-1.0)


@pytest.fixture(scope="module")
def path(people: tuple[BodyMotion, BodyMotion], tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("glb") / "scene.glb"
    write_scene_glb(target, tuple(character_of(motion) for motion in people), room())
    return target


def test_joints_follow_the_motion(path: Path, people: tuple[BodyMotion, BodyMotion]) -> None:
    reread = Reread(path)
    for motion, skin in zip(people, reread.document.skins, strict=True):
        assert [reread.document.nodes[joint].name for joint in skin.joints] == list(JOINT_NAMES)
        for frame in range(motion.frame_count):
            world = reread.world(frame)
            joints_m = np.stack([world[joint][:3, 3] for joint in skin.joints])
            np.testing.assert_allclose(joints_m, motion.joints_world_m[frame], atol=JOINT_TOLERANCE_M)


def test_skinned_vertices_follow_the_body(path: Path, people: tuple[BodyMotion, BodyMotion]) -> None:
    reread, motion, frame = Reread(path), people[0], 7
    body = shaped_body(motion.shape)
    joints_m, R_world_joint = forward_kinematics(
        motion.R_parent_joint[[frame]], motion.T_world_root[[frame], :3, 3], motion.rest_joints_m
    )
    truth_m = body.vertices(R_world_joint, joints_m)[0][np.unique(body.faces)]
    skin = reread.document.skins[0]
    node = next(node for node in reread.document.nodes if node.skin == 0)
    attributes = reread.document.meshes[node.mesh].primitives[0].attributes
    inverse_bind = reread.array(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
    world = reread.world(frame)
    matrices = np.stack([world[joint] for joint in skin.joints]) @ inverse_bind
    rest = np.pad(reread.array(attributes.POSITION), ((0, 0), (0, 1)), constant_values=1.0)
    joints, weights = reread.array(attributes.JOINTS_0), reread.array(attributes.WEIGHTS_0)
    skinned_m = np.einsum("vk,vkij,vj->vi", weights, matrices[joints], rest)[:, :3]
    error_m = np.linalg.norm(skinned_m - truth_m, axis=1)
    assert error_m.max() < SKIN_TOLERANCE_M
    assert np.quantile(error_m, 0.95) < 1e-3
    assert np.median(error_m) < 1e-5
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-6)


def test_buffers_obey_the_specification(path: Path) -> None:
    reread = Reread(path)
    document = reread.document
    assert path.stat().st_size % 4 == 0
    for accessor in document.accessors:
        view = document.bufferViews[accessor.bufferView]
        assert view.byteOffset % 4 == 0
        assert view.byteOffset + view.byteLength <= document.buffers[0].byteLength
    for mesh in document.meshes:
        primitive = mesh.primitives[0]
        positions = document.accessors[primitive.attributes.POSITION]
        values = reread.array(primitive.attributes.POSITION)
        np.testing.assert_array_equal(np.float32(positions.min), values.min(0))
        np.testing.assert_array_equal(np.float32(positions.max), values.max(0))
        indices = reread.array(primitive.indices)
        np.testing.assert_array_equal(np.unique(indices), np.arange(len(values)), "every vertex is in use")
        assert (
            document.bufferViews[document.accessors[primitive.indices].bufferView].target == gltf.ELEMENT_ARRAY_BUFFER
        )
        np.testing.assert_allclose(np.linalg.norm(reread.array(primitive.attributes.NORMAL), axis=1), 1.0, atol=1e-5)
    for sampler in document.animations[0].samplers:
        times = reread.array(sampler.input)[:, 0]
        assert (np.diff(times) > 0).all()
        assert document.accessors[sampler.input].min == [times[0]]
        assert len(reread.array(sampler.output)) == len(times)


def test_rotation_channels_do_not_jump_sign(path: Path) -> None:
    reread = Reread(path)
    for skin in reread.document.skins:
        for joint in skin.joints:
            xyzw = reread.channels(joint)["rotation"]
            assert ((xyzw[1:] * xyzw[:-1]).sum(1) > 0).all()


def test_camera_sees_what_the_filming_camera_saw(path: Path, people: tuple[BodyMotion, BodyMotion]) -> None:
    reread, motion, frame = Reread(path), people[0], 9
    lens = motion.intrinsics
    T_world_gl = reread.world(frame)[reread.node("camera")]
    point_gl = transform_points(np.linalg.inv(T_world_gl), motion.joints_world_m[frame])
    perspective = reread.document.cameras[0].perspective
    half_y = np.tan(0.5 * perspective.yfov)
    ndc = point_gl[:, :2] / -point_gl[:, 2:] / [half_y * perspective.aspectRatio, half_y]
    pixels = np.stack([0.5 * (ndc[:, 0] + 1) * lens.width_px, 0.5 * (1 - ndc[:, 1]) * lens.height_px], -1) - 0.5
    np.testing.assert_allclose(pixels, project(motion.joints_camera_m[frame], lens), atol=1e-2)


def test_still_camera_has_no_channels(tmp_path: Path) -> None:
    target = tmp_path / "still.glb"
    write_scene_glb(target, (character_of(walk(5)),), None)
    reread = Reread(target)
    assert reread.channels(reread.node("camera")) == {}


def test_objects_are_placed_nodes_with_their_colors(path: Path) -> None:
    placed = room().objects[0]
    scene = trimesh.load(path)
    transform, geometry = scene.graph[f"object_{placed.object_id}_storage_box"]
    mesh = scene.geometry[geometry]
    expected_m = transform_points(placed.T_world_object, placed.scale * placed.mesh.vertices_m)
    np.testing.assert_allclose(transform_points(transform, np.asarray(mesh.vertices)), expected_m, atol=1e-5)
    assert {"floor", "wall_1", "backdrop"} <= set(scene.geometry)
    reread = Reread(path)
    node = reread.document.nodes[reread.node("object_3_storage_box")]
    attributes = reread.document.meshes[node.mesh].primitives[0].attributes
    linear = reread.array(attributes.COLOR_0)[:, :3] / 65535.0
    np.testing.assert_allclose(linear, linear_from_srgb(placed.mesh.vertex_rgb), atol=1e-5)
    assert node.extras["label"] == "storage box"


def test_every_piece_of_the_room_is_an_unlit_node_with_its_picture(path: Path) -> None:
    reread = Reread(path)
    wall, backdrop = (reread.document.nodes[reread.node(name)] for name in ("wall_1", "backdrop"))
    piece = room().background[0]
    assert wall.extras["openings"] == [corners_m.tolist() for corners_m in piece.openings]
    assert not backdrop.extras
    primitive = reread.document.meshes[wall.mesh].primitives[0]
    uv = reread.array(primitive.attributes.TEXCOORD_0)
    np.testing.assert_allclose(uv, piece.textures[0].corner_uv.reshape(-1, 2), atol=1e-6)
    corners_m = piece.mesh.vertices_m[piece.mesh.faces].reshape(-1, 3)
    np.testing.assert_allclose(reread.array(primitive.attributes.POSITION), corners_m, atol=1e-6)
    for node in (wall, backdrop):
        material = reread.document.materials[reread.document.meshes[node.mesh].primitives[0].material]
        assert material.extensions == {"KHR_materials_unlit": {}}
        assert not material.doubleSided
    assert reread.document.extensionsUsed == ["KHR_materials_unlit"]


def test_without_animation_it_stands_in_the_t_pose(path: Path, people: tuple[BodyMotion, BodyMotion]) -> None:
    reread = Reread(path)
    reread.document.animations[0].channels = []
    for motion, skin in zip(people, reread.document.skins, strict=True):
        world = reread.world(0)
        joints_m = np.stack([world[joint][:3, 3] for joint in skin.joints])
        np.testing.assert_allclose(joints_m, motion.rest_joints_m, atol=JOINT_TOLERANCE_M)


def test_frames_lie_along_the_limbs(path: Path, people: tuple[BodyMotion, BodyMotion]) -> None:
    """The y axis of a joint's node points to its child, in every frame."""
    reread, motion, frame = Reread(path), people[0], 7
    world = reread.world(frame)
    for joint, child in (("left_hip", "left_knee"), ("right_elbow", "right_wrist"), ("spine3", "neck")):
        limb_m = np.subtract(*(motion.joints_world_m[frame, JOINT_NAMES.index(name)] for name in (child, joint)))
        y = world[reread.node(joint)][:3, 1]
        np.testing.assert_allclose(y, limb_m / np.linalg.norm(limb_m), atol=1e-5)


def node_modules() -> Path | None:
    """Folder that has the Khronos validator: the Makefile's, or one in NODE_PATH."""
    places = [Path(sys.prefix, "node_modules"), *map(Path, os.environ.get("NODE_PATH", "").split(os.pathsep))]
    return next((place for place in places if (place / "gltf-validator").is_dir()), None)


def test_the_khronos_validator_finds_nothing(path: Path, tmp_path: Path) -> None:
    node, modules = shutil.which("node"), node_modules()
    if node is None or modules is None:
        pytest.skip("no node with gltf-validator: `make .venv/.programs`, or name its folder in NODE_PATH")
    write_object_glb(tmp_path / "3.glb", room().objects[0])
    write_scene_glb(tmp_path / "still.glb", (character_of(walk(5)),), None)
    write_scene_glb(tmp_path / "carried.glb", (character_of(walk(24)),), room_with_carried_box(24))
    files = [path, *(tmp_path / f"{name}.glb" for name in ("3", "still", "carried"))]
    command = [node, str(Path(__file__).with_name("gltf_validate.js")), str(modules), *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for issues in json.loads(done.stdout):
        # glTF 2.0 allows pictures of any size; the validator mentions it.
        assert [issue for issue in issues["messages"] if issue["code"] != "IMAGE_NPOT_DIMENSIONS"] == []


def test_single_object_file_is_metric_in_its_own_frame(tmp_path: Path) -> None:
    placed = room().objects[0]
    write_object_glb(tmp_path / "3.glb", placed)
    bounds = trimesh.load(tmp_path / "3.glb").bounds
    np.testing.assert_allclose(bounds, [[-0.25, 0, -0.2], [0.25, 0.6, 0.2]], atol=1e-6)


def test_unmeasured_frames_are_named(path: Path, people: tuple[BodyMotion, BodyMotion]) -> None:
    reread = Reread(path)
    extras = reread.document.nodes[reread.node("person_7")].extras
    assert extras["frames_without_measurement"] == np.flatnonzero(~people[1].valid).tolist() == [6]


def test_contacts_are_at_the_node_of_the_person(tmp_path: Path, people: tuple[BodyMotion, BodyMotion]) -> None:
    hand = Contact(7, "left hand", 3, "storage box", "top", 0.1, 0.3, 0.004, -0.01)
    foot = Contact(7, "left foot", None, "floor", "floor", 0.0, 0.2, 0.0, 0.01)
    write_scene_glb(tmp_path / "told.glb", tuple(map(character_of, people)), room(), contacts=(hand, foot))
    reread = Reread(tmp_path / "told.glb")
    extras = [reread.document.nodes[reread.node(f"person_{number}")].extras for number in (people[0].person_id, 7)]
    assert "contacts" not in extras[0]
    assert extras[1]["contacts"] == [
        {"body_part": "left hand", "object_id": 3, "label": "storage box", "surface": "top", "start_s": 0.1,
         "end_s": 0.3, "mean_distance_m": 0.004, "largest_distance_m": -0.01},
        {"body_part": "left foot", "label": "floor", "surface": "floor", "start_s": 0.0, "end_s": 0.2,
         "mean_distance_m": 0.0, "largest_distance_m": 0.01},
    ]  # fmt: skip


def test_a_carried_object_follows_its_path(tmp_path: Path) -> None:
    motion, scene = walk(24), room_with_carried_box(24)
    write_scene_glb(tmp_path / "carried.glb", (character_of(motion),), scene)
    reread, (placed,) = Reread(tmp_path / "carried.glb"), scene.objects
    index = reread.node("object_3_storage_box")
    (animation,) = reread.document.animations
    channels = {
        one.target.path: animation.samplers[one.sampler] for one in animation.channels if one.target.node == index
    }
    assert set(channels) == {"translation", "rotation"}
    assert all(sampler.interpolation == "LINEAR" for sampler in channels.values())
    key_s = reread.array(channels["translation"].input)[:, 0]
    (hold,) = placed.holds
    np.testing.assert_allclose(
        key_s[[0, 1, -2, -1]], motion.frame_time_s[[0, hold.first_frame - 1, hold.last_frame + 1, -1]]
    )
    at_m, xyzw = (reread.array(channels[name].output) for name in ("translation", "rotation"))
    assert ((xyzw[1:] * xyzw[:-1]).sum(1) > 0).all()
    for frame, time_s in enumerate(motion.frame_time_s):
        # A viewer's linear interpolation; where keys were left out both neighbors are the same.
        moved = [[np.interp(time_s, key_s, column) for column in values.T] for values in (at_m, xyzw)]
        T = placed.path[0].T_world_object[frame]
        np.testing.assert_allclose(moved[0], T[:3, 3], atol=1e-5)
        np.testing.assert_allclose(matrix_from_quaternion(np.roll(moved[1], 1)), T[:3, :3], atol=1e-5)
    node = reread.document.nodes[index]
    assert node.scale == [2.0] * 3
    assert node.extras["holds"] == [
        {"person_id": 1, "hand": "right hand", "start_s": motion.frame_time_s[6], "end_s": motion.frame_time_s[18]}
    ]
    write_scene_glb(tmp_path / "alone.glb", (), scene)
    assert Reread(tmp_path / "alone.glb").document.animations == []


def test_strongest_influences_keep_order_and_sum() -> None:
    weights = np.array([[0.1, 0.3, 0.2, 0.15, 0.25], [0.0, 1.0, 0.0, 0.0, 0.0]])
    index, weight = strongest_influences(weights)
    np.testing.assert_array_equal(index, [[1, 4, 2, 3], [1, 0, 0, 0]])
    np.testing.assert_allclose(weight, [np.array([0.3, 0.25, 0.2, 0.15]) / 0.9, [1, 0, 0, 0]])
