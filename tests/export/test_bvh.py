"""BVH read back by a parser of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from walk_scene import walk

from video2anim.export.bvh import continuous_euler_zyx, write_bvh
from video2anim.export.character import character_of
from video2anim.types.skeleton import JOINT_NAMES


def parse_bvh(text: str) -> tuple[list[str], list[int], np.ndarray, list[list[str]], np.ndarray, float]:
    """Names, parents, offsets, channels, values (frames, channels), frame time. End sites are checked and dropped."""
    names, parents, offsets, channels, stack = [], [], [], [], []
    lines = iter(text.splitlines())
    in_end_site = False
    for line in lines:
        words = line.split()
        if words[0] in ("ROOT", "JOINT"):
            names.append(words[1])
            parents.append(stack[-1] if stack else -1)
            stack.append(len(names) - 1)
        elif words[0] == "End":
            in_end_site = True
        elif words[0] == "OFFSET" and not in_end_site:
            offsets.append([float(word) for word in words[1:]])
        elif words[0] == "CHANNELS":
            assert int(words[1]) == len(words) - 2
            channels.append(words[2:])
        elif words[0] == "}":
            if in_end_site:
                in_end_site = False
            else:
                stack.pop()
        elif words[0] == "MOTION":
            break
    frames = int(next(lines).split()[1])
    frame_time_s = float(next(lines).split()[2])
    values = np.array([[float(word) for word in line.split()] for line in lines])
    assert values.shape == (frames, sum(len(words) for words in channels))
    return names, parents, np.array(offsets), channels, values, frame_time_s


def bvh_joints_cm(text: str) -> tuple[list[str], np.ndarray]:
    names, parents, offsets, channels, values, _ = parse_bvh(text)
    joints = np.zeros((len(values), len(names), 3))
    turned: list[Rotation] = []
    column = 0
    for joint, words in enumerate(channels):
        here = values[:, column : column + len(words)]
        column += len(words)
        order = "".join(word[0] for word in words if word.endswith("rotation"))
        local = Rotation.from_euler(order, here[:, -3:], degrees=True)
        shift = offsets[joint] + (here[:, :3] if len(words) == 6 else 0.0)
        if parents[joint] < 0:
            joints[:, joint] = shift
            turned.append(local)
        else:
            joints[:, joint] = joints[:, parents[joint]] + turned[parents[joint]].apply(shift)
            turned.append(turned[parents[joint]] * local)
    return names, joints


@pytest.mark.filterwarnings("ignore:Gimbal lock")
def test_reread_joints_equal_the_motion(tmp_path: Path) -> None:
    motion = walk(40)
    write_bvh(tmp_path / "motion.bvh", character_of(motion))
    text = (tmp_path / "motion.bvh").read_text()
    names, joints_cm = bvh_joints_cm(text)
    order = [names.index(name) for name in JOINT_NAMES]
    np.testing.assert_allclose(joints_cm[:, order] / 100.0, motion.joints_world_m, atol=1e-6)
    assert parse_bvh(text)[-1] == pytest.approx(1 / 30, abs=1e-7)
    assert text.count("End Site") == 5


def test_channels_do_not_jump(tmp_path: Path) -> None:
    """The walker turns by more than half a turn; no channel may wrap."""
    motion = walk(40)
    write_bvh(tmp_path / "motion.bvh", character_of(motion))
    values = parse_bvh((tmp_path / "motion.bvh").read_text())[4]
    assert np.abs(np.diff(values[:, 3:], axis=0)).max() < 45.0


def test_euler_angles_reproduce_rotations_also_at_gimbal_lock() -> None:
    rng = np.random.default_rng(5)
    R = Rotation.random(60, rng=rng).as_matrix().reshape(20, 3, 3, 3)
    R[3, 0] = Rotation.from_euler("ZYX", [0.4, np.pi / 2, 0.3]).as_matrix()
    R[4, 1] = Rotation.from_euler("ZYX", [0.4, -np.pi / 2, 0.3]).as_matrix()
    angles = continuous_euler_zyx(R)
    again = Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix().reshape(R.shape)
    np.testing.assert_allclose(again, R, atol=1e-6)
