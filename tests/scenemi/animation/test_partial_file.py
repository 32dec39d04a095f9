"""The keys of partial keyframes in JSON, and the path of the root over time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scenemi.animation.partial_file import PartialValues, RootPath, expect_no_contradiction, partial_keyframes
from scenemi.data.plain_files import checked
from video2anim.errors import InputError
from video2anim.types.skeleton import JOINT_INDEX


def test_a_path_with_frames_passes_its_points() -> None:
    path = RootPath(points_xz_m=((0, 0), (1, 0), (1, 2)), frames=(10, 40, 100))
    start, places_m = path.over_time((False, False))
    assert (start, len(places_m)) == (10, 91)
    np.testing.assert_allclose(places_m[[0, 30, 90]], path.points_xz_m, atol=1e-12)


def test_a_path_with_a_speed_has_it_and_starts_and_ends_at_rest_where_the_person_stands() -> None:
    path = RootPath(points_xz_m=((0, 0), (0, 3)), speed_m_s=1.2)
    moving, standing = (path.over_time((rests, rests))[1] for rests in (False, True))
    np.testing.assert_allclose(30 * np.diff(moving[:, 1]), 1.2, rtol=0.01)
    speed = 30 * np.diff(standing[:, 1])
    assert speed[0] < 0.2
    assert speed[-1] < 0.2
    assert speed.max() == pytest.approx(1.2, rel=0.02)
    np.testing.assert_allclose(standing[[0, -1]], path.points_xz_m, atol=1e-9)
    assert len(standing) == 1 + 30 * (3 / 1.2 + 0.5)


def test_a_path_too_short_for_its_speed_is_refused() -> None:
    with pytest.raises(ValueError, match="too short"):
        RootPath(points_xz_m=((0, 0), (0, 0.2)), speed_m_s=2.0).over_time((True, True))


def test_values_become_places_path_and_pins() -> None:
    values = PartialValues.model_validate(
        {
            "joint_targets": [{"joint": "left_wrist", "time_s": 1, "position_m": [1, 2, 3]}],
            "pinned": [{"foot": "right", "frames": [5, 9]}],
        }
    )
    found = partial_keyframes("file", values, (3, np.ones((4, 2))), 41)
    assert found is not None
    assert found.position_m[30, JOINT_INDEX["left_wrist"]].tolist() == [1, 2, 3]
    assert np.flatnonzero(np.isfinite(found.path_m).all(1)).tolist() == [3, 4, 5, 6]
    assert [(pin.side, pin.first_frame, pin.last_frame) for pin in found.pinned] == [(1, 5, 9)]
    assert partial_keyframes("file", PartialValues(), None, 41) is None
    with pytest.raises(InputError, match="frame 30 is after the last whole pose, at frame 29"):
        partial_keyframes("file", values, None, 30)
    expect_no_contradiction("file", found, np.array([[1.0, 0.9, 1.04]]), np.array([4]), True)
    with pytest.raises(InputError, match=r"passes the pose at frame 4 at a distance of 0\.30 m"):
        expect_no_contradiction("file", found, np.array([[1.0, 0.9, 1.3]]), np.array([4]), True)
    expect_no_contradiction("file", found, np.array([[1.0, 0.9, 1.3]]), np.array([4]), False)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"joint_targets": [{"joint": "left_hand", "frame": 3, "position_m": [0, 0, 0]}]}, "joint_targets.0.joint"),
        ({"joint_targets": [{"joint": "head", "position_m": [0, 0, 0]}]}, "wants either frame or time_s"),
        ({"joint_targets": [{"joint": "head", "frame": 3, "position_m": [0, float("nan"), 0]}]}, "finite"),
        ({"root_path": {"points_xz_m": [[0, 0], [1, 0]]}}, "wants either frames or speed_m_s"),
        ({"root_path": {"points_xz_m": [[0, 0], [1, 0]], "frames": [9, 3]}}, "a frame for every point, rising"),
        ({"root_path": {"points_xz_m": [[0, 0], [0, 0]], "speed_m_s": 1}}, "points that differ"),
        ({"pinned": [{"foot": "left", "frames": [9, 9]}]}, "wants a later last frame"),
        ({"postures": [{"frame": 3}]}, "wants one of sit_on, stand_at and hand_on"),
        ({"postures": [{"frame": 3, "sit_on": "a", "seat": 1}]}, "Extra inputs"),
    ],
)
def test_bad_values_are_told_in_one_line(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as told:
        checked(PartialValues, "keys.json", values)
    assert "\n" not in str(told.value)
