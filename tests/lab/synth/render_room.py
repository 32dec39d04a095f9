"""A small furnished room of boxes, and people in it, for the renderer's tests and benchmark."""

from __future__ import annotations

import numpy as np
import trimesh

from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.lab.synth.appearance import make_appearance
from video2anim.lab.synth.world import Actor, Light, Material, Part, Room, SceneObject, SensorModel, Shot
from video2anim.types import BodyMotion, BodyShape, Intrinsics
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

HEIGHT_M, HALF_M = 2.6, 2.4


def box(size: tuple[float, float, float], at: tuple[float, float, float], material: Material) -> Part:
    """A box by size and center."""
    mesh = trimesh.creation.box(size)
    return Part(np.asarray(mesh.vertices) + at, np.asarray(mesh.faces), material)


def at(x: float, z: float, y: float = 0.0, yaw_rad: float = 0.0) -> np.ndarray:
    """Pose on the floor."""
    T = np.eye(4)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = x, y, z
    return T


def make_room() -> Room:
    """4.8 x 4.8 m: planks, plaster, a brick wall, table, box, sofa, shelf, ball, rug, picture, lamp."""
    w, h, d = 2 * HALF_M, HEIGHT_M, 0.1
    plaster = Material("plaster", (0.86, 0.84, 0.79), stain=0.2)
    brick = Material("brick", (0.62, 0.33, 0.25), (0.75, 0.72, 0.68), 0.07)
    planks = Material("planks", (0.62, 0.44, 0.28), (0.42, 0.27, 0.15), 0.14, gloss=0.25)
    wood = Material("wood", (0.55, 0.36, 0.20), (0.33, 0.19, 0.10), 0.12, gloss=0.2, seed=3)
    white = Material("plain", (0.93, 0.93, 0.92))
    cloth = Material("fabric", (0.25, 0.36, 0.48), (0.18, 0.25, 0.36), 0.01)
    rug = Material("carpet", (0.60, 0.20, 0.18), (0.85, 0.75, 0.55), 0.25)
    art = Material("picture", (0.75, 0.55, 0.25), (0.15, 0.25, 0.45), 0.6, seed=5)
    lamp = Material("plain", (1.0, 0.93, 0.8), emission=3.0)
    ball = trimesh.creation.icosphere(3, 0.16)
    rubber = Material("plain", (0.85, 0.35, 0.10), gloss=0.6)
    structure = [
        SceneObject(1, "floor", (box((w, d, w), (0, -d / 2, 0), planks),), np.eye(4)),
        SceneObject(2, "wall", (box((w, h, d), (0, h / 2, 0), plaster),), at(0, -HALF_M - d / 2)),
        SceneObject(3, "wall", (box((d, h, w), (0, h / 2, 0), brick),), at(-HALF_M - d / 2, 0)),
        SceneObject(4, "wall", (box((d, h, w), (0, h / 2, 0), plaster),), at(HALF_M + d / 2, 0)),
        SceneObject(5, "wall", (box((w, h, d), (0, h / 2, 0), plaster),), at(0, HALF_M + d / 2)),
        SceneObject(6, "ceiling", (box((w, d, w), (0, h + d / 2, 0), white),), np.eye(4)),
        SceneObject(7, "rug", (box((1.7, 0.012, 1.2), (0, 0.006, 0), rug),), at(0.2, 0.3)),
        SceneObject(8, "picture", (box((0.8, 0.55, 0.03), (0, 1.6, 0), art),), at(0.9, -HALF_M + 0.015)),
    ]
    legs = [box((0.05, 0.7, 0.05), (x, 0.35, z), wood) for x in (-0.5, 0.5) for z in (-0.3, 0.3)]
    sofa = [
        box((1.6, 0.42, 0.8), (0, 0.21, 0), cloth),
        box((1.6, 0.4, 0.2), (0, 0.62, -0.3), cloth),
        box((0.2, 0.2, 0.8), (-0.7, 0.52, 0), cloth),
        box((0.2, 0.2, 0.8), (0.7, 0.52, 0), cloth),
    ]
    boards = [box((0.9, 0.03, 0.3), (0, y, 0), wood) for y in (0.05, 0.5, 0.95, 1.4, 1.8)]
    sides = [box((0.03, 1.82, 0.3), (x, 0.91, 0), wood) for x in (-0.45, 0.45)]
    furniture = [
        SceneObject(10, "table", (box((1.1, 0.04, 0.7), (0, 0.72, 0), wood), *legs), at(-1.3, -0.9)),
        SceneObject(11, "sofa", tuple(sofa), at(1.3, -1.6, yaw_rad=-0.25)),
        SceneObject(12, "shelf", (*boards, *sides), at(-0.4, -2.2)),
        SceneObject(
            13, "toy", (Part(ball.vertices + np.array([0, 0.16, 0]), ball.faces, rubber, smooth=True),), at(-0.9, 0.5)
        ),
        SceneObject(14, "lamp", (box((0.3, 0.06, 0.3), (0, 0.03, 0), lamp),), at(0.3, 0.2, h - 0.06)),
        SceneObject(15, "box", (box((0.4, 0.4, 0.4), (0, 0.2, 0), white),), at(1.4, 0.6, yaw_rad=0.5)),
    ]
    lights = (
        Light((0.3, h - 0.1, 0.2), (2.6, 2.4, 2.1), 0.15),
        Light((-1.8, 1.9, 1.6), (1.0, 0.95, 0.9), 0.12),
    )
    bounds = (-HALF_M, HALF_M, -HALF_M, HALF_M)
    return Room(bounds, h, tuple(structure), tuple(furniture), lights, (0.42, 0.43, 0.45))


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    """T_world_camera of a level camera."""
    forward = np.subtract(target, eye)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    T[:3, 3] = eye
    return T


def standing(
    frames: int,
    intrinsics: Intrinsics,
    T_world_camera: np.ndarray,
    *,
    person_id: int = 0,
    x: float = 0.0,
    z: float = 0.3,
    step_m: float = 0.02,
    seed: int = 0,
    **phenotype: float,
) -> Actor:
    """A person who stands with the arms down and glides along x."""
    shape = BodyShape("anny", {**ADULT, **phenotype})
    body = shaped_body(shape)
    R = np.tile(np.eye(3), (frames, 22, 1, 1))
    for side, sign in (("left", -1), ("right", 1)):
        c, s = np.cos(1.2), np.sin(1.2) * sign
        R[:, JOINT_INDEX[f"{side}_shoulder"]] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        swing = np.sin(np.arange(frames) * 0.2 + seed) * 0.35 * sign
        c, s = np.cos(swing), np.sin(swing)
        R[:, JOINT_INDEX[f"{side}_hip"], 1, 1] = R[:, JOINT_INDEX[f"{side}_hip"], 2, 2] = c
        R[:, JOINT_INDEX[f"{side}_hip"], 2, 1] = s
        R[:, JOINT_INDEX[f"{side}_hip"], 1, 2] = -s
    sole = float(body.rest_vertices_m[:, 1].min()) - 0.003
    translation = np.stack([x + step_m * np.arange(frames), np.full(frames, -sole), np.full(frames, z)], 1)
    joints, _ = forward_kinematics(R, translation, body.rest_joints_m)
    T_world_root = np.tile(np.eye(4), (frames, 1, 1))
    T_world_root[:, :3, 3] = translation
    motion = BodyMotion(
        person_id,
        np.arange(frames) / 30,
        np.ones(frames, bool),
        T_world_root,
        R,
        T_world_camera,
        intrinsics,
        np.zeros((frames, 22)),
        shape,
        body.rest_joints_m,
        joints,
    )
    face_material, materials = make_appearance(body, np.random.default_rng(seed))
    return Actor(motion, face_material, materials)


def make_shot(
    width_px: int = 320,
    height_px: int = 240,
    *,
    frames: int = 4,
    people: int = 1,
    handheld: bool = False,
    sensor: SensorModel | None = None,
) -> Shot:
    """A view of the room with up to two people."""
    intrinsics = Intrinsics.centered(0.85 * width_px, width_px, height_px)
    poses = np.tile(look_at((0.9, 1.5, 2.3), (-0.1, 0.85, -0.6)), (frames, 1, 1))
    if handheld:
        for t in range(frames):
            poses[t] = look_at((0.9 + 0.01 * t, 1.5 + 0.004 * t, 2.3), (-0.1 + 0.012 * t, 0.85, -0.6))
    actors = [
        standing(frames, intrinsics, poses, person_id=n, x=0.1 - 0.6 * n, z=0.2 - 0.6 * n, seed=n, gender=1.0 - n)
        for n in range(people)
    ]
    model = SensorModel() if sensor is None else sensor
    return Shot("test", make_room(), tuple(actors), intrinsics, poses, not handheld, model)
