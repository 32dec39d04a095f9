"""`motion.npz`: one person's motion, with the same keys in every stage that makes one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import numpy as np
from jaxtyping import Float, Int, Shaped
from pydantic import NonNegativeInt, TypeAdapter, ValidationError

from video2anim.artifacts.arrays import Axes, opened_archive
from video2anim.artifacts.stage_files import first_fault
from video2anim.errors import ArtifactError
from video2anim.types.camera import Intrinsics
from video2anim.types.checks import ROTATION_TOLERANCE, is_array
from video2anim.types.motion import BodyMotion, BodyShape
from video2anim.types.motion_arrays import motion_arrays
from video2anim.types.skeleton import JOINT_NAMES, PARENTS, forward_kinematics
from video2anim.types.storage import Holds

_SCHEMA = {key: hint for key, hint in get_type_hints(BodyMotion, include_extras=True).items() if is_array(hint)}
_KEYS: dict[str, Any] = _SCHEMA | {
    "joint_names": Annotated[Shaped[np.ndarray, "22"], Holds.TEXT],
    "parents": Int[np.ndarray, "22"],
    "intrinsics": Float[np.ndarray, "6"],
    "shape_model": Annotated[Shaped[np.ndarray, ""], Holds.TEXT],
    "shape_names": Annotated[Shaped[np.ndarray, "parameters"], Holds.TEXT],
    "shape_values": Float[np.ndarray, "parameters"],
    "person_id": Int[np.ndarray, ""],
}
"""What is read, and what it must be. `joints_camera_m` follows from the rest and is not read."""
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")


@dataclass(frozen=True)
class _Scalars:
    person_id: NonNegativeInt
    intrinsics: Intrinsics
    shape: BodyShape


_SCALARS = TypeAdapter(_Scalars)


def write_motion(path: Path, motion: BodyMotion) -> None:
    """Write a motion as `.npz`. Never pickled."""
    np.savez(path, allow_pickle=False, **motion_arrays(motion))


def read_motion(path: Path, axes: Axes | None = None) -> BodyMotion:
    """Read a `motion.npz`, also one that was edited.

    The motion is what `R_parent_joint`, the translations of `T_world_root` and `rest_joints_m` say; joints are computed
    from them, whatever `joints_world_m` and `joints_camera_m` hold.

    Args:
        path: of the file.
        axes: named lengths that the arrays must have, such as the clip's `frames`.

    Raises:
        ArtifactError: missing, unreadable or lacks a key; an array of the wrong shape or kind, NaN, what is no
            rotation, times that do not rise, another skeleton, or two root orientations that differ.
    """
    axes = {} if axes is None else axes
    with opened_archive(path) as archive:
        arrays = {key: archive.read(key, hint, axes) for key, hint in _KEYS.items()}
    if tuple(arrays["joint_names"].tolist()) != JOINT_NAMES or not np.array_equal(arrays["parents"], PARENTS):
        raise ArtifactError(f"joint_names, parents: want the 22 joints in SMPL order, got others in {path}")
    off = np.abs(arrays["T_world_root"][:, :3, :3] - arrays["R_parent_joint"][:, 0]).max((1, 2))
    if off.max() > ROTATION_TOLERANCE:
        raise ArtifactError(
            f"T_world_root: want the rotation of R_parent_joint[:, 0], got another at [{off.argmax()}] in {path}; "
            "turn a body in both"
        )
    try:
        scalars = _SCALARS.validate_python(
            {
                "person_id": arrays["person_id"].item(),
                "intrinsics": dict(zip(_LENS, arrays["intrinsics"].tolist(), strict=True)),
                "shape": {
                    "model": arrays["shape_model"].item(),
                    "parameters": dict(
                        zip(arrays["shape_names"].tolist(), arrays["shape_values"].tolist(), strict=True)
                    ),
                },
            }
        )
    except ValidationError as error:
        raise ArtifactError(f"{first_fault(error)} in {path}") from error
    joints_world_m, _ = forward_kinematics(
        arrays["R_parent_joint"], arrays["T_world_root"][:, :3, 3], arrays["rest_joints_m"]
    )
    kept = {key: arrays[key] for key in _SCHEMA if key != "joints_world_m"}
    return BodyMotion(**kept, **vars(scalars), joints_world_m=joints_world_m)
