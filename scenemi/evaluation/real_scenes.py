"""Evaluation windows of captured clips in the scenes they were captured in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scenemi.data.scene_clips import SceneFit, fit_scene, read_scene_clips
from scenemi.data.split import Part
from scenemi.evaluation.windows import EvaluationWindow, adult_body, windows_of
from scenemi.features import canonical_frame
from scenemi.metrics import CLOSE_PROXIMITY_M
from scenemi.scene.grid import SPACING_M
from scenemi.windows import WINDOW_FRAMES
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError
from video2anim.geometry.sdf import SdfGrid

_SEEN_M = 1.0
"""How far around a window's joints a prior is given the scene."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedSolids:
    """What stands on the floor of a captured scene, around one window."""

    solids: SdfGrid
    """In the world of the clip."""
    fit: SceneFit
    T_world_canonical: Float[np.ndarray, "4 4"]
    """Of the window on the body of the evaluation."""

    def signed_distance(self, points_m: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
        """See `ObstacleField`; at most 0.3 m."""
        T = self.T_world_canonical
        world_m = points_m @ T[:3, :3].T + T[:3, 3]
        return np.minimum(self.fit.scale * self.solids.sample(self.fit.scene_points(world_m)), CLOSE_PROXIMITY_M)

    def with_floor(self, around_m: Float[np.ndarray, "points 3"]) -> SdfGrid:
        """The solids and the floor as a grid in the canonical frame, around points."""
        low_m = around_m.min(0) - _SEEN_M
        shape = np.ceil((around_m.max(0) + _SEEN_M - low_m) / SPACING_M).astype(int) + 1
        nodes_m = low_m + SPACING_M * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
        T = self.T_world_canonical
        scene_m = self.fit.scene_points(nodes_m @ T[:3, :3].T + T[:3, 3])
        distance_m = np.minimum(self.fit.scale * self.solids.sample(scene_m), nodes_m[..., 1])
        return SdfGrid(distance_m.astype(np.float32), low_m, SPACING_M)


def windows_in_real_scenes(
    sources: Sequence[tuple[str, Path]], chosen: Part | Sequence[str] = "test", body: ShapedBody | None = None
) -> tuple[EvaluationWindow, ...]:
    """Every clip of at least 121 frames in windows that do not overlap, each in its scene.

    Args:
        sources: name and folder of data sets, see `scenemi.data.scene_clips`.
        chosen: a part by the data sets' own rules, or names of clips.
        body: None = the average adult.

    Raises:
        InputError: files are missing or broken, or no clip of the part is long enough.
    """
    body = body or adult_body()
    windows: list[EvaluationWindow] = []
    clips = [
        found
        for source, folder in sources
        for found in read_scene_clips(source, folder)
        if (found.part == chosen if isinstance(chosen, str) else found.clip.name in chosen)
        and len(found.clip.root_position_m) >= WINDOW_FRAMES
    ]
    if not clips:
        told = f"part {chosen!r}" if isinstance(chosen, str) else "the part of the split"
        raise InputError(f"evaluation: want a clip of at least {WINDOW_FRAMES} frames with a scene in {told}, got none")
    rooms: dict[tuple[str, str], SdfGrid] = {}
    for found in sorted(clips, key=lambda one: (one.clip.source, one.scene_name)):
        room = found.clip.source, found.scene_name
        solids = rooms[room] = rooms.get(room) or found.solids()
        motion, cut = windows_of(found.clip, body)
        rows = np.arange(len(motion.translation_m))
        fit = fit_scene(found.clip, body, rows, motion.R_parent_joint[:, 0], motion.translation_m)
        for start, window in cut:
            T = canonical_frame(motion.R_parent_joint[start, 0], motion.translation_m[start])
            placed = PlacedSolids(solids, fit, T)
            scene = placed.with_floor(window.joints_m.reshape(-1, 3))
            windows.append(replace(window, obstacles=placed, scene=scene))
    return tuple(windows)
