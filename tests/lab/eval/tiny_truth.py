"""A tiny world with known truth, written as a truth folder, and the scene folder of a pipeline that makes no error.

Room: floor, four walls, two boxes as furniture. One or two persons walk on straight lines with swinging limbs. The
camera is fixed. Maps are 96 x 72, the clip 384 x 288. The estimated world is the true one turned and shifted, as a
pipeline would have it.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from video2anim.artifacts.codec import write_value
from video2anim.artifacts.folder import folder_digest
from video2anim.artifacts.images import write_png
from video2anim.artifacts.manifest import Manifest
from video2anim.artifacts.motion_io import write_motion
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.cli.compose import pipeline_nodes
from video2anim.geometry.projection import pixel_rays, project, transform_points
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.geometry.scene_mesh import empty_mesh
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
from video2anim.pipeline.scene_folder import RunRecord, write_record
from video2anim.types import (
    BackgroundImage,
    BodyMotion,
    BodyShape,
    BodyTracks,
    CameraEstimate,
    CompletedObject,
    CompletedObjects,
    DepthClip,
    InstanceMasks,
    Intrinsics,
    KeyframedMotion,
    Mesh,
    MetricDepth,
    ObjectInstance,
    ObjectMesh,
    ObjectMeshes,
    PayloadFile,
    PersonTrack,
    PersonTracks,
    PlacedObject,
    PlacedObjects,
    RefinedMotion,
    RoomPiece,
    SceneModel,
    SourceInfo,
    VideoClip,
)
from video2anim.types.skeleton import FEET, forward_kinematics

FPS = 30
FRAMES = 40
STRIDE = 5
CLIP = (384, 288)
MAP = (96, 72)
ROOM = (-2.5, 2.5, -4.0, 1.0)
"""x0, x1, z0, z1."""
FLOOR_ID, WALL_ID, TABLE_ID, BOX_ID = 1, 2, 3, 4
TURN = np.array(
    [[np.cos(0.6), 0, np.sin(0.6), 1.3], [0, 1, 0, 0], [-np.sin(0.6), 0, np.cos(0.6), -0.4], [0, 0, 0, 1.0]]
)
"""T_estimated_true: the estimated world against the true one."""
STAGES = {
    VideoClip: "01_ingest", PersonTracks: "02_track", CameraEstimate: "03_camera", BodyTracks: "04_humans",
    BackgroundImage: "05_background", DepthClip: "06_depth", InstanceMasks: "07_segment", MetricDepth: "08_metric",
    CompletedObjects: "09_complete", ObjectMeshes: "10_reconstruct", PlacedObjects: "11_place", SceneModel: "12_scene",
    KeyframedMotion: "13_keyframes", RefinedMotion: "14_refine",
}  # fmt: skip


@dataclass(frozen=True)
class TinyBox:
    """Furniture: a box that stands on the floor."""

    object_id: int
    label: str
    size_m: tuple[float, float, float]
    center_xz_m: tuple[float, float]

    @property
    def pose(self) -> np.ndarray:
        T_world_object = np.eye(4)
        T_world_object[[0, 2], 3] = self.center_xz_m
        return T_world_object

    def mesh(self) -> Mesh:
        box = trimesh.creation.box(extents=self.size_m)
        vertices = np.asarray(box.vertices) + np.array([0, 0.5 * self.size_m[1], 0])
        return Mesh(vertices, np.asarray(box.faces, np.int64), np.full((len(vertices), 3), 120, np.uint8))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        half = 0.5 * np.array(self.size_m)
        center = np.array([self.center_xz_m[0], half[1], self.center_xz_m[1]])
        return center - half, center + half


BOXES = (
    TinyBox(TABLE_ID, "table", (1.0, 0.7, 0.6), (1.5, -2.2)),
    TinyBox(BOX_ID, "box", (0.6, 0.9, 0.5), (-1.3, -3.0)),
)


def shape() -> BodyShape:
    return BodyShape("anny", dict(ADULT))


def intrinsics() -> Intrinsics:
    return Intrinsics.centered(300.0, *CLIP)


def camera_pose(pitch_deg: float = 12.0) -> np.ndarray:
    """T_world_camera: at 1.6 m, looks along -z and down."""
    pitch = np.deg2rad(pitch_deg)
    level = np.diag([1.0, -1.0, -1.0])
    down = np.array([[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]])
    T = np.eye(4)
    T[:3, :3] = level @ down
    T[:3, 3] = (0.0, 1.6, 1.0)
    return T


def walk(person_id: int = 0, x_m: float = -0.9, z_m: float = -2.3, speed_m_s: float = 0.9) -> BodyMotion:
    """A body that glides along +x with swinging limbs; the soles stay on the floor. Feet alternate in contact."""
    body = shaped_body(shape())
    time_s = np.arange(FRAMES) / FPS
    swing = np.zeros((FRAMES, 22, 3))
    for joint, sign in ((1, 1), (2, -1), (16, -1), (17, 1)):
        swing[:, joint, 0] = sign * 0.3 * np.sin(2 * np.pi * time_s)
    swing[:, 16, 2], swing[:, 17, 2] = -1.1, 1.1
    swing[:, 0, 1] = 0.5 * np.pi
    R_parent_joint = matrix_from_axis_angle(swing)
    root_m = np.stack([x_m + speed_m_s * time_s, np.zeros(FRAMES), np.full(FRAMES, z_m)], -1)
    joints_m, R_world_joint = forward_kinematics(R_parent_joint, root_m, body.rest_joints_m)
    lowest = body.vertices(R_world_joint, joints_m)[..., 1].min(1)
    root_m[:, 1] -= lowest
    contact = np.zeros((FRAMES, 22))
    contact[:, [FEET[0], FEET[2]]] = (np.arange(FRAMES) // 10 % 2 == 0)[:, None]
    contact[:, [FEET[1], FEET[3]]] = (np.arange(FRAMES) // 10 % 2 == 1)[:, None]
    blank = BodyMotion(
        person_id, time_s, np.ones(FRAMES, bool), np.tile(np.eye(4), (FRAMES, 1, 1)), R_parent_joint,
        np.tile(camera_pose(), (FRAMES, 1, 1)), intrinsics(), contact, shape(), body.rest_joints_m, joints_m,
    )  # fmt: skip
    return blank.with_pose(translation_world_m=root_m, R_parent_joint=R_parent_joint)


@dataclass(frozen=True, eq=False)
class Tiny:
    """The tiny world; everything else follows from it."""

    people: tuple[BodyMotion, ...] = field(default_factory=lambda: (walk(),))
    boxes: tuple[TinyBox, ...] = BOXES

    def maps(self, frame: int | None) -> tuple[np.ndarray, np.ndarray]:
        """Depth and instance at the size of the maps; None = without people. People are drawn as upright boxes."""
        solids = [(box.object_id, *box.bounds()) for box in self.boxes]
        if frame is not None:
            for person in self.people:
                joints = person.joints_world_m[frame]
                solids.append((1000 + person.person_id, joints.min(0) - 0.05, joints.max(0) + 0.05))
        return trace(solids, Intrinsics.resized(intrinsics(), *MAP))

    def amodal(self, box: TinyBox) -> np.ndarray:
        _, instance = trace([(box.object_id, *box.bounds())], Intrinsics.resized(intrinsics(), *MAP))
        return instance == box.object_id


def trace(solids: list[tuple[int, np.ndarray, np.ndarray]], lens: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """z-depth and instance by intersecting every pixel's ray with floor, walls and axis-aligned boxes."""
    T = camera_pose()
    ray, origin = pixel_rays(lens) @ T[:3, :3].T, T[:3, 3]
    depth = np.full(ray.shape[:2], np.inf)
    instance = np.zeros(ray.shape[:2], np.int64)
    with np.errstate(divide="ignore", invalid="ignore"):
        planes = [(FLOOR_ID, np.where(ray[..., 1] < 0, -origin[1] / ray[..., 1], np.inf))]
        for axis, (low, high) in ((0, ROOM[:2]), (2, ROOM[2:])):
            side = np.where(ray[..., axis] > 0, high, low)
            planes.append((WALL_ID, np.where(ray[..., axis] != 0, (side - origin[axis]) / ray[..., axis], np.inf)))
        for number, low, high in solids:
            a, b = (low - origin) / ray, (high - origin) / ray
            near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
            planes.append((number, np.where((near <= far) & (near > 0), near, np.inf)))
    for number, hit in planes:
        hit = np.where(hit > 1e-9, hit, np.inf)
        instance = np.where(hit < depth, number, instance)
        depth = np.minimum(depth, hit)
    return depth, instance


def write_truth(folder: Path, tiny: Tiny, *, meta: Mapping[str, Any] | None = None) -> Path:
    """The truth folder in format 1."""
    (folder / "objects").mkdir(parents=True)
    index = np.arange(0, FRAMES, STRIDE)
    drawn = [tiny.maps(int(t)) for t in index]
    depth, instance = np.stack([d for d, _ in drawn]), np.stack([i for _, i in drawn])
    bare_depth, bare_instance = tiny.maps(None)
    numbers = np.array([FLOOR_ID, WALL_ID, *(box.object_id for box in tiny.boxes)])
    write_motion(folder / "main.npz", tiny.people[0])
    with np.load(folder / "main.npz", allow_pickle=False) as archive:
        arrays = dict(archive)
    (folder / "main.npz").unlink()
    T = tiny.people[0].T_world_camera
    arrays |= {
        "up_camera": T[:, 1, :3],
        "is_static": np.array(True),
        "label_frame_index": index,
        "depth_mm": np.rint(1000 * depth).astype(np.uint16),
        "instance": instance.astype(np.uint16),
        "background_depth_mm": np.rint(1000 * bare_depth).astype(np.uint16)[None],
        "background_instance": bare_instance.astype(np.uint16)[None],
        "object_id": numbers,
        "object_class": np.arange(len(numbers)),
        "object_visible_px": np.array([(bare_instance == n).sum() for n in numbers]),
        "amodal_object_id": np.array([box.object_id for box in tiny.boxes]),
        "amodal": np.stack([tiny.amodal(box) for box in tiny.boxes]),
        "person_box_px": np.stack([joint_boxes(person) for person in tiny.people]),
    }
    np.savez_compressed(folder / "truth.npz", allow_pickle=False, **arrays)
    for person in tiny.people[1:]:
        write_motion(folder / f"truth_{person.person_id}.npz", person)
    write_png(folder / "plate.png", background_rgb())
    (folder / "meta.json").write_text(json.dumps(truth_meta(folder, tiny) | dict(meta or {})))
    return folder


def truth_meta(folder: Path, tiny: Tiny) -> dict[str, Any]:
    """`meta.json`; writes the object files it names."""
    entries = []
    floor = Mesh(
        np.array([[-3, 0, -5], [3, 0, -5], [3, 0, 2], [-3, 0, 2.0]]),
        np.array([[0, 2, 1], [0, 3, 2]]), np.zeros((4, 3), np.uint8),
    )  # fmt: skip
    objects = [(FLOOR_ID, "floor", False, np.eye(4), floor), (WALL_ID, "wall", False, np.eye(4), floor)]
    objects += [(box.object_id, box.label, True, box.pose, box.mesh()) for box in tiny.boxes]
    for number, label, is_furniture, pose, mesh in objects:
        trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).export(folder / "objects" / f"{number}.glb")
        entries.append(
            {
                "object_id": number, "label": label, "is_furniture": is_furniture, "is_moving": False,
                "T_world_object": pose.tolist(), "file": f"objects/{number}.glb",
            }
        )  # fmt: skip
    return {
        "format_version": 1, "name": folder.name, "preset": "tiny", "seed": 0, "index": 0, "kind": "walk",
        "fps": FPS, "frames": FRAMES, "width_px": CLIP[0], "height_px": CLIP[1],
        "labels": ["none", "person", "floor", "wall", "table", "box"], "objects": entries,
        "persons": [{"person_id": person.person_id, "kind": "walk"} for person in tiny.people],
        "room": {"bounds_m": list(ROOM), "height_m": 2.6},
    }  # fmt: skip


def background_rgb() -> np.ndarray:
    return np.random.default_rng(5).integers(60, 200, (CLIP[1], CLIP[0], 3)).astype(np.uint8)


def joint_boxes(person: BodyMotion) -> np.ndarray:
    pixels = project(person.joints_camera_m, person.intrinsics)
    return np.concatenate([pixels.min(1), pixels.max(1)], -1)


def in_estimate(person: BodyMotion) -> BodyMotion:
    """The same motion told in the estimated world."""
    R_parent_joint = person.R_parent_joint.copy()
    R_parent_joint[:, 0] = TURN[:3, :3] @ R_parent_joint[:, 0]
    moved = replace(person, T_world_camera=TURN @ person.T_world_camera)
    root_m = transform_points(TURN, person.T_world_root[:, :3, 3])
    return moved.with_pose(translation_world_m=root_m, R_parent_joint=R_parent_joint)


def shifted(person: BodyMotion, offset_m: np.ndarray | list[float]) -> BodyMotion:
    """The motion at another place."""
    root_m = person.T_world_root[:, :3, 3] + np.asarray(offset_m)
    return person.with_pose(translation_world_m=root_m, R_parent_joint=person.R_parent_joint)


def people_edit(change: Callable[[BodyMotion], BodyMotion]) -> Callable[[Any], Any]:
    """An edit of a motion stage, person by person."""
    return lambda stage: replace(stage, people=tuple(change(person) for person in stage.people))


Edit = Mapping[type, Callable[[Any], Any]]


def write_scene(folder: Path, tiny: Tiny, *, edits: Edit | None = None, leave_out: tuple[type, ...] = ()) -> Path:
    """Scene folder of a pipeline without error; `edits` change the value of a stage before it is written."""
    (folder / "stages").mkdir(parents=True)
    write_record(folder, RunRecord("clip.mp4", "0" * 64, "embedded", 0, {}, {}))
    values = perfect_values(folder, tiny)
    for kind in STAGES:
        if kind not in leave_out:
            stage = folder / "stages" / STAGES[kind]
            stage.mkdir(exist_ok=True)
            write_value((edits or {}).get(kind, lambda same: same)(values[kind]), stage)
            write_manifest(folder, kind)
    return folder


def write_manifest(folder: Path, kind: type) -> None:
    """The manifest of a stage that has just run, on what is there of its inputs."""
    node = next(node for node in pipeline_nodes() if node.output is kind)
    inputs = {made: folder / "stages" / STAGES[made] for _, made in node.inputs if made in STAGES}
    digests = {made.__name__: folder_digest(path) for made, path in inputs.items() if path.is_dir()}
    stage = folder / "stages" / STAGES[kind]
    digest = folder_digest(stage)
    Manifest(node.name, 1, "0" * 64, {}, digests, {}, 0, digest, 1.0, 1.0, [], [], {}).write(stage)


def perfect_values(folder: Path, tiny: Tiny) -> dict[type, Any]:
    """What every stage would say if it knew the truth. Estimated persons have numbers from 1."""
    people = tuple(replace(in_estimate(p), person_id=p.person_id + 1) for p in tiny.people)
    values = _seen_values(folder, tiny) | _depth_values(tiny) | _object_values(tiny)
    keyframes = tuple(np.arange(0, FRAMES, 5) for _ in people)
    motions = {
        BodyTracks: BodyTracks(people),
        KeyframedMotion: KeyframedMotion(people, keyframes),
        RefinedMotion: RefinedMotion(
            people, ("scenemi",) * len(people), (1.0,) * len(people), people, values[SceneModel]
        ),
    }
    return values | motions


def _seen_values(folder: Path, tiny: Tiny) -> dict[type, Any]:
    ingest = folder / "stages" / STAGES[VideoClip]
    ingest.mkdir(parents=True, exist_ok=True)
    (ingest / "video.mp4").write_bytes(b"not looked at")
    time_s = np.arange(FRAMES) / FPS
    source = SourceInfo("h264", "yuv420p", *CLIP, 0, 1.0, 30.0, FRAMES, FRAMES, FRAMES / FPS, 0.0)
    clip = VideoClip(
        PayloadFile(ingest / "video.mp4"), *CLIP, 30.0, time_s, time_s, source, ((0.0, FRAMES / FPS),), 0, ()
    )
    tracks = tuple(
        PersonTrack(
            p.person_id + 1, np.ones(FRAMES, bool), np.ones(FRAMES), joint_boxes(p), np.zeros((FRAMES, 33, 2)),
            np.zeros((FRAMES, 33, 3)), np.ones((FRAMES, 33)), np.zeros((FRAMES, 64, 64), np.uint8),
            np.zeros((FRAMES, 2, 3)),
        )
        for p in tiny.people
    )  # fmt: skip
    camera = CameraEstimate(
        intrinsics(), "picture", 0.1, camera_pose()[1, :3], 0.05, True, np.tile(np.eye(4), (FRAMES, 1, 1))
    )
    index = np.arange(0, FRAMES, STRIDE)
    masks = np.stack([tiny.maps(int(t))[1] >= 1000 for t in index])
    background = BackgroundImage(background_rgb(), np.ones(MAP[::-1]), index, masks, masks)
    return {
        VideoClip: clip,
        PersonTracks: PersonTracks(tracks, tuple(t.person_id for t in tracks)),
        CameraEstimate: camera,
        BackgroundImage: background,
    }


def _depth_values(tiny: Tiny) -> dict[type, Any]:
    index = np.arange(0, FRAMES, STRIDE)
    depth = np.stack([tiny.maps(int(t))[0] for t in index])
    bare, _ = tiny.maps(None)
    yes = np.ones_like(depth, bool)
    bodies = BodyTracks(tuple(in_estimate(person) for person in tiny.people))
    # Relative depth: meters = 4 * value + 0.5.
    relative = DepthClip("depth", "tiny", index, (depth - 0.5) / 4, np.ones_like(depth), yes, (bare - 0.5) / 4, yes[0])
    metric = MetricDepth(4.0, 0.5, 0.0, 0.0, None, None, True, "", index, depth, yes, bare, yes[0], {}, bodies)
    return {DepthClip: relative, MetricDepth: metric}


@functools.cache
def estimated_field(boxes: tuple[TinyBox, ...]) -> SdfGrid:
    """Distance field of the boxes and the floor in the estimated world; it has no walls."""
    solids = [(box.mesh(), TURN @ box.pose) for box in boxes]
    placed = [Mesh(transform_points(T, mesh.vertices_m), mesh.faces, mesh.vertex_rgb) for mesh, T in solids]
    return build_sdf_grid(placed, np.array([[-3.0, -0.3, -6.0], [5.0, 2.2, 2.0]]), 0.06)


def _object_values(tiny: Tiny) -> dict[type, Any]:
    """Objects have other numbers than in the truth."""
    _, bare = tiny.maps(None)
    big = (CLIP[1] // MAP[1], CLIP[0] // MAP[0])
    enlarge = np.ones(big, bool)
    instances, completed, meshes, placed = [], [], [], []
    for number, box in enumerate(tiny.boxes, start=11):
        mask, whole = (np.kron(m, enlarge).astype(bool) for m in (bare == box.object_id, tiny.amodal(box)))
        instances.append(ObjectInstance(number, "object", 1.0, np.zeros(4), mask))
        image = np.full((4, 4, 3), 127, np.uint8)
        completed.append(CompletedObject(number, "object", whole, image, (0, 0), 0.0))
        pose = TURN @ box.pose
        meshes.append(ObjectMesh(number, "object", "form: box", box.mesh(), pose))
        placed.append(PlacedObject(number, "object", box.mesh(), 1.0, pose, None, None, True, ""))
    floor = np.kron(bare == FLOOR_ID, enlarge).astype(bool)
    grid = estimated_field(tiny.boxes)
    scene = SceneModel(tuple(placed), RoomPiece("floor", empty_mesh()), (), grid.sdf_m, grid.origin_m, grid.spacing_m)
    return {
        InstanceMasks: InstanceMasks("tiny", tuple(instances), floor),
        CompletedObjects: CompletedObjects(tuple(completed)),
        ObjectMeshes: ObjectMeshes(tuple(meshes)),
        PlacedObjects: PlacedObjects(tuple(placed)),
        SceneModel: scene,
    }
