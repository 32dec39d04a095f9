"""A prior that does not tell left from right, with random weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from scenemi.model.denoiser import Denoiser
from scenemi.model.mirror import EvenDenoiser, MirroredField, mirrored
from scenemi.scene.field import BoxField
from tests.scenemi.model.test_denoiser import awake, conditions, window
from video2anim.types.skeleton import MIRROR_JOINT

BOXES = torch.tensor([[[0.6, 0.5, 0.2, 0.3, 0.5, 0.2, 0.4], [-0.9, 1.0, -0.1, 0.2, 1.0, 0.6, -1.0]]])
FLIP = torch.tensor([-1.0, 1.0, 1.0])


def reflect(model: Denoiser, normalized: torch.Tensor) -> torch.Tensor:
    return (mirrored(normalized * model.feature_std + model.feature_mean) - model.feature_mean) / model.feature_std


@pytest.mark.parametrize("scene", [False, True])
def test_the_answer_to_a_reflected_window_is_the_reflected_answer(*, scene: bool) -> None:
    model = awake().eval()
    even = EvenDenoiser(model)
    given = conditions(1)
    other = replace(given, base=reflect(model, given.base))
    if scene:
        boxes = BOXES.clone()
        boxes[..., 0], boxes[..., 6] = -boxes[..., 0], -boxes[..., 6]
        given = replace(given, field=BoxField.of(BOXES, torch.ones(1)))
        other = replace(other, field=BoxField.of(boxes, torch.ones(1)))
    x, t = window(1), torch.tensor([600])
    with torch.no_grad():
        made = even(x, t, given, None, even.prepare(given))
        turned = even(reflect(model, x), t, other, None, even.prepare(other))
        alone = model(x, t, given), model(reflect(model, x), t, other)
    torch.testing.assert_close(turned, reflect(model, made), atol=2e-4, rtol=1e-4)
    assert (alone[1] - reflect(model, alone[0])).abs().max() > 0.01, "the denoiser itself tells the sides apart"


def test_mirrored_features_are_those_of_the_mirrored_joints() -> None:
    features = torch.randn(3, 201)
    joints, other = (one[:, 135:].unflatten(-1, (22, 3)) for one in (features, mirrored(features)))
    torch.testing.assert_close(other, joints[:, np.asarray(MIRROR_JOINT)] * FLIP)
    torch.testing.assert_close(mirrored(mirrored(features)), features)


def test_a_mirrored_field_has_its_solids_on_the_other_side() -> None:
    field = BoxField.of(BOXES, torch.ones(1))
    points = torch.tensor([[[0.1, 0.5, 0.2], [-0.5, 1.0, 0.0], [0.6, 0.4, 0.2]]])
    distance, out = field.query(points)
    other, way = MirroredField(field).query(points * FLIP)
    torch.testing.assert_close(other, distance)
    torch.testing.assert_close(way, out * FLIP)
    assert float(distance[0, 2]) < 0, "one point is inside a solid, which floor and outside points are not"
