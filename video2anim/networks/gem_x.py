"""GEM-SMPL (GEM, Li et al. 2025), the SMPL sister of GEM-X: body motion from the 2D keypoints of a whole track.

Tensor contract of `gem_smpl_denoiser_no_imgfeat.onnx` and `gem_smpl_denoiser.onnx`, as the public export script names
it (https://github.com/NVlabs/GENMO, `tools/export/export_denoiser_onnx.py`). Inputs, float32, 120 frames at 30 fps:
`obs` (1, 120, 17, 3) COCO keypoints x, y in pixels and confidence (hidden up to 0.5, or outside the box); `bbx_xys`
(1, 120, 3) center and side of the square box; `K_fullimg` (1, 120, 3, 3); `f_imgseq` (1, 120, 1024) image tokens of
HMR2, ignored by the first network; `f_cam_angvel` (1, 120, 6) rotation from each frame's camera to the next one's.
Outputs: `pred_x` (1, 120, 151), normalized: 21 local rotations, 10 betas, root in the camera, root against gravity,
root velocity; `pred_cam` (1, 120, 3) = s, t_x, t_y. Rotations are the first two rows of the matrix.

`pred_x` needs GEM's own mean and deviation, which the public file does not hold. They go beside it as
`<name>.stats.npz` with `mean` and `std` (151,), taken from the encoder the demo uses
(`EnDecoder(stats_name="MM_V1_AMASS_LOCAL_BEDLAM_CAM", clip_std=True)`, its `stats_dict["gvhmr"]`).
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from jaxtyping import Float

from video2anim.errors import InputError, ModelMissingError
from video2anim.geometry.rotations import matrix_from_rot6d, rot6d_from_matrix
from video2anim.networks.body_estimate import BodyEstimate, full_frame_translation, square_of_box
from video2anim.networks.onnx import open_session
from video2anim.types.camera import Intrinsics
from video2anim.types.people import PersonTrack

WINDOW = 120
"""Frames of one pass; the export has this length baked in."""
_INPUTS = ("obs", "bbx_xys", "K_fullimg", "f_imgseq", "f_cam_angvel")
_OUTPUTS = {"pred_x": 151, "pred_cam": 3}
_FEATURES = 151
_BODY, _BETAS, _ROOT = slice(0, 126), slice(126, 136), slice(136, 142)
"""Parts of `pred_x` that are used."""
_TOKEN = 1024
_SEEN = 0.5
_BOX_MARGIN, _LANDMARK_MARGIN = 1.2, 1.1
"""Enlargement of a detector's box, and of a box around keypoints to a detector's; both as in GEM's demo."""
_COCO_OF_BLAZEPOSE = (0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28)
"""Nose, eyes, ears, shoulders, elbows, wrists, hips, knees, ankles; left before right."""


class GemSmpl:
    """The temporal regressor."""

    name = "gem-smpl"

    def __init__(self, path: Path) -> None:
        """Load the weights and the statistics beside them.

        Raises:
            ModelMissingError: the file is no network of that contract, or its statistics are missing or unusable.
        """
        self._path = path
        self._session = open_session(path, inputs=_INPUTS, outputs=tuple(_OUTPUTS))
        self._mean, self._std = _read_statistics(path.with_suffix(".stats.npz"))

    def infer(
        self,
        keypoints_px: Float[np.ndarray, "frames 17 3"],
        square_px: Float[np.ndarray, "frames 3"],
        intrinsics: Intrinsics,
        *,
        R_first_camera: Float[np.ndarray, "frames 3 3"] | None = None,
        image_tokens: Float[np.ndarray, "frames 1024"] | None = None,
    ) -> BodyEstimate:
        """SMPL-X parameters of one person over time in each frame's camera.

        Longer tracks are cut into windows that overlap by half and are blended; a short one is held at its end.
        Frames in which no keypoint is seen are filled in from their neighbors and not valid.

        Args:
            keypoints_px: COCO keypoints x, y and confidence at 30 fps (`coco_keypoints`); confidence 0 = not seen.
            square_px: center x, y and side of the person's square box (`track_squares`), finite in all frames.
            intrinsics: of the whole picture.
            R_first_camera: orientation of each frame's camera against the first; None: it stands still.
            image_tokens: HMR2's, for the network that wants them.

        Raises:
            ModelMissingError: the network's outputs are not those of the contract.
        """
        frames = len(keypoints_px)
        turns = np.tile(np.eye(3), (frames, 1, 1)) if R_first_camera is None else R_first_camera
        tokens = np.zeros((frames, _TOKEN)) if image_tokens is None else image_tokens
        inputs = {
            "obs": keypoints_px,
            "bbx_xys": square_px,
            "K_fullimg": np.tile(intrinsics.matrix(), (frames, 1, 1)),
            "f_imgseq": tokens,
            "f_cam_angvel": camera_turns(turns),
        }
        features, weak_camera = self._run(inputs, frames)
        local, betas = decode(features * self._std + self._mean)
        translation = full_frame_translation(weak_camera, square_px, intrinsics)
        valid = np.asarray((keypoints_px[..., 2] > _SEEN).any(-1) & np.isfinite(translation).all(-1))
        return BodyEstimate("smplx", valid, local, translation, betas)

    def _run(self, inputs: dict[str, np.ndarray], frames: int) -> tuple[np.ndarray, np.ndarray]:
        """`pred_x` (T, 151) and `pred_cam` (T, 3), windows blended with weights that fall towards their ends."""
        total, weight_sum = np.zeros((frames, sum(_OUTPUTS.values()))), np.zeros((frames, 1))
        tent = np.minimum(np.arange(WINDOW) + 1, WINDOW - np.arange(WINDOW))[:, None]
        for start in window_starts(frames):
            index = np.minimum(start + np.arange(WINDOW), frames - 1)
            feed = {name: value[index][None].astype(np.float32) for name, value in inputs.items()}
            found = [np.asarray(value, np.float64) for value in self._session.run(list(_OUTPUTS), feed)]
            for (name, width), value in zip(_OUTPUTS.items(), found, strict=True):
                if value.shape != (1, WINDOW, width) or not np.isfinite(value).all():
                    raise ModelMissingError(
                        f"{self._path}: want finite {name} {(1, WINDOW, width)}, got {value.shape}"
                        f"{'' if np.isfinite(value).all() else ' with NaN or infinity'}"
                    )
            count = min(WINDOW, frames - start)
            total[start : start + count] += (tent * np.concatenate([v[0] for v in found], -1))[:count]
            weight_sum[start : start + count] += tent[:count]
        blended = total / weight_sum
        return blended[:, :_FEATURES], blended[:, _FEATURES:]


def coco_keypoints(track: PersonTrack) -> Float[np.ndarray, "frames 17 3"]:
    """COCO keypoints x, y (pixels) and confidence of a BlazePose track; zeros where the person is not seen."""
    index = list(_COCO_OF_BLAZEPOSE)
    keypoints = np.concatenate([track.landmarks_px[:, index], track.visibility[:, index, None]], -1)
    return np.where(track.valid[:, None, None], keypoints, 0.0)


def track_squares(track: PersonTrack) -> Float[np.ndarray, "frames 3"]:
    """Centre x, y and side of the person's square box in pixels; gaps are bridged linearly, ends held.

    Raises:
        InputError: the person is seen in no frame.
    """
    seen = np.flatnonzero(track.valid)
    if not seen.size:
        raise InputError(f"person {track.person_id}: want a track with a valid frame, got none in {len(track.valid)}")
    squares = square_of_box(track.box_px[seen].astype(np.float64), _BOX_MARGIN * _LANDMARK_MARGIN)
    return np.stack([np.interp(np.arange(len(track.valid)), seen, column) for column in squares.T], -1)


def camera_turns(R_first_camera: Float[np.ndarray, "frames 3 3"]) -> Float[np.ndarray, "frames 6"]:
    """First two rows of the rotation from each frame's camera coordinates to the next one's; the last is repeated."""
    R_next_here = np.swapaxes(R_first_camera[1:], -1, -2) @ R_first_camera[:-1]
    R_next_here = np.concatenate([R_next_here, R_next_here[-1:] if len(R_next_here) else np.eye(3)[None]])
    return rot6d_from_matrix(np.swapaxes(R_next_here, -1, -2))


def decode(
    features: Float[np.ndarray, "frames 151"],
) -> tuple[Float[np.ndarray, "frames 22 3 3"], Float[np.ndarray, "frames 10"]]:
    """Local rotations (joint 0 = root in the camera) and betas of GEM's features, mean and deviation undone."""
    rows = np.concatenate([features[:, _ROOT], features[:, _BODY]], -1).reshape(len(features), 22, 6)
    return np.swapaxes(matrix_from_rot6d(rows), -1, -2), features[:, _BETAS]


def window_starts(frames: int) -> list[int]:
    """First frames of windows that overlap by half or more and end with the track; one window for a short track."""
    last = max(frames - WINDOW, 0)
    return [*range(0, last, WINDOW // 2), last]


def _read_statistics(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Mean and deviation (151,) of the network's features."""
    want = f"want `mean` and `std` ({_FEATURES},) of GEM's encoder"
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            mean, std = (archive[key].astype(np.float64) for key in ("mean", "std"))
    except FileNotFoundError as error:
        raise ModelMissingError(f"statistics of gem-smpl: {want} at {path}, there is none; save them there") from error
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise ModelMissingError(f"statistics of gem-smpl: {want}, got {error} in {path}; save them again") from error
    if mean.shape != (_FEATURES,) or std.shape != (_FEATURES,) or not np.isfinite(mean).all() or not (std > 0).all():
        raise ModelMissingError(
            f"statistics of gem-smpl: {want}, finite and positive, got {mean.shape} and {std.shape} in {path}"
        )
    return mean, std
