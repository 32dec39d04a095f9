"""The floor plan of a clip for the report: paths and outlines."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from scenemi.metrics import ROOT
from video2anim.errors import ArtifactError
from video2anim.geometry.projection import transform_points
from video2anim.lab.eval.model import Plan
from video2anim.lab.eval.motion_rows import CommonFrames
from video2anim.lab.eval.scene_rows import REACH_M
from video2anim.lab.eval.true_scene import world_mesh
from video2anim.lab.eval.truth import Truth
from video2anim.types import BodyMotion, SceneModel

Outline = tuple[tuple[float, float], ...]
_PATH_STEP_FRAMES = 2


def plan_of(
    stages: Mapping[str, BodyMotion],
    truth: BodyMotion,
    common: CommonFrames,
    T_true_estimate: np.ndarray,
    whole: Truth,
    scene: SceneModel | str,
) -> Plan:
    """Paths of the pelvis and outlines of furniture, in the true world."""
    rows = common.span[::_PATH_STEP_FRAMES]
    paths = {"truth": _path(truth.joints_world_m[common.true_index[rows], ROOT])}
    for name, motion in stages.items():
        paths[name] = _path(transform_points(T_true_estimate, motion.joints_world_m[rows, ROOT]))
    true_outlines = []
    near = np.array([p for path in paths.values() for p in path]).reshape(-1, 2)
    for item in whole.objects:
        if item.stands:
            try:
                corners = world_mesh(item).vertices_m[:, [0, 2]]
            except ArtifactError:
                continue
            if (
                len(near)
                and (corners.max(0) > near.min(0) - REACH_M).all()
                and (corners.min(0) < near.max(0) + REACH_M).all()
            ):
                true_outlines.append((item.label, outline(corners)))
    estimated = []
    for obj in () if isinstance(scene, str) else scene.objects:
        if len(obj.mesh.vertices_m):
            vertices_m = obj.scale * obj.mesh.vertices_m.astype(np.float64)
            points_m = transform_points(T_true_estimate @ obj.T_world_object, vertices_m)
            estimated.append((obj.label, outline(points_m[:, [0, 2]])))
    return Plan(paths, tuple(true_outlines), tuple(estimated))


def outline(points: np.ndarray) -> Outline:
    """Convex hull of 2D points; the points themselves if they span no area."""
    try:
        corners = points[ConvexHull(points).vertices]
    except QhullError:
        corners = points
    return tuple((round(float(x), 3), round(float(y), 3)) for x, y in corners)


def _path(points_m: np.ndarray) -> Outline:
    return tuple((round(float(x), 3), round(float(z), 3)) for x, _, z in points_m)
