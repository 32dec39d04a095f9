"""AMASS archives (Mahmood et al. 2019): SMPL-H or SMPL-X parameters of one motion per .npz file, z up.

Arrays: `poses` (T, 156) SMPL-H, (T, 165) SMPL-X or (T, 72) SMPL, or `root_orient` (T, 3) with `pose_body` (T, 63);
`trans` (T, 3); `mocap_framerate` or `mocap_frame_rate`. `betas` and `gender` need the licensed body files and are not
used. The data is for research only: clips get the source `amass`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scenemi.data.plain_files import read_arrays
from scenemi.data.smpl_clip import R_Y_UP_Z_UP, SmplModel, smpl_clip
from scenemi.data.source_clip import SourceClip
from video2anim.errors import InputError

_NAMES = ("poses", "root_orient", "pose_body", "trans", "mocap_framerate", "mocap_frame_rate")
_MODELS: dict[int, SmplModel] = {72: "smpl", 156: "smplh", 165: "smplx"}
"""By how many pose parameters the files have."""


def read_amass(path: str | Path, *, kind: str = "unknown") -> SourceClip:
    """One motion at 30 fps, +Y up, floor at y = 0.

    Raises:
        InputError: the file is missing or lacks arrays of this layout.
    """
    path = Path(path)
    arrays = read_arrays(path, _NAMES, "AMASS motion")
    rate = arrays.get("mocap_framerate", arrays.get("mocap_frame_rate"))
    if rate is None or np.size(rate) != 1 or "trans" not in arrays:
        raise InputError(f"{path}: no AMASS motion, want trans and mocap_framerate (shape.npz files hold no motion)")
    if "poses" in arrays:
        poses = arrays["poses"]
        if poses.ndim != 2 or poses.shape[1] not in _MODELS:
            raise InputError(f"{path}: poses want (T, 72), (T, 156) or (T, 165), got {poses.shape}")
        model, poses = _MODELS[poses.shape[1]], poses[:, :66]
    elif "root_orient" in arrays and "pose_body" in arrays:
        poses, model = np.concatenate([arrays["root_orient"], arrays["pose_body"]], axis=1), "smplx"
    else:
        raise InputError(f"{path}: no AMASS motion, want poses, or root_orient and pose_body")
    T_world_data = np.eye(4)
    T_world_data[:3, :3] = R_Y_UP_Z_UP
    return smpl_clip(
        poses,
        arrays["trans"],
        name=f"amass_{path.parent.name}_{path.stem}",
        source="amass",
        fps=float(rate),
        model=model,
        T_world_data=T_world_data,
        kind=kind,
    )
