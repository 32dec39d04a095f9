"""ASF/AMC against the archive made from the same files, and broken files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scenemi.data.asf_amc import read_asf, read_asf_amc
from scenemi.data.container import MotionArchive
from scenemi.data.readers import read_clips
from video2anim.errors import InputError


def test_raw_files_equal_the_archive(shared_motion: Path) -> None:
    raw = shared_motion / "raw"
    clip = read_asf_amc(raw / "02.asf", raw / "02_01.amc")
    want = MotionArchive.read(shared_motion / "cmu.npz").clip("cmu_02_01")
    assert (clip.fps, len(clip.root_position_m)) == (30.0, len(want.root_position_m))
    np.testing.assert_allclose(clip.smpl_joints_m(), want.smpl_joints_m(), atol=3e-3)
    order = [clip.skeleton.names.index(name) for name in want.skeleton.names]
    np.testing.assert_allclose(clip.world_rotations()[:, order], want.world_rotations(), atol=1e-3)
    for table in ("smpl_position", "smpl_rotation"):
        mine = [clip.skeleton.names[joint] for joint in getattr(clip.skeleton, table)]
        assert mine == [want.skeleton.names[joint] for joint in getattr(want.skeleton, table)]
    assert read_clips(raw / "02_01.amc")[0].name == "02_01"


def test_a_small_skeleton_by_hand(tmp_path: Path) -> None:
    """Two bones: the first turned about an oblique axis of its own."""
    asf = tmp_path / "two.asf"
    asf.write_text(
        ":units\n length 0.45\n angle deg\n:root\n order TX TY TZ RX RY RZ\n axis XYZ\n position 0 0 0\n"
        " orientation 0 0 0\n:bonedata\n begin\n name upper\n direction 0 -1 0\n length 4.5\n axis 0 0 90 XYZ\n"
        " dof rx\n end\n begin\n name lower\n direction 0 -1 0\n length 9\n axis 0 0 0 XYZ\n end\n"
        ":hierarchy\n begin\n upper lower\n root upper\n end\n"
    )
    skeleton = read_asf(asf)
    assert [bone.name for bone in skeleton.bones] == ["root", "upper", "lower"]
    assert skeleton.parents == (-1, 0, 1)
    np.testing.assert_allclose([bone.length_m for bone in skeleton.bones], [0, 0.254, 0.508], atol=1e-12)
    np.testing.assert_allclose(skeleton.bones[1].R_axis @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("lfemur", "thigh", "subject's own ASF"),
        ("root 10.4194", "root ten", "line 5 is no AMC data"),
        ("root 10.4194 16.7048", "root", "wants 6 numbers"),
    ],
)
def test_motion_that_does_not_fit(shared_motion: Path, tmp_path: Path, old: str, new: str, message: str) -> None:
    raw = shared_motion / "raw"
    amc = tmp_path / "x.amc"
    amc.write_text((raw / "02_01.amc").read_text().replace(old, new))
    with pytest.raises(InputError, match=message):
        read_asf_amc(raw / "02.asf", amc)


def test_broken_files_get_one_line(tmp_path: Path) -> None:
    amc, asf = tmp_path / "a.amc", tmp_path / "b.asf"
    amc.write_text(":DEGREES\n")
    asf.write_text(":units\n length 1\n")
    with pytest.raises(InputError, match="broken ASF"):
        read_asf_amc(asf, amc)
    with pytest.raises(InputError, match="cannot read"):
        read_asf(tmp_path / "none.asf")
    asf.unlink()
    with pytest.raises(InputError, match=r"want its subject's skeleton a\.asf"):
        read_clips(amc)
