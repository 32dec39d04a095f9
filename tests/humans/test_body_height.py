"""Known heights: whose they are, and which are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
import pytest

from stages.humans import HumansConfig, recover_humans
from video2anim.errors import UsageError
from video2anim.humans.body_height import expect_heights, height_of, parse_heights
from video2anim.pipeline.options import options_of
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    CameraEstimate,
    Intrinsics,
    PayloadFile,
    PersonTrack,
    PersonTracks,
    SourceInfo,
    VideoClip,
)


def test_one_number_is_the_main_persons_height() -> None:
    assert [height_of(1.82, person, main_id=2) for person in (2, 1, 3)] == [1.82, None, None]
    assert height_of(None, 2, main_id=2) is None


def test_heights_by_id() -> None:
    assert [height_of({3: 1.1, 2: 1.8}, person, main_id=2) for person in (2, 1, 3)] == [1.8, None, 1.1]


def test_words_of_the_command_line() -> None:
    assert parse_heights([]) is None
    assert parse_heights(["1.82"]) == 1.82
    assert parse_heights(["2=1.12"]) == {2: 1.12}
    assert parse_heights(["1=1.7", "2=1.12"]) == {1: 1.7, 2: 1.12}


@pytest.mark.parametrize(
    "words", [["tall"], ["1.7", "1.8"], ["1.7", "2=1.1"], ["a=1.7"], ["=1.7"], ["0=1.7"], ["1="], ["1=1.7", "1=1.8"]]
)
def test_words_that_say_no_height(words: list[str]) -> None:
    with pytest.raises(UsageError, match="--height-m: want one height in meters, such as"):
        parse_heights(words)


@pytest.mark.parametrize("known", [9.0, 0.1, float("nan"), {1: 1.7, 2: 9.0}])
def test_a_height_that_nobody_has(known: Any) -> None:
    with pytest.raises(UsageError, match=r"humans\.height_m: want a number from 0\.5 to 2\.5 m \(--height-m\).*, got"):
        options_of(HumansConfig)["height_m"].checked(known, "humans.height_m")


def test_somebody_who_is_not_worked_on() -> None:
    expect_heights({1: 1.7}, (1, 2))
    with pytest.raises(UsageError, match=r"--height-m 3=1.7: want the ID of a selected person \(1, 2\)"):
        expect_heights({3: 1.7}, (1, 2))


@pytest.mark.parametrize("height_m", [None, 1.7, {1: 1.7, 2: 1.1}])
def test_the_configuration_holds_both_forms(height_m: Any) -> None:
    """Also as they come back from JSON, where every key is text."""
    adapter = pydantic.TypeAdapter(HumansConfig)
    config = adapter.validate_python({"height_m": height_m})
    assert config == replace(HumansConfig(), height_m=height_m)
    assert adapter.validate_json(adapter.dump_json(config)) == config


def test_with_everybody_worked_on_only_the_main_person_has_the_given_height(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stage asks for nobody's fit before all heights are told apart; the second track is the main person's."""
    heights_m: list[float | None] = []

    def fitted(observed: Any, lifted: Any, height_m: float | None, *others: Any) -> None:
        heights_m.append(height_m)
        if len(heights_m) == 3:
            raise StopAsyncIteration

    monkeypatch.setattr("stages.humans._fit", fitted)
    monkeypatch.setattr("video2anim.humans.observe.observations", lambda *parts: None)
    monkeypatch.setattr("video2anim.humans.lifting.lift", lambda *parts: None)
    still = np.tile(np.eye(4), (2, 1, 1))
    track = PersonTrack(
        1, np.ones(2, bool), np.ones(2), np.zeros((2, 4)), np.zeros((2, 33, 2)), np.zeros((2, 33, 3)),
        np.zeros((2, 33)), np.zeros((2, 64, 64), np.uint8), np.zeros((2, 2, 3)),
    )  # fmt: skip
    tracks = PersonTracks(tuple(replace(track, person_id=number) for number in (1, 2, 3)), (2, 1, 3))
    time_s = np.arange(2) / 30
    source = SourceInfo("h264", "yuv420p", 64, 48, 0, 1.0, 30.0, 2, 2, 2 / 30, 0.0)
    clip = VideoClip(PayloadFile(Path("x")), 64, 48, 30.0, time_s, time_s, source, ((0.0, 1.0),), 0, ())
    camera = CameraEstimate(Intrinsics.centered(60.0, 64, 48), "user", 0.01, np.array([0, -1.0, 0]), 0.01, True, still)
    config = HumansConfig(height_m=1.82)
    with pytest.raises(StopAsyncIteration):
        recover_humans(clip, tracks, camera, config, StageContext(Path(), load_model=lambda name: None))
    assert heights_m == [1.82, None, None]
