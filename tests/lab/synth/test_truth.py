"""Truth of generated clips, checked from the outside: only files, trimesh, the body model and formulas of its own."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command import video2anim

from video2anim.body.anny_body import shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.types import BodyShape
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

NAMES = ("00_walk", "01_sit", "02_step_up", "03_pick_up")
FEET = [JOINT_INDEX[f"{side}_{part}"] for side in ("left", "right") for part in ("ankle", "foot")]
PERSON = 1000


@dataclass(frozen=True)
class Clip:
    folder: Path
    truth: dict[str, np.ndarray]
    meta: dict

    @property
    def lens(self) -> tuple[float, float, float, float]:
        fx, fy, cx, cy = self.truth["intrinsics"][:4]
        return float(fx), float(fy), float(cx), float(cy)

    def project(self, points_camera_m: np.ndarray) -> np.ndarray:
        fx, fy, cx, cy = self.lens
        return points_camera_m[..., :2] / points_camera_m[..., 2:] * (fx, fy) + (cx, cy)

    def rays(self) -> np.ndarray:
        fx, fy, cx, cy = self.lens
        v, u = np.mgrid[: self.meta["height_px"], : self.meta["width_px"]]
        return np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], -1)

    @property
    def body(self) -> ShapedBody:
        z = self.truth
        shape = dict(zip(z["shape_names"].tolist(), z["shape_values"].tolist(), strict=True))
        return shaped_body(BodyShape("anny", shape))

    def vertices(self, frames: np.ndarray) -> np.ndarray:
        z, body = self.truth, self.body
        joints, R = forward_kinematics(
            z["R_parent_joint"][frames], z["T_world_root"][frames, :3, 3], z["rest_joints_m"]
        )
        return body.vertices(R, joints)

    def mesh(self, entry: dict, *, world: bool = True) -> trimesh.Trimesh:
        loaded = trimesh.load(self.folder / entry["file"], force="mesh")
        assert isinstance(loaded, trimesh.Trimesh)
        if world:
            loaded.apply_transform(np.array(entry["T_world_object"]))
        return loaded


@pytest.fixture(scope="module")
def clips(bench_clips: Path) -> tuple[Clip, ...]:
    table = json.loads((bench_clips / "set.json").read_text())
    assert [clip["name"] for clip in table["clips"]] == list(NAMES)
    found = []
    for name in NAMES:
        with np.load(bench_clips / name / "truth.npz", allow_pickle=False) as archive:
            found.append(
                Clip(bench_clips / name, dict(archive), json.loads((bench_clips / name / "meta.json").read_text()))
            )
    return tuple(found)


def test_the_set_is_kept(clips: tuple[Clip, ...]) -> None:
    """Made again with the same options, nothing is drawn anew."""
    out = clips[0].folder.parent
    before = {path: path.stat().st_mtime_ns for path in out.glob("*/*.*")}
    words = ("synth", "--preset", "bench", "--count", "4", "--size", "320x240", "--longest", "5", "--out", out)
    done = video2anim(*words)
    assert done.code == 0
    assert done.err.count("(cached)") == 4
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/*.*")} == before


def test_every_promised_file_is_there(clips: tuple[Clip, ...]) -> None:
    for clip in clips:
        for name in ("video.mp4", "truth.npz", "meta.json", "plate.png", "scene.glb"):
            assert (clip.folder / name).stat().st_size > 1000
        assert all((clip.folder / entry["file"]).is_file() for entry in clip.meta["objects"])
        assert sum(entry["is_furniture"] for entry in clip.meta["objects"]) >= 4
        assert clip.meta["frames"] == len(clip.truth["frame_time_s"]) >= 120


def test_projected_joints_fall_in_the_person_mask(clips: tuple[Clip, ...]) -> None:
    inside = total = 0
    for clip in clips:
        z = clip.truth
        for k, t in enumerate(z["label_frame_index"]):
            joints = z["joints_camera_m"][t]
            pixel = np.rint(clip.project(joints)).astype(int)
            shape = z["instance"][k].shape
            held = (pixel >= 0).all(1) & (pixel[:, 0] < shape[1]) & (pixel[:, 1] < shape[0])
            column, row = pixel[held].T
            depth_m = z["depth_mm"][k][row, column] / 1000.0
            of_person = z["instance"][k][row, column] == PERSON
            hidden = ~of_person & (depth_m < joints[held, 2])  # something stands in front of it
            total += int((~hidden).sum())
            inside += int((of_person & ~hidden).sum())
    assert total > 1000
    assert inside / total >= 0.99


def test_depth_of_visible_vertices_is_the_rendered_depth(clips: tuple[Clip, ...]) -> None:
    for clip in clips:
        z = clip.truth
        chosen = np.arange(0, len(z["label_frame_index"]), 8)
        errors = []
        for k in chosen:
            t = int(z["label_frame_index"][k])
            vertices = clip.vertices(np.array([t]))[0]
            T = z["T_world_camera"][t]
            seen = seen_from(trimesh.Trimesh(vertices, clip.body.faces, process=False), T[:3, 3])
            camera = (vertices[seen] - T[:3, 3]) @ T[:3, :3]
            errors.append(
                _depth_errors(clip.project(camera), camera[:, 2], z["depth_mm"][k] / 1000.0, z["instance"][k])
            )
        error = np.concatenate(errors)
        assert len(error) > 500
        # Between four pixels 8 to 12 mm apart; a fold or a finger's edge leaves its own error.
        assert np.mean(np.abs(error) <= 0.005) >= 0.95, np.percentile(np.abs(error), [50, 90, 99])
        assert np.median(np.abs(error)) < 0.001


def _depth_errors(pixel: np.ndarray, depth: np.ndarray, picture_m: np.ndarray, instance: np.ndarray) -> np.ndarray:
    """Vertex depth minus the depth interpolated between four pixel centers, where all four see the person smoothly."""
    height, width = picture_m.shape
    corner = np.floor(pixel).astype(int)
    held = (corner >= 0).all(1) & (corner[:, 0] < width - 1) & (corner[:, 1] < height - 1)
    corner, pixel, depth = corner[held], pixel[held], depth[held]
    (u, v), (a, b) = corner.T, (pixel - corner).T
    four = np.stack([picture_m[v + i, u + j] for i in (0, 1) for j in (0, 1)], 1)
    seen = np.all([instance[v + i, u + j] == PERSON for i in (0, 1) for j in (0, 1)], 0)
    smooth = np.ptp(four, axis=1) < 0.012
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], 1)
    error = depth - (four * weights).sum(1)
    return error[seen & smooth]


def test_depth_of_the_body_at_pixel_centers_is_that_of_its_mesh(clips: tuple[Clip, ...]) -> None:
    for clip in clips:
        z = clip.truth
        for k in range(0, len(z["label_frame_index"]), 12):
            t = int(z["label_frame_index"][k])
            body = trimesh.Trimesh(clip.vertices(np.array([t]))[0], clip.body.faces, process=False)
            T = z["T_world_camera"][t]
            of_person = z["instance"][k] == PERSON
            rays = clip.rays()[of_person] @ T[:3, :3].T
            eye = np.broadcast_to(T[:3, 3], rays.shape)
            hit, index, _ = body.ray.intersects_location(eye, rays, multiple_hits=False)
            assert len(index) / len(rays) > 0.999
            depth_m = ((hit - T[:3, 3]) @ T[:3, :3])[:, 2]
            error = np.abs(depth_m - z["depth_mm"][k][of_person][index] / 1000.0)
            assert np.mean(error <= 0.005) > 0.999
            assert np.median(error) < 0.001


def seen_from(body: trimesh.Trimesh, eye: np.ndarray) -> np.ndarray:
    """Vertices in front of which the body itself has nothing; other objects are told apart by the instance map."""
    ray = body.vertices - eye
    hit, index, _ = body.ray.intersects_location(np.broadcast_to(eye, ray.shape), ray, multiple_hits=False)
    free = np.ones(len(ray), bool)
    free[index] = np.linalg.norm(hit - eye, axis=1) > np.linalg.norm(ray[index], axis=1) - 0.002
    return free


def test_objects_alone_match_their_amodal_masks(clips: tuple[Clip, ...]) -> None:
    for clip in clips:
        z = clip.truth
        T = z["T_world_camera"][0]
        rays = (clip.rays() @ T[:3, :3].T).reshape(-1, 3)
        origins = np.broadcast_to(T[:3, 3], rays.shape)
        entries = {entry["object_id"]: entry for entry in clip.meta["objects"]}
        compared = 0
        for number, mask in zip(z["amodal_object_id"], z["amodal"], strict=True):
            hit = clip.mesh(entries[int(number)]).ray.intersects_any(origins, rays).reshape(mask.shape)
            if hit.sum() >= 200:
                assert (hit & mask).sum() / (hit | mask).sum() >= 0.99, entries[int(number)]["label"]
                compared += 1
            visible = z["background_instance"][0] == number
            assert not (visible & ~mask).any()
        assert compared >= 2


def test_gravity_and_floor_agree(clips: tuple[Clip, ...]) -> None:
    for clip in clips:
        z = clip.truth
        T = z["T_world_camera"][0]
        np.testing.assert_allclose(T[:3, :3] @ z["up_camera"][0], (0, 1, 0), atol=1e-9)
        floor = [entry["object_id"] for entry in clip.meta["objects"] if entry["label"] == "floor"]
        seen = np.isin(z["background_instance"][0], floor)
        points = (clip.rays() * (z["background_depth_mm"][0] / 1000.0)[..., None])[seen] @ T[:3, :3].T + T[:3, 3]
        assert seen.sum() > 1000
        assert np.abs(points[:, 1]).max() < 0.01
        normal = z["background_normal"][0][seen].astype(float) / 127
        assert (normal @ z["up_camera"][0]).min() > 0.98


def test_no_body_vertex_is_deep_in_an_object(clips: tuple[Clip, ...]) -> None:
    for clip in clips:
        points = clip.vertices(clip.truth["label_frame_index"][::3]).reshape(-1, 3).astype(float)
        assert points[:, 1].min() > -0.01
        for entry in clip.meta["objects"]:
            if entry["is_moving"] or entry["label"] in ("floor", "ceiling"):
                continue
            for part in clip.mesh(entry).split(only_watertight=True):
                low, high = part.bounds
                near = points[((points > low + 0.01) & (points < high - 0.01)).all(1)]
                if len(near) == 0:
                    continue
                inside = near[part.contains(near)]
                if len(inside):
                    depth = trimesh.proximity.closest_point(part, inside)[1]
                    assert depth.max() <= 0.01, (clip.folder.name, entry["label"])


def test_feet_in_contact_do_not_slide(clips: tuple[Clip, ...]) -> None:
    for clip in clips:
        contact, joints = clip.truth["contact"] > 0.5, clip.truth["joints_world_m"]
        assert contact[:, FEET].any(1).mean() > 0.5
        for joint in FEET:
            both = contact[1:, joint] & contact[:-1, joint]
            step = np.linalg.norm(np.diff(joints[:, joint], axis=0), axis=1)[both]
            assert step.size == 0 or step.max() <= 0.005


def test_contacts_touch_something(clips: tuple[Clip, ...]) -> None:
    """A touching foot's sole is within 3 cm of a surface: the floor, or something below it."""
    for clip in clips:
        z = clip.truth
        frames = z["label_frame_index"][::2]
        vertices, body_part = clip.vertices(frames), clip.body.vertex_part
        scene = trimesh.util.concatenate([clip.mesh(entry) for entry in clip.meta["objects"] if not entry["is_moving"]])
        for side in ("left", "right"):
            ball, heel = JOINT_INDEX[f"{side}_foot"], JOINT_INDEX[f"{side}_ankle"]
            sole = vertices[:, np.isin(body_part, (ball, heel))]
            touching = np.flatnonzero(z["contact"][frames][:, ball] > 0.5)
            lowest = sole[touching, sole[touching, :, 1].argmin(1)].astype(float)
            start = lowest + np.array([0, 0.03, 0])
            hits, ray, _ = scene.ray.intersects_location(
                start, np.tile((0.0, -1.0, 0.0), (len(start), 1)), multiple_hits=False
            )
            assert set(ray.tolist()) == set(range(len(start)))
            assert np.abs(hits[:, 1] - lowest[ray, 1]).max() < 0.03


def test_the_camera_is_the_one_of_the_labels(clips: tuple[Clip, ...]) -> None:
    for clip in clips:
        z, camera = clip.truth, clip.meta["camera"]
        fy, height = z["intrinsics"][1], clip.meta["height_px"]
        assert camera["fov_y_rad"] == pytest.approx(2 * np.arctan(height / 2 / fy))
        assert np.deg2rad(34) <= camera["fov_y_rad"] <= np.deg2rad(91)
        assert camera["height_m"] == pytest.approx(z["T_world_camera"][0, 1, 3])
        assert 0.8 <= camera["height_m"] <= 2.6
        np.testing.assert_allclose(z["T_world_camera"], z["T_world_camera"][:1].repeat(clip.meta["frames"], 0))
