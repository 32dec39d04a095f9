"""AMASS npz and USD read back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from walk_scene import room, room_with_carried_box, walk

from video2anim.body.smplx_body import DIR_VARIABLE, MEAN_PELVIS_M, shaped_smpl
from video2anim.export.amass import AmassModel, write_amass
from video2anim.export.character import character_of
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types import BodyMotion, BodyShape
from video2anim.types.skeleton import JOINT_INDEX, PARENTS, forward_kinematics

MODELS: tuple[tuple[AmassModel, int], ...] = (("smplh", 52), ("smplx", 55))
PELVIS_M = np.array([0.01, -0.3, 0.02])
"""Of the test's body files."""
FITTED_M = 0.01
"""What is left of the difference between bodies whose bones the betas can make as long."""


@pytest.fixture(autouse=True)
def no_body_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(DIR_VARIABLE, raising=False)


def zup(points_m: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(points_m, -1, 0)
    return np.stack([x, -z, y], -1)


@pytest.mark.parametrize(("model", "joints"), MODELS)
def test_amass_is_z_up_and_complete(tmp_path: Path, model: AmassModel, joints: int) -> None:
    motion = walk(20)
    write_amass(tmp_path / "motion_amass.npz", motion, model)
    with np.load(tmp_path / "motion_amass.npz", allow_pickle=False) as data:
        assert data["poses"].shape == (20, 3 * joints)
        assert float(data["mocap_framerate" if model == "smplh" else "mocap_frame_rate"]) == 30.0
        assert str(data["gender"]) == "neutral"
        assert data["betas"].shape == (16,)
        assert not data["betas"].any()
        assert not bool(data["betas_estimated"])
        assert not data["poses"][:, 66:].any()
        R_parent_joint = matrix_from_axis_angle(data["poses"].reshape(20, joints, 3)[:, :22])
        pelvis_m = data["trans"] + MEAN_PELVIS_M[model]
        joints_m, _ = forward_kinematics(R_parent_joint, pelvis_m, motion.rest_joints_m)
        np.testing.assert_array_equal(data["valid"], motion.valid)
        if model == "smplx":
            assert str(data["surface_model_type"]) == "smplx"
            parts = [data[f"{name}"] for name in ("root_orient", "pose_body", "pose_jaw", "pose_eye", "pose_hand")]
            assert [part.shape[1] for part in parts] == [3, 63, 3, 6, 90]
            np.testing.assert_array_equal(np.concatenate(parts, axis=1), data["poses"])
    np.testing.assert_allclose(joints_m, zup(motion.joints_world_m), atol=1e-6)


def write_body_file(folder: Path, model: AmassModel, joints: int, rest_m: np.ndarray) -> None:
    """A body of one vertex at each joint, in the layout of the makers' files. Its mean is 7 % smaller than `rest_m`;
    beta 0 makes it larger, 1 lengthens the legs, 2 the arms, the others do nothing.
    """
    parents = np.array([-1, *PARENTS[1:], *[JOINT_INDEX["head"]] * (joints - 52), *[20] * 15, *[21] * 15])
    body_m = np.zeros((joints, 3))
    body_m[:22] = rest_m
    for joint in range(22, joints):
        body_m[joint] = body_m[parents[joint]] + [0.0, 0.0, 0.05]
    shapes = np.zeros((joints, 3, 20))
    shapes[:, :, 0] = 0.05 * body_m
    for beta, names in ((1, ("knee", "ankle", "foot")), (2, ("elbow", "wrist"))):
        for joint, parent in enumerate(parents):
            if joint:
                grows = joint < 22 and any(
                    JOINT_INDEX[f"{side}_{n}"] == joint for side in ("left", "right") for n in names
                )
                bone_m = body_m[joint] - body_m[parent]
                shapes[joint, :, beta] = shapes[parent, :, beta] + 0.05 * bone_m * grows
    nothing = np.zeros((6, 45))
    np.savez(
        folder / f"{model.upper()}_NEUTRAL.npz",
        v_template=0.93 * body_m + PELVIS_M, shapedirs=shapes, posedirs=np.zeros((joints, 3, 9 * (joints - 1))),
        J_regressor=np.eye(joints), weights=np.eye(joints), f=np.array([[0, 1, 2]], np.uint32),
        kintree_table=np.stack([parents.astype(np.uint32), np.arange(joints, dtype=np.uint32)]),
        hands_componentsl=nothing, hands_componentsr=nothing, hands_meanl=np.zeros(45), hands_meanr=np.zeros(45),
        lmk_faces_idx=np.zeros(51, np.int64), lmk_bary_coords=np.full((51, 3), 1 / 3),
    )  # fmt: skip


def loaded_joints_m(folder: Path, model: AmassModel, path: Path, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """(T, 22, 3) joints of an AMASS file by the loader that its readers use."""
    smplx = pytest.importorskip("smplx", reason="the loader of SMPL bodies is not installed: pip install smplx")
    import torch
    from smplx import body_models

    points = dict.fromkeys(body_models.VERTEX_IDS[model], 0)  # of the full meshes; only the joints are looked at
    monkeypatch.setitem(body_models.VERTEX_IDS, model, points)
    with np.load(path, allow_pickle=False) as data:
        poses, trans, betas = (torch.tensor(data[name]).float() for name in ("poses", "trans", "betas"))
    frames, zeros = len(poses), torch.zeros
    body = smplx.create(str(folder), model, use_pca=False, flat_hand_mean=True, batch_size=frames, ext="npz")
    face = {}
    if model == "smplx":
        face = {f"{name}_pose": zeros(frames, 3) for name in ("jaw", "leye", "reye")}
        face["expression"] = zeros(frames, 10)
    made = body(
        betas=betas[None, :10].expand(frames, -1), global_orient=poses[:, :3], body_pose=poses[:, 3:66],
        left_hand_pose=zeros(frames, 45), right_hand_pose=zeros(frames, 45), transl=trans, **face,
    )  # fmt: skip
    return made.joints[:, :22].detach().numpy()


@pytest.mark.parametrize(("model", "joints"), MODELS)
def test_a_real_loader_puts_the_body_where_the_motion_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: AmassModel, joints: int
) -> None:
    """Betas come from the user's file, so limbs are as long; `trans` is the pelvis less its rest place."""
    motion = walk(12)
    (tmp_path / model).mkdir()
    write_body_file(tmp_path / model, model, joints, motion.rest_joints_m)
    monkeypatch.setenv(DIR_VARIABLE, str(tmp_path))
    write_amass(tmp_path / "motion.npz", motion, model)
    found_m = loaded_joints_m(tmp_path, model, tmp_path / "motion.npz", monkeypatch)
    error_m = np.linalg.norm(found_m - zup(motion.joints_world_m), axis=-1)
    assert error_m[:, 0].max() < 1e-5, "the pelvis is exact"
    assert error_m.max() < FITTED_M
    with np.load(tmp_path / "motion.npz") as data:
        assert bool(data["betas_estimated"])
        assert "fitted" in str(data["note"])
        assert abs(data["betas"][0]) > 0.5


def test_a_motion_of_the_files_own_model_keeps_its_betas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    walker = walk(12)
    (tmp_path / "smplx").mkdir()
    write_body_file(tmp_path / "smplx", "smplx", 55, walker.rest_joints_m)
    monkeypatch.setenv(DIR_VARIABLE, str(tmp_path))
    shape = BodyShape("smplx", {"beta_0": 0.7, "beta_2": -1.5})
    motion = with_shape(walker, shape, shaped_smpl(shape).rest_joints_m)
    write_amass(tmp_path / "motion.npz", motion, "smplx")
    found_m = loaded_joints_m(tmp_path, "smplx", tmp_path / "motion.npz", monkeypatch)
    np.testing.assert_allclose(found_m, zup(motion.joints_world_m), atol=1e-5)
    with np.load(tmp_path / "motion.npz") as data:
        np.testing.assert_allclose(data["betas"][:3], [0.7, 0.0, -1.5])


def with_shape(motion: BodyMotion, shape: BodyShape, rest_joints_m: np.ndarray) -> BodyMotion:
    motion = replace(motion, shape=shape, rest_joints_m=rest_joints_m)
    return motion.with_pose(translation_world_m=motion.T_world_root[:, :3, 3], R_parent_joint=motion.R_parent_joint)


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
    for name in ("floor", "background/wall_1", "background/backdrop"):
        assert UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}")).GetPointsAttr().Get()
    box = UsdGeom.Xformable(stage.GetPrimAtPath("/World/objects/object_3_storage_box"))
    placed = room().objects[0]
    corner = box.ComputeLocalToWorldTransform(0).Transform(Gf.Vec3d(*placed.mesh.vertices_m[5].tolist()))
    expected = placed.T_world_object @ [*(placed.scale * placed.mesh.vertices_m[5]), 1.0]
    np.testing.assert_allclose(np.array(corner), expected[:3], atol=1e-6)
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera")).GetCamera(11)
    lens = motion.intrinsics
    assert camera.focalLength / camera.horizontalAperture == pytest.approx(lens.fx_px / lens.width_px)
    # 36 mm in tenths of a scene unit, which is a meter.
    assert camera.horizontalAperture == pytest.approx(0.36)
    pose = np.array(camera.transform).T
    np.testing.assert_allclose(pose[:3, 2], -motion.T_world_camera[11, :3, 2], atol=1e-6)
    np.testing.assert_allclose(pose[:3, 3], motion.T_world_camera[11, :3, 3], atol=1e-6)


def test_usd_object_follows_its_path(tmp_path: Path) -> None:
    Usd = pytest.importorskip("pxr.Usd")
    from pxr import Gf, UsdGeom

    from video2anim.export.usd import write_usd

    motion, scene = walk(24), room_with_carried_box(24)
    write_usd(tmp_path / "scene.usdc", (character_of(motion),), scene)
    (placed,) = scene.objects
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    box = UsdGeom.Xformable(stage.GetPrimAtPath("/World/objects/object_3_storage_box"))
    (transform,) = box.GetOrderedXformOps()
    assert len(transform.GetTimeSamples()) < motion.frame_count, "at rest two keys do"
    for frame in range(motion.frame_count):
        corner = box.ComputeLocalToWorldTransform(frame).Transform(Gf.Vec3d(*placed.mesh.vertices_m[5].tolist()))
        expected = placed.path[0].T_world_object[frame] @ [*(placed.scale * placed.mesh.vertices_m[5]), 1.0]
        np.testing.assert_allclose(np.array(corner), expected[:3], atol=1e-6)
