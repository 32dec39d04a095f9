"""ACCAD, MHAD and the later clips of the Daz figure: each stands upright, bends and faces as its source does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from retarget_quality import LIMBS, measure_retarget
from test_retarget import assert_elbows_bend_forward, body_of

from scenemi.data.body_measure import measure_body
from scenemi.data.container import MotionArchive, SourceClip
from scenemi.data.rest_pose import rest_axes
from scenemi.data.retarget import RetargetedMotion, retarget
from scenemi.data.sources import is_free, license_of
from video2anim.body.legs import LEGS
from video2anim.errors import InputError
from video2anim.geometry.rotations import axis_angle_from_matrix
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

NOTICE = Path(__file__).resolve().parents[3] / "NOTICE"
EXAMPLES = (
    ("more.npz", "accad_female1_B03_Walk"),
    ("more.npz", "accad_female1_B20_WalkWithBox"),
    ("more.npz", "accad_male1_B03_Walk"),
    ("more.npz", "accad_male1_B19_WalkToPickUpBox_Working"),
    ("more.npz", "accad_male2_A06_BoxLift"),
    ("more.npz", "accad_male2_B20_WalkWithBox"),
    ("more.npz", "accad_male2_E10_BodyHookRight"),
    ("more.npz", "cmudaz_08_01"),
    ("more.npz", "cmudaz_14_22"),
    ("more.npz", "cmudaz_14_33"),
    ("mhad.npz", "mhad_s07_a08_r01"),
    ("mhad.npz", "mhad_s08_a10_r01"),
    ("mhad.npz", "mhad_s11_a11_r01"),
)
"""At least one clip of every performer of ACCAD and of every kind of skeleton."""
STANDING = (
    ("more.npz", "accad_female1_A02_Sway", slice(None)),
    ("more.npz", "accad_male1_A02_Sway", slice(None)),
    ("more.npz", "accad_male2_A02_Sway", slice(None)),
    ("mhad.npz", "mhad_s02_a11_r01", slice(-10, None)),
    ("mhad.npz", "mhad_s06_a11_r01", slice(-10, None)),
    ("mhad.npz", "mhad_s11_a11_r01", slice(-10, None)),
)
"""Clips, and frames of them, in which a person stands with hanging arms."""


def clip_of(folder: Path, archive: str, name: str) -> SourceClip:
    if not (folder / archive).is_file():
        pytest.skip(f"motion archive not found at {folder / archive}")
    return MotionArchive.read(folder / archive).clip(name)


def posed(motion: RetargetedMotion) -> tuple[np.ndarray, np.ndarray]:
    """Joints and world orientations on `body_of(0.4)`."""
    return forward_kinematics(motion.R_parent_joint, motion.translation_m, body_of(0.4).rest_joints_m)


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def assert_elbows_do_not_bend_backward(motion: RetargetedMotion) -> None:
    """As `assert_elbows_bend_forward`, but forearms may go to the side by 30 degrees: MHAD's elbows are no hinges."""
    for side, outward in (("left", 1.0), ("right", -1.0)):
        forearm = outward * motion.R_parent_joint[:, JOINT_INDEX[f"{side}_elbow"], :, 0]
        forward_deg = np.degrees(np.arctan2(forearm[:, 2], outward * forearm[:, 0]))
        assert np.percentile(forward_deg, 1) > -10.0
        assert np.percentile(np.abs(forearm[:, 1]), 95) < 0.5


@pytest.mark.parametrize(("archive", "name"), EXAMPLES, ids=[name for _, name in EXAMPLES])
@pytest.mark.parametrize("height", [0.15, 0.8])
def test_captured_clips(shared_motion: Path, archive: str, name: str, height: float) -> None:
    clip, body = clip_of(shared_motion, archive, name), body_of(height)
    motion = retarget(clip, body)
    quality = measure_retarget(clip, body, motion)
    assert quality.contact_share > 0.35
    assert quality.slide_mm < 1.0
    assert quality.slide_max_mm <= 5.0
    assert 0.7 < quality.jerk_ratio < 1.25
    assert quality.limb_error_deg < 4.0
    assert quality.knee_min_deg > 0.0
    if clip.source == "mhad":
        assert_elbows_do_not_bend_backward(motion)
    else:
        assert_elbows_bend_forward(motion)
    if not clip.uneven:
        assert quality.sink_mm < 5.0
        assert quality.float_mm < 15.0
        assert quality.below_floor_mm < 10.0
        assert quality.body_below_mm < 15.0


@pytest.mark.parametrize(("archive", "name"), EXAMPLES, ids=[name for _, name in EXAMPLES])
def test_limbs_point_and_people_face_as_in_the_source(shared_motion: Path, archive: str, name: str) -> None:
    clip = clip_of(shared_motion, archive, name)
    joints_m, R_world = posed(retarget(clip, body_of(0.4)))
    source_m = clip.smpl_joints_m()
    starts, ends = np.array(LIMBS).T
    cosine = (unit(joints_m[:, ends] - joints_m[:, starts]) * unit(source_m[:, ends] - source_m[:, starts])).sum(-1)
    error_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.median(error_deg) < 2.5
    assert np.percentile(error_deg, 95) < 11.0
    left = unit((source_m[:, 1] - source_m[:, 2]) * [1.0, 0.0, 1.0])
    facing = np.cross(left, [0.0, 1.0, 0.0])
    assert (unit(R_world[:, 0, :, 2] * [1.0, 0.0, 1.0]) * facing).sum(-1).min() > 0.95
    assert (unit((joints_m[:, 1] - joints_m[:, 2]) * [1.0, 0.0, 1.0]) * left).sum(-1).min() > 0.95
    for leg in LEGS:
        assert (unit(R_world[:, leg.ankle, :, 2]) * facing).sum(-1).mean() > 0.6


@pytest.mark.parametrize(("archive", "name", "frames"), STANDING, ids=[name for _, name, _ in STANDING])
def test_uprightness(shared_motion: Path, archive: str, name: str, frames: slice) -> None:
    clip = clip_of(shared_motion, archive, name)
    motion = retarget(clip, body_of(0.4))
    _, R_world = posed(motion)
    for joint, max_deg in (("pelvis", 10.0), ("spine3", 10.0), ("head", 15.0)):
        up = np.median(R_world[frames, JOINT_INDEX[joint], :, 1], axis=0)
        assert np.degrees(np.arccos(unit(up)[1])) < max_deg, joint
    for side, outward in (("left", 1.0), ("right", -1.0)):
        collar = axis_angle_from_matrix(motion.R_parent_joint[frames, JOINT_INDEX[f"{side}_collar"]])
        assert np.degrees(np.linalg.norm(np.median(collar, axis=0))) < 20.0
        assert (outward * R_world[frames, JOINT_INDEX[f"{side}_elbow"], 1, 0]).max() < -0.6
        # The front of a hanging arm's frame is the side of its thumb.
        pelvis_front = R_world[frames, 0, :, 2]
        assert (R_world[frames, JOINT_INDEX[f"{side}_elbow"], :, 2] * pelvis_front).sum(-1).mean() > 0.5
        flat = motion.contact[:, [JOINT_INDEX[f"{side}_ankle"], JOINT_INDEX[f"{side}_foot"]]].all(axis=1)[frames]
        assert flat.mean() > 0.5
        assert R_world[frames, JOINT_INDEX[f"{side}_ankle"], 1, 1][flat].min() > np.cos(np.radians(12.0))


def test_everybody_sits_at_the_height_of_a_chair(shared_motion: Path) -> None:
    for person in (2, 3, 4, 5, 6, 7, 8, 9, 11, 12):
        clip = clip_of(shared_motion, "mhad.npz", f"mhad_s{person:02d}_a10_r01")
        joints_m, R_world = posed(retarget(clip, body_of(0.4)))
        thighs = unit(joints_m[-1, 4:6] - joints_m[-1, 1:3])
        assert joints_m[0, 0, 1] > 0.85
        assert 0.45 < joints_m[-1, 0, 1] < 0.68
        assert np.abs(thighs[:, 1]).max() < 0.35
        assert (unit(joints_m[-1, 7:9] - joints_m[-1, 4:6])[:, 1] < -0.8).all()
        assert R_world[-1, JOINT_INDEX["spine3"], 1, 1] > 0.85


def test_every_skeleton_is_known(shared_motion: Path) -> None:
    seen: dict[str, SourceClip] = {}
    for archive in ("more.npz", "mhad.npz"):
        if not (shared_motion / archive).is_file():
            pytest.skip(f"motion archive not found at {shared_motion / archive}")
        clips = MotionArchive.read(shared_motion / archive)
        for name in clips.names[::7]:
            clip = clips.clip(name)
            seen[clip.skeleton.name] = clip
            motion = retarget(clip, body_of(0.4))
            assert np.isfinite(motion.R_parent_joint).all()
            assert np.isfinite(motion.translation_m).all()
    assert len(seen) == 14
    for clip in seen.values():
        axes, table = rest_axes(clip.skeleton), clip.skeleton.smpl_rotation
        known = ~np.isnan(axes[:, 0, 0])
        np.testing.assert_allclose(
            axes[known] @ np.swapaxes(axes[known], -1, -2), np.tile(np.eye(3), (known.sum(), 1, 1)), atol=1e-9
        )
        toes = [leg.toe for leg in LEGS]
        np.testing.assert_array_equal(np.delete(known, toes), np.delete(table >= 0, toes))


def test_the_later_clips_of_the_daz_figure_are_of_its_family(shared_motion: Path) -> None:
    earlier = clip_of(shared_motion, "cmu.npz", "cmudaz_martial_04").skeleton
    later = clip_of(shared_motion, "more.npz", "cmudaz_08_01").skeleton
    assert later.names == earlier.names
    np.testing.assert_allclose(rest_axes(later), rest_axes(earlier), atol=1e-6)


def test_performers_are_told_by_the_names_of_their_skeletons(shared_motion: Path) -> None:
    skeleton = clip_of(shared_motion, "more.npz", "accad_male1_B03_Walk").skeleton
    joints = [JOINT_INDEX["left_knee"], JOINT_INDEX["left_elbow"]]
    other = rest_axes(replace(skeleton, name="accad_male2"))
    assert np.abs(rest_axes(skeleton)[joints] - other[joints]).max() > 0.3
    with pytest.raises(InputError, match="known family"):
        rest_axes(replace(skeleton, name="accad raw file"))


def test_only_sources_of_confirmed_free_licences_are_free() -> None:
    for source in ("cmu_daz", "accad", "cmu_asfamc", "deepmimic", "synthetic"):
        assert is_free(license_of(source))
    for source in ("mhad", "prox", "amass", "trumans", "gimo", "bandai1", "bandai2", "sie", "bvh", "my own"):
        assert not is_free(license_of(source)), "what is not known is not free"


def test_notice_names_whose_motion_weights_learn_from() -> None:
    text = " ".join(NOTICE.read_text().split())
    for wanted in (
        "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from "
        "NSF EIA-0196217.",
        "B. Hahne",
        "(c) 2018 Atelier Circle",
        "Open Motion Project by ACCAD/The Ohio State University is licensed under a Creative Commons Attribution 3.0 "
        "Unported License.",
        "https://creativecommons.org/licenses/by/3.0/",
    ):
        assert wanted in text


@pytest.mark.parametrize(
    ("archive", "name"),
    [("mhad.npz", "mhad_s02_a10_r01"), ("mhad.npz", "mhad_s07_a10_r01"), ("more.npz", "cmudaz_13_36")],
)
def test_feet_stand_on_the_floor_where_seat_and_steps_were_not_captured(
    shared_motion: Path, archive: str, name: str
) -> None:
    body = body_of(0.4)
    joints_m, R = posed(retarget(clip_of(shared_motion, archive, name), body))
    soles = [
        joints_m[:, leg.ankle, 1] + sole.lowest_m(R[:, leg.ankle], R[:, leg.toe])
        for leg, sole in zip(LEGS, measure_body(body).soles, strict=True)
    ]
    assert abs(np.percentile(np.concatenate(soles), 15)) < 0.02
