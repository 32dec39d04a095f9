"""SMPL, SMPL-H and SMPL-X bodies from the user's own model files.

The files are licensed by their makers (Loper et al. 2015, Romero et al. 2017, Pavlakos et al. 2019; non-commercial
unless bought) and are neither shipped nor downloaded. `VIDEO2ANIM_SMPL_DIR` is the folder with the files, laid out as
for the `smplx` package: `smplx/SMPLX_NEUTRAL.npz`, `smpl/SMPL_MALE.pkl`, or without subfolders. `shaped_body` then
accepts shapes with `model` `smpl`, `smplh` or `smplx` (neutral), or one of these with `-male` or `-female`.
`video2anim export` and `view` put a motion on such a body (`--body smplx`, `video2anim.body.smpl_fit`).

Their rest pose is the T-pose of this project with the same axes, so bind matrices are pure translations. Fingers, jaw
and eyes move with the wrist or the head. Pose-dependent corrections of the surface (`posedirs`) are left out, since
skinning is linear for all bodies here.
"""

from __future__ import annotations

import functools
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from video2anim.body.shaped_body import ShapedBody
from video2anim.body.smpl_file import SmplFile, read_smpl_file
from video2anim.errors import InputError, UsageError
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import PARENTS

DIR_VARIABLE = "VIDEO2ANIM_SMPL_DIR"
MEAN_PELVIS_M: dict[str, Float[np.ndarray, "3"]] = {
    "smpl": np.array([-0.002, -0.223, 0.028]),
    "smplh": np.array([-0.002, -0.23, 0.028]),
    "smplx": np.array([0.003, -0.351, 0.012]),
}
"""Pelvis joint of the mean shape in the model's own frame, for use without the files."""
MODEL_OF_JOINTS = {24: "smpl", 52: "smplh", 55: "smplx"}
"""Model by its number of joints; the first 22 of each are those of this project."""
_GENDERS = ("neutral", "male", "female")
_BODY = len(PARENTS)
_SMPLX_SHAPES = 300
"""Number of shape coefficients in SMPL-X files with 400 in total (10 in files with 20); the rest are expressions."""
_BETA = re.compile(r"beta_(0|[1-9][0-9]*)")


@dataclass(frozen=True, slots=True, eq=False)
class SmplModel:
    """A model file reduced to the 22 body joints, in the model's own frame (meters, +Y up, facing +Z)."""

    name: str
    """`smpl`, `smplh` or `smplx`."""
    template_m: Float[np.ndarray, "vertices 3"]
    shape_basis_m: Float[np.ndarray, "vertices 3 betas"]
    joint_regressor: Float[np.ndarray, "22 vertices"]
    skin_weights: Float[np.ndarray, "vertices 22"]
    faces: Int[np.ndarray, "faces 3"]

    def shaped(self, shape: BodyShape) -> ShapedBody:
        """The body of a shape in the T-pose, pelvis at the origin.

        Args:
            shape: Parameters `beta_0`, `beta_1`, ...; missing ones are 0.

        Raises:
            UsageError: the shape is of another model or has a parameter that the file lacks.
        """
        vertices, joints = self._rest(shape)
        inverse_bind = np.tile(np.eye(4), (_BODY, 1, 1))
        inverse_bind[:, :3, 3] = joints[0] - joints
        return ShapedBody(shape, vertices - joints[0], self.faces, self.skin_weights, inverse_bind, joints - joints[0])

    def pelvis_m(self, shape: BodyShape) -> Float[np.ndarray, "3"]:
        """Pelvis joint of a shape in the model's own frame.

        SMPL's translation parameter moves the origin of that frame, so the pelvis is at `transl + pelvis_m`.

        Raises:
            UsageError: as for `shaped`.
        """
        return self._rest(shape)[1][0]

    def _rest(self, shape: BodyShape) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) and joints (22, 3) at rest."""
        vertices = self.template_m + self.shape_basis_m @ self._betas(shape)
        return vertices, self.joint_regressor @ vertices

    def _betas(self, shape: BodyShape) -> np.ndarray:
        count = self.shape_basis_m.shape[2]
        betas = np.zeros(count)
        unknown = []
        for name, value in shape.parameters.items():
            match = _BETA.fullmatch(name)
            if match and int(match[1]) < count:
                betas[int(match[1])] = value
            else:
                unknown.append(name)
        if shape.model.partition("-")[0] != self.name or unknown:
            raise UsageError(
                f"body shape: want model {self.name!r} with beta_0..beta_{count - 1}, got {shape.model!r} "
                f"{sorted(unknown)}"
            )
        return betas


def load_body_model(path: Path) -> SmplModel:
    """The body model of a user's SMPL, SMPL-H or SMPL-X file (.npz or .pkl, read by `smpl_file`).

    Raises:
        InputError: the file cannot be read safely, or is not one of these three models.
    """
    file = read_smpl_file(path)
    joints = len(file.parents)
    if joints not in MODEL_OF_JOINTS:
        known = ", ".join(f"{count} ({name})" for count, name in MODEL_OF_JOINTS.items())
        raise InputError(f"SMPL file: want {known} joints, got {joints} in {path}; use the full body model")
    if not np.array_equal(file.parents[:_BODY], PARENTS) or not _ordered(file.parents):
        raise InputError(f"SMPL file: kintree_table: want SMPL's joint order, got another tree in {path}")
    name = MODEL_OF_JOINTS[joints]
    shapes = file.shape_basis_m.shape[2]
    if name == "smplx":
        shapes = _SMPLX_SHAPES if shapes > _SMPLX_SHAPES else min(shapes, 10)
    return SmplModel(
        name=name,
        template_m=file.template_m,
        shape_basis_m=np.ascontiguousarray(file.shape_basis_m[:, :, :shapes]),
        joint_regressor=file.joint_regressor[:_BODY],
        skin_weights=_body_weights(file, path),
        faces=file.faces,
    )


def shaped_smpl(shape: BodyShape) -> ShapedBody:
    """Body of a shape from the user's file in the folder `VIDEO2ANIM_SMPL_DIR`; files are read once per process.

    Raises:
        UsageError: unknown model or parameters, or no folder of SMPL files is given.
        InputError: the folder has no such file, or the file cannot be used.
    """
    return _shaped(model_file(shape.model), shape.model, tuple(sorted(shape.parameters.items())))


def users_model(model: str) -> SmplModel:
    """The user's model by name, such as `smplx` or `smpl-male`; files are read once per process.

    Raises:
        UsageError: there is no such model, or no folder is named.
        InputError: the folder or the file is missing, or the file cannot be used.
    """
    return _model(model_file(model))


def model_file(model: str) -> Path:
    """The user's file of a model, such as `smplx` or `smpl-male`.

    Raises:
        UsageError: there is no such model, or no folder is named.
        InputError: there is no such folder, or it has no such file.
    """
    name, _, gender = model.partition("-")
    gender = gender or "neutral"
    if name not in MODEL_OF_JOINTS.values() or gender not in _GENDERS:
        raise UsageError(f"body model: want smpl, smplh or smplx, alone or with -male or -female, got {model!r}")
    folder = smpl_folder()
    stem = f"{name.upper()}_{gender.upper()}"
    wanted = [*(f"{stem}{end}" for end in (".npz", ".pkl")), *(f"{name}/{stem}{end}" for end in (".npz", ".pkl"))]
    wanted.append(f"{name}/{gender}/model.npz")  # the layout of SMPL-H
    for candidate in wanted:
        if (folder / candidate).is_file():
            return folder / candidate
    raise InputError(
        f"body model {model!r}: want {' or '.join(wanted)} in {folder}, there is none; put your file there"
    )


def smpl_folder() -> Path:
    """The folder of the user's SMPL files: option `--smpl-dir`, or the variable `VIDEO2ANIM_SMPL_DIR`.

    Raises:
        UsageError: none is named.
        InputError: there is no such folder.
    """
    named = os.environ.get(DIR_VARIABLE)
    if not named:
        raise UsageError(
            f"SMPL body: want the folder of your SMPL files as --smpl-dir or in {DIR_VARIABLE}, got neither; get the "
            "files from their makers"
        )
    folder = Path(named).expanduser()
    if not folder.is_dir():
        raise InputError(f"SMPL body: want a folder of SMPL files, found none at {folder}; correct the path")
    return folder


@functools.lru_cache(maxsize=4)
def _model(path: Path) -> SmplModel:
    return load_body_model(path)


@functools.lru_cache(maxsize=8)
def _shaped(path: Path, model: str, parameters: tuple[tuple[str, float], ...]) -> ShapedBody:
    return _model(path).shaped(BodyShape(model, dict(parameters)))


def _ordered(parents: np.ndarray) -> bool:
    """Whether every joint but the root comes after its parent."""
    later = parents[1:]
    return bool((later >= 0).all() and (later < np.arange(1, len(parents))).all())


def _body_weights(file: SmplFile, path: Path) -> np.ndarray:
    """(V, 22) skinning weights that sum to 1; weights of other joints go to the nearest ancestor among the 22."""
    target = np.arange(len(file.parents))
    for joint in range(_BODY, len(target)):
        target[joint] = target[file.parents[joint]]
    weights = np.zeros((len(file.weights), _BODY))
    np.add.at(weights.T, target, file.weights.T)
    total = weights.sum(1, keepdims=True)
    if (file.weights < 0).any() or (total <= 0).any():
        raise InputError(f"SMPL file: weights: want rows >= 0 with a positive sum, got others in {path}")
    return weights / total
