"""What a run is, from a file; and the laws by which keyframes are drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenemi.data.windows import MotionSet
from scenemi.model.config import SIZES, ModelConfig, PaperConfig, config_from_json
from scenemi.training.config import TrainConfig
from scenemi.training.keyframe_masks import draw_mask, draw_observed_mask, draw_telling_mask
from scenemi.training.runs import RunFiles, drawn_from, watched_for
from video2anim.errors import InputError

SHIPPED = sorted((Path(__file__).parents[3] / "configs" / "scenemi").glob("*.json"))


def gaps(mask: np.ndarray) -> np.ndarray:
    return np.diff(np.flatnonzero(mask))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_configuration_is_read_and_comes_back(path: Path) -> None:
    config = TrainConfig.read(path)
    assert TrainConfig.from_json(config.to_json()) == config
    assert 0 < config.ema < 0.28, "a share of the steps, not a decay; no power function is wider"


def test_configurations_come_from_files(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    path.write_text('{"model": {"size": "tiny", "scene": false}, "batch": 7, "sources": ["cmu"]}')
    config = TrainConfig.read(path)
    assert config.model == replace(SIZES["tiny"], scene=False)
    assert config.batch == 7
    assert config.sources == ("cmu",)
    assert TrainConfig.from_json(config.to_json()) == config
    path.write_text('{"model": {"size": "paper-narrow", "use_local": false}}')
    assert TrainConfig.read(path).model == replace(SIZES["paper-narrow"], use_local=False)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"batches": 1}', "unknown batches"),
        ('{"model": "huge"}', "model: want"),
        ('{"model": 3}', "model: want"),
        ('{"model": {"size": "huge"}}', "model: want|huge"),
        ('{"model": {"depth": 3}}', "depth"),
        ('{"model": {"size": "tiny", "width": 63}}', "width"),
        ('{"batch": "many"}', "batch"),
        ('{"batch": 0}', "batch"),
        ('{"ema": 0.9999}', "ema"),
        ('{"keyframes": "some"}', "keyframes"),
        ("[1]", "want a table"),
        ("[", "cannot be read as JSON"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "c.json"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        TrainConfig.read(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.json"):
        TrainConfig.read(tmp_path / "none.json")


@pytest.mark.parametrize("size", sorted(SIZES))
def test_sizes_come_back_from_plain_values(size: str) -> None:
    assert config_from_json(SIZES[size].to_json()) == SIZES[size]
    with pytest.raises(ValueError, match="colors"):
        config_from_json({**SIZES[size].to_json(), "colors": 3})


def test_impossible_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="heads"):
        ModelConfig(width=100, heads=3)
    with pytest.raises(ValueError, match="whole patches"):
        PaperConfig(grid=(48, 20, 48))
    with pytest.raises(ValueError, match="groups"):
        PaperConfig(width=66)


def test_masks_have_both_ends_and_every_density() -> None:
    rng = np.random.default_rng(0)
    laws = ("paper", "mixed")
    for law in laws:
        masks = np.stack([draw_mask(rng, 121, law) for _ in range(500)])  # type: ignore[arg-type]
        assert masks[:, [0, -1]].all()
        assert masks.sum(1).min() <= 4
        assert masks.sum(1).max() >= 115
    share = np.mean([draw_mask(rng, 121, "mixed").sum() <= 10 for _ in range(1000)])
    assert share > 0.15, "sparse keyframes are common in the mixed law"


def test_keyframes_of_the_papers_law_are_any_number_alike() -> None:
    rng = np.random.default_rng(0)
    counts = np.array([draw_mask(rng, 121, "paper").sum() for _ in range(4000)])
    assert counts.mean() == pytest.approx((2 + 121) / 2, abs=2)
    quarters = np.histogram(counts, [2, 32, 62, 92, 122])[0] / len(counts)
    np.testing.assert_allclose(quarters, 0.25, atol=0.03)


def test_telling_keyframes_are_far_apart() -> None:
    rng = np.random.default_rng(0)
    masks = [draw_telling_mask(rng, 121) for _ in range(500)]
    assert all(mask[[0, -1]].all() for mask in masks)
    inner = np.concatenate([gaps(mask)[1:-1] for mask in masks])
    assert inner.min() >= 15
    assert np.mean([mask.sum() <= 4 for mask in masks]) > 0.3


def test_observed_frames_are_many_with_stretches_unseen() -> None:
    rng = np.random.default_rng(0)
    masks = [draw_observed_mask(rng, 121) for _ in range(600)]
    assert all(mask[[0, -1]].all() for mask in masks)
    longest = np.array([gaps(mask).max() for mask in masks])
    assert 0.1 < (longest == 1).mean() < 0.5, "some are seen all the time"
    assert (longest > 30).mean() > 0.1, "some are lost for a second or more"
    assert np.mean([mask.sum() for mask in masks]) > 40


def test_augmentation_is_that_of_the_configuration_but_not_for_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    files = RunFiles.of("gpu", [Path("some.npz")], None, None)
    use = drawn_from(files)
    assert (use.mix, use.restyle, use.reverse) == (0.5, 0.5, files.config.reverse)
    assert use.reverse > 0
    asked = []
    monkeypatch.setattr(MotionSet, "build", lambda *given, **_: asked.append(given))
    watched_for(files)
    assert (asked[0][4].mix, asked[0][4].restyle, asked[0][4].reverse) == (0, 0, 0)
