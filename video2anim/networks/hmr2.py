"""HMR2.0 (4D-Humans, Goel et al. 2023): SMPL pose, shape and camera from a crop around one person.

Tensor contract, of an ONNX export the user makes from the public checkpoint (code MIT; the weights predict SMPL, which
is not free for commercial use, so they are neither shipped nor fetched): input `image` (1, 3, 256, 256) float32, RGB in
[0, 1] less the ImageNet mean over its deviation; outputs `global_orient` (1, 1, 3, 3) and `body_pose` (1, 23, 3, 3)
rotation matrices in SMPL order, `betas` (1, 10), `pred_cam` (1, 3) = s, t_x, t_y. They are the entries
`pred_smpl_params` and `pred_cam` of the model's `forward`, whose backbone takes columns 32..223 of the square. There
is no official export: these names are this adapter's, in this order.

The crop is the one of the project's demo: the square whose middle 3:4 strip holds the person's box, the box's center at
crop pixel 128. Source: https://github.com/shubham-goel/4D-Humans (`hmr2/datasets`, `hmr2/models`, `hmr2/utils`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from video2anim.errors import ModelMissingError
from video2anim.networks.body_estimate import BodyEstimate, full_frame_translation, nearest_rotations
from video2anim.networks.depth_anything import MEAN_RGB, STD_RGB
from video2anim.networks.onnx import open_session
from video2anim.networks.roi import SquareRoi
from video2anim.types.camera import Intrinsics

CROP_PX = 256
_OUTPUTS = {"global_orient": (1, 1, 3, 3), "body_pose": (1, 23, 3, 3), "betas": (1, 10), "pred_cam": (1, 3)}
_BODY_JOINTS = 21
"""Of SMPL's 23 local rotations; the last two are the hands."""


class Hmr2:
    """The crop regressor."""

    name = "hmr2"

    def __init__(self, path: Path) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is no network of that contract.
        """
        self._path = path
        self._session = open_session(path, inputs=("image",), outputs=tuple(_OUTPUTS))

    def infer(
        self, image: UInt8[np.ndarray, "height width 3"], square_px: Float[np.ndarray, "3"], intrinsics: Intrinsics
    ) -> BodyEstimate:
        """SMPL parameters of the person in a square, in the camera frame; no leading axes.

        Args:
            image: RGB.
            square_px: center x, y and side (`square_of_box` of a detector's box, or `square_of_roi`).
            intrinsics: of the whole picture.

        Raises:
            ModelMissingError: the network's outputs are not those of the contract.
        """
        values = self._session.run(list(_OUTPUTS), {"image": to_input(image, square_px)})
        found = dict(zip(_OUTPUTS, (np.asarray(value, np.float64) for value in values), strict=True))
        for name, wanted in _OUTPUTS.items():
            if found[name].shape != wanted:
                raise ModelMissingError(f"{self._path}: want {name} {wanted}, got {found[name].shape}")
        local = np.concatenate([found["global_orient"][0], found["body_pose"][0, :_BODY_JOINTS]])
        rotations = nearest_rotations(local)
        if rotations is None:
            raise ModelMissingError(f"{self._path}: want rotation matrices in global_orient and body_pose, got others")
        translation = full_frame_translation(found["pred_cam"][0], square_px, intrinsics)
        betas = found["betas"][0]
        valid = np.array(np.isfinite(translation).all() and np.isfinite(betas).all())
        return BodyEstimate("smpl", valid, rotations, translation, betas)


def to_input(
    image: UInt8[np.ndarray, "height width 3"], square_px: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "1 3 256 256"]:
    """The square cut out (black outside the picture), scaled to [0, 1], normalized, channels first.

    Large squares are averaged over areas where the original blurs.
    """
    x_px, y_px, side_px = (float(v) for v in square_px)
    shift_px = 0.5 * side_px / CROP_PX  # a `SquareRoi` has its center between the crop's pixels 127 and 128
    crop = SquareRoi(x_px - shift_px, y_px - shift_px, side_px, 0.0).crop(image, CROP_PX)
    normal = (crop.astype(np.float32) / 255.0 - np.array(MEAN_RGB, np.float32)) / np.array(STD_RGB, np.float32)
    return np.ascontiguousarray(normal.transpose(2, 0, 1)[None])
