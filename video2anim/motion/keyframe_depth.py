"""Depth loss of stage keyframes: Chamfer distance between depth points and the visible skin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree

from video2anim.body.shaped_body import ShapedBody
from video2anim.geometry.line_of_sight import visible_vertices
from video2anim.geometry.projection import backproject, invert_rigid, transform_points
from video2anim.geometry.robust import huber_of_square
from video2anim.motion.keyframe_points import POINTS
from video2anim.types import BackgroundImage, BodyMotion, MetricDepth
from video2anim.types.skeleton import forward_kinematics

_MIN_POINTS = 50
"""Of depth and of skin, for a frame to count."""
_TRIM_RATIO = 0.1
"""Share of the pairs with the largest distances that is left out: hair, clothes, mask borders."""
_LOOK_UP_AFTER_M = 0.01
"""Neighbors are searched again where skin has moved so far: a fifth of the usual depth error on a body."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthTarget:
    """One frame's visible skin and depth points, world frame; the frame need not be a keyframe."""

    frame: int
    visible_m: Float[np.ndarray, "vertices 3"]
    depth_m: Float[np.ndarray, "points 3"]


def depth_targets(
    motion: BodyMotion,
    body: ShapedBody,
    depth: MetricDepth,
    background: BackgroundImage,
    rng: np.random.Generator,
) -> tuple[DepthTarget, ...]:
    """Frames that have both depth and a mask of the person, with enough valid pixels in it; the masks fit the depth.

    Of either set up to `POINTS` are drawn.
    """
    height, width = depth.depth_m.shape[1:]
    intrinsics = motion.intrinsics.resized(width, height)
    common, in_depth, in_background = np.intersect1d(depth.frame_index, background.frame_index, return_indices=True)
    targets: list[DepthTarget] = []
    for frame, d, p in zip(common, in_depth, in_background, strict=True):
        seen = background.selected_mask[p] & depth.valid[d] & (depth.depth_m[d] > 0)
        if not motion.valid[frame] or seen.sum() < _MIN_POINTS:
            continue
        T_world_camera = motion.T_world_camera[frame]
        points_m = transform_points(T_world_camera, backproject(depth.depth_m[d], intrinsics)[seen])
        _, R_world_joint = forward_kinematics(
            motion.R_parent_joint[frame], motion.T_world_root[frame, :3, 3], motion.rest_joints_m
        )
        skin_m = body.vertices(R_world_joint[None], motion.joints_world_m[frame][None])[0].astype(np.float64)
        skin_camera_m = transform_points(invert_rigid(T_world_camera), skin_m)
        visible_m = skin_m[visible_vertices(skin_camera_m, body.faces, intrinsics)]
        if len(visible_m) < _MIN_POINTS:
            continue
        chosen = [rng.choice(len(array), min(len(array), POINTS), replace=False) for array in (visible_m, points_m)]
        targets.append(DepthTarget(int(frame), visible_m[chosen[0]], points_m[chosen[1]]))
    return tuple(targets)


class DepthLoss:
    """Robust Chamfer cost (m^2) between moved skin and depth points, mean over frames and over both directions.

    All frames are one tensor, and the pairs of a frame are kept until its skin has moved: with a graph per frame and a
    search every few steps this loss took three quarters of the stage's time.
    """

    def __init__(self, targets: tuple[DepthTarget, ...], *, huber_m: float) -> None:
        self._huber_m = huber_m
        self._depth_m = [np.asarray(target.depth_m, dtype=np.float64) for target in targets]
        self._trees = [KDTree(depth_m) for depth_m in self._depth_m]
        counts = [len(target.visible_m) for target in targets]
        self._start = np.cumsum([0, *counts])
        self._looked_up_m = np.full((sum(counts), 3), np.inf)
        self._of_frame: dict[int, _Pairs] = {}
        self._skin, self._near_m, self._weight = torch.zeros(0), torch.zeros(0), torch.zeros(0)

    def __call__(self, skin_m: torch.Tensor) -> torch.Tensor:
        """Cost of the visible skin (S, 3) of all targets, in their order."""
        self._look_up(skin_m.detach().numpy())
        square = ((skin_m.index_select(0, self._skin) - self._near_m) ** 2).sum(-1)
        return (self._weight * huber_of_square(square, self._huber_m)).sum()

    def _look_up(self, skin_m: np.ndarray) -> None:
        moved_m = np.abs(skin_m - self._looked_up_m).ravel()
        stale = np.flatnonzero(np.maximum.reduceat(moved_m, 3 * self._start[:-1]) > _LOOK_UP_AFTER_M)
        for frame in stale.tolist():
            rows = slice(self._start[frame], self._start[frame + 1])
            self._looked_up_m[rows] = skin_m[rows]
            self._of_frame[frame] = self._pairs(frame, skin_m[rows])
        if len(stale):
            skin, near_m, weight = zip(*(self._of_frame[frame] for frame in range(len(self._trees))), strict=True)
            self._skin = torch.as_tensor(np.concatenate(skin))
            self._near_m = torch.as_tensor(np.concatenate(near_m), dtype=torch.float32)
            self._weight = torch.as_tensor(np.concatenate(weight), dtype=torch.float32)

    def _pairs(self, frame: int, skin_m: np.ndarray) -> _Pairs:
        """Pairs of one frame in both directions, without the farthest; each direction has half of the weight."""
        depth_m = self._depth_m[frame]
        to_depth_m, depth_of_skin = (np.asarray(found) for found in self._trees[frame].query(skin_m))
        to_skin_m, skin_of_depth = (np.asarray(found) for found in KDTree(skin_m).query(depth_m))
        by_skin, by_depth = _nearest(to_depth_m), _nearest(to_skin_m)
        skin = np.concatenate([by_skin, skin_of_depth[by_depth]]) + self._start[frame]
        near_m = np.concatenate([depth_m[depth_of_skin[by_skin]], depth_m[by_depth]])
        share = 0.5 / len(self._depth_m)
        weight = np.repeat([share / len(by_skin), share / len(by_depth)], [len(by_skin), len(by_depth)])
        return skin, near_m, weight


_Pairs = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Rows of skin (P,), the depth points beside them (P, 3), and weights (P,)."""


def _nearest(distance_m: np.ndarray) -> np.ndarray:
    """Indices of all but the trimmed share of the largest distances."""
    kept = max(1, round(len(distance_m) * (1 - _TRIM_RATIO)))
    return np.argpartition(distance_m, kept - 1)[:kept]
