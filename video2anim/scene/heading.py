"""The heading of a room's walls from the straight edges of its picture.

Edges of a room and its furniture run up or along its walls. With lens and gravity known, each edge's plane with the
camera tells which horizontal directions it may run along; the pair of directions at right angles that suits most edges
is the room's (Coughlan and Yuille 1999). On renders of furnished rooms it is within 1 degree, where slopes of networks'
depth are 5 to 20 degrees off.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from video2anim.geometry.line_segments import detect_line_segments
from video2anim.types.camera import View

_STEP_RAD = np.deg2rad(0.5)
_EDGE_SIGMA_RAD = np.deg2rad(1.0)
"""Angle between edges and their vanishing point: errors of their ends, of lens and of gravity."""
_UPRIGHT_RAD = np.deg2rad(2.0)
"""Edges in planes this close to vertical are ignored: most of them are vertical."""
_FULL_LENGTH = 0.1
"""Length in radians from which edges have full weight."""
_MIN_SCORE = 0.15
"""Minimum share of the edges' weight that the heading explains beyond the mean over all headings."""
_SECOND = 0.5
"""No heading is returned where another one scores more than this share of the best..."""
_APART_RAD = np.deg2rad(8.0)
"""...and is farther than this from it."""


def room_heading(background_rgb: UInt8[np.ndarray, "height width 3"], view: View) -> float | None:
    """atan2(z, x) of the walls' normals in the world, modulo a right angle; None where edges do not tell."""
    lens = view.intrinsics
    height = lens.height_px
    ends = detect_line_segments(background_rgb).ends.reshape(-1, 2, 2)
    if not len(ends):
        return None
    center = np.array([0.5 * (lens.width_px - 1) - lens.cx_px, 0.5 * (height - 1) - lens.cy_px]) / height
    seen = (ends + center) * height / [lens.fx_px, lens.fy_px]
    ray = np.concatenate([seen, np.ones((*seen.shape[:2], 1))], -1) @ view.T_world_camera[:3, :3].T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    normal, along = np.cross(ray[:, 0], ray[:, 1]), ray.sum(1)
    length = np.linalg.norm(normal, axis=-1)
    normal, along = normal / length[:, None], along / np.linalg.norm(along, axis=-1, keepdims=True)
    turns = np.arange(0, np.pi / 2, _STEP_RAD)
    fit = np.zeros((len(normal), len(turns)))
    for turn in (turns, turns + np.pi / 2):
        direction = np.stack([np.cos(turn), 0 * turn, np.sin(turn)])
        # Rotating an edge about its middle tilts its plane less toward directions that it points at.
        aside = np.sqrt(np.maximum(1 - (along @ direction) ** 2, 0.01))
        fit = np.maximum(fit, np.exp(-0.5 * (normal @ direction / aside / _EDGE_SIGMA_RAD) ** 2))
    weight = np.minimum(1, length / _FULL_LENGTH) * (np.abs(normal[:, 1]) > np.sin(_UPRIGHT_RAD))
    # Edges on the horizon fit every heading and cancel out.
    score = weight @ (fit - fit.mean(1, keepdims=True))
    best = int(score.argmax())
    apart = np.abs((turns - turns[best] + np.pi / 4) % (np.pi / 2) - np.pi / 4) > _APART_RAD
    if score[best] < max(_MIN_SCORE * weight.sum(), 1.0) or score[apart].max() > _SECOND * score[best]:
        return None
    return float(turns[best])
