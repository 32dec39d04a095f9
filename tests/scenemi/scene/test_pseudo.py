"""Random scenes leave the motion its space, carry what rests, and report what they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scene_motions import Window, procedural_window

from scenemi.scene.body_spheres import BodySpheres, adult_spheres, fit_spheres
from scenemi.scene.boxes import Boxes
from scenemi.scene.furniture import FURNITURE, Piece, doorway, wall
from scenemi.scene.pseudo import SyntheticSceneConfig, SyntheticScenes
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.types.motion import BodyShape

FULL = SyntheticSceneConfig(empty_share=0.0)
TIGHT = replace(FULL, clearance_m=((1.0, 0.0, 0.0),), wall_room_m=0.0, loose_share=0.0, furniture=(5, 8))
DEEPEST_M = 0.02


class Scene(NamedTuple):
    kinds: tuple[str, ...]
    boxes: Boxes


def draw(window: Window, seed: int, config: SyntheticSceneConfig = FULL, spheres: BodySpheres | None = None) -> Scene:
    rng = np.random.default_rng(seed)
    named = SyntheticScenes(config).solids(
        rng, window.joints_m, window.R_world_joint, window.anchors_m, window.contact, spheres=spheres
    )
    return Scene(tuple(kind for kind, _ in named), Boxes.joined(boxes for _, boxes in named))


@pytest.mark.parametrize("name", ["walk", "sit", "step_up"])
def test_no_skin_is_deep_in_the_tightest_scenes(name: str, request: pytest.FixtureRequest) -> None:
    window: Window = request.getfixturevalue(name)
    skin_m = window.skin_m()
    nearest_m = [float(draw(window, seed, TIGHT).boxes.signed_distance(skin_m).min()) for seed in range(8)]
    assert min(nearest_m) > -DEEPEST_M
    assert np.median(nearest_m) < 0.03, "tight scenes touch the body"


def test_no_skin_of_a_heavy_body_is_deep_either() -> None:
    body = shaped_body(BodyShape("anny", {**ADULT, "weight": 0.8, "height": 0.7}))
    window = procedural_window("sit", body, 4)
    skin_m = window.skin_m()
    for spheres in (None, fit_spheres(body)):
        for seed in range(4):
            assert draw(window, seed, TIGHT, spheres).boxes.signed_distance(skin_m).min() > -DEEPEST_M


def test_scenes_constrain_the_path(walk: Window) -> None:
    skin_m = walk.skin_m()
    nearest_m = np.array([draw(walk, seed).boxes.signed_distance(skin_m).min() for seed in range(20)])
    assert (nearest_m < 0.08).mean() > 0.3
    assert (nearest_m > 0.2).any()


def test_one_seed_one_scene(walk: Window) -> None:
    config = SyntheticSceneConfig()
    first, again, other = (draw(walk, seed, config) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.boxes.center_m, again.boxes.center_m)
    np.testing.assert_array_equal(first.boxes.half_m, again.boxes.half_m)
    assert first.kinds == again.kinds
    assert not np.array_equal(first.boxes.center_m, other.boxes.center_m)


def test_who_sits_gets_a_seat(sit: Window) -> None:
    bottom_m = (adult_spheres().placed(sit.joints_m, sit.R_world_joint)[1] - adult_spheres().radius_m)[90].min()
    for seed in range(6):
        scene = draw(sit, seed, replace(FULL, rest=replace(FULL.rest, hip_share=1.0)), adult_spheres())
        assert "seat" in scene.kinds
        hips_m = sit.body.vertices(sit.R_world_joint[90:91], sit.joints_m[90:91])[0]
        hips_m = hips_m[np.isin(sit.body.vertex_part, (0, 1, 2))]
        assert -DEEPEST_M < scene.boxes.signed_distance(hips_m).min() < 0.02
    assert bottom_m < 0.1, "the feet stand on the floor"


def test_raised_feet_get_a_step(step_up: Window) -> None:
    high = int(step_up.joints_m[:, 10, 1].argmax())
    assert step_up.joints_m[high, 10, 1] > 0.15
    scene = draw(step_up, 0, FULL, adult_spheres())
    assert "step" in scene.kinds
    soles_m = step_up.skin_m(3)[:, np.isin(step_up.body.vertex_part, (7, 8, 10, 11))]
    assert -DEEPEST_M < scene.boxes.signed_distance(soles_m).min() < 0.02


def test_walking_gets_no_supports(walk: Window) -> None:
    kinds = {kind for seed in range(6) for kind in draw(walk, seed).kinds}
    assert not kinds & {"seat", "step", "backrest"}
    assert kinds


def test_empty_scenes_hold_nothing(walk: Window) -> None:
    assert not draw(walk, 0, replace(FULL, empty_share=1.0)).kinds


def test_balls_stay_near_the_skin(adult: ShapedBody, walk: Window) -> None:
    spheres = adult_spheres()
    assert len(spheres.joint) < 200
    center_m = np.moveaxis(spheres.placed(walk.joints_m[::30], walk.R_world_joint[::30]), 0, -1)
    for skin_m, ball_m in zip(walk.skin_m(30), center_m, strict=True):
        gap_m = np.linalg.norm(skin_m[::5, None] - ball_m, axis=-1) - spheres.radius_m
        assert np.quantile(gap_m.min(1), 0.99) < 0.015
        assert gap_m.min(1).max() < 0.03


@pytest.mark.parametrize("maker", [*(maker for maker, _ in FURNITURE), wall, doorway])
def test_furniture_has_usual_sizes(maker: Callable[[np.random.Generator], Piece]) -> None:
    for seed in range(20):
        piece = maker(np.random.default_rng(seed))
        assert (piece.high_m > piece.low_m).all()
        assert piece.low_m[:, 1].min() >= 0.0
        assert piece.high_m[:, 1].max() < 2.9
        assert piece.high_m[:, 2].max() <= 1e-9
        assert piece.low_m[:, 2].min() > -2.3
    assert sum(chance for _, chance in FURNITURE) == pytest.approx(1.0)
