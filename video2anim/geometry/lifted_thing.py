"""Depth of one thing, at the distance that its feet and people before it tell, and the pixels that show it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.behind_people import Passed, factor_behind, passed_before
from video2anim.geometry.foot_line import floor_factor
from video2anim.geometry.masks import shrunk
from video2anim.geometry.projection import backproject, transform_points
from video2anim.geometry.thing_pixels import inverse_background, thing_pixels
from video2anim.types import BackgroundPlate, BodyMotion, CameraEstimate, InstanceMasks, MetricDepth
from video2anim.types.camera import Intrinsics


@dataclass(frozen=True, slots=True, eq=False)
class LiftedThing:
    """One thing at the size of the depth map."""

    own: Bool[np.ndarray, "height width"]
    """Its visible pixels."""
    shows: Bool[np.ndarray, "height width"]
    """Those with depth that show the thing itself."""
    depth_m: Float[np.ndarray, "height width"]
    """Of the whole picture, its own pixels brought to its feet and behind people."""
    points_world_m: Float[np.ndarray, "points 3"]
    """Of the pixels in `shows`."""


class ThingLifter:
    """Lifts the things of one picture."""

    def __init__(
        self,
        masks: InstanceMasks,
        depth: MetricDepth,
        plate: BackgroundPlate,
        body: BodyMotion,
        camera: CameraEstimate,
    ) -> None:
        """`body` is the main person, whom the plate has the masks of; it has the camera: its place over the floor, and
        the lens."""
        height, width = depth.background_depth_m.shape
        self.T_world_camera: Float[np.ndarray, "4 4"] = body.T_world_camera[0]
        self.lens: Intrinsics = body.intrinsics.resized(width, height)
        self.known: Bool[np.ndarray, "height width"] = depth.background_valid
        self.floor: Bool[np.ndarray, "height width"] = shrunk(masks.floor_mask, (height, width))
        self._depth_m = depth.background_depth_m.astype(np.float64)
        self._body, self._plate = body, plate
        self._up_sigma_rad = camera.up_sigma_rad
        self._masks = {i.object_id: shrunk(i.mask, (height, width)) for i in masks.instances}

    def own(self, object_id: int) -> Bool[np.ndarray, "height width"]:
        """Visible pixels of a thing."""
        return self._masks[object_id]

    def lift(self, object_id: int) -> LiftedThing:
        """The thing's depth."""
        own = self._masks[object_id]
        args = (self._depth_m, self.known, self.floor, self.T_world_camera, self.lens)
        depth_m = np.where(own, floor_factor(own, *args, self._up_sigma_rad), 1.0) * self._depth_m
        shows = thing_pixels(own, self.known, depth_m, self.T_world_camera, self.lens, self._behind)
        depth_m = np.where(own, factor_behind(depth_m, shows, self._passed), 1.0) * depth_m
        points_m = transform_points(self.T_world_camera, backproject(depth_m, self.lens)[shows])
        return LiftedThing(own, shows, depth_m, points_m)

    @cached_property
    def _passed(self) -> Passed:
        frames, seen = self._plate.frame_index, self._plate.selected_mask
        if seen.shape[1:] != self.known.shape:
            seen = np.array([shrunk(mask, self.known.shape) for mask in seen]).reshape(-1, *self.known.shape)
        return passed_before(self._body, frames, seen, self.lens)

    @cached_property
    def _behind(self) -> Float[np.ndarray, "height width"] | None:
        things = np.zeros(self.known.shape, bool)
        for mask in self._masks.values():
            things |= mask
        return inverse_background(self._depth_m, self.known, things, self.floor)
