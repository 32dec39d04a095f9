"""Path of a moving camera, and its focal length, from tracked points of the background.

Keyframes are added one after the other: each is located by the points that are known, inverse depths follow from the
poses, and a bundle adjustment improves both whenever the number of keyframes has doubled. At last the focal length is
free too, which any turn of the camera tells, and its mean with what was known of it is taken.
All other frames are located by the result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation, Slerp

from video2anim.camera.background_tracks import MIN_POINTS, BackgroundMotion, BackgroundTracks
from video2anim.camera.bundle_adjustment import (
    Observations,
    Poses,
    adjust,
    cost_of,
    errors,
    focal_information,
    known_points,
    locate,
    log_sigmas,
)
from video2anim.types import BackgroundPoints, Intrinsics

_SIGMA_RATIO = 0.001
"""Standard deviation of a tracked point over the long side of the image: one pixel of 960."""
_KEYFRAME_SHIFT = 0.03
"""A keyframe is added when the median point has moved by this share of the long side."""
_KEYFRAME_KEPT = 0.7
"""Or when fewer of the points are left."""
_MAX_KEYFRAMES = 400
"""Most keyframes, which bounds the time of a step of the adjustment; of longer clips each stands for several."""
_NEARER = 1.5
"""Expected change of the logarithm of inverse depth down the image, per long side: 0.6 to 3.0, in the mean 1.4, in the
depth that stage metric has of eight real clips (a script that is not kept)."""
_FAR = 0.02
"""Inverse depth that points behind the camera start from: 50 times the usual depth."""
_DEPTH_SIGMA = 0.1
"""Standard deviation of a point's depth, as a share of it, up to which it is known."""
_SAME_ERROR, _NOISE_ERROR = 2.0, 1.5
"""A camera only turns unless a path explains the median point so many times better, and surely only turns if it does
less than the second. Inverse depths of pure noise in two keyframes make it 1.24 times better (half-normal and Rayleigh
distribution), a hand that is nearly still 1.35 (`gvhmr_tennis`), a bed on which children jump 1.66, cameras that travel
3.5 and more (`davis_breakdance_flare`, `glamr_pexels_walking`, `monst3r_lady_running`, clips of `moving_cameras.py`; a
script that is not kept)."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraPath:
    """Where a moving camera is in every frame."""

    T_first_camera: Float[np.ndarray, "frames 4 4"]
    """In the first camera's axes; unit of length: the usual distance of the background."""
    located: Bool[np.ndarray, "frames"]
    """Frames with enough points; the others are interpolated."""
    residual_px: float
    """Median distance of the points from where the path has them."""
    log_focal: float
    """Logarithm of the focal length that explains the points, over the one given."""
    focal_log_sigma: float
    """Its standard deviation."""
    points: BackgroundPoints
    """Points of the background whose depth is known; none for a camera that only turns."""

    def faults(self, long_side_px: int) -> list[str]:
        """What is wrong with it, in words."""
        found, lost = [], int((~self.located).sum())
        if lost:
            found.append(f"{lost} of {len(self.located)} frames show too little background to locate the camera")
        limit_px = 2 * _SIGMA_RATIO * long_side_px
        if self.residual_px > limit_px:
            found.append(
                f"the camera's path leaves {self.residual_px:.1f} px between background and video (want at most "
                f"{limit_px:.1f} px); path and motion are not reliable"
            )
        return found


def camera_path(motion: BackgroundMotion, frames: int, intrinsics: Intrinsics, focal_log_sigma: float) -> CameraPath:
    """Path of the camera in a clip of so many frames; a static camera's is known.

    Args:
        motion: Of the background.
        frames: Count of frames.
        intrinsics: Lens as known from elsewhere.
        focal_log_sigma: Standard deviation of the logarithm of its focal length; 0 if it is not to change.
    """
    if motion.is_static:
        still = np.tile(np.eye(4), (frames, 1, 1))
        return CameraPath(still, np.ones(frames, bool), 0.0, 0.0, focal_log_sigma, BackgroundPoints.none())
    return path_of_tracks(motion.tracks, frames, intrinsics, focal_log_sigma)


def path_of_tracks(tracks: BackgroundTracks, frames: int, intrinsics: Intrinsics, focal_log_sigma: float) -> CameraPath:
    """The path, and the focal length, that explain tracked points; arguments as in `camera_path`."""
    k = intrinsics
    seen = (tracks.pixel - [k.cx_px, k.cy_px]) / [k.fx_px, k.fy_px]
    long_side_px = max(k.width_px, k.height_px)
    sigma = _SIGMA_RATIO * long_side_px / k.fx_px
    keyframes = _keyframes(tracks, frames, _KEYFRAME_SHIFT * long_side_px)
    observed, row_of = _observations(tracks, seen, keyframes, sigma)
    poses, rho, focal_after = _keyframe_poses(observed, len(keyframes), focal_log_sigma)
    T, located, residual_px = _all_frames(tracks, seen, row_of, (poses, rho, observed), frames, k.fx_px)
    points = _points_of_known_depth(poses, rho, observed)
    return CameraPath(T, located, residual_px, poses.log_focal, focal_after, points)


def _points_of_known_depth(poses: Poses, rho: np.ndarray, observed: Observations) -> BackgroundPoints:
    log_sigma = log_sigmas(poses, rho, observed)
    known = (log_sigma < _DEPTH_SIGMA) & (rho > 0)
    if not known.any():
        return BackgroundPoints.none()
    place = known_points(poses, rho, observed)[known] / rho[known, None]
    return BackgroundPoints(place, log_sigma[known], observed.anchor[known] == 0)


def _keyframes(tracks: BackgroundTracks, frames: int, shift_px: float) -> Int[np.ndarray, "keyframes"]:
    """Frames between which the image moves by a few percent."""
    found, begin = [0], np.searchsorted(tracks.frame, np.arange(frames + 1))
    last = dict(zip(tracks.point[: begin[1]].tolist(), tracks.pixel[: begin[1]], strict=True))
    for frame in range(1, frames):
        own = slice(begin[frame], begin[frame + 1])
        now = dict(zip(tracks.point[own].tolist(), tracks.pixel[own], strict=True))
        shared = [point for point in last if point in now]
        kept = len(shared) >= _KEYFRAME_KEPT * len(last)
        shift = np.median([np.linalg.norm(now[p] - last[p]) for p in shared]) if shared else np.inf
        if not kept or shift > shift_px or frame == frames - 1:
            found.append(frame)
            last = now
    every = -(-len(found) // _MAX_KEYFRAMES)
    return np.unique([*found[::every], found[-1]])


def _observations(
    tracks: BackgroundTracks, seen: np.ndarray, keyframes: np.ndarray, sigma: float
) -> tuple[Observations, Int[np.ndarray, "points"]]:
    """Observations of keyframes by points that are in at least two of them, and the row of each tracked point (-1 for
    none)."""
    camera = np.searchsorted(keyframes, tracks.frame).clip(0, len(keyframes) - 1)
    rows = np.flatnonzero(keyframes[camera] == tracks.frame)
    point, first, count = np.unique(tracks.point[rows], return_index=True, return_counts=True)
    point, first = point[count > 1], rows[first[count > 1]]
    row_of = np.full(int(tracks.point.max(initial=-1)) + 1, -1)
    row_of[point] = np.arange(len(point))
    ray = np.c_[seen[first], np.ones(len(first))]
    others = rows[(row_of[tracks.point[rows]] >= 0) & ~np.isin(rows, first)]
    expected = _NEARER * _SIGMA_RATIO / sigma * ray[:, 1]
    observed = Observations(
        camera[others], row_of[tracks.point[others]], seen[others], camera[first], ray, expected, sigma
    )
    return observed, row_of


def _keyframe_poses(
    seen: Observations, keyframes: int, focal_sigma: float
) -> tuple[Poses, Float[np.ndarray, "points"], float]:
    """Poses of the keyframes, inverse depths of the points, and the standard deviation of the logarithm of the focal
    length, which is `focal_sigma` before."""
    poses, rho = Poses(np.eye(3)[None], np.zeros((1, 3))), np.ones(len(seen.ray))
    for camera in range(1, keyframes):
        own = seen.camera == camera
        looks = np.bincount(seen.point[seen.camera < camera], minlength=len(rho))
        sure = own & (looks[seen.point] > 1)
        used = sure if sure.sum() >= MIN_POINTS else own
        some = seen.point[used]
        place = known_points(poses, rho, seen)[some]
        R, center, _ = locate(place, rho[some], seen.seen[used], seen.sigma, (poses.R[-1], poses.center[-1]))
        poses = Poses(np.r_[poses.R, R[None]], np.r_[poses.center, center[None]])
        known = seen.among(camera + 1)
        signed = _triangulated(poses, known)
        poses, rho = _in_front(poses, signed)
        if camera & (camera - 1) == 0:
            # Over a short path the opposite one shows much the same with the relief turned inside out.
            opposite = _in_front(Poses(poses.R, -poses.center), 1 / rho)
            fits = [adjust(*start, known) for start in ((poses, rho), opposite)]
            poses, rho = min(fits, key=lambda fit: cost_of(*fit, known))
    if not len(seen.point):
        return Poses(np.tile(np.eye(3), (keyframes, 1, 1)), np.zeros((keyframes, 3))), rho, focal_sigma
    free = focal_sigma > 0
    turning = adjust(Poses(poses.R, np.zeros((keyframes, 3))), np.zeros(len(rho)), seen, free_focal=free)
    moving = adjust(poses, rho, seen, free_focal=free)
    off = [float(np.median(np.linalg.norm(errors(*fit, seen), axis=1))) for fit in (turning, moving)]
    # Of two coordinates of every observation, an inverse depth takes one per point.
    freedom = 1 - len(np.unique(seen.point)) / max(2 * len(seen.point), 1)
    better = off[0] * freedom**0.5 / max(off[1], 1e-9)
    fit = turning if better < _SAME_ERROR else moving
    if not free:
        return *fit, focal_sigma
    told, before = focal_information(*fit, seen), focal_sigma**-2
    if _NOISE_ERROR < better < _SAME_ERROR:
        # As likely it goes a little way around what it looks at, which as a turn alone has a focal length of a third.
        told /= 1 + 0.25 * told * (turning[0].log_focal - moving[0].log_focal) ** 2
    poses = replace(fit[0], log_focal=fit[0].log_focal * told / (told + before))
    return *adjust(poses, fit[1], seen), (told + before) ** -0.5


def _in_front(poses: Poses, rho: Float[np.ndarray, "points"]) -> tuple[Poses, Float[np.ndarray, "points"]]:
    """The same with usual inverse depths of 1, and points behind the camera far away."""
    size = float(np.median(rho[rho > 0])) if (rho > 0).any() else 1.0
    return Poses(poses.R, poses.center * size), np.maximum(rho / size, _FAR)


def _triangulated(poses: Poses, seen: Observations) -> Float[np.ndarray, "points"]:
    """Inverse depths for given poses: the projection is linear in them."""
    anchor = seen.anchor[seen.point]
    ray = np.einsum("nab,nb->na", poses.R[anchor], seen.ray[seen.point])
    a = np.einsum("nab,na->nb", poses.R[seen.camera], ray)
    b = np.einsum("nab,na->nb", poses.R[seen.camera], poses.center[anchor] - poses.center[seen.camera])
    constant, slope = ((v[:, :2] - seen.seen * v[:, 2:]) / seen.sigma for v in (a, b))
    top = 1 - np.bincount(seen.point, (constant * slope).sum(1), minlength=len(seen.ray))
    return top / (1 + np.bincount(seen.point, (slope**2).sum(1), minlength=len(seen.ray)))


def _all_frames(
    tracks: BackgroundTracks,
    seen: np.ndarray,
    row_of: np.ndarray,
    keyframe_result: tuple[Poses, np.ndarray, Observations],
    frames: int,
    focal_px: float,
) -> tuple[Float[np.ndarray, "frames 4 4"], Bool[np.ndarray, "frames"], float]:
    """Every frame located by the points of the keyframes, each from the pose of the frame before; which frames have
    enough of them, and the median error in pixels."""
    poses, rho, observed = keyframe_result
    sigma, seen = observed.sigma / np.exp(poses.log_focal), poses.rays(seen)
    points = known_points(poses, rho, observed)
    R, center = np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3))
    found, off = np.zeros(frames, bool), [np.zeros(1)]
    found[0] = True
    begin = np.searchsorted(tracks.frame, np.arange(frames + 1))
    for frame in range(1, frames):
        R[frame], center[frame] = R[frame - 1], center[frame - 1]
        own = np.arange(begin[frame], begin[frame + 1])
        own = own[row_of[tracks.point[own]] >= 0]
        if len(own) < MIN_POINTS:
            continue
        some = row_of[tracks.point[own]]
        R[frame], center[frame], error = locate(
            points[some], rho[some], seen[own], sigma, (R[frame - 1], center[frame - 1])
        )
        found[frame] = True
        off.append(error * observed.sigma * focal_px)
    at = np.flatnonzero(found)
    clamped = np.clip(np.arange(frames), at[0], at[-1])
    R = Slerp(at, Rotation.from_matrix(R[at]))(clamped).as_matrix() if len(at) > 1 else R
    center = np.stack([np.interp(clamped, at, center[at, axis]) for axis in range(3)], 1)
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, center
    return T, found, float(np.median(np.concatenate(off)))
