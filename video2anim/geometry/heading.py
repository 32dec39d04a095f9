"""Headings of a room's walls and of single objects from the straight edges of a picture.

Edges of a room and its furniture run up or along its walls, and those of an object along its sides. With lens and
gravity known, each edge's plane with the camera tells which horizontal directions it may run along; the pair of
directions at right angles that suits most edges is the heading (Coughlan and Yuille 1999). On renders of furnished
rooms the median error of both is below 0.3 degrees (`benchmarks/headings.py`), where slopes of networks' depth are 5 to
20 degrees off.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from video2anim.geometry.line_segments import INDEPENDENT, OUTLIERS, detect_line_segments
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
"""No heading is returned where another one, apart from it, scores more than this share of the best."""
_OUTLINE_PX = 2
"""Edges so near to a mask are its object's: most are its outline."""


@dataclass(frozen=True, slots=True)
class Heading:
    """atan2(z, x) of a horizontal direction in the world, modulo a right angle."""

    angle_rad: float
    sigma_rad: float
    """Standard deviation by the edges alone: errors of lens and gravity are not in it."""
    log_odds: float
    """Of this one heading for all edges, against another one for each."""

    @property
    def yaw_rad(self) -> float:
        """The same as a turn about +y, from z towards x."""
        return -self.angle_rad


class EdgeHeadings:
    """Horizontal directions of the straight edges of one picture."""

    def __init__(self, background_rgb: UInt8[np.ndarray, "height width 3"], view: View) -> None:
        """`view`: the camera of this picture, with lens and gravity."""
        lens = view.intrinsics
        height = lens.height_px
        ends = detect_line_segments(background_rgb).ends.reshape(-1, 2, 2)
        center = np.array([0.5 * (lens.width_px - 1) - lens.cx_px, 0.5 * (height - 1) - lens.cy_px]) / height
        seen = (ends + center) * height / [lens.fx_px, lens.fy_px]
        ray = np.concatenate([seen, np.ones((*seen.shape[:2], 1))], -1) @ view.T_world_camera[:3, :3].T
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        normal, along = np.cross(ray[:, 0], ray[:, 1]), ray.sum(1)
        length = np.linalg.norm(normal, axis=-1)
        normal, along = normal / length[:, None], along / np.linalg.norm(along, axis=-1, keepdims=True)
        self._turns = np.arange(0, np.pi / 2, _STEP_RAD)
        fit = np.zeros((len(normal), len(self._turns)))
        for turn in (self._turns, self._turns + np.pi / 2):
            direction = np.stack([np.cos(turn), 0 * turn, np.sin(turn)])
            # Rotating an edge about its middle tilts its plane less toward directions that it points at.
            aside = np.sqrt(np.maximum(1 - (along @ direction) ** 2, 0.01))
            fit = np.maximum(fit, np.exp(-0.5 * (normal @ direction / aside / _EDGE_SIGMA_RAD) ** 2))
        # Edges on the horizon fit every heading and cancel out.
        self._beyond_mean = fit - fit.mean(1, keepdims=True)
        by_chance = OUTLIERS * _EDGE_SIGMA_RAD * np.sqrt(2 / np.pi)
        self._log_likelihood = np.log((1 - OUTLIERS) * fit + by_chance)
        self._weight = np.minimum(1, length / _FULL_LENGTH) * (np.abs(normal[:, 1]) > np.sin(_UPRIGHT_RAD))
        # Of the picture: 0 to 1 from its first to its last row and column.
        self._middle = ends.mean(1) * height / [lens.width_px - 1, height - 1] + 0.5

    def of_room(self) -> Heading | None:
        """That of the walls' normals; None where edges do not tell."""
        return self._heading(np.ones(len(self._weight), bool))

    def within(self, mask: Bool[np.ndarray, "height width"]) -> Heading | None:
        """That of the sides of an object with this mask, of any resolution; None where its edges do not tell."""
        wide = cv2.dilate(mask.astype(np.uint8), np.ones((2 * _OUTLINE_PX + 1,) * 2, np.uint8)) > 0
        column, row = (np.clip(self._middle, 0, 1) * [wide.shape[1] - 1, wide.shape[0] - 1]).round().astype(int).T
        return self._heading(wide[row, column])

    def _heading(self, chosen: Bool[np.ndarray, "edges"]) -> Heading | None:
        weight = self._weight[chosen]
        score = weight @ self._beyond_mean[chosen]
        # The best one in the middle.
        middle = len(score) // 2
        order = (int(score.argmax()) + np.arange(-middle, len(score) - middle)) % len(score)
        score, off_rad = score[order], _STEP_RAD * np.arange(-middle, len(score) - middle)
        low = score < _SECOND * score[middle]
        first, last = middle - np.argmax(low[middle::-1]), middle + np.argmax(low[middle:])
        apart = np.concatenate([score[:first], score[last:]])
        if score[middle] < max(_MIN_SCORE * weight.sum(), 1.0) or apart.max() > _SECOND * score[middle]:
            return None
        log_likelihood = (INDEPENDENT * weight @ self._log_likelihood[chosen])[order[first:last]]
        share, off_rad = np.exp(log_likelihood - log_likelihood.max()), off_rad[first:last]
        best = int(order[middle])
        each = self._log_likelihood[chosen, best] - np.log(np.exp(self._log_likelihood[chosen]).mean(1))
        return Heading(
            float(self._turns[best]), float(np.sqrt(share @ off_rad**2 / share.sum())),
            max(INDEPENDENT * float(weight @ each), 0.0),
        )  # fmt: skip
