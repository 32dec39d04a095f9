"""Up direction of the first frame's camera from images, the ground that it passes, and people's poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from video2anim.camera.ground_plane import ground_up
from video2anim.geometry.perspective_field import FieldCamera
from video2anim.humans.lifter_input import LiftedBody
from video2anim.humans.lifting import Network, lift
from video2anim.humans.observe import at_frame_times, observations
from video2anim.types import Intrinsics, PersonTrack, PersonTracks, VideoClip
from video2anim.types.camera import SLOPE_SIGMA_RAD
from video2anim.types.clip import FPS

_LIFTER_SIGMA_RAD = 0.1
"""Error of the lifter's up direction."""


@dataclass(frozen=True, slots=True, eq=False)
class UpEvidence:
    """Estimate of gravity from one source alone."""

    source: str
    """`people` (their poses), `image` (perspective fields and line segments) or `ground` (the plane that a traveling
    camera passes)."""
    up_camera: Float[np.ndarray, "3"]
    """Unit vector against gravity in camera axes, first frame."""
    sigma_rad: float


def lifted_people(
    tracks: PersonTracks,
    clip: VideoClip,
    intrinsics: Intrinsics,
    up_camera: Float[np.ndarray, "frames 3"],
    network: Network,
) -> list[tuple[LiftedBody, PersonTrack]]:
    """The lifter's bodies of every person, selected or not.

    Args:
        tracks: All people.
        clip: The clip.
        intrinsics: Lens.
        up_camera: Unit vector against gravity in the axes of each frame's camera, by the image.
        network: The lifter.

    Raises:
        ArtifactError: a track has rows beyond the clip.
    """
    rows = [track.frames_in(clip.frame_count) for track in tracks.people]
    observed = [
        observations(at_frame_times(track, clip), clip.frame_time_s[some], intrinsics, up_camera[some])
        for track, some in zip(tracks.people, rows, strict=True)
    ]
    return [(lift(seen, network), track) for seen, track in zip(observed, tracks.people, strict=True)]


def up_by_lifter(
    people: Sequence[tuple[LiftedBody, PersonTrack]], R_first_camera: Float[np.ndarray, "frames 3 3"]
) -> Float[np.ndarray, "3"]:
    """Up direction by the lifter: mean over people, weighted by the expected error of their poses.

    People who are seen for less than a second weigh less.
    """
    total = np.zeros(3)
    for lifted, track in people:
        turn = R_first_camera[track.first_frame + np.flatnonzero(track.valid)]
        up = np.median(np.einsum("nab,nb->na", turn, lifted.up_camera[track.valid]), axis=0)
        share = min(int(track.valid.sum()), FPS) / FPS
        # Unusual poses mislead the lifter about gravity by more than the error of their joints.
        total += share * float(np.median(lifted.error_m[track.valid])) ** -4 * up / np.linalg.norm(up)
    return total / np.linalg.norm(total)


def up_by_images(cameras: Sequence[FieldCamera], R_first_camera: Float[np.ndarray, "cameras 3 3"]) -> UpEvidence:
    """Up direction by the images of some frames, in the first camera's axes: that of the frame which agrees best with
    the others. Its standard deviation is at least the median angle to them: what misleads an image, lines of objects
    that stand at an angle above all, changes along the way of a camera.
    """
    up = np.einsum("nab,nb->na", R_first_camera, np.stack([camera.up_camera for camera in cameras]))
    apart_rad = np.arccos(np.clip(up @ up.T, -1, 1))
    best = int(apart_rad.sum(1).argmin())
    others = np.delete(apart_rad[best], best)
    sigma_rad = max(cameras[best].up_sigma_rad, float(np.median(others)) if len(others) else 0.0)
    return UpEvidence("image", up[best], sigma_rad)


def combined_up(evidence: Sequence[UpEvidence]) -> tuple[Float[np.ndarray, "3"], float]:
    """Mean of the up directions of all sources, weighted by their variances, and its standard deviation in radians."""
    up, sigma_rad = evidence[0].up_camera, evidence[0].sigma_rad
    for source in evidence[1:]:
        weights = np.array([sigma_rad**-2, source.sigma_rad**-2])
        together = weights @ np.stack([up, source.up_camera]) / weights.sum()
        # Where the two disagree, neither is as certain as its standard deviation.
        apart_rad = angle_rad(up, source.up_camera)
        sigma_rad = max(float(weights.sum() ** -0.5), 0.5 * apart_rad * float(min(weights) / max(weights)) ** 0.5)
        up = together / np.linalg.norm(together)
    return up, sigma_rad


def angle_rad(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> float:
    """Angle between unit vectors."""
    return math.acos(float(np.clip(a @ b, -1, 1)))


def up_evidence(
    by_lifter: Float[np.ndarray, "3"],
    by_image: UpEvidence,
    focal_px: float,
    points: Float[np.ndarray, "points 3"],
) -> tuple[UpEvidence, ...]:
    """Every source of the up direction on its own.

    Args:
        by_lifter: Of people's poses.
        by_image: Of the images.
        focal_px: An image is no more certain than a pixel at this distance.
        points: Background points of known depth that a traveling camera has passed, in the first camera's axes.
    """
    ground = ground_up(points, by_image.up_camera)
    sources = [
        UpEvidence("people", by_lifter, _LIFTER_SIGMA_RAD),
        replace(by_image, sigma_rad=max(by_image.sigma_rad, 1 / focal_px)),
    ]
    return (*sources, *([] if ground is None else [UpEvidence("ground", ground, SLOPE_SIGMA_RAD)]))
