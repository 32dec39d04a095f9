"""Writes the folder of a synthetic clip: video, truth, meshes. Format: docs/synthetic_world.md."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from video2anim.artifacts.folder import atomic_directory
from video2anim.artifacts.images import write_png
from video2anim.artifacts.motion_io import write_motion
from video2anim.export.character import character_of
from video2anim.export.glb import write_object_glb, write_scene_glb
from video2anim.geometry.scene_mesh import empty_mesh
from video2anim.geometry.vertex_normals import vertex_normals
from video2anim.lab.synth.render import Picture, Renderer, Sensor
from video2anim.lab.synth.render.texture import material_rgb, unrolled
from video2anim.lab.synth.world import (
    FURNITURE_LABELS,
    LABEL_STRIDE_FRAMES,
    LABELS,
    PERSON_ID,
    STRUCTURE_LABELS,
    Part,
    SceneObject,
    Shot,
)
from video2anim.types import Mesh, PlacedObject, RoomPiece
from video2anim.types.motion_arrays import motion_arrays
from video2anim.video import FrameWriter

FORMAT_VERSION = 1
_BAKED_DETAIL_M = 0.1
DEPTH_UNIT_M = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class _SceneMeshes:
    objects: tuple[PlacedObject, ...]
    floor: RoomPiece
    background: tuple[RoomPiece, ...]


def write_clip(
    shot: Shot,
    folder: Path,
    facts: dict[str, Any],
    rng: np.random.Generator,
) -> None:
    """Render a shot and write its folder; an older folder of that name is replaced by one rename at the end.

    Args:
        shot: The clip to render.
        folder: Folder to make.
        facts: Entries of `meta.json` known to the caller (name, preset, seed, index).
        rng: Random numbers of the sensor.
    """
    with atomic_directory(folder) as work:
        renderer, sensor = Renderer(shot), Sensor(shot.sensor, rng)
        labels = _Labels(shot, renderer)
        width_px, height_px = shot.intrinsics.width_px, shot.intrinsics.height_px
        with FrameWriter(
            work / "video.mp4", width_px=width_px, height_px=height_px, crf=shot.sensor.crf, threads=1
        ) as video:
            for t in range(shot.frame_count):
                picture = renderer.frame(t)
                labels.add(t, picture)
                video.write(sensor.apply(picture.rgb, t))
        write_png(work / "plate.png", labels.background_rgb)
        _write_truth(work, shot, labels)
        _write_meshes(work, shot)
        (work / "meta.json").write_text(json.dumps(_meta(shot, facts), indent=1) + "\n")


class _Labels:
    """Label maps collected while the clip is rendered."""

    def __init__(self, shot: Shot, renderer: Renderer) -> None:
        self.shot, self.renderer = shot, renderer
        self.index = np.arange(0, shot.frame_count, LABEL_STRIDE_FRAMES)
        self._wanted = frozenset(self.index.tolist())
        self.depth, self.normal, self.instance = [], [], []
        self.bare_depth, self.bare_normal, self.bare_instance = [], [], []
        self.box = np.full((len(shot.actors), shot.frame_count, 4), np.nan)
        self.background_rgb = np.zeros((0, 0, 3), np.uint8)
        self._bare(0)

    def _bare(self, t: int) -> None:
        background = self.renderer.background(t)
        if t == 0:
            self.background_rgb = background.rgb
        self.bare_depth.append(depth_code(background.depth_m))
        self.bare_normal.append(normal_code(background.normal_camera))
        self.bare_instance.append(background.instance)

    def add(self, t: int, picture: Picture) -> None:
        for person in range(len(self.shot.actors)):
            rows, columns = np.nonzero(picture.instance == PERSON_ID + person)
            if len(rows):
                self.box[person, t] = columns.min(), rows.min(), columns.max(), rows.max()
        if t not in self._wanted:
            return
        self.depth.append(depth_code(picture.depth_m))
        self.normal.append(normal_code(picture.normal_camera))
        self.instance.append(picture.instance)
        if t and not self.shot.is_static:
            self._bare(t)


def depth_code(depth_m: np.ndarray) -> np.ndarray:
    """Depth in millimeters, uint16; 0 = no surface."""
    return np.rint(np.clip(depth_m / DEPTH_UNIT_M, 0, 65535)).astype(np.uint16)


def normal_code(normal: np.ndarray) -> np.ndarray:
    """Unit normals times 127, int8."""
    return np.rint(normal * 127).astype(np.int8)


def up_in_camera(shot: Shot) -> Float[np.ndarray, "frames 3"]:
    """Unit vector against gravity in the camera axes of each frame."""
    return shot.T_world_camera[:, 1, :3]


def _write_truth(work: Path, shot: Shot, labels: _Labels) -> None:
    furniture = [obj for obj in shot.room.furniture if obj.label not in STRUCTURE_LABELS]
    amodal = [labels.renderer.amodal(obj.object_id) for obj in furniture]
    numbers = np.array([obj.object_id for obj in shot.room.objects])
    extra = {
        "up_camera": up_in_camera(shot),
        "is_static": np.array(shot.is_static),
        "label_frame_index": labels.index,
        "depth_mm": np.stack(labels.depth),
        "normal_camera": np.stack(labels.normal),
        "instance": np.stack(labels.instance),
        "background_depth_mm": np.stack(labels.bare_depth),
        "background_normal": np.stack(labels.bare_normal),
        "background_instance": np.stack(labels.bare_instance),
        "object_id": numbers,
        "object_class": np.array([LABELS.index(obj.label) for obj in shot.room.objects]),
        "object_visible_px": np.array([int((labels.bare_instance[0] == number).sum()) for number in numbers]),
        "amodal_object_id": np.array([obj.object_id for obj in furniture], np.int64),
        "amodal": np.stack(amodal) if amodal else np.zeros((0, *labels.bare_instance[0].shape), bool),
        "person_box_px": labels.box,
    }
    if shot.moving:
        extra |= {
            "moving_object_id": np.array([item.scene_object.object_id for item in shot.moving]),
            "T_world_moving": np.stack([item.T_world_object for item in shot.moving]),
            "moving_held": np.stack([item.held.any(1) for item in shot.moving]),
            "moving_hands": np.stack([item.held.any(0) for item in shot.moving]),
        }
    main, *others = (actor.motion for actor in shot.actors)
    np.savez_compressed(work / "truth.npz", allow_pickle=False, **motion_arrays(main), **extra)
    for motion in others:
        write_motion(work / f"truth_{motion.person_id}.npz", motion)


def _write_meshes(work: Path, shot: Shot) -> None:
    (work / "objects").mkdir()
    objects = [*shot.room.objects, *(moving.scene_object for moving in shot.moving)]
    placed = [placed_object(obj) for obj in objects]
    for obj in placed:
        write_object_glb(work / "objects" / f"{obj.object_id}.glb", obj)
    scene = _SceneMeshes(tuple(placed), RoomPiece("floor", empty_mesh()), ())
    write_scene_glb(work / "scene.glb", tuple(character_of(actor.motion) for actor in shot.actors), scene)


def placed_object(obj: SceneObject) -> PlacedObject:
    """An object as the type of the pipeline, with colors baked into the vertices."""
    vertices, faces, colors, count = [], [], [], 0
    for part in obj.parts:
        vertices.append(np.asarray(part.vertices_m, float))
        faces.append(np.asarray(part.faces, np.int64) + count)
        colors.append(_baked(part))
        count += len(part.vertices_m)
    mesh = Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors))
    return PlacedObject(obj.object_id, obj.label, mesh, 1.0, obj.T_world_object, None, None, True, obj.note)


def _baked(part: Part) -> UInt8[np.ndarray, "vertices 3"]:
    """sRGB colors of the texture at the vertices, without detail finer than `_BAKED_DETAIL_M`."""
    if part.vertex_rgb is not None:
        return part.vertex_rgb
    points, normal = np.asarray(part.vertices_m, np.float32), np.abs(vertex_normals(part.vertices_m, part.faces))
    spot = unrolled(points, normal, np.full(len(points), _BAKED_DETAIL_M, np.float32))
    linear = np.clip(material_rgb(part.material, spot), 0, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(255 * srgb).astype(np.uint8)


def _meta(shot: Shot, facts: dict[str, Any]) -> dict[str, Any]:
    lens, T = shot.intrinsics, shot.T_world_camera[0]
    x0, x1, z0, z1 = shot.room.bounds_m
    moving = {item.scene_object.object_id for item in shot.moving}
    objects = [*shot.room.objects, *(item.scene_object for item in shot.moving)]
    return {
        "format_version": FORMAT_VERSION,
        **facts,
        **shot.facts,
        "fps": 30,
        "frames": shot.frame_count,
        "width_px": lens.width_px,
        "height_px": lens.height_px,
        "labels": list(LABELS),
        "camera": {
            "fov_y_rad": float(2 * np.arctan(0.5 * lens.height_px / lens.fy_px)),
            "focal_px": lens.fy_px,
            "height_m": float(T[1, 3]),
            "pitch_rad": float(np.arcsin(np.clip(T[1, 2], -1, 1))),
            "roll_rad": float(np.arctan2(-T[1, 0], -T[1, 1])),
            "k1": shot.sensor.k1,
            "k2": shot.sensor.k2,
            "is_static": shot.is_static,
        },
        "persons": [
            {
                "person_id": actor.motion.person_id,
                "kind": actor.kind,
                "source": actor.source,
                "clip": actor.clip,
                "shape": asdict(actor.motion.shape),
            }
            for actor in shot.actors
        ],
        "objects": [
            {
                "object_id": obj.object_id,
                "label": obj.label,
                "is_furniture": obj.label in FURNITURE_LABELS or obj.label == "mesh",
                "is_moving": obj.object_id in moving,
                "T_world_object": np.asarray(obj.T_world_object).tolist(),
                "file": f"objects/{obj.object_id}.glb",
                "note": obj.note,
            }
            for obj in objects
        ],
        "room": {"width_m": x1 - x0, "depth_m": z1 - z0, "height_m": shot.room.height_m, "bounds_m": [x0, x1, z0, z1]},
        "sensor": asdict(shot.sensor),
    }
