"""Which form objects in rooms are taken for, and what a network's word counts."""

from __future__ import annotations

import numpy as np
import pytest
from furnished import bed, chair, furnished, moved, shelf, yaw_of
from seen_boxes import Block, table

from video2anim.objects.extrusion import OUTLINE
from video2anim.objects.furniture import BOX, FORMS
from video2anim.objects.meshing import outline_iou
from video2anim.objects.recognize import Recognition, log_prior, recognized

CLASSES = {form.name for form in FORMS} | {OUTLINE}

THINGS = {
    "chair": moved(chair(), (0.2, -2.8), 0.5),
    "table": table(1.3, 0.74, 0.8, (0.1, -3.2), 0.5),
    "bed": moved(bed(), (0.2, -3.6), 0.5),
    "box": [Block((0.2, 0.25, -3.0), (0.7, 0.5, 0.4), 0.4)],
    "shelf": moved(shelf(), (0.2, -3.5), 0.3),
}


@pytest.mark.parametrize("name", ["chair", "table", "bed", "box"])
def test_things_that_nothing_is_said_of_are_recognized(name: str) -> None:
    """From exact depth and masks. A plain box may be a low cabinet, which is the same solid."""
    found = recognized(furnished(THINGS[name]).seen, log_prior("object"))
    assert found[0].form.name in ({"box", "cabinet"} if name == "box" else {name})
    scores = [fit.log_evidence for fit in found]
    assert scores == sorted(scores, reverse=True)
    rival = next(fit for fit in found[1:] if fit.form.name not in {"box", "cabinet"} or name != "box")
    assert found[0].log_evidence > rival.log_evidence + 3


def test_a_shelf_full_of_books_is_told_from_a_cabinet_by_its_name_alone() -> None:
    seen = furnished(THINGS["shelf"]).seen
    forms = [form for form in FORMS if form.name in ("shelf", "cabinet", "box", "bed")]
    assert recognized(seen, log_prior("object"), forms)[0].form.name in ("shelf", "cabinet")
    fit = recognized(seen, log_prior("bookcase"))[0]
    assert fit.form.name == "shelf"
    np.testing.assert_allclose(fit.sizes_m, (0.9, 0.3, 1.8), atol=0.06)


def test_a_wrong_word_is_outvoted_by_the_outline_and_the_depth() -> None:
    """A chair that a network calls a lamp stays a chair, and is called one."""
    seen = furnished(THINGS["chair"]).seen
    (fit, *_), label = Recognition(seen, "lamp").fits()
    assert (fit.form.name, label) == ("chair", "chair")
    lamp = recognized(seen, {"lamp": 0.0})[0]
    overlap, whole = (outline_iou(one, seen.evidence, seen.own) for one in (lamp, fit))
    assert overlap < 0.8 * whole


def test_a_label_with_impossible_sizes_is_rejected() -> None:
    """A screen 2.6 m high is no chair; a chair is one."""
    screen = furnished([Block((0.2, 1.3, -3.6), (1.8, 2.6, 0.1), 0.2)]).seen
    (fit, *_), label = Recognition(screen, "chair").fits()
    assert label == fit.form.name
    assert label not in ("chair", "armchair", "stool", "sofa")
    (fit, *_), label = Recognition(furnished(THINGS["chair"]).seen, "swivel chair").fits()
    assert (fit.form.name, label) == ("chair", "swivel chair")


def test_a_label_decides_between_forms_that_look_alike() -> None:
    """A cabinet and a plain box are the same solid."""
    seen = furnished(THINGS["box"]).seen
    for word in ("box", "wardrobe"):
        (fit, *_), label = Recognition(seen, word).fits()
        assert (fit.form.name, label) == ({"wardrobe": "cabinet"}.get(word, word), word)


def test_a_bench_is_a_low_table_of_that_name() -> None:
    (fit, *_), label = Recognition(furnished(table(1.3, 0.44, 0.36, (0.1, -3.0), 0.4)).seen, "bench").fits()
    assert (fit.form.name, fit.form.variant, label) == ("table", "low", "bench")
    np.testing.assert_allclose(fit.sizes_m[[0, 2]], (1.3, 0.44), atol=0.06)


def test_a_label_without_a_form_is_kept() -> None:
    """It says nothing about the form."""
    assert Recognition(furnished(THINGS["box"]).seen, "piano").fits()[1] == "piano"


def test_a_chair_is_not_turned_around() -> None:
    """The back of a chair seen from the front is behind it."""
    for yaw_rad in (0.4, np.pi - 0.4):
        fit = recognized(furnished(moved(chair(), (0, -2.8), yaw_rad)).seen, {"chair": 0.0})[0]
        assert np.cos(yaw_of(fit.T_world_object) - yaw_rad) > 0.99


def test_classes_without_a_probability_are_not_tried() -> None:
    seen = furnished(THINGS["chair"]).seen
    tried = {fit.form.name for fit in recognized(seen, {"box": 0.0, "stool": -1.0})}
    assert tried == {"box", "stool"}


def test_a_probability_adds_to_the_evidence() -> None:
    seen = furnished(THINGS["box"]).seen
    (first,), (second,) = (recognized(seen, {"box": odds}, forms=[BOX]) for odds in (0.0, -2.5))
    assert first.log_evidence - second.log_evidence == pytest.approx(2.5)
    np.testing.assert_array_equal(first.values, second.values)


def test_a_thing_on_another_rests_where_it_is_seen() -> None:
    """A box on a chest 0.6 m high. How far it goes on behind the edge of the chest is not seen; stage place puts it
    down."""
    chest = Block((0.0, 0.3, -3.0), (1.4, 0.6, 0.6))
    room = furnished([Block((0.0, 0.75, -3.0), (0.4, 0.3, 0.3))], [chest])
    fit = recognized(room.seen, log_prior("box"))[0]
    assert fit.T_world_object[1, 3] == pytest.approx(0.6, abs=0.06)
    assert fit.T_world_object[1, 3] + fit.sizes_m[2] == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize("word", sorted(CLASSES))
def test_a_word_names_its_own_class_most(word: str) -> None:
    odds = log_prior(word)
    assert odds.keys() == CLASSES
    assert max(odds, key=odds.__getitem__) == word
    assert all(value < 0 for other, value in odds.items() if other != word)


@pytest.mark.parametrize(
    ("word", "means"),
    [("couch", "sofa"), ("dining table", "table"), ("potted plant", "plant"), ("bookcase", "shelf"),
     ("wardrobe", "cabinet"), ("refrigerator", "cabinet"), ("stairs", "steps"), ("swivel chair", "chair")],
)  # fmt: skip
def test_words_of_networks_are_known(word: str, means: str) -> None:
    assert log_prior(word) == log_prior(means)


def test_a_chair_may_be_an_armchair_rather_than_a_lamp() -> None:
    odds = log_prior("chair")
    assert odds["chair"] > odds["armchair"] > odds["lamp"] + 2
    assert log_prior("table")["desk"] > log_prior("table")["bed"] + 2


@pytest.mark.parametrize("word", ["object", "furniture", "zebra", ""])
def test_words_that_no_form_has_say_nothing(word: str) -> None:
    assert len(set(log_prior(word).values())) == 1
    assert log_prior(word).keys() == CLASSES
