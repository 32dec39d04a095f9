"""Training and evaluation in captured scenes, from files of the data sets' layouts to weights and numbers."""

from __future__ import annotations

import contextlib
import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from captured_files import GRID, START_Z_M, VOXEL_M, WALL, WRITERS

from scenemi.cli import main as cli
from scenemi.data import trumans
from scenemi.data.container import write_archive
from scenemi.data.scene_clips import read_scene_clips
from scenemi.data.split import Split
from scenemi.data.windows import MotionSetConfig
from scenemi.evaluation.protocol import evaluate
from scenemi.evaluation.real_scenes import windows_in_real_scenes
from scenemi.evaluation.windows import KeyframeProtocol
from scenemi.features import JOINTS, canonical_frame, to_canonical
from scenemi.metrics import CLOSE_PROXIMITY_M
from scenemi.model.config import SIZES, PaperConfig
from scenemi.model.denoiser import Denoiser
from scenemi.model.weights import load_weights
from scenemi.prior import InterpolationPrior
from scenemi.training import loop, pool, run
from scenemi.training.batches import PoolBatches, statistics_of
from scenemi.training.config import TrainConfig
from scenemi.training.descriptors import descriptors_of
from scenemi.training.losses import TrainingLoss
from scenemi.training.pool import SceneShard, Shard, grow_pool, open_pool, telling_share
from scenemi.training.run import Progress
from scenemi.training.runs import RunFiles, clips_for, write_run_weights
from scenemi.training.scene_pool import SceneMotions, prepare_scenes
from video2anim.errors import InputError, UsageError
from video2anim.types.skeleton import MIRROR_JOINT, forward_kinematics

SHARD = 16
CONFIG = TrainConfig(
    model=SIZES["tiny"], batch=4, parts=1, workers=0, log_every=1, save_every=2, warmup=2, bodies=2, validate_every=3,
    pool_windows=2 * SHARD, sources=tuple(WRITERS), scene_share=1.0,
)  # fmt: skip


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (pool, loop):
        monkeypatch.setattr(module, "SHARD_WINDOWS", SHARD)
    monkeypatch.setattr(run, "_SCALE_WINDOWS", 8)


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where converted data sets are kept."""
    return tmp_path_factory.mktemp("cache")


def run_files(source: str, written: dict[str, Path], cache: Path) -> RunFiles:
    """A run on one data set, its test room for validation."""
    files = RunFiles(CONFIG, (), None, cache, ((source, written[source]),))
    names = [one.clip.name for one in read_scene_clips(source, written[source]) if one.part == "test"]
    return replace(files, split=Split({name: "val" for name in names}))


@pytest.mark.parametrize("source", WRITERS)
def test_three_steps_in_captured_scenes(source: str, written: dict[str, Path], cache: Path, tmp_path: Path) -> None:
    files = run_files(source, written, cache)
    clips = clips_for(files, tmp_path)
    assert isinstance(clips.motions, SceneMotions)
    assert clips.scenes is None
    told: list[Progress] = []
    state = loop.train(CONFIG, clips.motions, tmp_path, validation=clips.watched, stop_at=3, on_progress=told.append)
    assert state.step == 3
    (rows,) = [one.validation for one in told if one.validation]
    assert [row.scene for row in rows] == [False, False, False, True]
    assert 0 <= rows[-1].inside <= 1
    shards = open_pool(tmp_path / loop.POOL)
    assert all(isinstance(shard, SceneShard) for shard in shards)
    assert 0 <= telling_share(shards) <= 1
    card = load_weights(write_run_weights(tmp_path / "w.safetensors", state, *clips.sets)).card
    assert card["sources"] == [source]
    again = loop.train(CONFIG, clips_for(files, tmp_path).motions, tmp_path, stop_at=4)
    assert again.step == 4


@pytest.fixture(scope="session")
def motions(written: dict[str, Path], cache: Path) -> SceneMotions:
    """The clip for training of TRUMANS on two bodies."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trumans, "_VOXEL_M", VOXEL_M)
        patch.setattr(trumans, "_GRID", GRID)
        folder = prepare_scenes("trumans", written["trumans"], cache)
    return SceneMotions.read([folder], None, "train", 2, MotionSetConfig(sources=("trumans",)), cache=cache)


def test_a_volume_has_the_wall_where_the_person_meets_it(motions: SceneMotions, written: dict[str, Path]) -> None:
    """In the frame of each window, on each body: the scene's own distances at the joints, and the wall ahead."""
    solids = next(read_scene_clips("trumans", written["trumans"])).solids()
    (batch,) = motions.fixed_windows(stride=10, full_only=True)
    T = canonical_frame(batch.R_parent_joint[:, 0, 0], batch.translation_m[:, 0])
    R, translation_m = to_canonical(batch.R_parent_joint, batch.translation_m)
    joints_m, _ = forward_kinematics(R, translation_m, motions.rest_joints_m[batch.body_index][:, None])
    flat_m = joints_m.reshape(len(batch), -1, 3)
    rows = motions.volumes(T, batch.clip, batch.body_index, flat_m)
    found_m = rows.field(torch.ones(len(batch))).solids_m(torch.from_numpy(flat_m).float()).numpy()
    assert set(batch.body_index) == {0, 1}
    for i in range(len(batch)):
        fit = motions._fit(int(batch.clip[i]), int(batch.body_index[i]))
        world_m = flat_m[i] @ T[i, :3, :3].T + T[i, :3, 3]
        exact_m = np.minimum(fit.scale * solids.sample(fit.scene_points(world_m)), 0.6)
        assert np.abs(found_m[i] - exact_m).max() < 0.04
        assert np.abs(found_m[i] - exact_m).mean() < 0.004
        wall_m = fit.scale * WALL[0, 2] - batch.translation_m[i, -1, 2]
        ahead = torch.tensor([[[0.0, 1.0, float(translation_m[i, -1, 2]) + 0.6]]])
        known = rows.field((torch.arange(len(batch)) == i).float())
        assert float(known.solids_m(ahead)) == pytest.approx(min(wall_m - 0.6, 0.6), abs=0.04)


@pytest.fixture(scope="session")
def shards(motions: SceneMotions, tmp_path_factory: pytest.TempPathFactory) -> list[SceneShard]:
    folder = tmp_path_factory.mktemp("pool")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool, "SHARD_WINDOWS", SHARD)
        grow_pool(folder, motions, 2 * SHARD)
    return open_pool(folder)


def test_mirrored_windows_keep_their_distances(shards: list[SceneShard]) -> None:
    """Of every window drawn the distances of its joints are those of the stored window, sides exchanged or not."""
    stored = torch.cat([torch.from_numpy(shard.features / 8192.0) for shard in shards]).float()
    scene = pool.stored_scenes([(shard, row) for shard in shards for row in range(SHARD)])
    true_m = scene.field(torch.ones(2 * SHARD)).distance_m(stored[..., JOINTS].unflatten(-1, (22, 3)).flatten(1, 2))
    true_m = true_m.unflatten(1, (-1, 22))
    mirrored = 0
    for step in range(3):
        batch = PoolBatches(shards, CONFIG)[step]
        joints = batch.features[..., JOINTS].unflatten(-1, (22, 3))
        field = batch.scene.field(torch.ones(CONFIG.batch))
        found_m = field.distance_m(joints.flatten(1, 2)).unflatten(1, (-1, 22))
        for window, features in zip(found_m, batch.features, strict=True):
            apart = (stored[..., 1] - features[:, 1]).abs().amax(1)
            near = true_m[torch.nonzero(apart < 1e-6)[:, 0]]
            straight = (near - window).abs().amax((1, 2))
            across = (near[..., MIRROR_JOINT] - window).abs().amax((1, 2))
            assert float(torch.minimum(straight, across).min()) < 1e-3
            mirrored += int(across.min() < straight.min())
    assert 0 < mirrored < 3 * CONFIG.batch


def test_both_kinds_of_scenes_take_turns(shards: list[SceneShard], motions: SceneMotions) -> None:
    boxes = np.zeros((SHARD, 16, 7), np.float32)
    boxes[:, 0] = [0.5, 0.4, 1.0, 0.2, 0.4, 0.2, 0.3]
    made_up = Shard(
        *(getattr(shards[0], name) for name in ("features", "valid_frames", "body")), boxes,
        shards[0].mask, shards[0].collides,
    )  # fmt: skip
    data = PoolBatches([made_up, *shards], CONFIG)
    kinds = [len(data[step].values) > 0 for step in range(20)]
    assert 4 < sum(kinds) < 16
    statistics = statistics_of(data.shards, motions.bodies())
    loss = TrainingLoss(Denoiser(SIZES["tiny"]), statistics, motions.bodies(), CONFIG)
    for captured in (False, True):
        losses = loss(data[kinds.index(captured)])
        assert torch.isfinite(losses.total)


def test_the_papers_form_sees_captured_scenes(shards: list[SceneShard], motions: SceneMotions) -> None:
    batch = PoolBatches(shards, replace(CONFIG, keyframes="paper", drop_global=0.0, drop_local=0.0))[0]
    config = PaperConfig(grid=(24, 24, 24), voxel_m=0.2)
    found = descriptors_of(batch, batch.features, motions.bodies(), config)
    assert found is not None
    share = found.occupancy.mean((1, 2, 3))
    assert ((share > 0.001) & (share < 0.5)).all()
    offsets = found.local_m.norm(dim=-1)
    assert (offsets[batch.mask > 0].amax(-1) > 0.05).all()
    assert float(offsets.max()) <= 0.61


def test_clips_of_archives_and_of_captured_scenes_in_one_run(
    written: dict[str, Path], cache: Path, tmp_path: Path
) -> None:
    found = next(read_scene_clips("gimo", written["gimo"])).clip
    write_archive(tmp_path / "own.npz", [replace(found, name="own", source="own")])
    config = replace(CONFIG, sources=("own", "gimo"), bodies=1, pool_windows=SHARD)
    files = replace(run_files("gimo", written, cache), config=config, motion=(tmp_path / "own.npz",))
    clips = clips_for(files, tmp_path)
    assert not isinstance(clips.motions, SceneMotions)
    assert clips.scenes is not None
    state = loop.train(config, clips.motions, tmp_path, scenes=clips.scenes, stop_at=2)
    assert len(open_pool(tmp_path / loop.POOL)) == len(open_pool(tmp_path / loop.SCENE_POOL)) == 1
    state = loop.cool(tmp_path, clips.motions, 1)
    assert state.step == 3
    card = load_weights(write_run_weights(tmp_path / "w.safetensors", state, *clips.sets)).card
    assert card["sources"] == ["gimo", "own"]


def test_noncommercial_sources_are_named_in_the_configuration(written: dict[str, Path], tmp_path: Path) -> None:
    files = RunFiles.of(None, [], None, None, [f"gimo={written['gimo']}"])
    with pytest.raises(InputError, match=r"gimo is not free .* configs/scenemi/gimo\.json"):
        clips_for(files, tmp_path)
    with pytest.raises(UsageError, match="got neither"):
        RunFiles.of(None, [], None, None)


def test_shipped_configurations_name_their_source() -> None:
    for source in WRITERS:
        config = TrainConfig.read(Path(__file__).parents[3] / "configs" / "scenemi" / f"{source}.json")
        assert config.sources == (source,)


@pytest.mark.parametrize("source", WRITERS)
def test_a_window_is_evaluated_in_its_own_scene(source: str, written: dict[str, Path]) -> None:
    (window,) = windows_in_real_scenes([(source, written[source])])
    assert window.source == source
    assert window.obstacles is not None
    assert window.scene is not None
    start_m = window.joints_m[0, 0] * [1, 0, 1]
    assert np.abs(start_m).max() < 1e-6, "windows begin over the origin"
    wall_m = window.obstacles.fit.scale * (WALL[0, 2] - START_Z_M)
    probe = np.array([[[0.0, 1.0, wall_m - 0.25], [0.0, 1.0, wall_m + 0.04]], [[0.0, 0.01, 0.3], [0.0, 0.0, 0.0]]])
    found = window.obstacles.signed_distance(probe)
    assert found.shape == (2, 2)
    assert found[0, 0] == CLOSE_PROXIMITY_M, "what is farther is not close"
    assert found[0, 1] == pytest.approx(-0.04, abs=0.04)
    assert (found[1] == CLOSE_PROXIMITY_M).all(), "the floor is none of the obstacles"
    assert float(window.scene.sample(np.array([[0.0, 0.3, 0.5]]))[0]) == pytest.approx(0.3, abs=0.02)
    result = evaluate([window], InterpolationPrior(), KeyframeProtocol(60))
    assert result.truth[0].collision_frame_ratio_1cm == 0
    assert result.summary()["windows"] == 1
    assert 0 < result.mean("mjpe_all_m") < 0.5


def scenemi(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> tuple[int, str]:
    """Exit code and what was said on stderr."""
    monkeypatch.setattr(sys, "argv", ["scenemi", *map(str, words)])
    err, code = io.StringIO(), 0
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
            cli.run()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(bool(end.code))
    return code, err.getvalue()


def test_the_command_line_trains_and_evaluates(
    written: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, prox = tmp_path / "run.json", f"prox={written['prox']}"
    values = {"model": "tiny", "batch": 2, "bodies": 1, "log_every": 1, "workers": 0, "pool_windows": SHARD}
    config.write_text(json.dumps(values | {"sources": ["prox"]}))
    words = ("train", "--scenes", prox, "--config", config, "--out", tmp_path / "run", "--device", "cpu")
    code, err = scenemi(monkeypatch, *words, "--minutes", "0.01")
    assert code == 0, err
    assert "no clip is for validation" in err
    words = ("evaluate", "--scenes-from", prox, "--weights", tmp_path / "run" / "weights.safetensors", "--steps", "2")
    code, err = scenemi(monkeypatch, *words, "--device", "cpu", "--json", tmp_path / "numbers.json")
    assert code == 0, err
    assert json.loads((tmp_path / "numbers.json").read_text())["windows"] == 1
    assert scenemi(monkeypatch, "evaluate", "--weights", "interpolation")[0] == 2
    assert scenemi(monkeypatch, "train", "--out", tmp_path / "x")[0] == 2
    code, err = scenemi(monkeypatch, "train", "--scenes", prox, "--out", tmp_path / "x")
    assert code == 3
    assert "configs/scenemi/prox.json" in err
