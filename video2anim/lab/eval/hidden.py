"""Frames in which the main person is not visible according to the truth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import posed_vertices
from video2anim.geometry.projection import project
from video2anim.lab.eval.truth import Truth
from video2anim.lab.synth.world import NEAR_M

HIDDEN_RATIO = 0.25
"""Hidden: the box around the visible pixels has less than this share of the area of the body's box."""
SHORTEST_S = 0.3
"""Shorter intervals do not count: a person passes behind a table leg."""
_SKIN_STRIDE = 20


def hidden_frames(truth: Truth) -> Bool[np.ndarray, "frames"]:
    """True frames in which the main person is behind objects or outside the picture (`HIDDEN_RATIO`)."""
    seen_px = _area_px2(truth.person_box_px[0] + np.array([-0.5, -0.5, 0.5, 0.5]))
    whole_px = _area_px2(_whole_box_px(truth))
    return ~(seen_px >= HIDDEN_RATIO * whole_px)


def hidden_stretches(hidden: Bool[np.ndarray, "frames"], fps: float) -> list[tuple[int, int]]:
    """First and last frame of every hidden interval of `SHORTEST_S` or more that has visible frames before and
    after."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], hidden, [False]]).astype(int)))
    runs = [(int(first), int(stop) - 1) for first, stop in edges.reshape(-1, 2)]
    return [
        (first, last)
        for first, last in runs
        if first > 0 and last < len(hidden) - 1 and (last - first + 1) / fps >= SHORTEST_S
    ]


def _whole_box_px(truth: Truth) -> Float[np.ndarray, "frames 4"]:
    """Box of the projected body, also outside the picture; NaN in frames in which a part of it is behind the camera."""
    motion = truth.main
    body = shaped_body(motion.shape)
    index = np.arange(0, len(body.rest_vertices_m), _SKIN_STRIDE)
    skin_m = posed_vertices(motion, body, index, np.arange(motion.frame_count))
    R, camera_m = motion.T_world_camera[:, :3, :3], motion.T_world_camera[:, None, :3, 3]
    skin_camera_m = (skin_m - camera_m) @ R
    ahead = skin_camera_m[..., 2].min(1) > NEAR_M
    pixel = project(np.where(ahead[:, None, None], skin_camera_m, [0.0, 0.0, 1.0]), motion.intrinsics)
    box_px = np.concatenate([pixel.min(1), pixel.max(1)], -1)
    return np.where(ahead[:, None], box_px, np.nan)


def _area_px2(box_px: Float[np.ndarray, "frames 4"]) -> Float[np.ndarray, "frames"]:
    return (box_px[:, 2] - box_px[:, 0]) * (box_px[:, 3] - box_px[:, 1])
