"""Stage 4: bodies in meters, fitted to the landmarks of all frames together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from video2anim.pipeline.options import Heights, limits, model_of, only_without
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BodyMotion,
    BodyTracks,
    CameraEstimate,
    PersonQuality,
    PersonTrack,
    PersonTracks,
    VideoClip,
)

if TYPE_CHECKING:
    from video2anim.humans.lifter_input import LiftedBody
    from video2anim.humans.problem import FittedBody, Observations

_FRAMES_AT_ONCE = 256
"""Of meshes in memory."""


@dataclass(frozen=True)
class HumansConfig:
    """Settings of the stage."""

    method: Literal["both", "lifter", "optimizer"] = "both"
    """`lifter`: the network's answer as it is; `optimizer`: a fit to the landmarks alone; `both`: a fit that starts
    from the network's answer and stays near it."""
    model: Annotated[str, model_of("lifter"), only_without("method", "optimizer")] = "lifter"
    """Model that lifts landmarks to bodies; `lifter@FILE` for weights of your own."""
    height_m: Heights | None = None
    """Known standing height in meters: of the main person, or by person's ID. Others are taken for adults of the mean
    height, under the evidence of the picture and of the floor that they share."""
    iterations: Annotated[Annotated[int, limits(ge=1, le=100_000)] | None, only_without("method", "lifter")] = None
    """Steps of the fit (default: 400 from the landmarks, 160 from the lifter's answer)."""
    cutoff_hz: Annotated[float, limits("Hz", ge=0, le=1000), only_without("method", "lifter")] = 6.0
    """Faster changes are taken out of the fitted motion (6 Hz is usual for gait; raise it for throws and strikes, 0
    leaves all)."""


def recover_humans(
    clip: VideoClip, tracks: PersonTracks, camera: CameraEstimate, config: HumansConfig, ctx: StageContext
) -> BodyTracks:
    """Fit the selected persons and put them into a world with +Y up and the floor under the main person's feet."""
    from video2anim.humans.body_height import KNOWN_SIGMA_M, expect_heights, height_of
    from video2anim.humans.objective import FitConfig
    from video2anim.humans.observe import observations
    from video2anim.humans.quality import person_quality

    expect_heights(config.height_m, tracks.selected_ids)
    selected = tuple(track.whole(clip.frame_count) for track in tracks.selected())
    observed = [observations(track, clip.frame_time_s, camera.intrinsics) for track in selected]
    lifted = _lifted(observed, config, ctx)
    heights_m = [height_of(config.height_m, track.person_id, tracks.selected_ids[0]) for track in selected]
    fits = [
        _fit(seen, raised, height_m, config, ctx)
        for seen, raised, height_m in zip(observed, lifted, heights_m, strict=True)
    ]
    T_world_camera, spread_m = _world(fits[0], selected[0].valid, _R_world_camera(camera), clip.fps)
    people = tuple(
        _motion(clip, track, fit, camera, T_world_camera, raised)
        for track, fit, raised in zip(selected, fits, lifted, strict=True)
    )
    quality = tuple(
        replace(
            person_quality(track, seen, fit, motion, clip.fps, **_smoothness(motion, clip.fps)),
            body_height_sigma_m=FitConfig().body_height_sigma_m if height_m is None else KNOWN_SIGMA_M,
        )
        for track, seen, fit, motion, height_m in zip(selected, observed, fits, people, heights_m, strict=True)
    )
    _record(people[0], quality[0], spread_m, ctx)
    for motion, judged in zip(people, quality, strict=True):
        for doubt in judged.doubts:
            ctx.warn(f"person {motion.person_id} should not be trusted: {doubt}")
    return BodyTracks(people, quality)


def _lifted(observed: list[Observations], config: HumansConfig, ctx: StageContext) -> list[LiftedBody] | list[None]:
    """The network's answer for each person; nothing where it is not asked for."""
    from video2anim.humans.lifting import lift

    if config.method == "optimizer":
        return [None] * len(observed)
    network = ctx.model(config.model)
    return [lift(one, network) for one in observed]


def _slots(config: HumansConfig) -> tuple[str, ...]:
    """Slots of the models that are used."""
    return () if config.method == "optimizer" else ("lifter",)


def _fit(
    observed: Observations,
    lifted: LiftedBody | None,
    height_m: float | None,
    config: HumansConfig,
    ctx: StageContext,
) -> FittedBody:
    from video2anim.humans.body_height import KNOWN_SIGMA_M
    from video2anim.humans.long_clip import fit_long
    from video2anim.humans.objective import FitConfig
    from video2anim.humans.optimize import place_lifted

    fit_config = FitConfig()
    if height_m is not None:
        fit_config = replace(fit_config, body_height_m=height_m, body_height_sigma_m=KNOWN_SIGMA_M)
    if lifted is not None and config.method == "lifter":
        if height_m is not None:
            ctx.warn("humans.method=lifter knows no height: --height-m is not used, the body is an adult of 1.70 m")
        return place_lifted(observed, lifted, fit_config)
    fit = fit_long(observed, lifted, fit_config, iterations=config.iterations, on_step=ctx.progress)
    return _smoothed(observed, fit, config)


def _smoothed(observed: Observations, fit: FittedBody, config: HumansConfig) -> FittedBody:
    """Without the jitter of the landmarks, where the frame rate shows it."""
    from video2anim.humans.optimize import reposed
    from video2anim.humans.smoothing import low_pass

    frames = len(observed.valid)
    fps = 1.0 / float(np.median(np.diff(observed.frame_time_s))) if frames > 1 else 0.0
    if not 0 < config.cutoff_hz < 0.5 * fps:
        return fit
    R, translation_m = low_pass(
        fit.R_parent_joint, fit.translation_camera_m, np.ones(frames, bool), fps=fps, cutoff_hz=config.cutoff_hz
    )
    return reposed(observed, fit, R, translation_m)


def _R_world_camera(camera: CameraEstimate) -> np.ndarray:
    """(T, 3, 3)"""
    from video2anim.humans.ground import level_frame

    return level_frame(camera.up_camera) @ camera.R_first_camera


def _world(fit: FittedBody, valid: np.ndarray, R_world_camera: np.ndarray, fps: float) -> tuple[np.ndarray, float]:
    """T_world_camera (T, 4, 4) with the floor at y = 0 and the first valid root over the origin; floor spread."""
    from video2anim.humans.ground import floor_height

    joints = np.einsum("tab,tjb->tja", R_world_camera, fit.joints_camera_m)
    floor_m, spread_m = floor_height(_sole_heights(fit, R_world_camera)[valid], fps)
    first = int(np.flatnonzero(valid)[0])
    T_world_camera = np.tile(np.eye(4), (len(valid), 1, 1))
    T_world_camera[:, :3, :3] = R_world_camera
    T_world_camera[:, :3, 3] = [-joints[first, 0, 0], -floor_m, -joints[first, 0, 2]]
    return T_world_camera, spread_m


def _sole_heights(fit: FittedBody, R_world_camera: np.ndarray) -> np.ndarray:
    """(T, 2) height of the lowest point of the left and the right foot above the camera."""
    from video2anim.body.anny_body import shaped_body
    from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

    body = shaped_body(fit.shape)
    R_parent_joint = fit.R_parent_joint.copy()
    R_parent_joint[:, 0] = R_world_camera @ R_parent_joint[:, 0]
    translation = np.einsum("tab,tb->ta", R_world_camera, fit.translation_camera_m)
    joints, R_world_joint = forward_kinematics(R_parent_joint, translation, body.rest_joints_m)
    heights = np.empty((len(joints), 2))
    for foot, side in enumerate(("left", "right")):
        own = [JOINT_INDEX[f"{side}_ankle"], JOINT_INDEX[f"{side}_foot"]]
        index = np.flatnonzero(np.isin(body.vertex_part, own))
        for begin in range(0, len(joints), _FRAMES_AT_ONCE):
            some = slice(begin, begin + _FRAMES_AT_ONCE)
            heights[some, foot] = body.vertices(R_world_joint[some], joints[some], index)[..., 1].min(1)
    return heights


def _motion(
    clip: VideoClip,
    track: PersonTrack,
    fit: FittedBody,
    camera: CameraEstimate,
    T_world_camera: np.ndarray,
    lifted: LiftedBody | None,
) -> BodyMotion:
    from video2anim.humans.ground import foot_contact
    from video2anim.humans.lifter_input import CONTACT_INDEX

    R_world_camera, t_world_camera = T_world_camera[:, :3, :3], T_world_camera[:, :3, 3]
    R_parent_joint = fit.R_parent_joint.copy()
    R_parent_joint[:, 0] = R_world_camera @ R_parent_joint[:, 0]
    translation = np.einsum("tab,tb->ta", R_world_camera, fit.translation_camera_m) + t_world_camera
    blank = BodyMotion(
        person_id=track.person_id,
        frame_time_s=clip.frame_time_s,
        valid=track.valid,
        T_world_root=T_world_camera,
        R_parent_joint=R_parent_joint,
        T_world_camera=T_world_camera,
        intrinsics=camera.intrinsics,
        contact=np.zeros((clip.frame_count, 22)),
        shape=fit.shape,
        rest_joints_m=fit.rest_joints_m,
        joints_world_m=np.zeros((clip.frame_count, 22, 3)),
    )
    posed = blank.with_pose(translation_world_m=translation, R_parent_joint=R_parent_joint)
    if lifted is None:
        return replace(posed, contact=foot_contact(posed.joints_world_m, track.valid, clip.fps, t_world_camera))
    contact = np.zeros((clip.frame_count, 22))
    contact[:, CONTACT_INDEX] = lifted.contact * track.valid[:, None]
    return replace(posed, contact=contact)


def _smoothness(motion: BodyMotion, fps: float) -> dict[str, float]:
    from scenemi.metrics import foot_skating_gmd, jerk_m_s3

    joints_m = motion.measured_joints_m
    if len(joints_m) < 4:
        return {"jerk_m_s3": float("nan"), "skating_gmd": float("nan")}
    return {"jerk_m_s3": jerk_m_s3(joints_m, fps), "skating_gmd": foot_skating_gmd(joints_m, fps)}


def _record(motion: BodyMotion, quality: PersonQuality, spread_m: float, ctx: StageContext) -> None:
    from video2anim.types.skeleton import FEET

    ctx.quality("reprojection", quality.reprojection_px, "px", "lower")
    ctx.quality("reprojection_over_height", 100 * quality.reprojection_ratio, "%", "lower")
    ctx.quality("valid_frames", 100 * quality.valid_share, "%", "higher")
    ctx.quality("jerk", quality.jerk_m_s3, "m/s^3", "lower")
    ctx.quality("foot_skating_gmd", quality.skating_gmd, "ratio", "lower")
    ctx.quality("bone_length_spread", 100 * quality.bone_spread, "%", "lower")
    ctx.quality("foot_contact", 100 * float((motion.contact[:, list(FEET)].max(1) > 0.5).mean()), "%")
    ctx.quality("floor_spread", spread_m, "m", "lower")
    ctx.quality("skeleton_height", quality.body_height_m, "m")


STAGE = StageSpec("humans", recover_humans, version=13, models=_slots)
