"""SMPL files of the user's own: synthetic ones in the same layouts give the same body, hostile ones are refused."""

from __future__ import annotations

import io
import os
import pickle
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import scipy.sparse

from video2anim.body.anny_body import shaped_body
from video2anim.body.smpl_file import read_smpl_file
from video2anim.body.smplx_body import DIR_VARIABLE, load_body_model
from video2anim.errors import InputError, UsageError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types import BodyShape
from video2anim.types.skeleton import JOINT_INDEX, PARENTS, forward_kinematics

VERTICES = 80
LEFT_WRIST, RIGHT_WRIST, HEAD = (JOINT_INDEX[name] for name in ("left_wrist", "right_wrist", "head"))
FINGERS = {
    "smpl": [LEFT_WRIST, RIGHT_WRIST],
    "smplh": [parent for wrist, first in ((LEFT_WRIST, 22), (RIGHT_WRIST, 37)) for k in range(5)
              for parent in (wrist, first + 3 * k, first + 3 * k + 1)],
    "smplx": [HEAD] * 3 + [parent for wrist, first in ((LEFT_WRIST, 25), (RIGHT_WRIST, 40)) for k in range(5)
                           for parent in (wrist, first + 3 * k, first + 3 * k + 1)],
}  # fmt: skip
"""Parents of the joints beyond the 22: hands; three knuckles per finger; jaw, eyes and knuckles."""


def arrays(model: str = "smpl", betas: int = 10, seed: int = 0) -> dict[str, Any]:
    """A random body of that model's skeleton under the names the files use."""
    rng = np.random.default_rng(seed)
    parents = np.array([2**32 - 1, *PARENTS[1:], *FINGERS[model]])
    joints = len(parents)
    regressor = rng.random((joints, VERTICES)) * (rng.random((joints, VERTICES)) < 0.2) + 0.01
    return {
        "v_template": rng.normal(size=(VERTICES, 3)),
        "shapedirs": rng.normal(0, 0.1, (VERTICES, 3, betas)),
        "weights": rng.dirichlet(np.ones(joints), VERTICES),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "kintree_table": np.stack([parents, np.arange(joints)]).astype(np.uint32),
        "f": rng.integers(0, VERTICES, (30, 3)).astype(np.uint32),
        "posedirs": np.zeros((VERTICES, 3, 4)),
        "bs_style": "lbs",
    }


def tree(joint: int, parent: int) -> np.ndarray:
    """SMPL's tree with another parent of one joint; the last two are children of each other where 22 has 23."""
    found = arrays()["kintree_table"].astype(np.int64)
    found[0, joint] = parent
    if (joint, parent) == (22, 23):
        found[0, 23] = 22
    return found


def write(path: Path, content: Any, protocol: int = 2) -> Path:
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


class _Python2Pickler(pickle._Pickler):  # pyright: ignore[reportAttributeAccessIssue]
    """Writes as Python 2 did: the bytes of arrays are strings, and modules have their old names."""

    dispatch: ClassVar = dict(pickle._Pickler.dispatch)  # pyright: ignore[reportAttributeAccessIssue]

    def save_string(self, text: Any) -> None:
        raw = text.encode("latin1") if isinstance(text, str) else text
        self.write(pickle.BINSTRING + len(raw).to_bytes(4, "little") + raw)
        self.memoize(text)

    dispatch[bytes] = dispatch[str] = save_string


def as_python2(content: Any) -> bytes:
    stream = io.BytesIO()
    _Python2Pickler(stream, protocol=2).dump(content)
    written = stream.getvalue()
    assert b"cnumpy._core.multiarray\n_reconstruct\n" in written
    assert b"_codecs" not in written
    return written.replace(b"numpy._core.", b"numpy.core.").replace(b"scipy.sparse._", b"scipy.sparse.")


def as_chumpy(content: dict[str, Any], keys: tuple[str, ...], protocol: int, slot: str = "x") -> bytes:
    """Some arrays as chumpy's, without that library: only the name of its class is in the file."""
    module = types.ModuleType("chumpy.ch")
    held = type("Ch", (), {"__module__": "chumpy.ch"})
    module.Ch = held  # pyright: ignore[reportAttributeAccessIssue]
    sys.modules["chumpy"], sys.modules["chumpy.ch"] = types.ModuleType("chumpy"), module
    try:
        for key in keys:
            box = held()
            box.__dict__.update({slot: content[key], "_cache": {"r": None}})
            content = content | {key: box}
        return pickle.dumps(content, protocol=protocol)
    finally:
        del sys.modules["chumpy"], sys.modules["chumpy.ch"]


def sparse(content: dict[str, Any], form: Callable[[np.ndarray], Any]) -> dict[str, Any]:
    return content | {"J_regressor": form(content["J_regressor"])}


LAYOUTS: dict[str, Callable[[dict[str, Any]], bytes]] = {
    **{f"protocol {n}": lambda a, n=n: pickle.dumps(a, protocol=n) for n in range(6)},
    **{
        f"{form.__name__} {n}": lambda a, n=n, form=form: pickle.dumps(sparse(a, form), protocol=n)
        for form in (scipy.sparse.csc_matrix, scipy.sparse.csr_array, scipy.sparse.coo_matrix, scipy.sparse.csr_matrix)
        for n in (0, 2, 5)
    },
    "python 2": lambda a: as_python2(sparse(a, scipy.sparse.csc_matrix)),
    "chumpy 0": lambda a: as_chumpy(sparse(a, scipy.sparse.csc_matrix), ("v_template", "shapedirs"), 0),
    "chumpy 2": lambda a: as_chumpy(a, ("v_template", "shapedirs", "weights"), 2),
    "fortran": lambda a: pickle.dumps(a | {"shapedirs": np.asfortranarray(a["shapedirs"])}, protocol=2),
    "big-endian": lambda a: pickle.dumps(a | {"v_template": a["v_template"].astype(">f8")}, protocol=2),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_all_layouts_give_the_same_body(tmp_path: Path, layout: str) -> None:
    content = arrays()
    path = tmp_path / "SMPL_NEUTRAL.pkl"
    path.write_bytes(LAYOUTS[layout](content))
    found = read_smpl_file(path)
    np.testing.assert_allclose(found.template_m, content["v_template"], rtol=0, atol=0)
    np.testing.assert_allclose(found.shape_basis_m, content["shapedirs"], rtol=0, atol=0)
    np.testing.assert_allclose(found.weights, content["weights"], rtol=0, atol=0)
    np.testing.assert_allclose(found.joint_regressor, content["J_regressor"], rtol=0, atol=0)
    np.testing.assert_array_equal(found.parents, [-1, *PARENTS[1:], LEFT_WRIST, RIGHT_WRIST])
    np.testing.assert_array_equal(found.faces, content["f"])
    assert "chumpy" not in sys.modules


def test_npz_and_pickle_agree_and_single_precision_does(tmp_path: Path) -> None:
    content = {k: v.astype(np.float32) if k == "v_template" else v for k, v in arrays().items()}
    np.savez(tmp_path / "a.npz", **content)
    for path in (tmp_path / "a.npz", write(tmp_path / "a.pkl", content)):
        found = read_smpl_file(path)
        assert found.template_m.dtype == np.float64
        np.testing.assert_array_equal(found.template_m, content["v_template"].astype(np.float64))


def model_of(folder: Path, name: str, betas: int = 10) -> tuple[Any, dict[str, Any]]:
    content = arrays(name, betas)
    return load_body_model(write(folder / f"{name}.pkl", content)), content


@pytest.mark.parametrize("name", FINGERS)
def test_skin_equals_blending_over_all_joints_of_the_file(tmp_path: Path, name: str) -> None:
    """The textbook formula over all joints of the file, fingers and face at rest, against the 22-joint body."""
    model, content = model_of(tmp_path, name)
    assert model.name == name
    betas = np.array([0.7, -1.2])
    body = model.shaped(BodyShape(name, {"beta_0": 0.7, "beta_1": -1.2}))
    rng = np.random.default_rng(3)
    local, shift = matrix_from_axis_angle(rng.normal(0, 0.8, (22, 3))), rng.normal(size=3)

    vertices = content["v_template"] + content["shapedirs"][..., :2] @ betas
    joints = content["J_regressor"] @ vertices
    parents = [-1, *PARENTS[1:], *FINGERS[name]]
    world = [np.eye(4)] * len(parents)
    for joint, parent in enumerate(parents):
        step = np.eye(4)
        step[:3, :3] = local[joint] if joint < 22 else np.eye(3)
        step[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0.0)
        world[joint] = world[parent] @ step if parent >= 0 else step
    expected = np.zeros_like(vertices)
    for joint, T in enumerate(world):
        expected += content["weights"][:, joint, None] * ((vertices - joints[joint]) @ T[:3, :3].T + T[:3, 3])

    # SMPL's translation parameter moves its own origin; ours is that of the pelvis.
    pelvis = model.pelvis_m(body.shape)
    np.testing.assert_allclose(pelvis, joints[0], atol=1e-12)
    posed, R_world_joint = forward_kinematics(local[None], (shift + pelvis)[None], body.rest_joints_m)
    np.testing.assert_allclose(body.vertices(R_world_joint, posed)[0], expected + shift, atol=2e-5)
    np.testing.assert_allclose(posed[0], np.array([T[:3, 3] for T in world[:22]]) + shift, atol=1e-9)


def test_rest_is_the_t_pose_of_the_file(tmp_path: Path) -> None:
    model, content = model_of(tmp_path, "smplx")
    body = model.shaped(BodyShape("smplx", {}))
    joints = content["J_regressor"] @ content["v_template"]
    np.testing.assert_allclose(body.rest_joints_m, joints[:22] - joints[0], atol=1e-12)
    np.testing.assert_array_equal(body.inverse_bind[:, :3, :3], np.tile(np.eye(3), (22, 1, 1)))
    rest = np.tile(np.eye(3), (1, 22, 1, 1))
    unposed = body.vertices(rest, body.rest_joints_m[None])[0]
    np.testing.assert_allclose(unposed, content["v_template"] - joints[0], atol=1e-5)
    np.testing.assert_allclose(body.skin_weights.sum(1), 1.0, atol=1e-12)
    knuckles = content["weights"][:, [LEFT_WRIST, *range(25, 40)]].sum(1)
    np.testing.assert_allclose(body.skin_weights[:, LEFT_WRIST], knuckles, atol=1e-12)
    np.testing.assert_allclose(body.skin_weights[:, HEAD], content["weights"][:, [HEAD, 22, 23, 24]].sum(1), atol=1e-12)


@pytest.mark.parametrize(
    ("name", "stored", "usable"),
    [("smpl", 10, 10), ("smpl", 300, 300), ("smplh", 16, 16), ("smplx", 20, 10), ("smplx", 400, 300)],
)
def test_expressions_are_not_shape(tmp_path: Path, name: str, stored: int, usable: int) -> None:
    model, content = model_of(tmp_path, name, betas=stored)
    last = BodyShape(name, {f"beta_{usable - 1}": 2.0})
    moved = content["v_template"] + 2 * content["shapedirs"][..., usable - 1]
    np.testing.assert_allclose(model.shaped(last).rest_vertices_m + model.pelvis_m(last), moved, atol=1e-12)
    with pytest.raises(UsageError, match=rf"beta_0..beta_{usable - 1}, got .*\['beta_{usable}'\]"):
        model.shaped(BodyShape(name, {f"beta_{usable}": 1.0}))


@pytest.mark.parametrize("shape", [BodyShape("smpl", {}), BodyShape("smplx", {"height": 1.0})])
def test_another_shape_is_refused(tmp_path: Path, shape: BodyShape) -> None:
    with pytest.raises(UsageError, match="want model 'smplx' with beta_0"):
        model_of(tmp_path, "smplx")[0].shaped(shape)


class _Call:
    """Pickles as a call of a function."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = function, args

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("key", ["v_template", "comment"])
@pytest.mark.parametrize(
    ("make", "asked"),
    [
        (lambda mark: _Call(os.system, f"touch {mark}"), "system"),
        (lambda mark: _Call(subprocess.call, ["touch", str(mark)]), "call"),
        (lambda mark: _Call(eval, f"__import__('pathlib').Path({str(mark)!r}).touch()"), "eval"),
        (lambda mark: _Call(np.save, str(mark), np.zeros(1)), "save"),
    ],
    ids=["os.system", "subprocess", "eval", "numpy.save"],
)
def test_a_malicious_pickle_is_refused_and_not_run(
    tmp_path: Path, make: Callable[[Path], Any], asked: str, key: str, protocol: int
) -> None:
    mark = tmp_path / "ran.npy"
    path = write(tmp_path / "evil.pkl", arrays() | {key: make(mark)}, protocol)
    with pytest.raises(
        InputError, match=rf"the pickle asks for \S+\.{asked} in .*evil\.pkl; nothing was run"
    ) as caught:
        load_body_model(path)
    assert "\n" not in str(caught.value)
    assert not mark.exists()
    pickle.loads(path.read_bytes())
    assert mark.exists(), "read in the usual way, the file does harm"


def raw_pickle(*parts: bytes) -> bytes:
    return b"".join([pickle.PROTO, b"\x02", *parts, pickle.STOP])


def test_methods_are_no_way_around_the_list(tmp_path: Path) -> None:
    """Protocol 4 can name an attribute of an admitted class."""
    names = b"".join(pickle.SHORT_BINUNICODE + bytes([len(n)]) + n for n in (b"numpy", b"ndarray.tofile"))
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.PROTO + b"\x04" + names + pickle.STACK_GLOBAL + pickle.STOP)
    with pytest.raises(InputError, match=r"asks for numpy\.ndarray\.tofile"):
        read_smpl_file(path)
    path.write_bytes(raw_pickle(b"ccopyreg\n_reconstructor\n(ccopyreg\n_reconstructor\nccollections\ndeque\n"))
    with pytest.raises(InputError, match=r"asks for collections\.deque"):
        read_smpl_file(path)


def test_raw_bytes_never_become_object_pointers(tmp_path: Path) -> None:
    """A dtype whose state says that it holds plain bytes, though its code says objects."""
    content = arrays()
    content["v_template"] = np.zeros((1,), np.int64)
    forged = pickle.dumps(content, protocol=2).replace(b"i8", b"O8")
    assert forged.count(b"O8") >= 1
    (tmp_path / "a.pkl").write_bytes(forged)
    with pytest.raises(InputError, match="v_template: want numbers, got an array of objects"):
        read_smpl_file(tmp_path / "a.pkl")


def looped_chumpy() -> bytes:
    """A chumpy array whose content is itself."""
    entries = b"".join(
        pickle.SHORT_BINSTRING + bytes([len(key)]) + key.encode() + pickle.BININT1 + b"\x01"
        for key in arrays()
        if key != "v_template"
    )
    held = b"cchumpy.ch\nCh\n" + pickle.EMPTY_TUPLE + pickle.NEWOBJ + pickle.BINPUT + b"\x00"
    held += pickle.EMPTY_DICT + pickle.SHORT_BINSTRING + b"\x01x" + pickle.BINGET + b"\x00" + pickle.SETITEM
    held += pickle.BUILD
    key = pickle.SHORT_BINSTRING + bytes([10]) + b"v_template"
    return raw_pickle(pickle.EMPTY_DICT, pickle.MARK, key, held, entries, pickle.SETITEMS)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "want a pickle"),
        (b"no pickle at all", "want a pickle"),
        (pickle.dumps(arrays(), protocol=2)[:-200], "want a pickle"),
        (
            pickle.dumps(arrays(), protocol=2).replace(b"f8", b"f4"),
            r"v_template: want numbers, got 1920 bytes for shape",
        ),
        (pickle.dumps([1, 2]), "want arrays v_template, .* got nothing"),
        (pickle.dumps({"v_template": np.zeros(3)}), "want arrays shapedirs, weights, .* got v_template in"),
        (pickle.dumps(arrays() | {"f": "text"}), "f: want numbers, got a str"),
        (pickle.dumps(arrays() | {"f": np.array([None])}), "f: want numbers, got an array of objects"),
        (as_chumpy(arrays(), ("f",), 2, slot="a"), "f: want numbers, got a chumpy expression without its value"),
        (looped_chumpy(), "v_template: want numbers, got maximum recursion"),
    ],
    ids=["empty", "text", "cut", "forged dtype", "list", "few keys", "text array", "objects", "expression", "loop"],
)
def test_damaged_pickles_are_reported_in_one_line(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "SMPL.pkl"
    path.write_bytes(content)
    with pytest.raises(InputError, match=told) as caught:
        read_smpl_file(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("suffix", ["npz", "pkl"])
@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"v_template": np.zeros((VERTICES, 2))}, r"v_template: want shape \(vertices, 3\), got \(80, 2\)"),
        ({"shapedirs": np.zeros((7, 3, 10))}, r"shapedirs: want shape \(80, 3, shapes\), got \(7, 3, 10\)"),
        ({"weights": np.zeros((VERTICES,))}, r"weights: want shape \(80, joints\), got \(80,\)"),
        ({"J_regressor": np.zeros((VERTICES, 24))}, r"J_regressor: want shape \(24, 80\), got \(80, 24\)"),
        ({"kintree_table": np.zeros((2, 22), int)}, r"kintree_table: want shape \(2, 24\), got \(2, 22\)"),
        ({"v_template": np.full((VERTICES, 3), np.nan)}, "v_template: want finite numbers"),
        ({"f": np.full((3, 3), VERTICES)}, r"f: want vertices 0\.\.79, got 80\.\.80"),
        ({"weights": np.zeros((VERTICES, 24))}, "weights: want rows >= 0 with a positive sum"),
        ({"kintree_table": np.tile(np.arange(24), (2, 1))}, "want SMPL's joint order"),
        *(({"kintree_table": tree(joint, parent)}, "want SMPL's joint order")
          for joint, parent in ((22, 23), (23, 23), (5, 7), (1, 22))),
        ({"kintree_table": arrays()["kintree_table"] + 0.5}, "kintree_table: want whole numbers"),
        ({"kintree_table": np.full((2, 24), np.nan)}, "kintree_table: want whole numbers"),
        ({"f": np.full((3, 3), 0.5)}, "f: want whole numbers"),
        ({"f": np.full((3, 3), np.inf)}, "f: want whole numbers"),
        ({"f": np.full((3, 3), 1e300)}, "f: want whole numbers"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("error")
def test_wrong_arrays_are_reported_in_one_line(tmp_path: Path, suffix: str, changed: dict[str, Any], told: str) -> None:
    path = tmp_path / f"SMPL.{suffix}"
    content = arrays() | changed
    if suffix == "npz":
        np.savez(path, **content)
    else:
        write(path, content)
    with pytest.raises(InputError, match=told) as caught:
        load_body_model(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("axis", ["vertices", "joints", "faces"])
def test_a_body_of_nothing_is_refused(tmp_path: Path, axis: str) -> None:
    empty = {"vertices": ("v_template", np.zeros((0, 3))), "faces": ("f", np.zeros((0, 3), int)),
             "joints": ("weights", np.zeros((VERTICES, 0)))}  # fmt: skip
    key, value = empty[axis]
    changed: dict[str, Any] = {key: value}
    content = arrays() | changed
    np.savez(tmp_path / "SMPL.npz", **content)
    with pytest.raises(InputError, match=rf"SMPL file: {key}: want shape \(.*\), got \(.*0.*\) in"):
        load_body_model(tmp_path / "SMPL.npz")


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is none; correct the path"):
        load_body_model(tmp_path / "absent.npz")
    (tmp_path / "SMPL.onnx").write_bytes(b"")
    with pytest.raises(InputError, match=r"want \.npz or \.pkl, got '\.onnx'"):
        load_body_model(tmp_path / "SMPL.onnx")
    (tmp_path / "broken.npz").write_bytes(b"PK no archive")
    with pytest.raises(InputError, match=r"want arrays of numbers, got .* in .*broken\.npz"):
        load_body_model(tmp_path / "broken.npz")
    np.savez(tmp_path / "objects.npz", **(arrays() | {"weights": np.array([_Call(os.getcwd)], object)}))
    with pytest.raises(InputError, match="want arrays of numbers, got Object arrays"):
        load_body_model(tmp_path / "objects.npz")
    np.savez(tmp_path / "few.npz", v_template=np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"want arrays shapedirs, .*, got v_template in"):
        load_body_model(tmp_path / "few.npz")
    hand = arrays()
    for key in ("weights", "J_regressor", "kintree_table"):
        hand[key] = hand[key][:16] if key == "J_regressor" else hand[key][:, :16]
    with pytest.raises(InputError, match=r"want 24 \(smpl\), 52 \(smplh\), 55 \(smplx\) joints, got 16"):
        load_body_model(write(tmp_path / "MANO.pkl", hand))


def test_shapes_of_the_family_find_the_users_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(DIR_VARIABLE, raising=False)
    with pytest.raises(UsageError, match=rf"want the folder of your SMPL files as --smpl-dir or in {DIR_VARIABLE}"):
        shaped_body(BodyShape("smplx", {}))
    monkeypatch.setenv(DIR_VARIABLE, str(tmp_path))
    with pytest.raises(InputError, match=r"want SMPLX_NEUTRAL\.npz or .* or smplx/neutral/model\.npz in"):
        shaped_body(BodyShape("smplx", {}))
    for folder in ("smplx", "smplh/male"):
        (tmp_path / folder).mkdir(parents=True)
    files = {"smplx": "smplx/SMPLX_NEUTRAL.npz", "smpl-male": "SMPL_MALE.pkl", "smplh-male": "smplh/male/model.npz"}
    for seed, (model, file) in enumerate(files.items()):
        content = arrays(model.partition("-")[0], seed=seed)
        if file.endswith("npz"):
            np.savez(tmp_path / file, **content)
        else:
            write(tmp_path / file, content)
        body = shaped_body(BodyShape(model, {"beta_3": 1.5}))
        vertices = content["v_template"] + 1.5 * content["shapedirs"][..., 3]
        expected = vertices - content["J_regressor"][0] @ vertices
        np.testing.assert_allclose(body.rest_vertices_m, expected, atol=1e-12)
        assert body.shape.model == model
        assert shaped_body(BodyShape(model, {"beta_3": 1.5})) is body, "read once"
    for wrong in ("smplify", "smpl-robot"):
        with pytest.raises(UsageError, match="want smpl, smplh or smplx"):
            shaped_body(BodyShape(wrong, {}))
