"""Examples of `scenemi sample` for animators, as one picture for the docs.

    python benchmarks/scenemi/gallery.py [--out docs/scenemi_gallery.jpg] [--work bench_work/gallery] [--only sit ...]

Makes a furnished room (`room.glb`) from the project's parametric furniture, runs `scenemi sample` on every request in
`benchmarks/scenemi/gallery/`, prints the commands, and draws some poses of each motion, later ones darker.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from scenemi.cli import main as cli
from video2anim.artifacts.motion_io import read_motion
from video2anim.body.anny_body import shaped_body
from video2anim.export.glb import write_scene_glb
from video2anim.geometry.scene_mesh import joined
from video2anim.objects.furniture import FORMS
from video2anim.types import BodyMotion, Mesh, PlacedObject, RoomPiece
from video2anim.types.scene import ObjectPart
from video2anim.types.skeleton import forward_kinematics
from video2anim.viewer.drawing import draw_body, drawable_mesh
from video2anim.viewer.raster import Canvas, draw_lines, draw_mesh
from video2anim.viewer.viewpoint import Viewpoint, fit_viewpoint, looking

REQUESTS = Path(__file__).parent / "gallery"
TILES = {
    "path": "root path only", "sit": "sit on chair_1 at 3.5 s", "sofa": "rise, turn, sit on sofa_3",
    "hand_on_table": "right hand on table_2", "hands": "hands only, feet pinned", "samples": "three samples",
}  # fmt: skip
"""Caption of each request."""
SAMPLES, FREE = {"samples": 3}, ("hands",)
"""Number of motions if it is not one; requests without the room."""
FURNITURE = (("chair", 0, (1.3, 1.5), 180), ("table", 5, (0.2, -1.3), 0), ("sofa", 3, (2.6, -0.9), -90))
"""Label, index in `FORMS`, position (x, z) in meters, heading of the front in degrees. Object IDs start at 1."""
WIDTH_PX, HEIGHT_PX, COLUMNS, POSES = 560, 400, 3, 6
RGB = ((205, 163, 138), (150, 90, 60))
"""Colors of the first and the last pose."""


@dataclass(frozen=True, slots=True)
class Room:
    """The content of `room.glb`."""

    objects: tuple[PlacedObject, ...]
    floor: RoomPiece
    background: tuple[RoomPiece, ...] = ()


def main() -> None:
    """Make the room, the motions and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/scenemi_gallery.jpg"))
    parser.add_argument("--work", type=Path, default=Path("bench_work/gallery"))
    parser.add_argument("--only", nargs="*", default=list(TILES))
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    room = furnished()
    write_scene_glb(given.work / "room.glb", (), room)
    tiles = [tile(name, sampled(name, given.work), room) for name in given.only]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
    rows = [np.concatenate(tiles[k : k + COLUMNS], 1) for k in range(0, len(tiles), COLUMNS)]
    picture = np.concatenate(rows, 0)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 82] if given.out.suffix == ".jpg" else []
    cv2.imwrite(str(given.out), picture[..., ::-1], quality)


def furnished() -> Room:
    """Chair, table and sofa of usual sizes on a floor."""
    placed = []
    for number, (label, form, (x, z), degrees) in enumerate(FURNITURE, start=1):
        names, solids = FORMS[form].build(FORMS[form].usual_m[None])
        meshes = [
            Mesh(vertices.astype(np.float32), faces, np.full((len(vertices), 3), 170, np.uint8))
            for vertices, faces in solids.meshes()
        ]
        starts = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])
        parts = tuple(
            ObjectPart(name, int(start), len(mesh.faces))
            for name, start, mesh in zip(names, starts, meshes, strict=False)
        )
        T, turn = np.eye(4), np.radians(degrees)
        T[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        T[:3, 3] = x, 0.0, z
        placed.append(PlacedObject(number, label, joined(meshes), 1.0, T, None, None, True, "", parts=parts))
    corners_m = np.array([[-2.8, 0, 2.2], [3.3, 0, 2.2], [3.3, 0, -1.9], [-2.8, 0, -1.9]])
    floor = Mesh(corners_m, np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 225, np.uint8))
    return Room(tuple(placed), RoomPiece("floor", floor))


def sampled(name: str, work: Path) -> list[BodyMotion]:
    """Motions of a request, made by the printed command."""
    words = ["scenemi", "sample", "--keyframes", str(REQUESTS / f"{name}.json"), "--out", str(work / f"{name}.npz")]
    words += [] if name in FREE else ["--scene", str(work / "room.glb")]
    words += ["--samples", str(SAMPLES[name])] if name in SAMPLES else []
    sys.stdout.write(shlex.join(words) + "\n")
    sys.stdout.flush()
    before, sys.argv = sys.argv, words
    try:
        cli.run()
    except SystemExit as end:
        if end.code:
            raise
    finally:
        sys.argv = before
    paths = [work / f"{name}.npz", *(work / f"{name}_{k}.npz" for k in range(2, SAMPLES.get(name, 1) + 1))]
    return [read_motion(path) for path in paths]


def tile(name: str, motions: list[BodyMotion], room: Room) -> np.ndarray:
    """Poses of the motions in the room, and the paths of their pelves."""
    free = name in FREE
    bodies = [body for motion in motions for body in posed(motion, POSES if len(motions) == 1 else 3)]
    points_m = np.concatenate([vertices for vertices, _ in bodies])
    if not free:
        points_m = np.concatenate([points_m, np.asarray(room.floor.mesh.vertices_m)])
    seen_from = looking(np.array([0.4, 0.0, -1.0]), 0.2) if free else looking(np.array([0.6, 0.0, 1.0]), 0.5)
    view = fit_viewpoint(points_m, seen_from, width_px=WIDTH_PX, height_px=HEIGHT_PX)
    canvas = Canvas.blank(WIDTH_PX, HEIGHT_PX, (255, 255, 255))
    meshes = [room.floor.mesh, *(() if free else map(drawable_mesh, room.objects))]
    for mesh in meshes:
        draw_mesh(canvas, view.to_camera(mesh.vertices_m), mesh.faces, mesh.vertex_rgb, view.intrinsics)
    for vertices, share in bodies:
        rgb = np.rint((1 - share) * np.array(RGB[0]) + share * np.array(RGB[1])).astype(np.uint8)
        body = shaped_body(motions[0].shape)
        draw_body(canvas, view, vertices, body.faces, np.tile(rgb, (len(vertices), 1)))
    for motion in motions:
        lines(canvas, view, motion.joints_world_m[:, 0] * [1, 0, 1] + [0, 0.01, 0], (60, 90, 200))
    marks(canvas, view, json.loads((REQUESTS / f"{name}.json").read_text()))
    cv2.putText(canvas.rgb, TILES[name], (10, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (40, 40, 40), 1, cv2.LINE_AA)
    return canvas.rgb


def posed(motion: BodyMotion, count: int) -> list[tuple[np.ndarray, float]]:
    """Skin vertices in some frames, and the relative time (0 to 1) of each."""
    body = shaped_body(motion.shape)
    found = []
    for share in np.linspace(0, 1, count):
        frame = round(share * (motion.frame_count - 1))
        R, translation_m = motion.R_parent_joint[frame], motion.T_world_root[frame, :3, 3]
        joints_m, R_world = forward_kinematics(R, translation_m, motion.rest_joints_m)
        found.append((body.vertices(R_world[None], joints_m[None])[0], float(share)))
    return found


def lines(canvas: Canvas, view: Viewpoint, points_m: np.ndarray, rgb: tuple[int, int, int]) -> None:
    """Draw a line through world points."""
    at = view.to_camera(points_m)
    draw_lines(canvas, at[:-1], at[1:], rgb, view.intrinsics)


def marks(canvas: Canvas, view: Viewpoint, asked: dict) -> None:
    """Draw red crosses at wanted joint positions and red points on the wanted path."""
    places = [one["position_m"] for one in asked.get("joint_targets", ())]
    places += [[x, 0.02, z] for x, z in asked.get("root_path", {}).get("points_xz_m", ())]
    for place in places:
        x, y, z = view.to_camera(np.array([place]))[0]
        k = view.intrinsics
        at = round(float(k.fx_px * x / z + k.cx_px)), round(float(k.fy_px * y / z + k.cy_px))
        cv2.drawMarker(canvas.rgb, at, (220, 30, 30), cv2.MARKER_TILTED_CROSS, 14, 2)


if __name__ == "__main__":
    main()
