"""AMASS npz and USD read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from walk_scene import room, walk

from video2anim.body.skeleton import forward_kinematics
from video2anim.export.amass import write_amass
from video2anim.export.character import character_of
from video2anim.geometry.rotations import matrix_from_axis_angle


def test_amass_is_z_up_and_complete(tmp_path: Path) -> None:
    motion = walk(20)
    write_amass(tmp_path / "motion_amass.npz", motion)
    with np.load(tmp_path / "motion_amass.npz", allow_pickle=False) as data:
        assert data["poses"].shape == (20, 156)
        assert float(data["mocap_framerate"]) == 30.0
        assert str(data["gender"]) == "neutral"
        assert not data["betas"].any()
        assert not bool(data["betas_estimated"])
        assert not data["poses"][:, 66:].any()
        R_parent_joint = matrix_from_axis_angle(data["poses"].reshape(20, 52, 3)[:, :22])
        joints_m, _ = forward_kinematics(R_parent_joint, data["trans"], motion.rest_joints_m)
        np.testing.assert_array_equal(data["valid"], motion.valid)
    x, y, z = np.moveaxis(motion.joints_world_m, -1, 0)
    np.testing.assert_allclose(joints_m, np.stack([x, -z, y], -1), atol=1e-6)


def test_usd_skeleton_skin_objects_and_camera(tmp_path: Path) -> None:
    Usd = pytest.importorskip("pxr.Usd")
    from pxr import Gf, UsdGeom, UsdSkel

    from video2anim.export.usd import write_usd

    motion, other = walk(12, camera_moves=True), walk(12, 7, side_m=-1.0)
    write_usd(tmp_path / "scene.usdc", (character_of(motion), character_of(other)), room())
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == 30.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 11.0)
    for person in (motion, other):
        root = UsdSkel.Root(stage.GetPrimAtPath(f"/World/person_{person.person_id}"))
        cache = UsdSkel.Cache()
        cache.Populate(root, Usd.PrimDefaultPredicate)
        skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath(f"{root.GetPath()}/person_{person.person_id}_skeleton"))
        query = cache.GetSkelQuery(skeleton)
        for frame in (0, 5, 11):
            transforms = np.array(query.ComputeJointSkelTransforms(frame))
            np.testing.assert_allclose(transforms[:, 3, :3], person.joints_world_m[frame], atol=1e-5)
        skin = cache.GetSkinningQuery(stage.GetPrimAtPath(f"{root.GetPath()}/person_{person.person_id}_body"))
        points = skin.GetPrim().GetAttribute("points").Get()
        assert skin.ComputeSkinnedPoints(query.ComputeSkinningTransforms(5), points, 5)
        joints_m = person.joints_world_m[5]
        skinned_m = np.array(points)
        low, high = joints_m.min(0) - 0.4, joints_m.max(0) + 0.4
        assert (skinned_m >= low).all()
        assert (skinned_m <= high).all()
    box = UsdGeom.Xformable(stage.GetPrimAtPath("/World/objects/object_3_storage_box"))
    placed = room().objects[0]
    corner = box.ComputeLocalToWorldTransform(0).Transform(Gf.Vec3d(*placed.mesh.vertices_m[5].tolist()))
    expected = placed.T_world_object @ [*(placed.scale * placed.mesh.vertices_m[5]), 1.0]
    np.testing.assert_allclose(np.array(corner), expected[:3], atol=1e-6)
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera")).GetCamera(11)
    lens = motion.intrinsics
    assert camera.focalLength / camera.horizontalAperture == pytest.approx(lens.fx_px / lens.width_px)
    pose = np.array(camera.transform).T
    np.testing.assert_allclose(pose[:3, 2], -motion.T_world_camera[11, :3, 2], atol=1e-6)
    np.testing.assert_allclose(pose[:3, 3], motion.T_world_camera[11, :3, 3], atol=1e-6)
