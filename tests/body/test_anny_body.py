"""The body: skeleton, forward kinematics, skin and shape agree with each other."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from video2anim.body.anny_body import ADULT, KEYPOINT_NAMES, PHENOTYPES, anny_model, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import UsageError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types import BodyShape
from video2anim.types.skeleton import FEET, JOINT_INDEX, JOINT_NAMES, PARENTS, forward_kinematics

SHAPES = [
    ADULT,
    ADULT | {"height": 0.9, "gender": 1.0},
    ADULT | {"weight": 0.9, "muscle": 0.1},
    ADULT | {"gender": 0.0, "height": 0.1},
]
PAIRS = [(JOINT_INDEX[n], JOINT_INDEX[n.replace("left", "right")]) for n in JOINT_NAMES if n.startswith("left_")]
REST = np.tile(np.eye(3), (1, 22, 1, 1))


def random_pose(frames: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return matrix_from_axis_angle(rng.uniform(-1, 1, (frames, 22, 3))), rng.normal(size=(frames, 3))


@pytest.fixture(params=SHAPES, ids=["adult", "tall man", "heavy", "short woman"])
def body(request: pytest.FixtureRequest) -> ShapedBody:
    return shaped_body(BodyShape("anny", dict(request.param)))


def test_skeleton_table() -> None:
    assert len(JOINT_NAMES) == len(set(JOINT_NAMES)) == len(PARENTS) == 22
    assert PARENTS[0] == -1
    assert all(parent < joint for joint, parent in enumerate(PARENTS))
    # SMPL order (Loper et al. 2015).
    assert [JOINT_INDEX[n] for n in ("left_hip", "left_foot", "head", "right_wrist")] == [1, 10, 15, 21]
    assert [JOINT_NAMES[f] for f in FEET] == ["left_ankle", "right_ankle", "left_foot", "right_foot"]
    for left, right in PAIRS:
        assert JOINT_NAMES[PARENTS[right]] == JOINT_NAMES[PARENTS[left]].replace("left", "right")


def test_rest_pose_gives_rest_joints() -> None:
    rest = np.random.default_rng(1).normal(size=(22, 3))
    shift = np.array([[1.0, 2, 3]])
    joints, R = forward_kinematics(REST, shift, rest)
    np.testing.assert_allclose(joints[0], rest + shift)
    np.testing.assert_allclose(R, REST)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_forward_kinematics_leading_axes_and_torch(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(2)
    R, t, rest = (
        matrix_from_axis_angle(rng.normal(size=(*shape, 22, 3))),
        rng.normal(size=(*shape, 3)),
        rng.normal(size=(22, 3)),
    )
    joints, orientations = forward_kinematics(R, t, rest)
    assert joints.shape == (*shape, 22, 3)
    assert orientations.shape == (*shape, 22, 3, 3)
    again = forward_kinematics(torch.from_numpy(R), torch.from_numpy(t), torch.from_numpy(rest))
    np.testing.assert_allclose(again[0].numpy(), joints, atol=1e-12)
    np.testing.assert_allclose(again[1].numpy(), orientations, atol=1e-12)


def test_bones_keep_their_length_and_the_root_moves_all() -> None:
    R, t = random_pose(6)
    rest = shaped_body(BodyShape("anny", dict(ADULT))).rest_joints_m
    joints, orientations = forward_kinematics(R, t, rest)
    for joint in range(1, 22):
        length = np.linalg.norm(joints[:, joint] - joints[:, PARENTS[joint]], axis=-1)
        np.testing.assert_allclose(length, np.linalg.norm(rest[joint] - rest[PARENTS[joint]]), atol=1e-12)
    turn = matrix_from_axis_angle(np.array([0.3, 1.0, -0.5]))
    turned = R.copy()
    turned[:, 0] = turn @ R[:, 0]
    moved, _ = forward_kinematics(turned, t @ turn.T + 1, rest)
    np.testing.assert_allclose(moved, joints @ turn.T + 1, atol=1e-12)
    np.testing.assert_allclose(orientations[:, 4], R[:, 0] @ R[:, 1] @ R[:, 4], atol=1e-12)


def test_skinned_bone_heads_equal_forward_kinematics(body: ShapedBody) -> None:
    """A point of the rest mesh at a bone's head, skinned by that bone, lies where the skeleton says."""
    R, t = random_pose(4)
    joints, orientations = forward_kinematics(R, t, body.rest_joints_m)
    for joint in range(22):
        bind = np.linalg.inv(body.inverse_bind[joint])
        head = bind[:3, 3]  # origin of the joint's T-pose frame, in the rest mesh (A-pose)
        local = (body.inverse_bind[joint] @ [*head, 1.0])[:3]
        skinned = np.einsum("tij,j->ti", orientations[:, joint], local) + joints[:, joint]
        np.testing.assert_allclose(skinned, joints[:, joint], atol=1e-6)
        parent = PARENTS[joint]
        if parent >= 0:  # the same head, skinned by the parent bone: bones do not come apart
            local = (body.inverse_bind[parent] @ [*head, 1.0])[:3]
            skinned = np.einsum("tij,j->ti", orientations[:, parent], local) + joints[:, parent]
            np.testing.assert_allclose(skinned, joints[:, joint], atol=1e-5)


def test_skin_follows_rigid_motion(body: ShapedBody) -> None:
    R, t = random_pose(1)
    joints, orientations = forward_kinematics(R, t, body.rest_joints_m)
    vertices = body.vertices(orientations, joints)
    assert vertices.shape == (1, len(body.rest_vertices_m), 3)
    turn, shift = matrix_from_axis_angle(np.array([0.2, -2.0, 0.4])), np.array([3.0, -1.0, 2.0])
    moved = body.vertices(turn @ orientations, joints @ turn.T + shift)
    np.testing.assert_allclose(moved, vertices @ turn.T + shift, atol=2e-5)
    chosen = np.array([5, 100, 4000])
    np.testing.assert_allclose(body.vertices(orientations, joints, chosen), vertices[:, chosen], atol=1e-6)


def test_every_vertex_is_a_blend(body: ShapedBody) -> None:
    np.testing.assert_allclose(body.skin_weights.sum(1), 1.0, atol=1e-6)
    assert (body.skin_weights >= 0).all()
    assert len(set(body.vertex_part)) >= 20, "nearly every joint leads some skin"
    assert body.faces.min() == 0
    assert body.faces.max() < len(body.rest_vertices_m)


def test_t_pose_is_straight_symmetric_and_faces_forward(body: ShapedBody) -> None:
    rest = body.rest_joints_m
    np.testing.assert_allclose(rest[0], 0.0, atol=1e-6)
    for left, right in PAIRS:
        # Anny's own collar bones differ by up to 11 mm in shapes far from the mean.
        tolerance_m = 0.015 if JOINT_NAMES[left] == "left_collar" else 0.01
        np.testing.assert_allclose(rest[left] * [-1, 1, 1], rest[right], atol=tolerance_m)
    for start, end, direction in (
        ("left_shoulder", "left_elbow", [1, 0, 0]), ("left_elbow", "left_wrist", [1, 0, 0]),
        ("right_shoulder", "right_elbow", [-1, 0, 0]), ("right_elbow", "right_wrist", [-1, 0, 0]),
        ("left_hip", "left_knee", [0, -1, 0]), ("right_knee", "right_ankle", [0, -1, 0]),
    ):  # fmt: skip
        bone = rest[JOINT_INDEX[end]] - rest[JOINT_INDEX[start]]
        np.testing.assert_allclose(bone / np.linalg.norm(bone), direction, atol=1e-5)
    assert rest[JOINT_INDEX["left_hip"], 0] > 0.03, "x is the body's left"
    assert rest[JOINT_INDEX["head"], 1] > 0.4, "y is up"
    assert rest[JOINT_INDEX["left_foot"], 2] - rest[JOINT_INDEX["left_ankle"], 2] > 0.05, "z is forward"


def test_t_pose_skin_is_where_the_joints_are(body: ShapedBody) -> None:
    vertices = body.vertices(REST, body.rest_joints_m[None])[0]
    reach = np.ptp(vertices[:, 0])
    body_height = np.ptp(vertices[:, 1])
    assert 0.85 < reach / body_height < 1.15, "arm span is about body height in the T-pose"
    for joint in range(22):
        nearest = np.linalg.norm(vertices - body.rest_joints_m[joint], axis=-1).min()
        assert nearest < 0.2, JOINT_NAMES[joint]


def test_body_height_follows_the_shape() -> None:
    model = anny_model()
    statures = [
        float(model.rest_skeleton({k: torch.tensor(v) for k, v in (ADULT | {"height": h}).items()}).body_height_m)
        for h in (0.1, 0.4, 0.9)
    ]
    assert statures == sorted(statures)
    assert statures[1] == pytest.approx(1.73, abs=0.02)
    vertices = shaped_body(BodyShape("anny", dict(ADULT))).rest_vertices_m
    assert np.ptp(vertices[:, 1]) == pytest.approx(statures[1], abs=0.02)


def test_rest_skeleton_is_differentiable_and_agrees_with_the_shaped_body() -> None:
    phenotype = {k: torch.tensor(v, requires_grad=True) for k, v in ADULT.items()}
    rest = anny_model().rest_skeleton(phenotype)
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    np.testing.assert_allclose(rest.rest_joints_m.detach().numpy(), body.rest_joints_m, atol=1e-5)
    rest.body_height_m.backward()
    assert torch.isfinite(phenotype["height"].grad)
    assert phenotype["height"].grad > 0


def test_keypoints_lie_on_the_body() -> None:
    model = anny_model()
    rest = model.rest_skeleton({k: torch.tensor(v) for k, v in ADULT.items()})
    blend = model.keypoint_weights
    torch.testing.assert_close(blend.sum(1), torch.ones(len(KEYPOINT_NAMES)), atol=1e-5, rtol=0)
    points = torch.einsum("kj,kja->ka", blend, rest.keypoint_offsets_m + rest.rest_joints_m[None]).numpy()
    at = dict(zip(KEYPOINT_NAMES, points, strict=True))
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    for name, point in at.items():
        other = at[name.replace("left", "@").replace("right", "left").replace("@", "right")]
        np.testing.assert_allclose(point * [-1, 1, 1], other, atol=0.01, err_msg=name)
        if name in JOINT_INDEX:
            assert np.linalg.norm(point - body.rest_joints_m[JOINT_INDEX[name]]) < 0.12, name
    assert at["nose"][2] > at["left_ear"][2], "the face looks forward"
    assert at["left_eye"][1] > at["nose"][1] > at["left_shoulder"][1]
    assert at["left_big_toe"][2] > at["left_heel"][2]
    assert at["left_index"][0] > at["left_wrist"][0]


@pytest.mark.parametrize(
    "shape", [BodyShape("anny", {"wings": 1.0}), BodyShape("star", {}), BodyShape("anny", {**ADULT, "betas": 0.0})]
)
def test_unknown_shape_is_refused(shape: BodyShape) -> None:
    with pytest.raises(UsageError, match="want model 'anny'"):
        shaped_body(shape)
    assert set(ADULT) == set(PHENOTYPES)


LIMBS = tuple(
    (f"{side}_{a}", f"{side}_{b}")
    for side in ("left", "right")
    for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
)


@pytest.mark.parametrize(
    ("name", "upper", "lower"),
    [
        ("upper_leg", "left_hip", "left_knee"), ("lower_leg", "right_knee", "right_ankle"),
        ("upper_arm", "right_shoulder", "right_elbow"), ("lower_arm", "left_elbow", "left_wrist"),
        ("shoulders", "left_shoulder", "right_shoulder"), ("trunk", "pelvis", "neck"),
    ],
)  # fmt: skip
def test_a_length_changes_its_bone_alone(name: str, upper: str, lower: str) -> None:
    def bones_m(value: float) -> np.ndarray:
        rest_m = shaped_body(BodyShape("anny", {**ADULT, name: value})).rest_joints_m
        pairs = np.array([(JOINT_INDEX[a], JOINT_INDEX[b]) for a, b in (*LIMBS, (upper, lower))])
        return np.linalg.norm(rest_m[pairs[:, 0]] - rest_m[pairs[:, 1]], axis=1)

    usual, longer, shorter = bones_m(0.0), bones_m(0.5), bones_m(-0.5)
    assert longer[-1] - usual[-1] > 0.015
    assert usual[-1] - shorter[-1] > 0.01
    same = [i for i, (a, b) in enumerate(LIMBS) if a.split("_")[1] != upper.split("_")[-1]]
    np.testing.assert_allclose(longer[same], usual[same], atol=2e-3)
    plain = shaped_body(BodyShape("anny", dict(ADULT)))
    named = shaped_body(BodyShape("anny", {**ADULT, name: 0.0}))
    np.testing.assert_allclose(named.rest_vertices_m, plain.rest_vertices_m, atol=1e-6)
