"""The checks of annotations are on in every test, and end where a test repeats itself."""

from __future__ import annotations

import jaxtyping
import numpy as np
import pytest
from runtime_types import CHECKS_IN_A_TEST, start_test

from video2anim.geometry.perspective_field import pitch_roll_of


def test_a_wrong_shape_is_refused_until_a_test_has_had_enough_checks() -> None:
    up_camera, wrong = np.array([0.0, -1.0, 0.0]), np.array([0.0, -1.0, 0.0, 0.0])
    with pytest.raises(jaxtyping.TypeCheckError):
        pitch_roll_of(wrong)
    for _ in range(CHECKS_IN_A_TEST):
        pitch_roll_of(up_camera)
    pitch_roll_of(wrong)
    start_test()
    with pytest.raises(jaxtyping.TypeCheckError):
        pitch_roll_of(wrong)
