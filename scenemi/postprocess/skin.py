"""Sampled skin of a body, and its parts that touch as one."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from video2anim.geometry.sampling import farthest_points
from video2anim.types.skeleton import TOUCHING_PARTS

if TYPE_CHECKING:
    from video2anim.body.shaped_body import ShapedBody

PARTS = tuple(TOUCHING_PARTS.values())
_SPREAD_POINTS, _PART_POINTS = 500, 100
"""Of the whole skin, and of each part that touches: about 6 cm and 2 cm apart."""


@lru_cache(maxsize=8)
def skin_of(body: ShapedBody) -> Skin:
    """The sampled skin of a body; the last few are kept."""
    return Skin(body)


class Skin:
    """Sampled skin: some of everywhere, more where the body may touch."""

    def __init__(self, body: ShapedBody) -> None:
        chosen = [farthest_points(body.rest_vertices_m, _SPREAD_POINTS)]
        for part in PARTS:
            members = np.flatnonzero(np.isin(body.vertex_part, part))
            chosen.append(members[farthest_points(body.rest_vertices_m[members], _PART_POINTS)])
        ends = np.cumsum([len(some) for some in chosen])
        self.body, self.index = body, np.concatenate(chosen)
        self.of_part = [np.arange(a, b) for a, b in pairwise(ends)]
        self.joint = body.vertex_part[self.index]

    def at(self, joints_m: np.ndarray, R_world_joint: np.ndarray) -> Float[np.ndarray, "frames points 3"]:
        # About the root: single precision is lost far from the origin.
        root_m = joints_m[:, :1]
        return self.body.vertices(R_world_joint, joints_m - root_m, self.index).astype(np.float64) + root_m
