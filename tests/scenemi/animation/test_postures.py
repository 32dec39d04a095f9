"""Objects by name and postures at them: where the body is, what it touches, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from scenemi.animation.named_objects import NamedObject, object_by_name, read_objects
from scenemi.animation.partial_file import PostureWish
from scenemi.animation.postures import Posture, place, settled
from scenemi.data.scene_file import read_scene
from scenemi.postprocess.skin import skin_of
from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.grid import distance_grid
from scenemi.scene.scene_parts import geometry_of
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.export.glb import write_scene_glb
from video2anim.geometry.scene_mesh import box_mesh, joined
from video2anim.types import Mesh, ObjectPart, PlacedObject, RoomPiece
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

BODY = shaped_body(BodyShape("anny", dict(ADULT)))
FLOOR = Mesh(np.array([[-3.0, 0, 3], [3, 0, 3], [3, 0, -3]]), np.array([[0, 1, 2]]), np.zeros((3, 3), np.uint8))


class Room:
    """What is written to the file."""

    def __init__(self, *objects: PlacedObject) -> None:
        self.objects, self.floor, self.background = objects, RoomPiece("floor", FLOOR), ()


def furniture(
    number: int, label: str, x_m: float, *parts: tuple[str, tuple[float, float, float], float]
) -> PlacedObject:
    """An object at (x, 0) whose front is +X. Parts have a name, sizes across, up and to the front, and a height."""
    T = np.array([[0.0, 0, 1, x_m], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    meshes = []
    for _, size_m, y_m in parts:
        box = box_mesh(*size_m)
        meshes.append(Mesh(box.vertices_m + np.array([0, y_m, 0]), box.faces, box.vertex_rgb))
    named = tuple(ObjectPart(name, 12 * k, 12) for k, (name, _, _) in enumerate(parts))
    return PlacedObject(number, label, joined(meshes), 1.0, T, None, None, True, "", parts=named)


@pytest.fixture
def room(tmp_path: Path) -> Path:
    write_scene_glb(
        tmp_path / "scene.glb", (),
        Room(
            furniture(1, "chair", 0.0, ("seat", (0.45, 0.05, 0.42), 0.4), ("back", (0.45, 0.9, 0.02), 0.0)),
            furniture(2, "table", 2.5, ("top", (1.2, 0.03, 0.8), 0.72)),
            furniture(3, "shelf", -2.5, ("board", (0.8, 0.03, 0.3), 1.6)),
            furniture(4, "bar stool", 5.0, ("seat", (0.36, 0.05, 0.36), 0.65)),
            furniture(5, "chair", 7.0, ("seat", (0.45, 0.05, 0.42), 0.4)),
        ),
    )  # fmt: skip
    return tmp_path


def at_object(room: Path, **wish: object) -> tuple[Posture, np.ndarray, SceneGeometry]:
    """A posture after the solve, its joints, and the solids."""
    objects = read_objects(room / "scene.glb")
    scene = geometry_of(read_scene(room).parts, np.array([[0.0, 1.5, 0.0]]))
    posture = settled(place(PostureWish(frame=0, **wish), objects, BODY, "file"), BODY, scene, "file")  # type: ignore[arg-type]
    joints_m, _ = forward_kinematics(posture.R_parent_joint, posture.translation_m, BODY.rest_joints_m)
    return posture, joints_m, scene


def depth_m(posture: Posture, scene: SceneGeometry) -> float:
    """How deep the skin is in solids, to 1 cm."""
    joints_m, R_world = forward_kinematics(posture.R_parent_joint, posture.translation_m, BODY.rest_joints_m)
    skin_m = skin_of(BODY).at(joints_m[None], R_world[None])[0]
    field = distance_grid(scene, skin_m.min(0) - 0.1, skin_m.max(0) + 0.1, 0.02)
    return -float(field.sample(skin_m).min())


@pytest.mark.parametrize(("name", "height_m", "x_m"), [("chair_1", 0.45, 0.0), ("bar_stool_4", 0.70, 5.0)])
def test_a_body_sits_on_a_seat_and_faces_its_front(name: str, height_m: float, x_m: float, room: Path) -> None:
    posture, joints_m, scene = at_object(room, sit_on=name)
    pelvis, knee, ankle = (joints_m[JOINT_INDEX[joint]] for joint in ("pelvis", "left_knee", "left_ankle"))
    assert 0.06 < pelvis[1] - height_m < 0.2
    assert abs(pelvis[0] - x_m) < 0.2
    assert abs(pelvis[2]) < 0.08
    assert knee[0] - pelvis[0] > (0.25 if height_m < 0.5 else 0.1), "the knees are on the side of the front, +X"
    assert posture.R_parent_joint[0, 0, 2] > 0.9
    assert ankle[1] < (0.12 if height_m < 0.5 else 0.35)
    assert depth_m(posture, scene) <= 0.02


def test_a_hand_lies_on_the_table_before_which_the_body_stands(room: Path) -> None:
    posture, joints_m, scene = at_object(room, hand_on="table_2", hand="left")
    wrist = joints_m[JOINT_INDEX["left_wrist"]]
    assert wrist[1] == pytest.approx(0.78, abs=0.03)
    assert 2.1 < wrist[0] < 2.9
    assert joints_m[0, 0] > 2.9, "before its front, +X"
    assert posture.R_parent_joint[0, 0, 2] < -0.8, "and faces it"
    assert depth_m(posture, scene) <= 0.02


def test_standing_by_heading(room: Path) -> None:
    posture, joints_m, _ = at_object(room, stand_at=(1.0, 1.2), heading_deg=90)
    np.testing.assert_allclose(posture.translation_m[[0, 2]], [1.0, 1.2], atol=0.02)
    assert posture.R_parent_joint[0, 0, 2] > 0.95
    assert joints_m[JOINT_INDEX["left_hip"], 2] < joints_m[JOINT_INDEX["right_hip"], 2]


def test_names(room: Path) -> None:
    objects = read_objects(room / "scene.glb")
    assert [one.name for one in objects] == ["chair_1", "table_2", "shelf_3", "bar_stool_4", "chair_5"]
    assert object_by_name(objects, "table", "file").name == "table_2"
    with pytest.raises(Exception, match="file: no object 'sofa' in the scene; it has chair_1, table_2, shelf_3"):
        object_by_name(objects, "sofa", "file")
    with pytest.raises(Exception, match="more than one object 'chair'"):
        object_by_name(objects, "chair", "file")
    with pytest.raises(Exception, match=r"shelf_3 has no seat, nothing level 0\.2 to 0\.8 m .*parts: board"):
        object_by_name(objects, "shelf", "file").seat()


def test_meshes_of_other_programs_have_the_names_of_their_nodes(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    move = trimesh.transformations.translation_matrix((1.0, 0.2, 0.0))
    scene.add_geometry(trimesh.creation.box((0.5, 0.4, 0.5), move), node_name="crate", geom_name="crate")
    scene.export(tmp_path / "room.glb")
    (crate,) = read_objects(tmp_path / "room.glb")
    assert isinstance(crate, NamedObject)
    assert crate.name == "crate"
    np.testing.assert_allclose(crate.seat()[..., 1], 0.4, atol=1e-6)
    with pytest.raises(Exception, match="want a scene whose objects have names"):
        read_objects(tmp_path / "room.ply")
