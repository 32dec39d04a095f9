"""Clothes sit where clothes sit, on every body."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.lab.synth.appearance import make_appearance
from video2anim.lab.synth.render.garments import borders_of, material_at, spanning
from video2anim.lab.synth.render.texture import KINDS
from video2anim.lab.synth.wardrobe import BAREFOOT, draw_outfit
from video2anim.types import BodyShape
from video2anim.types.skeleton import JOINT_INDEX

SHAPES = (
    {},
    {"gender": 0.0, "height": 0.65, "weight": 0.8, "muscle": 0.7},
    {"gender": 1.0, "height": 0.15, "weight": 0.25, "age": 0.85},
)


def body_of(number: int) -> ShapedBody:
    return shaped_body(BodyShape("anny", {**ADULT, **SHAPES[number]}))


def rest_joint(body: ShapedBody, name: str) -> np.ndarray:
    return np.linalg.inv(body.inverse_bind[JOINT_INDEX[name]])[:3, 3]


@pytest.mark.parametrize("number", range(len(SHAPES)))
@pytest.mark.parametrize("seed", range(6))
def test_every_part_of_the_body_wears_what_belongs_there(number: int, seed: int) -> None:
    body = body_of(number)
    face, materials = make_appearance(body, np.random.default_rng(seed))
    outfit = draw_outfit(body.shape.parameters["gender"], np.random.default_rng(seed))
    names = list(outfit.materials)
    assert face.shape == (len(body.faces),)
    assert face.min() >= 0
    assert face.max() < len(materials) == len(names)
    worn = np.array(names)[face]
    center = body.rest_vertices_m[body.faces].mean(1)

    def near(joint: str, radius: float) -> np.ndarray:
        return worn[np.linalg.norm(center - rest_joint(body, joint), axis=1) < radius]

    feet = {"shoe", "sole"} if outfit.shoe != BAREFOOT else {"sock"} if outfit.sock else {"skin"}
    assert set(near("left_foot", 0.05)) <= feet
    assert set(near("right_foot", 0.05)) <= feet
    assert (near("spine2", 0.17) == "top").mean() > 0.9
    assert set(near("pelvis", 0.17)) <= {"top", "bottom", "belt"}
    hands = worn[np.abs(center[:, 0]) > np.abs(rest_joint(body, "left_wrist")[0]) + 0.03]
    assert set(hands) == {"skin"}
    for wanted in ("skin", "lips", "brow", "eye", "iris", "top", "bottom"):
        assert (worn == wanted).any(), wanted
    top_of_head = center[:, 1] > body.rest_vertices_m[:, 1].max() - 0.03
    assert len(set(worn[top_of_head])) == 1
    assert set(worn[top_of_head]) <= {"hair", "skin"}


def test_looks_are_about_symmetric() -> None:
    body = body_of(0)
    face, _ = make_appearance(body, np.random.default_rng(3))
    area = np.linalg.norm(
        np.cross(*(body.rest_vertices_m[body.faces[:, k]] - body.rest_vertices_m[body.faces[:, 0]] for k in (1, 2))),
        axis=1,
    )
    left = body.rest_vertices_m[body.faces].mean(1)[:, 0] > 0
    for number in np.unique(face):
        of = face == number
        assert area[of & left].sum() == pytest.approx(area[of & ~left].sum(), rel=0.12, abs=3e-4)


def test_same_generator_same_looks_and_others_differ() -> None:
    body = body_of(0)
    first, again = (make_appearance(body, np.random.default_rng(8)) for _ in range(2))
    assert np.array_equal(first[0], again[0])
    assert first[1] == again[1]
    wardrobe = {make_appearance(body, np.random.default_rng(seed))[1] for seed in range(20)}
    assert len(wardrobe) == 20


def test_materials_can_be_drawn() -> None:
    for seed in range(40):
        for material in draw_outfit(0.5, np.random.default_rng(seed)).materials.values():
            assert material.kind in KINDS
            assert all(0 <= c <= 1 for c in (*material.rgb, *material.rgb2))


def test_borders_are_cut_between_the_materials_of_their_corners() -> None:
    body = body_of(0)
    face, materials = make_appearance(body, np.random.default_rng(1))
    borders = borders_of(body.faces, face, materials, len(body.rest_vertices_m))
    split = np.flatnonzero(borders.row >= 0)
    assert 0.02 < len(split) / len(face) < 0.5
    rng = np.random.default_rng(2)
    at = rng.integers(0, len(face), 5000)
    b = rng.dirichlet([1, 1, 1], 5000)[:, 1:]
    found = material_at(borders, at, face[at], b)
    inner = borders.row[at] < 0
    assert np.array_equal(found[inner], face[at][inner])
    assert (found == face[at]).mean() > 0.9
    assert (found != face[at]).any()


def test_cloth_spans_and_skin_does_not() -> None:
    body = body_of(0)
    face, materials = make_appearance(body, np.random.default_rng(1))
    matrix = spanning(body.faces, face, materials, len(body.rest_vertices_m))
    assert np.asarray(matrix.sum(1)).ravel() == pytest.approx(1, abs=1e-4)
    skin = np.unique(body.faces[np.array([m.kind == "skin" for m in materials])[face]])
    assert matrix.diagonal()[skin] == pytest.approx(1)
