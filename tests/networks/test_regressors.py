"""Regressors of the user's own in the humans stage, over tiny graphs of their contracts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from synthetic import planted_walk, true_keypoints
from tiny_graphs import constant_graph

import video2anim.video
from stages.humans import HumansConfig, recover_humans
from video2anim.geometry.projection import project
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.humans.landmarks import LANDMARK_ORDER
from video2anim.networks import load_model, weight_digests
from video2anim.networks.gem_x import WINDOW
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    BodyMotion,
    CameraEstimate,
    Intrinsics,
    PayloadFile,
    PersonTrack,
    PersonTracks,
    SourceInfo,
    VideoClip,
)

FRAMES = 24
LENS = Intrinsics.centered(700.0, 640, 480)
FACING = np.diag([1.0, -1.0, -1.0])
GONE = slice(10, 13)


def hmr2_file(folder: Path) -> Path:
    """Someone who faces the camera, all other joints turned by 0.2 about x."""
    pose = np.tile(matrix_from_axis_angle(np.array([0.2, 0, 0])), (1, 23, 1, 1))
    outputs = {"global_orient": FACING[None, None], "body_pose": pose, "betas": np.zeros((1, 10)),
               "pred_cam": np.array([[0.8, 0.0, 0.0]])}  # fmt: skip
    return constant_graph(folder / "hmr2.onnx", inputs={"image": [1, 3, 256, 256]}, outputs=outputs)


def gem_file(folder: Path) -> Path:
    """The same as GEM writes it: two rows of each matrix, statistics beside the network."""
    turned = matrix_from_axis_angle(np.array([0.2, 0, 0]))[:2].ravel()
    features = np.concatenate([np.tile(turned, 21), np.zeros(10), FACING[:2].ravel(), np.zeros(9)])
    path = folder / "gem.onnx"
    np.savez(path.with_suffix(".stats.npz"), mean=features, std=np.ones(151))
    inputs = {"obs": [1, WINDOW, 17, 3], "bbx_xys": [1, WINDOW, 3], "K_fullimg": [1, WINDOW, 3, 3],
              "f_imgseq": [1, WINDOW, 1024], "f_cam_angvel": [1, WINDOW, 6]}  # fmt: skip
    outputs = {"pred_x": np.zeros((1, WINDOW, 151)), "pred_cam": np.tile([0.8, 0.0, 0.0], (1, WINDOW, 1))}
    return constant_graph(path, inputs=inputs, outputs=outputs)


@pytest.fixture
def filmed(monkeypatch: pytest.MonkeyPatch) -> tuple[VideoClip, PersonTracks, CameraEstimate, BodyMotion]:
    """A walk towards a level camera 5 m away; the person is not tracked for three frames."""
    motion = planted_walk(FRAMES)
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3], T_camera_world[:3, 3] = FACING, [0, 1.0, 5.0]
    points = true_keypoints(motion) @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    landmarks_px, landmarks_m = np.zeros((FRAMES, 33, 2)), np.zeros((FRAMES, 33, 3))
    landmarks_px[:, LANDMARK_ORDER] = project(points, LENS)
    landmarks_m[:, LANDMARK_ORDER] = points - points[:, 11:13].mean(1, keepdims=True)
    valid = np.ones(FRAMES, bool)
    valid[GONE] = False
    shown = landmarks_px[:, LANDMARK_ORDER]
    track = PersonTrack(
        1, valid, np.ones(FRAMES), np.concatenate([shown.min(1), shown.max(1)], -1), landmarks_px, landmarks_m,
        np.ones((FRAMES, 33)), np.zeros((FRAMES, 64, 64), np.uint8), np.zeros((FRAMES, 2, 3)),
    )  # fmt: skip
    times = np.arange(FRAMES) / 30
    source = SourceInfo("h264", "yuv420p", 640, 480, 0, 1.0, 30.0, FRAMES, FRAMES, times[-1], 0.0)
    shots = ((0.0, FRAMES / 30),)
    clip = VideoClip(PayloadFile(Path("none.mp4")), 640, 480, 30.0, times, times, source, shots, 0, True, 0.0, ())
    camera = CameraEstimate(
        LENS, "user", 0.01, np.array([0.0, -1.0, 0.0]), "human", 0.01, True, np.tile(np.eye(3), (FRAMES, 1, 1))
    )
    blank = np.zeros((480, 640, 3), np.uint8)
    monkeypatch.setattr(video2anim.video, "read_frames", lambda clip: (blank for _ in range(FRAMES)))
    return clip, PersonTracks((track,), (1,), 1), camera, motion


@pytest.mark.parametrize(("name", "file"), [("hmr2", hmr2_file), ("gem-smpl", gem_file)])
def test_rotations_of_the_users_network_take_the_place_of_the_lifters(
    name: str, file: object, filmed: tuple[VideoClip, PersonTracks, CameraEstimate, BodyMotion], tmp_path: Path
) -> None:
    clip, tracks, camera, motion = filmed
    config = HumansConfig(method="lifter", model=f"{name}@{file(tmp_path)}")  # type: ignore[operator]
    bodies = recover_humans(clip, tracks, camera, config, StageContext(tmp_path, load_model=load_model))
    person = bodies.people[0]
    seen = np.ones(FRAMES, bool)
    seen[GONE] = False
    wanted = matrix_from_axis_angle(np.array([0.2, 0, 0]))
    np.testing.assert_allclose(person.R_parent_joint[seen, 1:], np.broadcast_to(wanted, (21, 21, 3, 3)), atol=1e-5)
    # A level camera: the body that faces it stands upright in the world.
    np.testing.assert_allclose(person.R_parent_joint[seen, 0] @ [0, 1, 0], np.tile([0, 1.0, 0], (21, 1)), atol=1e-5)
    depth_m = person.joints_camera_m[seen, 0, 2]
    true_m = 5.0 - motion.joints_world_m[seen, 0, 2]
    np.testing.assert_allclose(depth_m, true_m, rtol=0.15, err_msg="meters from the size in the picture")
    fitted = recover_humans(
        clip,
        tracks,
        camera,
        HumansConfig(model=config.model, iterations=40),
        StageContext(tmp_path, load_model=load_model),
    )
    error_px = fitted.quality[0].reprojection_px
    assert error_px < bodies.quality[0].reprojection_px, "the fit moves the network's body to the landmarks"


def test_statistics_beside_the_network_are_part_of_its_digest(tmp_path: Path) -> None:
    path = gem_file(tmp_path)
    before = weight_digests(f"gem-smpl@{path}")
    np.savez(path.with_suffix(".stats.npz"), mean=np.zeros(151), std=np.ones(151))
    assert weight_digests(f"gem-smpl@{path}") != before
