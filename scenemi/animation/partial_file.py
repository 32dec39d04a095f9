"""What a JSON keyframe file asks of a motion beside whole poses (docs/scenemi.md): places of joints, a path of the
root, pinned feet, postures at objects."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, NonNegativeInt, model_validator
from scipy.interpolate import Akima1DInterpolator

from scenemi.data.plain_files import MAX_FRAMES
from scenemi.postprocess.partial import LEVEL, MISS_M, PartialKeyframes, PinnedFoot
from video2anim.errors import InputError
from video2anim.types.clip import FPS
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES

Point2 = tuple[FiniteFloat, FiniteFloat]
Point3 = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Frame = Annotated[int, Field(ge=0, lt=MAX_FRAMES)]
SPEED_UP_S = 0.5
"""Time in which a person who stands begins to walk, and stops: one step."""
_STRICT = ConfigDict(extra="forbid", frozen=True)


class Moment(BaseModel):
    """A frame, or a time in seconds."""

    model_config = _STRICT
    frame: Frame | None = None
    time_s: Annotated[float, Field(ge=0, lt=MAX_FRAMES / FPS)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Moment:
        if (self.frame is None) == (self.time_s is None):
            raise ValueError("wants either frame or time_s")
        return self

    @property
    def at(self) -> int:
        """The frame."""
        return round(self.time_s * FPS) if self.time_s is not None else int(self.frame or 0)


class JointTarget(Moment):
    """A joint at a place."""

    joint: Literal[JOINT_NAMES]  # pyright: ignore[reportInvalidTypeForm]  (a tuple of names is what Literal wants)
    position_m: Point3


class RootPath(BaseModel):
    """Where the pelvis goes over the ground: places with frames, or places and a speed."""

    model_config = _STRICT
    points_xz_m: Annotated[tuple[Point2, ...], Field(min_length=2, max_length=MAX_FRAMES)]
    frames: tuple[Frame, ...] | None = None
    start_frame: NonNegativeInt = 0
    speed_m_s: Annotated[float, Field(gt=0, le=10)] | None = None

    @model_validator(mode="after")
    def _timed(self) -> RootPath:
        if (self.frames is None) == (self.speed_m_s is None):
            raise ValueError("wants either frames or speed_m_s")
        if self.frames is not None and (len(self.frames) != len(self.points_xz_m) or min(np.diff(self.frames)) < 1):
            raise ValueError("wants a frame for every point, rising")
        if self.speed_m_s is not None and not np.linalg.norm(np.diff(self.points_xz_m, axis=0), axis=1).all():
            raise ValueError("wants points that differ from the one before")
        return self

    def over_time(self, rests: tuple[bool, bool]) -> tuple[int, Float[np.ndarray, "frames 2"]]:
        """First frame, and x and z in every frame from there: a curve through the points (modified Akima) without
        overshoot.

        Args:
            rests: whether the person stands at the beginning and at the end, which matters for a path with a speed.
        """
        points_m = np.array(self.points_xz_m, float)
        if self.frames is not None:
            curve = Akima1DInterpolator(self.frames, points_m, method="makima")
            return self.frames[0], curve(np.arange(self.frames[0], self.frames[-1] + 1))
        chord_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1))])
        dense = np.linspace(0.0, chord_m[-1], 50 * len(points_m))
        curve_m = Akima1DInterpolator(chord_m, points_m, method="makima")(dense)
        way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve_m, axis=0), axis=1))])
        gone_m = self._gone(float(way_m[-1]), rests)
        return self.start_frame, np.stack([np.interp(gone_m, way_m, curve_m[:, k]) for k in range(2)], -1)

    def _gone(self, length_m: float, rests: tuple[bool, bool]) -> Float[np.ndarray, "frames"]:
        """Way gone in every frame: constant speed, reached from and left to rest in `SPEED_UP_S` where the person
        stands."""
        assert self.speed_m_s is not None
        slow_s = SPEED_UP_S * np.array(rests)
        whole_s = length_m / self.speed_m_s + slow_s.sum() / 2
        if whole_s < slow_s.sum():
            raise ValueError(f"is too short ({length_m:.2f} m) to be walked at {self.speed_m_s:g} m/s from and to rest")
        frames = max(2, round(whole_s * FPS) + 1)
        knots_s = np.array([0.0, slow_s[0], whole_s - slow_s[1], whole_s])
        speed = np.interp(np.linspace(0, whole_s, frames), knots_s, [not rests[0], 1, 1, not rests[1]])
        gone = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2)])
        return gone * length_m / gone[-1]


class Pinned(BaseModel):
    """A foot that does not move from a frame to another."""

    model_config = _STRICT
    foot: Literal["left", "right"]
    frames: tuple[Frame, Frame]

    @model_validator(mode="after")
    def _rising(self) -> Pinned:
        if self.frames[1] <= self.frames[0]:
            raise ValueError("wants a later last frame")
        return self


class PostureWish(Moment):
    """A posture of the library at an object, or standing somewhere."""

    sit_on: str | None = None
    stand_at: str | Point2 | None = None
    hand_on: str | None = None
    hand: Literal["left", "right"] = "right"
    heading_deg: FiniteFloat | None = None
    """Where the body faces: 0 is +Z, 90 is +X. Default: by the object's front."""

    @model_validator(mode="after")
    def _one_place(self) -> PostureWish:
        if sum(place is not None for place in (self.sit_on, self.stand_at, self.hand_on)) != 1:
            raise ValueError("wants one of sit_on, stand_at and hand_on")
        return self


class PartialValues(BaseModel):
    """The keys of partial keyframes; others are left alone."""

    model_config = ConfigDict(frozen=True)
    poses_from: str | None = None
    """Another keyframe file beside this one that holds the whole poses."""
    joint_targets: tuple[JointTarget, ...] = ()
    root_path: RootPath | None = None
    pinned: tuple[Pinned, ...] = ()
    postures: tuple[PostureWish, ...] = ()

    def asked(self) -> bool:
        """Whether there is any of it."""
        return bool(self.joint_targets or self.root_path or self.pinned or self.postures or self.poses_from)


def partial_keyframes(
    where: str,
    values: PartialValues,
    path: tuple[int, Float[np.ndarray, "way 2"]] | None,
    frame_count: int,
) -> PartialKeyframes | None:
    """Places, path and pinned feet over all frames of a motion; None where none is asked for.

    Args:
        where: of what the errors speak.
        values: of the file.
        path: `RootPath.over_time`.
        frame_count: of the motion, up to its last whole pose.

    Raises:
        InputError: a frame outside of the motion.
    """
    if path is None and not values.joint_targets and not values.pinned:
        return None
    position_m, path_m = np.full((frame_count, len(JOINT_NAMES), 3), np.nan), np.full((frame_count, 2), np.nan)
    last = max([0, *(one.at for one in values.joint_targets), *(one.frames[1] for one in values.pinned)])
    last = last if path is None else max(last, path[0] + len(path[1]) - 1)
    if last >= frame_count:
        raise InputError(f"{where}: frame {last} is after the last whole pose, at frame {frame_count - 1}; add a pose")
    for target in values.joint_targets:
        position_m[target.at, JOINT_INDEX[target.joint]] = target.position_m
    if path is not None:
        path_m[path[0] : path[0] + len(path[1])] = path[1]
    pins = tuple(PinnedFoot(int(one.foot == "right"), *one.frames) for one in values.pinned)
    return PartialKeyframes(position_m, path_m, pins)


def expect_no_contradiction(where: str, partial: PartialKeyframes, roots_m: Any, frames: Any, exact: bool) -> None:
    """Refuse a path that misses exact whole poses.

    Args:
        where: of what the error speaks.
        partial: of the motion.
        roots_m: (K, 3) pelvis of whole poses.
        frames: (K,) of those.
        exact: whether they are met.

    Raises:
        InputError: the path is more than `MISS_M["path"]` from such a pose.
    """
    off_m = np.linalg.norm(partial.path_m[frames] - np.asarray(roots_m)[:, LEVEL], axis=1)
    worst = int(np.nan_to_num(off_m, nan=-1.0).argmax())
    if exact and off_m[worst] > MISS_M["path"]:
        raise InputError(
            f"{where}: root_path passes the pose at frame {frames[worst]} at a distance of {off_m[worst]:.2f} m; "
            "move one of both"
        )
