"""Depth of one object and the pixels that show it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.masks import shrunk
from video2anim.geometry.projection import world_points
from video2anim.objects.foreground import foreground_mask, inverse_background
from video2anim.types import InstanceMasks, MetricDepth, View


@dataclass(frozen=True, slots=True, eq=False)
class BackprojectedObject:
    """One object at the size of the depth map."""

    own: Bool[np.ndarray, "height width"]
    """Its visible pixels."""
    shows: Bool[np.ndarray, "height width"]
    """Those with depth that show the object itself."""
    depth_m: Float[np.ndarray, "height width"]
    """Of the whole picture."""
    points_world_m: Float[np.ndarray, "points 3"]
    """Of the pixels in `shows`."""


class ObjectBackprojector:
    """Lifts the objects of one picture."""

    def __init__(self, masks: InstanceMasks, depth: MetricDepth) -> None:
        height, width = depth.background_depth_m.shape
        self.view: View = depth.bodies.main_view.resized(width, height)
        self.known: Bool[np.ndarray, "height width"] = depth.background_valid
        self.floor: Bool[np.ndarray, "height width"] = shrunk(masks.floor_mask, (height, width))
        self._depth_m = depth.background_depth_m.astype(np.float64)
        self._masks = {i.object_id: shrunk(i.mask, (height, width)) for i in masks.instances}

    def own(self, object_id: int) -> Bool[np.ndarray, "height width"]:
        """Visible pixels of an object."""
        return self._masks[object_id]

    def lift(self, object_id: int) -> BackprojectedObject:
        """The object's depth."""
        own = self._masks[object_id]
        shows = foreground_mask(own, self.known, self._depth_m, self.view, self._behind)
        return BackprojectedObject(own, shows, self._depth_m, self.world_m()[shows])

    def world_m(self) -> Float[np.ndarray, "height width 3"]:
        """World points of all pixels."""
        return world_points(self._depth_m, self.view)

    @cached_property
    def _behind(self) -> Float[np.ndarray, "height width"] | None:
        objects = np.zeros(self.known.shape, bool)
        for mask in self._masks.values():
            objects |= mask
        return inverse_background(self._depth_m, self.known, objects, self.floor)
