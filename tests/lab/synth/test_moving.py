"""Cameras of preset `moving`: they do what their name says."""

from __future__ import annotations

import numpy as np

from video2anim.geometry.projection import project
from video2anim.lab.synth.compose import ComposeOptions, compose
from video2anim.lab.synth.presets import clip_specs, hiding_of


def test_preset_moving() -> None:
    specs = clip_specs("moving", None, 0)
    assert [spec.camera for spec in specs] == ["pan", "pan", "follow", "follow", "handheld", "handheld"]
    assert all(hiding_of(spec) is None for spec in specs)


def test_a_pan_turns_with_the_person_from_one_place() -> None:
    shot = compose(clip_specs("moving", None, 0)[0], ComposeOptions())
    T, body = shot.T_world_camera, shot.actors[0].motion
    assert not shot.is_static
    assert np.linalg.norm(T[:, :3, 3] - T[:, :3, 3].mean(0), axis=1).max() < 0.2
    column = project(body.joints_camera_m[:, 0], shot.intrinsics)[:, 0]
    walked_m = np.linalg.norm(np.ptp(body.joints_world_m[:, 0], axis=0))
    assert walked_m > 1.0
    assert np.ptp(column) < 0.4 * shot.intrinsics.width_px


def test_a_camera_that_follows_moves_the_way_of_the_person() -> None:
    shot = compose(clip_specs("moving", None, 0)[2], ComposeOptions())
    person_m, camera_m = shot.actors[0].motion.joints_world_m[:, 0], shot.T_world_camera[:, :3, 3]
    way_m, own_m = (path[-1, [0, 2]] - path[0, [0, 2]] for path in (person_m, camera_m))
    assert own_m @ way_m > 0.15 * way_m @ way_m
