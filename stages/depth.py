"""Stage depth: depth of the background image and of the people in sampled frames, up to one scale and offset.

Provider `geometric` needs no network: gravity and the floor under the feet make a planar scene proxy (floor, upright
objects, upright background). Any other provider is a model of slot `depth`, whose uncertainty comes from hue jitter
(paper 8.1). With a static camera every frame has the depth of the background image; only people come from the depth of
the frame itself, aligned to it, so that nothing flickers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8

from video2anim.pipeline.options import limits, model_of, only_with, only_without
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import BackgroundImage, BodyTracks, CameraEstimate, DepthClip, VideoClip, View

if TYPE_CHECKING:
    from video2anim.depth.planar_scene import PlanarSceneProxy

_SAME_VIEW = 0.01
"""Camera motion, in meters and radians, below which the background image still is the frame's background."""


_HueShift = Annotated[float, limits("rad", ge=-3.1416, le=3.1416)]


@dataclass(frozen=True)
class DepthConfig:
    """Provider of depth and its limits."""

    provider: Annotated[str, model_of("depth", also=("geometric",))] = "room-depth"
    """`geometric`, or a model of slot `depth`, by its name or as NAME@PATH."""
    far_m: Annotated[float, limits("m", gt=0, le=10_000), only_with("provider", "geometric")] = 30.0
    """Geometric: nothing is placed beyond this distance."""
    contact_threshold: Annotated[float, limits(ge=0, le=1), only_with("provider", "geometric")] = 0.5
    """Geometric: contact probability from which a foot stands."""
    hue_shifts_rad: Annotated[tuple[_HueShift, ...], only_without("provider", "geometric")] = (-0.6, -0.3, 0.3, 0.6)
    """Network: hue shifts of the background image's copies that give its uncertainty."""
    frame_hue_shifts_rad: Annotated[tuple[_HueShift, ...], only_without("provider", "geometric")] = (-0.45, 0.45)
    """Network: the same for each sampled frame."""
    unreliable_ratio: Annotated[float, limits(ge=0, le=1), only_without("provider", "geometric")] = 0.04
    """Network: pixels with a deviation above this share of the range of values are dropped."""


class DepthModel(Protocol):
    """A network in slot `depth`."""

    kind: str
    """`disparity` (relative, large = near) or `metric`."""

    def infer(self, image_rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
        """Depth or disparity at the size of the picture; NaN where unknown."""
        ...


def estimate_depth(
    clip: VideoClip,
    background_image: BackgroundImage,
    bodies: BodyTracks,
    camera: CameraEstimate,
    config: DepthConfig,
    ctx: StageContext,
) -> DepthClip:
    """Relative depth of the background image and of every sampled frame, with uncertainty.

    The camera's place over the floor is taken from the fitted bodies; `camera` says whether it moves.

    Raises:
        StageError: provider `geometric`, and nobody is seen in any frame.
    """
    if config.provider == "geometric":
        depth = _geometric(background_image, bodies, camera, config, ctx)
    else:
        depth = _network(clip, background_image, camera.is_static, config, ctx)
    on_person = background_image.selected_mask & depth.valid
    ctx.quality("background_valid_ratio", float(depth.background_valid.mean()), "ratio", "higher")
    ctx.quality(
        "person_valid_ratio", on_person.sum() / max(int(background_image.selected_mask.sum()), 1), "ratio", "higher"
    )
    sigma = depth.sigma[depth.valid] / np.maximum(np.abs(depth.value[depth.valid]), 1e-6)
    ctx.quality("median_sigma_ratio", float(np.median(sigma)) if sigma.size else 1.0, "ratio", "lower")
    return depth


def _geometric(
    background_image: BackgroundImage,
    bodies: BodyTracks,
    camera: CameraEstimate,
    config: DepthConfig,
    ctx: StageContext,
) -> DepthClip:
    import cv2

    from video2anim.depth.person_depth import standing_feet
    from video2anim.depth.planar_scene import PlanarSceneConfig, planar_scene_depth

    height, width = background_image.seen_ratio.shape
    view = bodies.main_view.resized(width, height)
    small_rgb = cv2.resize(background_image.background_rgb, (width, height), interpolation=cv2.INTER_AREA)
    stands = [standing_feet(body, config.contact_threshold) for body in bodies.people]
    spots = np.concatenate([feet[on] for feet, on in stands]) * np.array([1.0, 0.0, 1.0])
    planar_scene = planar_scene_depth(small_rgb, view, spots, PlanarSceneConfig(far_m=config.far_m))
    ctx.quality("standing_spots", len(spots), "count", "higher")
    if planar_scene is None:
        ctx.warn("no foot stands on floor that the picture shows; background depth is unknown")
        planar_scene = _nothing_known(height, width)
    return _with_people(background_image, bodies, planar_scene, camera.is_static, config)


def _nothing_known(height: int, width: int) -> PlanarSceneProxy:
    from video2anim.depth.planar_scene import PlanarSceneProxy

    unknown = np.zeros((height, width), dtype=bool)
    return PlanarSceneProxy(
        np.ones((height, width)), np.ones((height, width)), unknown, np.zeros((height, width), np.int32)
    )


def _with_people(
    background_image: BackgroundImage,
    bodies: BodyTracks,
    planar_scene: PlanarSceneProxy,
    is_static: bool,
    config: DepthConfig,
) -> DepthClip:
    """The planar scene behind, the person as an upright figure before it, in every sampled frame."""
    from video2anim.depth.person_depth import person_distance, standing_feet
    from video2anim.geometry.gravity_view import GravityView

    main = bodies.main
    height, width = background_image.seen_ratio.shape
    feet_world_m, standing = standing_feet(main, config.contact_threshold)
    samples = len(background_image.frame_index)
    depth_m = np.repeat(planar_scene.depth_m[None].astype(np.float32), samples, axis=0)
    sigma_m = np.repeat(planar_scene.sigma_m[None].astype(np.float32), samples, axis=0)
    valid = np.repeat(planar_scene.valid[None], samples, axis=0) & ~background_image.person_mask
    first = main.view().resized(width, height)
    view = GravityView.of(first)
    for sample, frame in enumerate(background_image.frame_index):
        if not is_static:
            now = main.view(frame).resized(width, height)
            valid[sample] &= _same_view(now, first)
            view = GravityView.of(now)
        mask = background_image.selected_mask[sample]
        found = person_distance(view, mask, feet_world_m[frame][standing[frame]])
        if found is None or view.camera_height_m <= 0.05:
            continue
        depth_m[sample][mask] = found[0] / view.ray_horizontal[mask]
        sigma_m[sample][mask] = found[1] / view.ray_horizontal[mask]
        valid[sample] |= mask
    known = depth_m[valid] if valid.any() else np.ones(1)
    unit_m = (
        float(np.median(planar_scene.depth_m[planar_scene.valid]))
        if planar_scene.valid.any()
        else float(np.median(known))
    )
    return DepthClip(
        kind="depth",
        provider="geometric",
        frame_index=background_image.frame_index,
        value=depth_m / np.float32(unit_m),
        sigma=sigma_m / np.float32(unit_m),
        valid=valid,
        background_value=(planar_scene.depth_m / unit_m).astype(np.float32),
        background_valid=planar_scene.valid,
    )


def _same_view(a: View, b: View) -> bool:
    return bool(np.abs(a.T_world_camera[:3] - b.T_world_camera[:3]).max() < _SAME_VIEW)


def _network(
    clip: VideoClip, background_image: BackgroundImage, is_static: bool, config: DepthConfig, ctx: StageContext
) -> DepthClip:
    from video2anim.video import read_frames

    model: DepthModel = ctx.model(config.provider)
    shape = background_image.seen_ratio.shape
    background = _jittered(model, background_image.background_rgb, shape, config.hue_shifts_rad, config)
    wanted = {int(frame): sample for sample, frame in enumerate(background_image.frame_index)}
    maps = np.zeros((2, len(wanted), *shape), dtype=np.float32)
    valid = np.zeros((len(wanted), *shape), dtype=bool)
    for frame, image_rgb in enumerate(read_frames(clip, 0, int(background_image.frame_index.max()) + 1)):
        if frame in wanted:
            sample = wanted[frame]
            answer = _jittered(model, image_rgb, shape, config.frame_hue_shifts_rad, config)
            maps[0, sample], maps[1, sample], valid[sample] = answer
            ctx.progress(sample + 1, len(wanted))
    if is_static:
        _steady(maps, valid, background, background_image.person_mask, ctx)
    if model.kind == "disparity":
        # Its zero is anywhere: put it a little beyond the farthest object, so that all values are positive.
        known = background[0][background[2]] if background[2].any() else background[0]
        low, high = np.percentile(known, [0.5, 98])
        zero = np.float32(low - 0.05 * (high - low))
        maps[0] -= zero
        background = (background[0] - zero, background[1], background[2])
    return DepthClip(
        kind="disparity" if model.kind == "disparity" else "depth",
        provider=config.provider,
        frame_index=background_image.frame_index,
        value=maps[0],
        sigma=maps[1],
        valid=valid,
        background_value=background[0],
        background_valid=background[2],
    )


def _steady(
    maps: Float[np.ndarray, "2 samples h w"],
    valid: Bool[np.ndarray, "samples h w"],
    background: tuple[np.ndarray, np.ndarray, np.ndarray],
    person_mask: Bool[np.ndarray, "samples h w"],
    ctx: StageContext,
) -> None:
    """Align every sample to the background image, in place; only people keep the depth of their own frame."""
    from video2anim.depth.temporal_alignment import fitted_line, flicker

    value, sigma, known = background
    still = known & ~person_mask.any(0)
    before = flicker(maps[0], still) if still.any() else 0.0
    lost = 0
    for sample, people in enumerate(person_mask):
        line = fitted_line(maps[0, sample], value, known & ~people)
        if line is None:
            lost += 1
            valid[sample] &= False
            line = (1.0, 0.0)
        maps[0, sample] = np.where(people, line[0] * maps[0, sample] + line[1], value)
        maps[1, sample] = np.where(people, line[0] * maps[1, sample], sigma)
        valid[sample] = np.where(people, valid[sample], known)
    if lost:
        ctx.warn(
            f"depth: {lost} of {len(person_mask)} sampled frames could not be aligned to the background; no people"
        )
    if still.any():
        ctx.quality("flicker_before", before, "ratio", "lower")
        ctx.quality("flicker_after", flicker(maps[0], still), "ratio", "lower")


def _jittered(
    model: DepthModel, image_rgb: np.ndarray, shape: tuple[int, int], shifts_rad: tuple[float, ...], config: DepthConfig
) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, "small_height small_width"]]:
    """Value, its deviation and reliable pixels, at the working resolution."""
    import cv2

    from video2anim.depth.hue_jitter import jittered_disparity, reliable

    size = (shape[1], shape[0])
    small_rgb = cv2.resize(image_rgb, _shrunk(image_rgb, size), interpolation=cv2.INTER_AREA)
    value, sigma = jittered_disparity(model.infer, small_rgb, shifts_rad)
    small = [cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_AREA) for m in (value, sigma)]
    good = reliable(small[0], small[1], config.unreliable_ratio)
    return np.where(np.isfinite(small[0]), small[0], 0), np.where(np.isfinite(small[1]), small[1], 1e3), good


def _shrunk(image_rgb: np.ndarray, size: tuple[int, int]) -> tuple[int, int]:
    """Width and height at which a network looks: no network gains from more than a few times the working size."""
    factor = min(1.0, 3 * size[0] / image_rgb.shape[1])
    return round(image_rgb.shape[1] * factor), round(image_rgb.shape[0] * factor)


STAGE = StageSpec("depth", estimate_depth, version=4, models=("depth",))
