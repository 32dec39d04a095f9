"""Motion of bodies: the content of `motion.npz` in every stage that makes one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import FiniteFloat, NonNegativeFloat, NonNegativeInt

from video2anim.errors import StageError
from video2anim.types.camera import Intrinsics, View
from video2anim.types.checks import Checked, expect_equal_lengths, expect_sound
from video2anim.types.scene import SceneModel
from video2anim.types.storage import Holds, OnePer


@dataclass(frozen=True, slots=True)
class BodyShape(Checked):
    """Shape parameters of a body model."""

    model: str
    """`anny`, or `smpl`, `smplh`, `smplx` (neutral; with `-male` or `-female` the others)."""
    parameters: dict[str, FiniteFloat]
    """Named scalars; for Anny the phenotypes gender, age, muscle, weight, height, proportions in [0, 1]; for the SMPL
    family `beta_0`, `beta_1`, ..."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyMotion(Checked):
    """Skeletal motion of one person at 30 fps in the world frame (+Y up, floor at y = 0, meters).

    Rows with `valid` False are finite (held or interpolated) but are not measurements.
    """

    person_id: NonNegativeInt
    frame_time_s: Annotated[Float[np.ndarray, "frames"], Holds.RISING]
    valid: Bool[np.ndarray, "frames"]
    T_world_root: Annotated[Float[np.ndarray, "frames 4 4"], Holds.RIGID]
    """Root transform; its translation is the pelvis, since `rest_joints_m[0]` is the origin."""
    R_parent_joint: Annotated[Float[np.ndarray, "frames 22 3 3"], Holds.ROTATION]
    """Local joint rotations in SMPL order and rest convention; joint 0 is the root orientation in the world."""
    T_world_camera: Annotated[Float[np.ndarray, "frames 4 4"], Holds.RIGID]
    intrinsics: Intrinsics
    contact: Annotated[Float[np.ndarray, "frames 22"], Holds.SHARES]
    """Probability that the joint touches the scene."""
    shape: BodyShape
    rest_joints_m: Annotated[Float[np.ndarray, "22 3"], Holds.FROM_ORIGIN]
    """Joints of the T-pose, pelvis at the origin, +Y up, facing +Z."""
    joints_world_m: Float[np.ndarray, "frames 22 3"]

    @property
    def frame_count(self) -> int:
        return len(self.frame_time_s)

    @property
    def joints_camera_m(self) -> Float[np.ndarray, "frames 22 3"]:
        """Joints in the camera frame of each frame (OpenCV axes)."""
        R_world_camera, t = self.T_world_camera[:, :3, :3], self.T_world_camera[:, :3, 3]
        return np.einsum("tji,tkj->tki", R_world_camera, self.joints_world_m - t[:, None])

    @property
    def measured_joints_m(self) -> Float[np.ndarray, "span 22 3"]:
        """World joints from the first to the last valid frame, for differences over time."""
        rows = np.flatnonzero(self.valid)
        return self.joints_world_m[rows[0] : rows[-1] + 1] if len(rows) else self.joints_world_m[:0]

    def view(self, frame: int = 0) -> View:
        """The clip's camera in a frame; frame 0 is the view of the background image."""
        return View(self.T_world_camera[frame], self.intrinsics)

    def in_world(self, T_world_camera: Float[np.ndarray, "frames 4 4"]) -> BodyMotion:
        """The same motion relative to the cameras, in a world in which the cameras have the given poses."""
        T_camera_own = np.linalg.inv(self.T_world_camera)
        T_world_root = T_world_camera @ T_camera_own @ self.T_world_root
        R = self.R_parent_joint.copy()
        R[:, 0] = T_world_root[:, :3, :3]
        moved = self.with_pose(translation_world_m=T_world_root[:, :3, 3], R_parent_joint=R)
        return replace(moved, T_world_camera=T_world_camera)

    def with_pose(self, *, translation_world_m: np.ndarray, R_parent_joint: np.ndarray) -> BodyMotion:
        """The same person with another pose sequence; joints by forward kinematics."""
        from video2anim.types.skeleton import forward_kinematics

        joints_world_m, _ = forward_kinematics(R_parent_joint, translation_world_m, self.rest_joints_m)
        T_world_root = np.tile(np.eye(4), (len(translation_world_m), 1, 1))
        T_world_root[:, :3, :3] = R_parent_joint[:, 0]
        T_world_root[:, :3, 3] = translation_world_m
        return replace(self, T_world_root=T_world_root, R_parent_joint=R_parent_joint, joints_world_m=joints_world_m)


ADULT_HEIGHT_SIGMA_M = 0.09
"""Standard deviation of adults' standing height, both sexes together: 7 cm in each, with means 12 cm apart (NCD-RisC
2016)."""


@dataclass(frozen=True, slots=True)
class PersonQuality(Checked):
    """Quality of one fitted person, computed without ground truth."""

    reprojection_px: float
    """Median 2D error of the visible landmarks."""
    reprojection_ratio: float
    """The same error divided by the person's size in the picture."""
    jerk_m_s3: float
    skating_gmd: float
    """Share of frames with foot skating (definition: docs/evaluation.md); NaN for fewer than 4 frames."""
    bone_spread: float
    """Relative standard deviation over time of limb lengths in the 3D landmarks; NaN if they are hardly visible."""
    valid_share: float
    """Share of the clip's frames with a measurement."""
    body_height_m: float
    """From the highest to the lowest joint of the T-pose."""
    fast_share: float
    """Share of the frames in which the root moves faster than humanly possible."""
    doubts: tuple[str, ...] = ()
    """Reasons not to trust the person's motion; empty if there are none."""
    body_height_sigma_m: float = ADULT_HEIGHT_SIGMA_M
    """Standard deviation of the prior on standing height: of adults, or of the height given by the user."""

    @property
    def trusted(self) -> bool:
        return not self.doubts


_NOBODY = "want a fitted body with at least one valid frame, got none; check stage humans"


def main_person(people: Sequence[BodyMotion]) -> BodyMotion:
    """The main person, who comes first.

    Raises:
        StageError: there is no person.
    """
    if not people:
        raise StageError(_NOBODY)
    return people[0]


@dataclass(frozen=True, slots=True, eq=False)
class _People(Checked):
    people: tuple[BodyMotion, ...]
    """Main person first; all have the same frames and the same camera."""

    def __post_init__(self) -> None:
        expect_sound(self)
        expect_equal_lengths(self, "people", [one.frame_count for one in self.people])

    @property
    def main(self) -> BodyMotion:
        """The main person.

        Raises:
            StageError: there is no person.
        """
        return main_person(self.people)

    @property
    def main_view(self) -> View:
        """The view of the background image: the clip's camera in the first frame.

        Raises:
            StageError: there is no person.
        """
        return self.main.view()


@dataclass(frozen=True, slots=True, eq=False)
class BodyTracks(_People):
    """Bodies fitted to the video, before any motion prior ("raw" in reports)."""

    quality: Annotated[tuple[PersonQuality, ...], OnePer("people")] = ()
    """Quality of each person."""
    path_log_sigma: NonNegativeFloat = 0.0
    """Standard deviation of the logarithm of the length of a traveling camera's path."""

    @property
    def main(self) -> BodyMotion:
        """The main person.

        Raises:
            StageError: there is no person, or the main person is valid in no frame.
        """
        main = main_person(self.people)
        if not main.valid.any():
            raise StageError(_NOBODY)
        return main


@dataclass(frozen=True, slots=True, eq=False)
class KeyframedMotion(_People):
    """Motion after keyframe optimization (paper 8.2): roots of the keyframes moved, others interpolated."""

    keyframe_index: Annotated[tuple[Annotated[Int[np.ndarray, "keyframes"], Holds.FRAMES], ...], OnePer("people")]
    """Optimized frames, one array per person."""


@dataclass(frozen=True, slots=True, eq=False)
class RefinedMotion(_People):
    """Final motion (stage refine)."""

    prior: Annotated[tuple[str, ...], OnePer("people")]
    """In-betweening prior of each person's motion: `scenemi`, or `none` for the observed motion."""
    prior_share: Annotated[tuple[float, ...], OnePer("people")]
    """Share of each person's measured frames in which a joint differs by more than 3 degrees from the same solve
    without the prior."""
    without_prior: tuple[BodyMotion, ...]
    """The same solve without the prior, from the observed motion."""
    scene: SceneModel
    """The scene that the motion fits: objects moved along their lines of sight."""
