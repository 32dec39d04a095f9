"""Stage camera: focal length, up direction and path by user, metadata, perspective of the image, people, background.

A network's perspective fields and the line segments of a few frames (`video2anim.camera.image_camera`) give focal
length (`focal`) and up direction, of which people's poses are further evidence (`up`). Points of the background give
the path of a moving camera (`path`), and correct its focal length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from video2anim.errors import UsageError
from video2anim.pipeline.options import limits, model_of
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import CameraEstimate, Intrinsics, PersonTracks, VideoClip

if TYPE_CHECKING:
    from collections.abc import Sequence

    from video2anim.camera.background_tracks import BackgroundMotion
    from video2anim.camera.image_camera import ImageCamera
    from video2anim.camera.path import CameraPath
    from video2anim.camera.up import UpEvidence

_CONFLICT_RAD = math.radians(12)
"""Angle between a source of gravity and the estimate from which a warning names it: twice the error of people's poses,
the least certain source."""


@dataclass(frozen=True)
class CameraConfig:
    """Settings of the stage."""

    focal_px: Annotated[float, limits("px", gt=0, le=1_000_000)] | None = None
    """Known focal length in pixels of the upright video; it is not estimated then."""
    model: Annotated[str, model_of("lifter")] = "lifter"
    """Model that lifts landmarks to bodies, whose poses tell gravity."""
    camera_model: Annotated[str, model_of("camera")] = "room-camera"
    """Model of slot `camera` that gives perspective fields."""
    field_frames: Annotated[int, limits(ge=1, le=1000)] = 3
    """Frames whose fields are fitted, together if the camera is static."""
    line_segments: bool = True
    """Correct the camera of the fields by the line segments of the images."""


def estimate_camera(clip: VideoClip, tracks: PersonTracks, config: CameraConfig, ctx: StageContext) -> CameraEstimate:
    """Intrinsics and up direction of the first frame's camera, with their uncertainty, and the camera's path.

    Raises:
        UsageError: a focal length that no camera has.
        ArtifactError: a track has rows beyond the clip.
    """
    from video2anim.camera.background_tracks import background_motion
    from video2anim.camera.focal import estimate_focal
    from video2anim.camera.image_camera import image_cameras
    from video2anim.camera.path import camera_path
    from video2anim.camera.up import combined_up, lifted_people, up_by_images, up_by_lifter, up_evidence

    _expect_sane(config, clip)
    motion = background_motion(clip, tracks)
    images = image_cameras(
        clip, ctx.model(config.camera_model), config.field_frames,
        one_view=motion.is_static, line_segments=config.line_segments,
    )  # fmt: skip
    image = sorted(images, key=lambda one: one.camera.focal_ratio)[len(images) // 2]
    _report_image(image, clip, ctx)
    focal = estimate_focal(clip, image.camera, config.focal_px)
    lens = Intrinsics.centered(focal.focal_px, clip.width_px, clip.height_px)
    path = camera_path(motion, clip.frame_count, lens, focal.free_log_sigma)
    if path.log_focal:
        focal = focal.after_path(path.log_focal, path.focal_log_sigma)
        lens = Intrinsics.centered(focal.focal_px, clip.width_px, clip.height_px)
    known = path.log_focal or focal.source != "picture"
    R_first_camera = path.T_first_camera[:, :3, :3]
    by_image = up_by_images(
        [one.with_focal(focal.focal_px / clip.height_px) if known else one.camera for one in images],
        R_first_camera[[one.frame for one in images]],
    )
    people = lifted_people(tracks, clip, lens, by_image.up_camera @ R_first_camera, ctx.model(config.model))
    by_lifter = up_by_lifter(people, R_first_camera)
    evidence = up_evidence(by_lifter, by_image, focal.focal_px, path.points.place)
    up, up_sigma_rad = combined_up(evidence)
    estimate = CameraEstimate(
        intrinsics=lens,
        focal_source=focal.source,
        focal_sigma_ratio=focal.sigma_ratio,
        up_camera=up,
        up_sigma_rad=up_sigma_rad,
        is_static=motion.is_static,
        T_first_camera=path.T_first_camera,
        points=path.points,
    )
    if focal.contradicted_px is not None:
        ctx.warn(
            f"the metadata's focal length of {focal.contradicted_px:.0f} px ({clip.source.focal_35mm:.0f} mm on full "
            f"frame) contradicts the image's perspective (about {focal.focal_px:.0f} px) and is not used; set it by "
            "--focal-px if it is right"
        )
    _report(estimate, motion, path, ctx)
    _report_up(estimate, evidence, ctx)
    return estimate


def _report_up(estimate: CameraEstimate, evidence: Sequence[UpEvidence], ctx: StageContext) -> None:
    """Each source of gravity against the estimate."""
    from video2anim.camera.up import angle_rad

    for one in evidence:
        off_rad = angle_rad(one.up_camera, estimate.up_camera)
        ctx.quality(f"up_by_{one.source}_off", math.degrees(off_rad), "deg", "lower")
        if off_rad > _CONFLICT_RAD:
            ctx.warn(
                f"the up direction by the {one.source} alone is {math.degrees(off_rad):.0f} degrees from the estimate: "
                "the scene may lean"
            )
    ctx.quality("up_uncertainty", math.degrees(estimate.up_sigma_rad), "deg", "lower")


def _report(estimate: CameraEstimate, motion: BackgroundMotion, path: CameraPath, ctx: StageContext) -> None:
    from video2anim.geometry.perspective_field import pitch_roll_of

    ctx.quality("camera_drift", motion.drift_ratio, "ratio")
    if not estimate.is_static:
        ctx.quality("camera_path_residual", path.residual_px, "px", "lower")
        ctx.quality("camera_path_located", float(path.located.mean()), "ratio", "higher")
        ctx.quality("points_of_known_depth", len(path.points.place), "count", "higher")
    k = estimate.intrinsics
    for fault in [*motion.warnings(), *path.faults(max(k.width_px, k.height_px))]:
        ctx.warn(fault)
    if estimate.focal_sigma_ratio > 0.2:
        ctx.warn(f"focal length is uncertain ({estimate.focal_sigma_ratio:.0%}); give --focal-px if you know it")
    pitch, roll = pitch_roll_of(estimate.up_camera)
    ctx.quality("focal", k.fx_px, "px")
    ctx.quality("focal_uncertainty", estimate.focal_sigma_ratio, "ratio", "lower")
    ctx.quality("pitch", math.degrees(pitch), "deg")
    ctx.quality("roll", math.degrees(roll), "deg")


def _report_image(found: ImageCamera, clip: VideoClip, ctx: StageContext) -> None:
    if found.segments:
        ctx.quality("line_segments", float(np.mean([len(one.ends) for one in found.segments])), "count")
        ctx.quality("focal_of_perspective_field", found.of_fields.focal_ratio * clip.height_px, "px")
    ctx.quality("focal_of_image", found.camera.focal_ratio * clip.height_px, "px")
    ctx.quality("focal_of_image_uncertainty", found.camera.focal_log_sigma, "ratio", "lower")


def _expect_sane(config: CameraConfig, clip: VideoClip) -> None:
    long_side = max(clip.width_px, clip.height_px)
    if config.focal_px is not None and not 0.2 * long_side <= config.focal_px <= 20 * long_side:
        raise UsageError(
            f"--focal-px: want {0.2 * long_side:.0f} to {20 * long_side:.0f} for this video of "
            f"{clip.width_px}x{clip.height_px}, got {config.focal_px:g}"
        )


STAGE = StageSpec("camera", estimate_camera, version=32, models=("lifter", "camera"))
