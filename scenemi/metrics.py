"""Quality numbers of motion, each defined once: unit and direction stand in the docstring, thresholds in constants.

Joints are the 22 SMPL joints in meters, world +Y up, floor at y = 0. A rate over nothing (no contact frame, too few
frames) is NaN, never a made-up zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from video2anim.types.skeleton import JOINT_INDEX

ANKLES = (JOINT_INDEX["left_ankle"], JOINT_INDEX["right_ankle"])
TOES = (JOINT_INDEX["left_foot"], JOINT_INDEX["right_foot"])
ROOT = JOINT_INDEX["pelvis"]
HORIZONTAL = [0, 2]
"""Axes of the ground plane."""
UP = 1

TOE_CONTACT_M = 0.05
"""A toe below this touches the floor (`gmd` and `kimodo`)."""
GMD_SPEED_M_S = 0.50
"""Karunratanakul et al. 2023, as `GMD_WINDOW_FRAMES`."""
GMD_WINDOW_FRAMES = 5
"""Frames over which the speed is averaged."""
KIMODO_SPEED_M_S = 0.20
"""As in kimodo's metric."""
ROHM_ANKLE_HEIGHT_M = 0.15
"""RoHM (Zhang et al. 2024), with the two below."""
ROHM_TOE_HEIGHT_M = 0.10
"""See above."""
ROHM_SPEED_M_S = 0.10
"""See above."""
STANCE_SPEED_M_S = 0.3
"""A low foot slower than this stands."""
INSIDE_M = 0.01
"""A joint or vertex deeper than this is inside; shallower ones are within the errors of skin and scene."""
COLLISION_TAUS_M = (0.0, INSIDE_M)
"""Depths at which collision ratios are reported."""
CLOSE_PROXIMITY_M = 0.08
"""Human and scene nearer than this: the close-proximity subset."""
FLOATING_TOLERANCE_M = 0.005
"""A gap up to this still counts as touching (PhysDiff, Yuan et al. 2023)."""
WORLD_CHUNK_FRAMES = 100
"""Length of the chunks of W-MPJPE and WA-MPJPE (SLAHMR, Ye et al. 2023)."""
W_ALIGN_FRAMES = 2
"""Frames at a chunk's start that W-MPJPE aligns by."""


def expect_joints(joints_m: np.ndarray, name: str = "joints_m") -> np.ndarray:
    """The array as float64, or ValueError: want (T, 22, 3), all finite."""
    joints_m = np.asarray(joints_m, dtype=np.float64)
    if joints_m.ndim != 3 or joints_m.shape[1:] != (22, 3):
        raise ValueError(f"{name}: want shape (T, 22, 3), got {joints_m.shape}")
    if not np.isfinite(joints_m).all():
        raise ValueError(f"{name}: want finite values, got NaN or infinity; drop invalid frames first")
    return joints_m


def jerk_m_s3(joints_m: Float[np.ndarray, "frames 22 3"], fps: float) -> float:
    """Mean norm of the third difference times fps^3, over frames and 22 joints, in m/s^3.

    Lower is smoother; too low is over-smoothed, so it is always read beside the ground truth's. NaN below 4 frames.
    """
    joints_m = expect_joints(joints_m)
    if len(joints_m) < 4:
        return float("nan")
    return float(np.linalg.norm(np.diff(joints_m, n=3, axis=0), axis=-1).mean() * fps**3)


def foot_skating_gmd(joints_m: Float[np.ndarray, "frames 22 3"], fps: float) -> float:
    """Share of the T-1 steps in which a foot skates (Karunratanakul et al. 2023). Ratio, lower is better.

    A foot skates when its toe is below 5 cm in t and t+1 and both its horizontal speed and the mean of that speed
    over 5 frames (zero outside the clip) exceed 0.5 m/s.
    """
    joints_m = expect_joints(joints_m)
    if len(joints_m) < 2:
        return float("nan")
    toes = joints_m[:, TOES]
    speed = np.linalg.norm(np.diff(toes[..., HORIZONTAL], axis=0), axis=-1) * fps
    mean_speed = uniform_filter1d(speed, size=GMD_WINDOW_FRAMES, axis=0, mode="constant")
    low = toes[..., UP] < TOE_CONTACT_M
    skates = low[:-1] & low[1:] & (speed > GMD_SPEED_M_S) & (mean_speed > GMD_SPEED_M_S)
    return float(skates.any(axis=1).mean())


def foot_skating_kimodo(joints_m: Float[np.ndarray, "frames 22 3"], fps: float) -> float:
    """Share of toe-contact steps, both feet pooled, with a 3D toe speed above 0.2 m/s. Ratio, lower is better.

    A step is in contact when the toe is below 5 cm in both its frames. NaN where there is none.
    """
    toes = expect_joints(joints_m)[:, TOES]
    speed = np.linalg.norm(np.diff(toes, axis=0), axis=-1) * fps
    low = toes[..., UP] < TOE_CONTACT_M
    contact = low[:-1] & low[1:]
    return float((speed[contact] > KIMODO_SPEED_M_S).mean()) if contact.any() else float("nan")


def foot_skating_rohm(joints_m: Float[np.ndarray, "frames 22 3"], fps: float) -> float:
    """Share of the T-1 steps in which both feet skate (RoHM, Zhang et al. 2024). Ratio, lower is better.

    Both ankles below 15 cm, both toes below 10 cm in the step's first frame, and all four 3D speeds above 0.1 m/s.
    """
    joints_m = expect_joints(joints_m)
    if len(joints_m) < 2:
        return float("nan")
    feet = joints_m[:, (*ANKLES, *TOES)]
    speed = np.linalg.norm(np.diff(feet, axis=0), axis=-1) * fps
    limit_m = np.array([ROHM_ANKLE_HEIGHT_M] * 2 + [ROHM_TOE_HEIGHT_M] * 2)
    low = feet[:-1, :, UP] < limit_m
    return float((low & (speed > ROHM_SPEED_M_S)).all(axis=1).mean())


def collision_frame_ratio(signed_distance_m: Float[np.ndarray, "frames vertices"], tau_m: float = 0.0) -> float:
    """Share of frames with a body vertex deeper than `tau_m` in the scene. Ratio, lower is better.

    `signed_distance_m` is positive in free space.
    """
    return float((np.min(signed_distance_m, axis=1) < -tau_m).mean())


def collision_vertex_ratio(signed_distance_m: Float[np.ndarray, "frames vertices"], tau_m: float = 0.0) -> float:
    """Share of all body vertices of all frames deeper than `tau_m` in the scene. Ratio, lower is better."""
    return float((np.asarray(signed_distance_m) < -tau_m).mean())


def penetration_max_m(signed_distance_m: Float[np.ndarray, "frames vertices"]) -> float:
    """Depth of the clip's deepest body vertex in the scene, 0 when none is inside. Meters, lower is better.

    Reported over a set of clips as the mean of this value.
    """
    return float(max(0.0, -np.min(signed_distance_m)))


def floating_m(signed_distance_m: Float[np.ndarray, "frames vertices"]) -> float:
    """Mean over frames of the gap between body and scene beyond a 5 mm tolerance. Meters, lower is better.

    Flight phases count too: read it beside the ground truth's.
    """
    gap_m = np.min(signed_distance_m, axis=1) - FLOATING_TOLERANCE_M
    return float(np.maximum(gap_m, 0.0).mean())


def mpjpe(estimate_m: Float[np.ndarray, "frames 22 3"], truth_m: Float[np.ndarray, "frames 22 3"]) -> float:
    """Mean distance between equal joints, no alignment. Meters, lower is better."""
    return float(_distances(estimate_m, truth_m).mean())


def root_relative_mpjpe(
    estimate_m: Float[np.ndarray, "frames 22 3"], truth_m: Float[np.ndarray, "frames 22 3"]
) -> float:
    """MPJPE after each frame's pelvis is moved to the origin. Meters, lower is better."""
    return mpjpe(estimate_m - estimate_m[:, [ROOT]], truth_m - truth_m[:, [ROOT]])


def pa_mpjpe(estimate_m: Float[np.ndarray, "frames 22 3"], truth_m: Float[np.ndarray, "frames 22 3"]) -> float:
    """MPJPE after each frame is aligned by its own similarity (Procrustes). Meters, lower is better."""
    estimate_m, truth_m = expect_joints(estimate_m, "estimate_m"), expect_joints(truth_m, "truth_m")
    aligned_m = np.stack([align_similarity(e, t)(e) for e, t in zip(estimate_m, truth_m, strict=True)])
    return mpjpe(aligned_m, truth_m)


def w_mpjpe(estimate_m: Float[np.ndarray, "frames 22 3"], truth_m: Float[np.ndarray, "frames 22 3"]) -> float:
    """World MPJPE over chunks of 100 frames, each aligned by a similarity of its first two frames. Meters, lower."""
    return _chunked_mpjpe(estimate_m, truth_m, W_ALIGN_FRAMES)


def wa_mpjpe(estimate_m: Float[np.ndarray, "frames 22 3"], truth_m: Float[np.ndarray, "frames 22 3"]) -> float:
    """World MPJPE over chunks of 100 frames, each aligned by a similarity of all its frames. Meters, lower."""
    return _chunked_mpjpe(estimate_m, truth_m, WORLD_CHUNK_FRAMES)


def rte(estimate_root_m: Float[np.ndarray, "frames 3"], truth_root_m: Float[np.ndarray, "frames 3"]) -> float:
    """Root translation error after one rigid alignment, over the length of the true path. Ratio, lower is better.

    Published tables give it in percent (WHAM, Shin et al. 2024). NaN where the true root does not move.
    """
    path_m = float(np.linalg.norm(np.diff(truth_root_m, axis=0), axis=-1).sum())
    if path_m <= 0:
        return float("nan")
    aligned_m = align_similarity(estimate_root_m, truth_root_m, with_scale=False)(estimate_root_m)
    return float(np.linalg.norm(aligned_m - truth_root_m, axis=-1).mean() / path_m)


def acceleration_error_m_s2(
    estimate_m: Float[np.ndarray, "frames 22 3"], truth_m: Float[np.ndarray, "frames 22 3"], fps: float
) -> float:
    """Mean distance of the second differences of equal joints times fps^2, in m/s^2; lower is better.

    Both must be in axes that agree; a constant offset does not count. NaN below 3 frames.
    """
    estimate_m, truth_m = expect_joints(estimate_m, "estimate_m"), expect_joints(truth_m, "truth_m")
    if len(estimate_m) < 3:
        return float("nan")
    difference_m = np.diff(estimate_m - truth_m, n=2, axis=0)
    return float(np.linalg.norm(difference_m, axis=-1).mean() * fps**2)


@dataclass(frozen=True, slots=True)
class BinaryScores:
    """How well yes/no answers agree with the truth. Ratios, higher is better; NaN where nothing was to be found."""

    precision: float
    """Share of the claimed that is true."""
    recall: float
    """Share of the true that is claimed."""
    f1: float
    """2 true claims / (claims + true ones)."""


def binary_scores(estimate: Bool[np.ndarray, "..."], truth: Bool[np.ndarray, "..."]) -> BinaryScores:
    """Precision, recall and F1 of foot contact or any other yes/no label."""
    both, claimed, true = (int(np.count_nonzero(x)) for x in (estimate & truth, estimate, truth))
    nan = float("nan")
    return BinaryScores(
        precision=both / claimed if claimed else nan,
        recall=both / true if true else nan,
        f1=2 * both / (claimed + true) if claimed + true else nan,
    )


class Similarity:
    """x -> scale * R x + offset."""

    def __init__(self, scale: float, R_to_from: np.ndarray, offset_m: np.ndarray) -> None:
        self.scale, self.R_to_from, self.offset_m = scale, R_to_from, offset_m

    def __call__(self, points_m: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        return self.scale * points_m @ self.R_to_from.T + self.offset_m


def align_similarity(
    source_m: Float[np.ndarray, "points 3"], target_m: Float[np.ndarray, "points 3"], *, with_scale: bool = True
) -> Similarity:
    """Least-squares similarity (or rigid motion) from source to target (Umeyama 1991)."""
    source_mean, target_mean = source_m.mean(axis=0), target_m.mean(axis=0)
    source_0, target_0 = source_m - source_mean, target_m - target_mean
    u, singular, vt = np.linalg.svd(target_0.T @ source_0)
    mirror = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    R_to_from = (u * mirror) @ vt
    spread = float((source_0**2).sum())
    scale = float((singular * mirror).sum() / spread) if with_scale and spread > 0 else 1.0
    return Similarity(scale, R_to_from, target_mean - scale * R_to_from @ source_mean)


def _distances(estimate_m: np.ndarray, truth_m: np.ndarray) -> np.ndarray:
    estimate_m, truth_m = expect_joints(estimate_m, "estimate_m"), expect_joints(truth_m, "truth_m")
    if len(estimate_m) != len(truth_m):
        raise ValueError(f"estimate_m has {len(estimate_m)} frames, truth_m {len(truth_m)}; cut to equal frames")
    return np.linalg.norm(estimate_m - truth_m, axis=-1)


def _chunked_mpjpe(estimate_m: np.ndarray, truth_m: np.ndarray, align_frames: int) -> float:
    """Mean over all frames, each chunk aligned by its first `align_frames` frames."""
    errors_m = []
    for start in range(0, len(truth_m), WORLD_CHUNK_FRAMES):
        chunk = slice(start, start + WORLD_CHUNK_FRAMES)
        estimate, truth = expect_joints(estimate_m[chunk]), expect_joints(truth_m[chunk])
        head = slice(0, align_frames)
        align = align_similarity(estimate[head].reshape(-1, 3), truth[head].reshape(-1, 3))
        errors_m.append(_distances(align(estimate), truth))
    return float(np.concatenate(errors_m).mean())


def standing_feet(joints_m: Float[np.ndarray, "frames 22 3"], fps: float) -> Float[np.ndarray, "frames 22"]:
    """Ankles and toes that are low and slow, 1 or 0."""
    contact = np.zeros(joints_m.shape[:2])
    if len(joints_m) < 2:
        return contact
    for joints, height_m in ((ANKLES, ROHM_ANKLE_HEIGHT_M), (TOES, ROHM_TOE_HEIGHT_M)):
        for joint in joints:
            speed = np.linalg.norm(np.gradient(joints_m[:, joint], axis=0), axis=-1) * fps
            contact[:, joint] = (joints_m[:, joint, UP] < height_m) & (speed < STANCE_SPEED_M_S)
    return contact
