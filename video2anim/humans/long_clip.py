"""The body fit of clips of any length in constant memory and linear time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from video2anim.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp
from video2anim.humans.lifter_input import LiftedBody
from video2anim.humans.objective import FitConfig
from video2anim.humans.optimize import fit_body
from video2anim.humans.problem import FittedBody, Observations, evenly_spread

PIECE_FRAMES, SHARED_FRAMES = 360, 24
"""Longer clips are fitted in pieces of 12 s, which bound the memory, and overlap by 0.8 s."""
_SHAPE_FRAMES = 120
"""Frames, spread over a long clip, that its shape is fitted to."""


def fit_long(
    observed: Observations,
    lifted: LiftedBody,
    config: FitConfig,
    *,
    iterations: int,
    on_step: Callable[[int, int], None] | None = None,
) -> FittedBody:
    """`fit_body` under a known lens: of the whole clip where it is short, else in pieces.

    The shape of a long clip comes from frames spread over all of it and holds for every piece. Neighboring pieces
    overlap and are blended there.

    Raises:
        StageError: fewer than one valid frame.
    """
    frames = len(observed.valid)
    pieces = _pieces(observed.valid)
    if len(pieces) == 1:
        return fit_body(observed, lifted, config=config, iterations=iterations, on_step=on_step)
    total = iterations * (len(pieces) + 1)
    done = 0

    def count(step: int, _: int) -> None:
        if on_step is not None:
            on_step(done + step, total)

    spread = evenly_spread(np.flatnonzero(observed.valid), _SHAPE_FRAMES)
    whole = fit_body(
        _rows(observed, spread), lifted.rows(spread), config=config, iterations=iterations,
        on_step=count,
    )  # fmt: skip
    fits = []
    for rows in pieces:
        done += iterations
        piece = fit_body(
            _rows(observed, rows), lifted.rows(rows), fit_shape=False,
            shape=whole.shape.parameters, config=config, iterations=iterations, on_step=count,
        )  # fmt: skip
        fits.append(piece)
    return _joined(fits, pieces, frames)


def _pieces(valid: np.ndarray) -> list[Int[np.ndarray, "frames"]]:
    """Overlapping runs of frames that cover the clip; each holds a valid frame."""
    frames = len(valid)
    if frames <= PIECE_FRAMES + SHARED_FRAMES:
        return [np.arange(frames)]
    found: list[np.ndarray] = []
    begin, end = 0, PIECE_FRAMES
    while True:
        end = frames if frames - end < PIECE_FRAMES // 2 else end
        if valid[begin:end].any():
            found.append(np.arange(begin, end))
            begin = end - SHARED_FRAMES
        if end == frames:
            break
        end += PIECE_FRAMES
    if found[-1][-1] != frames - 1:
        found[-1] = np.arange(found[-1][0], frames)
    return found


def _rows(observed: Observations, rows: np.ndarray) -> Observations:
    return replace(
        observed, frame_time_s=observed.frame_time_s[rows], valid=observed.valid[rows],
        keypoints_px=observed.keypoints_px[rows], keypoints_m=observed.keypoints_m[rows], weight=observed.weight[rows],
    )  # fmt: skip


def _joined(fits: list[FittedBody], pieces: list[np.ndarray], frames: int) -> FittedBody:
    """Pieces blended over their shared frames; joints by forward kinematics of the blended pose."""
    from video2anim.types.skeleton import forward_kinematics

    first = fits[0]
    R = np.empty((frames, 22, 3, 3))
    translation = np.empty((frames, 3))
    error = np.full((frames, first.reprojection_px.shape[1]), np.nan)
    filled = 0
    for fit, rows in zip(fits, pieces, strict=True):
        shared = max(filled - int(rows[0]), 0)
        fresh = slice(int(rows[0]) + shared, int(rows[-1]) + 1)
        if shared:
            both = slice(int(rows[0]), int(rows[0]) + shared)
            weight = (np.arange(shared) + 1.0) / (shared + 1.0)
            weight = weight**2 * (3 - 2 * weight)
            a, b = quaternion_from_matrix(R[both]), quaternion_from_matrix(fit.R_parent_joint[:shared])
            share = np.broadcast_to(weight[:, None, None], (shared, 22, 1))
            R[both] = matrix_from_quaternion(slerp(a, b, share))
            w = weight[:, None]
            translation[both] = (1 - w) * translation[both] + w * fit.translation_camera_m[:shared]
        R[fresh] = fit.R_parent_joint[shared:]
        translation[fresh] = fit.translation_camera_m[shared:]
        error[int(rows[0]) : int(rows[-1]) + 1] = fit.reprojection_px
        filled = int(rows[-1]) + 1
    joints, _ = forward_kinematics(R, translation, first.rest_joints_m)
    return FittedBody(R, translation, np.asarray(joints), first.rest_joints_m, first.shape, error)
