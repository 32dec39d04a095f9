"""What is known of one object, for its fit."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from video2anim.geometry.heading import Heading
from video2anim.types.camera import Intrinsics
from video2anim.types.contact import RestedSkin


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """Errors of estimated depth within an object. Relief is how the logarithm of depth varies within it."""

    sigma: float
    """Standard deviation of the logarithm of depth, besides the relief's."""
    relief: float
    """True relief over the estimated one: mean of all objects."""
    relief_sigma: float
    """Its standard deviation."""
    open_bias: float = 0.0
    """Mean of the logarithm of estimated over true depth of open furniture (`form_fit.OPEN`), between whose parts the
    picture shows what is behind it."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectEvidence:
    """What is known of one object. Rays have length 1 along the camera's axis, so that depth times ray is a point."""

    camera_m: Float[np.ndarray, "3"]
    T_camera_world: Float[np.ndarray, "4 4"]
    intrinsics: Intrinsics
    """Of the depth map."""
    rays: Float[np.ndarray, "points 3"]
    """World, of some of its pixels."""
    depth_m: Float[np.ndarray, "points"]
    """NaN where it is not reliable."""
    outside_px: Float[np.ndarray, "height width"]
    """How far each pixel is from where the object may be: its outline and what hides it."""
    free_m: Float[np.ndarray, "height width"]
    """Depth up to which the camera sees through each pixel; 0 where that is not known."""
    size_px: float
    """Square root of the area of its visible pixels in the depth map."""
    depth_errors: DepthErrors
    distance_sigma: float
    """Standard deviation of the logarithm of the object's whole distance."""
    raised: bool = False
    """It does not stand on the floor."""
    rested: RestedSkin = field(default_factory=RestedSkin.nothing)
    """Skin that rested on it."""
    body_m: Float[np.ndarray, "inner 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    """Points where bodies were; independent of each other."""
    others_m: Float[np.ndarray, "others 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    """Seen points of walls and other objects, which are not inside it."""
    sides: Heading | None = None
    """Of its own straight edges; None where they do not tell."""
    walls: Heading | None = None
    """Of the room, where `sides` is not known."""

    def every_other(self) -> ObjectEvidence:
        """The same with half of the pixels and of the points around it."""
        return replace(self, rays=self.rays[::2], depth_m=self.depth_m[::2], others_m=self.others_m[::2])

    def rested_at(self, places: Collection[int]) -> ObjectEvidence:
        """The same if only what rested at these places rested on it."""
        return replace(self, rested=self.rested.only(np.isin(self.rested.place, list(places))))
