"""The whole scene, and inputs that have little to show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_chain import T_room_world, all_finite, run_chain, unfilmed
from synthetic_room import BOX_CENTER_M, BOX_SIZE_M, WALL_Z_M, make_room

from stages.scene import SceneConfig, build_scene
from video2anim.errors import StageError
from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.geometry.scene_mesh import joined
from video2anim.geometry.sdf import sample_sdf
from video2anim.pipeline.stage import StageContext
from video2anim.types import BodyTracks


def test_scene_has_floor_box_and_wall() -> None:
    room = make_room()
    chain = run_chain(room)
    scene = chain.scene
    # Depth shows a flat front, which may be that of a box or the back of an armchair: it is solid right behind.
    behind_m = np.outer(0.5 * BOX_SIZE_M[2] - np.linspace(0, 0.2, 11), [0, 0, 1])
    probe = np.array([*(BOX_CENTER_M + behind_m), [-0.5, 0.5, -4.5], [-0.5, -0.1, -4.5]])
    T_world_room = invert_rigid(T_room_world(room, chain))
    probe = transform_points(T_world_room, probe)
    *inside_box, free, under_floor = sample_sdf(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m, probe)
    assert min(inside_box) < -0.05
    # Of the 7 cm that height and gravity are uncertain by, half.
    assert free == pytest.approx(0.5, abs=0.035)
    assert under_floor == pytest.approx(-0.1, abs=0.035)
    assert (scene.floor.mesh.vertices_m[:, 1] == 0).all()
    a, b, c = (scene.floor.mesh.vertices_m[scene.floor.mesh.faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 1] > 0).all()
    # Wall distance: 4 % from the scale, one row (3 %) from its foot line.
    wall_m = transform_points(invert_rigid(T_world_room), joined([piece.mesh for piece in scene.background]).vertices_m)
    assert np.median(wall_m[:, 2]) == pytest.approx(WALL_Z_M, rel=0.08)
    joints = chain.metric.bodies.people[0].joints_world_m.reshape(-1, 3)
    high = scene.sdf_origin_m + scene.sdf_spacing_m * (np.array(scene.sdf_m.shape) - 1)
    assert (joints > scene.sdf_origin_m).all()
    assert (joints < high).all()
    assert all_finite(chain)


def test_floor_colors_come_from_the_plate() -> None:
    scene = run_chain(make_room()).scene
    rgb = scene.floor.textures[0].image_rgb.reshape(-1, 3).astype(int)
    assert (rgb[:, 0] > rgb[:, 2] + 30).mean() > 0.95


def test_node_limit_is_kept() -> None:
    room = make_room()
    chain = run_chain(room)
    config = SceneConfig(max_nodes=20_000)
    ctx = StageContext(chain.ctx.work_dir)
    scene = build_scene(
        room.clip, unfilmed(room), chain.placed, chain.metric, chain.depth, chain.masks, room.background, config, ctx
    )
    assert scene.sdf_m.size <= 20_000
    assert scene.sdf_spacing_m > config.sdf_spacing_m


@pytest.mark.parametrize("case", ["wall only", "never on the floor", "horizon", "tiny", "no frame valid"])
def test_poor_inputs_give_finite_honest_results(case: str) -> None:
    room = make_room()
    if case == "wall only":
        room = make_room(pitch_deg=-20.0)
    elif case == "horizon":
        room = make_room(pitch_deg=0.0, with_box=False)
    elif case == "tiny":
        room = make_room(small=(32, 18))
    else:
        body = room.bodies.people[0]
        poor = (
            replace(body, contact=np.zeros_like(body.contact))
            if case == "never on the floor"
            else replace(body, valid=np.zeros_like(body.valid))
        )
        room = replace(room, bodies=BodyTracks((poor,), room.bodies.quality))
    if case == "no frame valid":
        with pytest.raises(StageError, match="at least one valid frame"):
            run_chain(room)
        return
    chain = run_chain(room)
    assert all_finite(chain)
    if case == "never on the floor":
        true_scale = float(np.median(room.depth_m))
        assert abs(chain.metric.scale - true_scale) < 3 * chain.metric.scale_sigma
    if case == "wall only":
        assert not chain.metric.trusted
        assert chain.masks.instances == ()
        assert len(chain.scene.floor.mesh.faces) > 0
        assert {piece.name for piece in chain.scene.background} <= {"backdrop"}
