"""glTF 2.0 binary files: the whole scene with skinned, animated people, and single objects.

Meters, +Y up, 30 fps, which are glTF's own conventions; cameras are turned from OpenCV's axes to glTF's.

Each person is one skin over 22 joint nodes named in SMPL order. Without animation they stand in the T-pose; their
frames have y along the limb, so that programs that show bones draw them along limbs. The skin is bound in the body
model's own pose (an A-pose for Anny), in which it is exact. Joint rotations are linear (slerp) channels.
Vertices keep their four strongest joints, so a skinned vertex differs slightly from the body model's.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pygltflib as gltf

from video2anim import __version__
from video2anim.export.character import Character, Rig
from video2anim.export.frames import (
    is_still,
    linear_from_srgb,
    needed_keys,
    opengl_camera_poses,
    vertical_fov_rad,
)
from video2anim.export.gltf_buffer import GltfBuffer
from video2anim.geometry.projection import NEAR_M
from video2anim.geometry.rotations import continuous_quaternions, quaternion_from_matrix
from video2anim.geometry.vertex_normals import vertex_normals
from video2anim.types import BodyMotion, Contact, Hold, Mesh, PlacedObject, RoomPiece, Texture
from video2anim.types.skeleton import JOINT_NAMES, PARENTS
from video2anim.viewer.bodies import PERSON_RGB


class SceneMeshes(Protocol):
    """What `write_scene_glb` needs of a scene; a `SceneModel` has it."""

    @property
    def objects(self) -> tuple[PlacedObject, ...]: ...
    @property
    def floor(self) -> RoomPiece: ...
    @property
    def background(self) -> tuple[RoomPiece, ...]: ...


SKIN_RGB = PERSON_RGB[0]
FAR_M = 1000.0
"""Clipping range of cameras."""
_UNLIT = "KHR_materials_unlit"


def write_scene_glb(
    path: Path,
    characters: tuple[Character, ...],
    scene: SceneMeshes | None,
    *,
    camera: bool = True,
    joint_names: tuple[str, ...] = JOINT_NAMES,
    contacts: Sequence[Contact] = (),
) -> None:
    """Write people, objects, floor, background and camera to one `.glb`.

    Args:
        path: File to make.
        characters: People, main person first; the camera is the one their motions carry.
        scene: Objects and room, or None for people alone. Objects that somebody moves are animated in the time of the
            people; without people they stay where they are at first.
        camera: Whether to write the filming camera.
        joint_names: Names of the 22 joint nodes, in SMPL order.
        contacts: What the people touch; each person's are in the extras of their node.
    """
    writer = _GlbWriter(joint_names)
    if scene is not None:
        writer.add_piece(scene.floor, unlit=False)
        for piece in scene.background:
            writer.add_piece(piece, unlit=True)
        time_s = characters[0].motion.frame_time_s if characters else None
        for placed in scene.objects:
            writer.add_object(placed, np.asarray(placed.T_world_object), time_s)
    for character in characters:
        writer.add_character(character, [one for one in contacts if one.person_id == character.motion.person_id])
    if characters and camera:
        writer.add_camera(characters[0].motion)
    writer.save(path)


def write_object_glb(path: Path, placed: PlacedObject) -> None:
    """Write one object in meters in its own frame (resting on y = 0), not animated; its world pose, in the first frame
    where somebody moves it, is in the node's extras."""
    writer = _GlbWriter()
    writer.add_object(placed, np.eye(4))
    writer.save(path)


def object_name(placed: PlacedObject) -> str:
    """Node name of an object: its number and label, in letters, digits and underscores."""
    return plain_name(f"object_{placed.object_id}_{placed.label}")


def plain_name(text: str) -> str:
    """A text in letters, digits and underscores."""
    return re.sub(r"\W+", "_", text, flags=re.ASCII)


class _GlbWriter:
    def __init__(self, joint_names: tuple[str, ...] = JOINT_NAMES) -> None:
        self.joint_names = joint_names
        self.document = gltf.GLTF2(
            asset=gltf.Asset(version="2.0", generator=f"video2anim {__version__}"),
            scene=0,
        )
        self.roots: list[int] = []
        self.buffer = GltfBuffer(self.document)
        self.animation = gltf.Animation(name="motion", channels=[], samplers=[])
        self.materials: dict[str, int] = {}
        self.time_accessors: dict[bytes, int] = {}

    def add_mesh(
        self, name: str, mesh: Mesh, *, unlit: bool, T: np.ndarray | None = None, scale: float = 1.0
    ) -> int | None:
        """Static mesh with vertex colors as its own node; None where it has no faces."""
        if len(mesh.faces) == 0:
            return None
        vertices_m = np.asarray(mesh.vertices_m, np.float64)
        alpha = np.full((len(vertices_m), 1), 1.0)
        rgba = np.concatenate([linear_from_srgb(mesh.vertex_rgb), alpha], 1)
        rgba_uint16 = np.rint(rgba * np.iinfo(np.uint16).max).astype(np.uint16)
        attributes = gltf.Attributes(
            POSITION=self.buffer.add(vertices_m, target=gltf.ARRAY_BUFFER, bounds=True),
            NORMAL=self.buffer.add(vertex_normals(vertices_m, mesh.faces), target=gltf.ARRAY_BUFFER),
            COLOR_0=self.buffer.add(rgba_uint16, target=gltf.ARRAY_BUFFER, normalized=True),
        )
        mesh_index = self._add_primitive(name, attributes, mesh.faces, self._material("photo" if unlit else "matte"))
        node = gltf.Node(name=name, mesh=mesh_index)
        if T is not None:
            _set_pose(node, T)
            node.scale = [float(scale)] * 3
        return self._add_root(node)

    def add_piece(self, piece: RoomPiece, *, unlit: bool) -> None:
        """A part of the room with its picture or vertex colors; the corners of its openings are in the extras."""
        name = plain_name(piece.name)
        if piece.textures and len(piece.mesh.faces):
            index = self._add_textured(name, piece.mesh, piece.textures[0], np.eye(4), 1.0, unlit=unlit)
        else:
            index = self.add_mesh(name, piece.mesh, unlit=unlit)
        if index is not None and piece.openings:
            self.document.nodes[index].extras = {"openings": [corners_m.tolist() for corners_m in piece.openings]}

    def add_object(self, placed: PlacedObject, T: np.ndarray, time_s: np.ndarray | None = None) -> None:
        """An object at a pose; where it is moved and the times of the clip's frames are given, along its path."""
        if placed.textures:
            index = self._add_textured(object_name(placed), placed.mesh, placed.textures[0], T, placed.scale)
        else:
            index = self.add_mesh(object_name(placed), placed.mesh, unlit=False, T=T, scale=placed.scale)
        if index is None:
            return
        extras = {
            "object_id": int(placed.object_id),
            "label": placed.label,
            "trusted": bool(placed.trusted),
            "parts": [asdict(part) for part in placed.parts],
            "T_world_object": np.asarray(placed.T_world_object, float).tolist(),
        }
        if placed.path and time_s is not None:
            extras["holds"] = [_hold_extras(hold, time_s) for hold in placed.holds]
            self._animate_pose(time_s, index, np.asarray(placed.path[0].T_world_object))
        self.document.nodes[index].extras = extras

    def _add_textured(
        self, name: str, mesh: Mesh, texture: Texture, T: np.ndarray, scale: float, *, unlit: bool = False
    ) -> int:
        """Static mesh with a picture on it; flat faces, so every corner is a vertex of its own."""
        corners_m = mesh.vertices_m.astype(np.float64)[mesh.faces]
        normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        target = gltf.ARRAY_BUFFER
        attributes = gltf.Attributes(
            POSITION=self.buffer.add(corners_m.reshape(-1, 3), target=target, bounds=True),
            NORMAL=self.buffer.add(np.repeat(normals, 3, axis=0), target=target),
            TEXCOORD_0=self.buffer.add(texture.corner_uv.reshape(-1, 2), target=target),
        )
        sampler = gltf.Texture(source=self.buffer.add_png(texture.image_rgb))
        self.document.textures.append(sampler)
        picture = gltf.TextureInfo(index=len(self.document.textures) - 1)
        surface = gltf.PbrMetallicRoughness(baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=0.7)
        material = gltf.Material(name=f"{name}_photo", pbrMetallicRoughness=surface)
        if unlit:
            self._set_unlit(material)
        self.document.materials.append(material)
        corner = np.arange(3 * len(mesh.faces)).reshape(-1, 3)
        index = self._add_primitive(name, attributes, corner, len(self.document.materials) - 1)
        node = gltf.Node(name=name, mesh=index)
        _set_pose(node, T)
        node.scale = [float(scale)] * 3
        return self._add_root(node)

    def add_character(self, character: Character, contacts: Sequence[Contact] = ()) -> None:
        motion = character.motion
        rig = character.rig()
        joints = self._add_joints(rig)
        target = gltf.ARRAY_BUFFER
        attributes = gltf.Attributes(
            POSITION=self.buffer.add(character.vertices_m, target=target, bounds=True),
            NORMAL=self.buffer.add(character.normals, target=target),
            JOINTS_0=self.buffer.add(character.joint_index.astype(np.uint8), target=target),
            WEIGHTS_0=self.buffer.add(character.joint_weight, target=target),
        )
        name = f"person_{motion.person_id}"
        mesh = self._add_primitive(f"{name}_body", attributes, character.faces, self._material("skin"))
        inverse_bind = self.buffer.add(rig.inverse_bind)
        self.document.skins.append(
            gltf.Skin(name=f"{name}_skin", joints=joints, skeleton=joints[0], inverseBindMatrices=inverse_bind)
        )
        self._add_root(gltf.Node(name=f"{name}_body", mesh=mesh, skin=len(self.document.skins) - 1))
        armature = gltf.Node(name=name, children=[joints[0]])
        armature.extras = {
            "person_id": int(motion.person_id),
            "frames_without_measurement": np.flatnonzero(~motion.valid).tolist(),
            "shape": {"model": motion.shape.model, "parameters": motion.shape.parameters},
        }
        if contacts:
            armature.extras["contacts"] = [_contact_extras(contact) for contact in contacts]
        self._add_root(armature)
        self._animate(motion.frame_time_s, joints[0], "translation", character.root_translation_m)
        xyzw = np.roll(rig.rotations_wxyz, -1, axis=-1)
        for joint, node in enumerate(joints):
            self._animate(motion.frame_time_s, node, "rotation", xyzw[:, joint])

    def add_camera(self, motion: BodyMotion) -> None:
        intrinsics = motion.intrinsics
        lens = gltf.Perspective(
            yfov=vertical_fov_rad(intrinsics),
            aspectRatio=(intrinsics.width_px / intrinsics.fx_px) / (intrinsics.height_px / intrinsics.fy_px),
            znear=NEAR_M,
            zfar=FAR_M,
        )
        self.document.cameras.append(gltf.Camera(name="camera", type="perspective", perspective=lens))
        poses = opengl_camera_poses(motion.T_world_camera)
        node = gltf.Node(name="camera", camera=len(self.document.cameras) - 1)
        _set_pose(node, poses[0])
        index = self._add_root(node)
        self._animate_pose(motion.frame_time_s, index, poses)

    def save(self, path: Path) -> None:
        if self.animation.channels:
            self.document.animations.append(self.animation)
        self.document.scenes.append(gltf.Scene(name="scene", nodes=self.roots))
        self.buffer.finish()
        path.write_bytes(b"".join(self.document.save_to_bytes()))

    def _add_joints(self, rig: Rig) -> list[int]:
        first = len(self.document.nodes)
        for joint, name in enumerate(self.joint_names):
            children = [first + int(child) for child in np.flatnonzero(joint == PARENTS)]
            xyzw = np.roll(rig.rest_wxyz[joint], -1).tolist()
            offset_m = rig.offsets_m[joint].tolist()
            self.document.nodes.append(gltf.Node(name=name, translation=offset_m, rotation=xyzw, children=children))
        return list(range(first, first + len(self.joint_names)))

    def _add_primitive(self, name: str, attributes: gltf.Attributes, faces: np.ndarray, material: int) -> int:
        indices = self.buffer.add(faces.reshape(-1).astype(np.uint32), target=gltf.ELEMENT_ARRAY_BUFFER)
        primitive = gltf.Primitive(attributes=attributes, indices=indices, material=material, mode=gltf.TRIANGLES)
        self.document.meshes.append(gltf.Mesh(name=name, primitives=[primitive]))
        return len(self.document.meshes) - 1

    def _add_root(self, node: gltf.Node) -> int:
        self.document.nodes.append(node)
        index = len(self.document.nodes) - 1
        self.roots.append(index)
        return index

    def _animate_pose(self, time_s: np.ndarray, node: int, T_world_node: np.ndarray) -> None:
        """Channels of a node that moves, with the keys that it needs; none where it is still."""
        if is_still(T_world_node):
            return
        keys = needed_keys(T_world_node)
        wxyz = continuous_quaternions(quaternion_from_matrix(T_world_node[keys, :3, :3]))
        self._animate(time_s[keys], node, "translation", T_world_node[keys, :3, 3])
        self._animate(time_s[keys], node, "rotation", np.roll(wxyz, -1, axis=-1))

    def _animate(self, time_s: np.ndarray, node: int, path: str, values: np.ndarray) -> None:
        key = np.asarray(time_s, np.float32).tobytes()
        if key not in self.time_accessors:
            self.time_accessors[key] = self.buffer.add(np.asarray(time_s, np.float32), bounds=True)
        sampler = gltf.AnimationSampler(
            input=self.time_accessors[key], output=self.buffer.add(values), interpolation="LINEAR"
        )
        self.animation.samplers.append(sampler)
        target = gltf.AnimationChannelTarget(node=node, path=path)
        self.animation.channels.append(gltf.AnimationChannel(sampler=len(self.animation.samplers) - 1, target=target))

    def _set_unlit(self, material: gltf.Material) -> None:
        material.extensions = {_UNLIT: {}}
        if _UNLIT not in self.document.extensionsUsed:
            self.document.extensionsUsed.append(_UNLIT)

    def _material(self, name: str) -> int:
        """Index of a shared material: `skin`, `matte` (lit vertex colors) or `photo` (colors hold the light;
        seen from its front alone, so that a wall or ceiling hides nothing from behind)."""
        if name not in self.materials:
            rgba = [*linear_from_srgb(np.array(SKIN_RGB)).tolist(), 1.0] if name == "skin" else [1.0] * 4
            surface = gltf.PbrMetallicRoughness(baseColorFactor=rgba, metallicFactor=0.0, roughnessFactor=0.7)
            material = gltf.Material(name=name, pbrMetallicRoughness=surface, doubleSided=name == "matte")
            if name == "photo":
                self._set_unlit(material)
            self.document.materials.append(material)
            self.materials[name] = len(self.document.materials) - 1
        return self.materials[name]


def _contact_extras(contact: Contact) -> dict[str, Any]:
    """A contact without its person, whose node it is at; that with the floor has no `object_id`, since Blender's
    properties hold no null."""
    return {name: value for name, value in asdict(contact).items() if name != "person_id" and value is not None}


def _hold_extras(hold: Hold, time_s: np.ndarray) -> dict[str, Any]:
    """A stretch in which somebody has the object in hand, in the times of contacts."""
    start_s, end_s = (float(time_s[frame]) for frame in (hold.first_frame, hold.last_frame))
    return {"person_id": int(hold.person_id), "hand": hold.hand, "start_s": start_s, "end_s": end_s}


def _set_pose(node: gltf.Node, T: np.ndarray) -> None:
    wxyz = quaternion_from_matrix(np.asarray(T, np.float64)[None, :3, :3])[0]
    node.translation = np.asarray(T, np.float64)[:3, 3].tolist()
    node.rotation = np.roll(wxyz, -1).tolist()
