"""Stage reconstruct with a network that makes meshes: the place it gives them, and what it does when it fails."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from object_graphs import triposr_folder
from synthetic_room import BOX_CENTER_M, BOX_SIZE_M, make_room
from test_reconstruct_sources import chair, command_of, expect_own_frame, extents, folder_with, own
from test_reconstruct_sources import reconstruct as made_by

from stages import reconstruct as stage
from stages.reconstruct import ReconstructConfig
from video2anim import networks
from video2anim.cli.compose import TableModels, pipeline_nodes
from video2anim.errors import ModelMissingError, UsageError
from video2anim.geometry.projection import transform_points
from video2anim.pipeline.config import resolve
from video2anim.pipeline.stage import StageContext
from video2anim.types import ObjectMesh


def context(load: Callable[[str], Any] = networks.load_model) -> StageContext:
    return StageContext(Path(), load_model=load)


def reconstruct(config: ReconstructConfig, ctx: StageContext | None = None, objects: int = 1) -> list[ObjectMesh]:
    return made_by(config, ctx or context(), objects)


def with_model(folder: Path, **options: Any) -> ReconstructConfig:
    return ReconstructConfig(model=f"triposr@{folder}", model_resolution=32, **options)


def configured(**options: Any) -> ReconstructConfig:
    """As a run has it."""
    return resolve(pipeline_nodes(), "p", [("test", {"reconstruct": options})]).stages["reconstruct"]


def test_the_network_makes_the_object_in_its_place(tmp_path: Path) -> None:
    """As high as what is seen, standing where that stands, closed, and with the network's colors."""
    ctx = context()
    (found,) = reconstruct(with_model(triposr_folder(tmp_path)), ctx)
    assert (found.object_id, found.label, found.method) == (1, "box", "triposr")
    expect_own_frame(found)
    np.testing.assert_allclose(extents(found), BOX_SIZE_M[1], rtol=0.05, err_msg="a ball")
    assert extents(found)[1] == pytest.approx(BOX_SIZE_M[1], rel=0.01)
    np.testing.assert_allclose(found.T_world_object[[0, 2], 3], BOX_CENTER_M[[0, 2]], atol=0.15)
    assert found.T_world_object[1, 3] == pytest.approx(0, abs=0.01)
    mesh = trimesh.Trimesh(found.mesh.vertices_m, found.mesh.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert ctx.warnings == []


@pytest.mark.parametrize("radius", [0.1, 0.36, 0.45, 0.55])
def test_its_unit_is_no_metre(tmp_path: Path, radius: float) -> None:
    """Of the same sizes a user's mesh would be kept as it is from 0.36 on; the box is 0.9 m high."""
    (found,) = reconstruct(with_model(triposr_folder(tmp_path, radius=radius)))
    assert extents(found)[1] == pytest.approx(BOX_SIZE_M[1], rel=0.01)


def test_what_the_picture_shows_faces_the_camera(tmp_path: Path) -> None:
    """The network's red grows towards its viewer, so the reddest places are nearest to the camera."""
    (found,) = reconstruct(with_model(triposr_folder(tmp_path)))
    camera_m = make_room().bodies.people[0].T_world_camera[0, :3, 3]
    world_m = transform_points(found.T_world_object, found.mesh.vertices_m.astype(np.float64))
    distance_m = np.linalg.norm(world_m - camera_m, axis=1)
    red = found.mesh.vertex_rgb[:, 0].astype(int)
    assert distance_m[red > np.percentile(red, 90)].max() < distance_m[red < np.percentile(red, 10)].min() - 0.3
    blue = found.mesh.vertex_rgb[:, 2].astype(float)
    assert np.corrcoef(blue, world_m[:, 1])[0, 1] > 0.99, "blue grows upwards"


def test_options_reach_the_network(tmp_path: Path) -> None:
    folder = triposr_folder(tmp_path)
    (coarse,) = reconstruct(replace(with_model(folder), model_resolution=16))
    (fine,) = reconstruct(replace(with_model(folder), model_resolution=64))
    (limited,) = reconstruct(replace(with_model(folder), model_resolution=64, max_faces=500))
    assert len(coarse.mesh.faces) < 0.2 * len(fine.mesh.faces)
    assert 250 < len(limited.mesh.faces) <= 500 < len(fine.mesh.faces)


def test_the_users_mesh_comes_first_and_the_program_last(tmp_path: Path) -> None:
    config = folder_with(tmp_path, "1.glb", chair(0.9))
    command = command_of(tmp_path, f"open({str(tmp_path / 'ran')!r}, 'w')")
    model = with_model(triposr_folder(tmp_path / "net")).model
    brought, made = reconstruct(replace(config, model=model, model_resolution=32, command=command), objects=2)
    assert (brought.method, made.method) == ("user mesh", "triposr")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("gains", "told"),
    [
        ({"density_gain": 1e-9}, "triposr: want density of 25 somewhere"),
        ({"density_gain": np.nan}, "triposr: want finite density"),
        ({"color_gain": np.nan}, "triposr: want finite color"),
    ],
)
def test_a_failing_network_leaves_a_warning_and_the_own_shape(tmp_path: Path, gains: dict, told: str) -> None:
    ctx = context()
    (found,) = reconstruct(with_model(triposr_folder(tmp_path, **gains)), ctx)
    assert found.method == own().method
    np.testing.assert_array_equal(found.mesh.vertices_m, own().mesh.vertices_m)
    np.testing.assert_array_equal(found.mesh.vertex_rgb, own().mesh.vertex_rgb)
    (warning,) = ctx.warnings
    assert f"object 1 is made of what is seen instead: {told}" in warning
    assert "\n" not in warning


def test_a_failing_network_leaves_it_to_the_program(tmp_path: Path) -> None:
    chair(50.0).export(tmp_path / "made.glb")
    command = command_of(tmp_path, f"shutil.copy({str(tmp_path / 'made.glb')!r}, mesh)")
    ctx = context()
    (found,) = reconstruct(with_model(triposr_folder(tmp_path / "net", density_gain=1e-9), command=command), ctx)
    assert found.method == "program"
    (warning,) = ctx.warnings
    assert "object 1 is made by the program instead: triposr: want density" in warning


def test_wrong_networks_and_options_stop_the_stage(tmp_path: Path) -> None:
    folder = triposr_folder(tmp_path / "small", codes=(1, 3, 40, 32, 32))
    with pytest.raises(ModelMissingError, match="want scene_codes"):
        reconstruct(with_model(folder))
    (folder / "field.onnx").unlink()
    with pytest.raises(ModelMissingError, match=r"field\.onnx, there is none; correct the path"):
        reconstruct(with_model(folder))
    with pytest.raises(UsageError, match=r"reconstruct\.model: want a model of slot object-mesh"):
        configured(model=f"hmr2@{folder / 'encoder.onnx'}")
    for resolution in (15, 257):
        with pytest.raises(UsageError, match=rf"model_resolution: want .*16 to 256, got {resolution}"):
            configured(model=f"triposr@{folder}", model_resolution=resolution)


def test_the_networks_files_are_part_of_the_key(tmp_path: Path) -> None:
    digests = functools.partial(TableModels().digests, stage.STAGE.models)
    assert digests(ReconstructConfig()) == {}
    first = digests(with_model(triposr_folder(tmp_path)))
    assert list(first) == ["triposr"]
    assert digests(with_model(triposr_folder(tmp_path, color_gain=0.5))) != first, "of field.onnx"
    assert digests(with_model(triposr_folder(tmp_path))) == first
