"""Solids that decide something: on the path of who sees no scene, clear of the true body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scene_motions import FRAMES, Window

from scenemi.model.base import join_keyframes
from scenemi.scene.body_spheres import adult_spheres
from scenemi.scene.boxes import Boxes
from scenemi.scene.pseudo import SyntheticSceneConfig, SyntheticScenes
from scenemi.scene.sliding import SweptBody
from scenemi.scene.telling import TrueSweep, telling_solids

CLEARANCE_M = 0.01
ROUNDING_M = 1e-4


def swept(window: Window) -> SweptBody:
    spheres = adult_spheres()
    return SweptBody(spheres.placed(window.joints_m, window.R_world_joint), spheres.radius_m)


def blind(window: Window, interval: int = FRAMES - 1) -> np.ndarray:
    """Joints of the joined keyframes (N, 22, 3)."""
    mask = torch.zeros(1, FRAMES)
    mask[0, ::interval] = mask[0, -1] = 1
    joints = torch.from_numpy(window.joints_m.reshape(1, FRAMES, 66)).float()
    return join_keyframes(joints, mask)[0].unflatten(-1, (22, 3)).numpy().astype(float)


def nearest_ball_m(body: SweptBody, box: Boxes) -> float:
    """Gap between a box and the nearest ball of any frame."""
    centers_m = np.moveaxis(body.center_m, 0, -1).astype(float)
    return float((box.signed_distance(centers_m) - body.radius_m).min())


@pytest.mark.parametrize("name", ["walk", "sit", "step_up"])
def test_no_solid_is_nearer_to_the_body_than_a_centimeter(name: str, request: pytest.FixtureRequest) -> None:
    window: Window = request.getfixturevalue(name)
    body, path_m = swept(window), blind(window)
    found = [solid for seed in range(8) for solid in telling_solids(np.random.default_rng(seed), body, path_m, 3)]
    assert found, "there is room for some"
    assert min(nearest_ball_m(body, box) for _, box in found) > CLEARANCE_M - ROUNDING_M


@pytest.mark.parametrize("name", ["walk", "step_up"])
def test_the_blind_path_goes_through_most_solids(name: str, request: pytest.FixtureRequest) -> None:
    window: Window = request.getfixturevalue(name)
    body, path_m = swept(window), blind(window)
    hits, depth_m = [], []
    for seed in range(16):
        solids = telling_solids(np.random.default_rng(seed), body, path_m, 2)
        if solids:
            depth_m.append(Boxes.joined(box for _, box in solids).signed_distance(path_m).min())
            hits += [box.signed_distance(path_m).min() < 0 for _, box in solids]
    assert np.mean(hits) > 0.95, "each is put around a joint of that path"
    assert np.mean(np.array(depth_m) < -0.01) > 0.5, "a centimeter deep or more"


def test_where_the_blind_path_is_the_true_one_there_is_nothing(walk: Window, sit: Window) -> None:
    for window in (walk, sit):
        assert telling_solids(np.random.default_rng(0), swept(window), window.joints_m, 3) == []


def test_solids_stand_on_the_floor_or_hang_above_it_and_have_names(walk: Window) -> None:
    body, path_m = swept(walk), blind(walk)
    solids = [solid for seed in range(20) for solid in telling_solids(np.random.default_rng(seed), body, path_m, 3)]
    assert len({name for name, _ in solids}) > 1
    for name, box in solids:
        low_m = float(box.center_m[0, 1] - box.half_m[0, 1])
        assert low_m >= -1e-9
        assert low_m < 1e-9 or name == "board"
        assert (box.half_m > 0).all()


def test_at_most_as_many_as_asked_for_and_alike_for_one_seed(walk: Window) -> None:
    body, path_m = swept(walk), blind(walk)
    assert telling_solids(np.random.default_rng(0), body, path_m, 0) == []
    for count in (1, 3):
        assert len(telling_solids(np.random.default_rng(0), body, path_m, count)) <= count
    first, again = (telling_solids(np.random.default_rng(4), body, path_m, 3) for _ in range(2))
    assert [name for name, _ in first] == [name for name, _ in again]
    for (_, a), (_, b) in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.center_m, b.center_m)


def test_gaps_to_the_sweep_against_all_balls(walk: Window) -> None:
    body = swept(walk)
    points_m = np.random.default_rng(0).uniform([-1, 0, -1], [1, 2, 3], (300, 3))
    centers_m = np.moveaxis(body.center_m, 0, -1).reshape(-1, 3)
    radius_m = np.tile(body.radius_m, FRAMES)
    true_m = (np.linalg.norm(points_m[:, None] - centers_m[None], axis=-1) - radius_m).min(1)
    found_m = TrueSweep(body).gap_m(points_m)
    assert (found_m >= true_m - 1e-5).all()
    near = true_m < 0.3
    assert np.abs(found_m - true_m)[near].mean() < 0.01


def test_a_scene_around_a_blind_path_keeps_the_body_free_and_stops_the_other(walk: Window) -> None:
    """Through `SyntheticScenes`, with furniture pushed up to the telling solids."""
    scenes = SyntheticScenes(replace(SyntheticSceneConfig(), empty_share=0.0))
    body, path_m, hits = swept(walk), blind(walk), []
    for seed in range(8):
        named = scenes.solids(
            np.random.default_rng(seed), walk.joints_m, walk.R_world_joint, None, walk.contact, spheres=adult_spheres(),
            blind_m=path_m,
        )  # fmt: skip
        boxes = Boxes.joined(box for _, box in named)
        assert nearest_ball_m(body, boxes) > -0.02, "supports may press in as far as their slack"
        hits.append(boxes.signed_distance(path_m).min() < -0.01)
    assert np.mean(hits) > 0.5
    without = [
        Boxes.joined(
            box
            for _, box in scenes.solids(
                np.random.default_rng(seed), walk.joints_m, walk.R_world_joint, None, walk.contact,
                spheres=adult_spheres(),
            )
        ).signed_distance(path_m).min() < -0.01
        for seed in range(8)
    ]  # fmt: skip
    assert np.mean(hits) > np.mean(without), "scenes drawn without that path stop it less often"
