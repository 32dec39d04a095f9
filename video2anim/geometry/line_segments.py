"""Lens and gravity from the straight edges of a room.

Most edges of a room and its furniture run up or along one of two horizontal directions square to each other (Coughlan
and Yuille 1999). Each edge of a picture spans a plane with the camera (Barnard 1983), and a direction it runs along
lies in that plane; the camera, the room's heading and the lens' distortion that suit most edges best are looked for,
beginning with and held by what a perspective field says. Edges that run otherwise, of people or of objects that stand
at an angle, count as outliers. A picture that shows the room from straight ahead leaves the focal length open: then it
stays the field's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.geometry.perspective_field import FieldCamera, pitch_roll_of, up_of

WORKING_AREA_PX = 960 * 540
"""Edges are looked for in pictures no larger than this, and in small ones at twice their own size."""
END_SIGMA_PX = 0.25
"""Error of an edge's end across it, in pixels of the picture or of the working size, whichever is coarser. It and the
constants below were chosen on renders of other rooms than `benchmarks/room_net.py` measures on."""
SHORTEST = 0.03
"""Edges shorter than this share of the picture's height are left out."""
MAX_EDGES = 160
"""Longest edges of a picture that are used."""
_BENT_SIGMA_RAD = math.radians(0.3)
"""What straight objects, lenses and the detector miss beside the error of the ends."""
OUTLIERS = 0.4
"""Expected share of edges that run along none of the three directions."""
_FULL_LENGTH = 0.1
"""Edges of this length (picture heights) and more count whole."""
INDEPENDENT = 0.4
"""Both borders of one board are two edges: each counts so much."""
_DISTORTION_SIGMA = 0.05
"""Expected first radial coefficient of Brown's lens model."""
_LENGTHS, _LENGTH_SPAN = 11, 2.2
"""Focal lengths to begin with, over so many deviations of the field's to both sides."""
_HEADINGS, _HEADINGS_KEPT = 12, 3
"""Headings over a quarter turn to begin with, and how many go on per focal length."""
_ROUNDS = 9
"""Steps of a climb."""
_SAME = 0.03
"""Ends of climbs no farther apart than this (log focal length, radians) are one."""
_MAX_DOUBT = 0.5
"""A field less sure of its focal length's logarithm than this is taken for as sure: some edges suit any lens."""
_MIN_DOUBT = 0.01
"""Focal lengths by edges are no surer than this; principal points are not looked for."""
_STEP = 1e-4
"""Of numerical derivatives: the square root of the numbers' accuracy (1.5e-8) makes covariances noisy by 2e-6."""
_LONGEST_STEP = 0.25
"""Of the logarithm of the focal length and of angles (radians) in one round."""
_FEWEST = 3
"""Edges below which the field stays as it is: one for each direction."""
_FOCAL, _PITCH, _ROLL, _HEADING, _DISTORTION = range(5)


@dataclass(frozen=True, slots=True, eq=False)
class LineSegments:
    """Straight edges of one picture."""

    ends: Float[np.ndarray, "edges 4"]
    """x, y of both ends in picture heights from the picture's middle (x right, y down), longest first."""
    end_sigma: float
    """Expected error of an end across the edge, in picture heights."""


def detect_line_segments(image: UInt8[np.ndarray, "height width 3"]) -> LineSegments:
    """Edges of an RGB picture by the line segment detector of Grompone von Gioi et al. (2010)."""
    height, width = image.shape[:2]
    scale = min(2.0, math.sqrt(WORKING_AREA_PX / (width * height)))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    grey = cv2.resize(
        cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    )
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    pixels = np.zeros((0, 4)) if found is None else np.asarray(found, np.float64).reshape(-1, 4)
    x, y = (pixels[:, 0::2] + 0.5) / size[0] - 0.5, (pixels[:, 1::2] + 0.5) / size[1] - 0.5
    ends = np.stack([x * width / height, y], -1).reshape(-1, 4)
    length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    longest = np.argsort(-length, kind="stable")[:MAX_EDGES]
    return LineSegments(ends[longest[length[longest] > SHORTEST]], END_SIGMA_PX / min(height, size[1]))


def camera_with_edges(camera: FieldCamera, edges: Sequence[LineSegments], *, focal_known: bool = False) -> FieldCamera:
    """The camera that a perspective field and the edges of pictures of the same view suggest together.

    Expectation maximization from several focal lengths and headings, by Gauss-Newton steps: an edge belongs to each
    direction by its likelihood there; the most probable end is taken.

    Args:
        camera: what the fields say, with its covariance.
        edges: of one or several pictures; their weights are shared.
        focal_known: the camera's focal length is right; gravity alone is corrected.
    """
    fit = _Fit.of(camera, edges)
    if fit is None:
        return camera
    states = _apart(fit.climbed(fit.starts(1 if focal_known else _LENGTHS)), fit)
    covariance = np.linalg.inv(fit.normal_equations(states)[0])[:, :3, :3]
    # Each summit by the volume under it (Laplace): other summits nearly as high are doubts, too.
    log_volume = 0.5 * np.linalg.slogdet(covariance)[1] - fit.cost(states)
    best = int(log_volume.argmax())
    share = np.exp(log_volume - log_volume[best])
    off = states[:, :3] - states[best, :3]
    spread = covariance + off[:, :, None] * off[:, None, :]
    return FieldCamera(
        focal_ratio=camera.focal_ratio if focal_known else math.exp(states[best, _FOCAL]),
        up_camera=up_of(states[best, _PITCH], states[best, _ROLL]),
        covariance=np.einsum("s,sij->ij", share / share.sum(), spread) + np.diag([_MIN_DOUBT**2, 0, 0]),
    )


def _apart(states: Float[np.ndarray, "states 5"], fit: _Fit) -> Float[np.ndarray, "summits 5"]:
    """Ends of the climbs, best first, each once."""
    kept: list[np.ndarray] = []
    for state in states[np.argsort(fit.cost(states), kind="stable")]:
        turn = [abs((state[_HEADING] - other[_HEADING] + math.pi / 4) % (math.pi / 2) - math.pi / 4) for other in kept]
        off = [np.abs(state[:3] - other[:3]).max() for other in kept]
        if not any(max(pair) < _SAME for pair in zip(turn, off, strict=True)):
            kept.append(state)
    return np.stack(kept)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """States are rows of log focal length, pitch, roll, heading and distortion."""

    ends: Float[np.ndarray, "edges 2 2"]
    sigma_rad: Float[np.ndarray, "edges 1"]
    weight: Float[np.ndarray, "edges"]
    expected: Float[np.ndarray, "5"]
    information: Float[np.ndarray, "5 5"]
    """Of the prior."""

    @classmethod
    def of(cls, camera: FieldCamera, edges: Sequence[LineSegments]) -> _Fit | None:
        """None where there are too few edges to speak of."""
        ends = np.concatenate([np.zeros((0, 4)), *(some.ends for some in edges)])
        if len(ends) < _FEWEST:
            return None
        end_sigma = np.concatenate([np.full(len(some.ends), some.end_sigma) for some in edges])
        length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
        information = np.zeros((5, 5))
        # Row and column alike, so that what goes with the focal length shrinks with it.
        held = np.diag([min(1.0, _MAX_DOUBT / camera.focal_log_sigma), 1.0, 1.0])
        information[:3, :3] = np.linalg.inv(held @ camera.covariance @ held)
        information[_DISTORTION, _DISTORTION] = _DISTORTION_SIGMA**-2
        return cls(
            ends.reshape(-1, 2, 2),
            np.hypot(_BENT_SIGMA_RAD, 2 * end_sigma / length)[:, None],
            INDEPENDENT / len(edges) * np.minimum(1, length / _FULL_LENGTH),
            np.array([math.log(camera.focal_ratio), *pitch_roll_of(camera.up_camera), 0.0, 0.0]),
            information,
        )

    def starts(self, lengths: int) -> Float[np.ndarray, "states 5"]:
        """Focal lengths around the expected one, each with the gravity that goes with it and the headings that suit
        most edges roughly."""
        covariance = np.linalg.inv(self.information[:3, :3])
        sigma = math.sqrt(covariance[_FOCAL, _FOCAL])
        off = np.linspace(-_LENGTH_SPAN, _LENGTH_SPAN, lengths) * sigma if lengths > 1 else np.zeros(1)
        heading = np.arange(_HEADINGS) / _HEADINGS * math.pi / 2
        states = np.zeros((lengths, _HEADINGS, 5))
        states[..., :3] = self.expected[:3] + off[:, None, None] * covariance[0] / covariance[0, 0]
        states[..., _HEADING] = heading
        cost = self.cost(states.reshape(-1, 5), wider=4.0).reshape(lengths, _HEADINGS)
        kept = np.argsort(cost, axis=1)[:, :_HEADINGS_KEPT]
        return np.take_along_axis(states, kept[..., None], axis=1).reshape(-1, 5)

    def cost(self, states: Float[np.ndarray, "states 5"], *, wider: float = 1.0) -> Float[np.ndarray, "states"]:
        """Negative logarithm of the posterior density, up to a constant."""
        off = self._off_prior(states)
        density = self._densities(self.residual_rad(states), wider).sum(-1) + OUTLIERS / math.pi
        return 0.5 * np.einsum("si,ij,sj->s", off, self.information, off) - np.log(density) @ self.weight

    def climbed(self, states: Float[np.ndarray, "states 5"]) -> Float[np.ndarray, "states 5"]:
        """States after some rounds, the first with a wider tolerance."""
        for done in range(_ROUNDS):
            H, gradient = self.normal_equations(states, wider=max(1.0, 4.0 * (1 - done / (0.6 * _ROUNDS))))
            step = np.linalg.solve(H, gradient[..., None])[..., 0]
            states = states - np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
            states[:, _DISTORTION] = np.clip(states[:, _DISTORTION], *(5 * _DISTORTION_SIGMA * np.array([-1, 1])))
        return states

    def normal_equations(
        self, states: Float[np.ndarray, "states 5"], *, wider: float = 1.0
    ) -> tuple[Float[np.ndarray, "states 5 5"], Float[np.ndarray, "states 5"]]:
        """Matrix and right side of a Gauss-Newton step, edges shared out among the directions."""
        residual = self.residual_rad(states)
        density = self._densities(residual, wider)
        share = density / (density.sum(-1, keepdims=True) + OUTLIERS / math.pi)
        weight = self.weight[:, None] * share / (wider * self.sigma_rad) ** 2
        J = np.stack([(self.residual_rad(states + _STEP * axis) - residual) / _STEP for axis in np.eye(5)], -1)
        weighted = weight[..., None] * J
        H = np.einsum("snki,snkj->sij", weighted, J) + self.information + 1e-6 * np.eye(5)
        gradient = np.einsum("snki,snk->si", weighted, residual)
        return H, gradient + self._off_prior(states) @ self.information

    def residual_rad(self, states: Float[np.ndarray, "states 5"]) -> Float[np.ndarray, "states edges 3"]:
        """Angle in the picture by which edges miss the vanishing points of up and of both headings."""
        seen = self.ends[None] / np.exp(states[:, _FOCAL])[:, None, None, None]
        straight = _undistorted(seen, states[:, _DISTORTION][:, None, None, None])
        ray = np.concatenate([straight, np.ones((*straight.shape[:-1], 1))], -1)
        first, second = (part / np.linalg.norm(part, axis=-1, keepdims=True) for part in (ray[:, :, 0], ray[:, :, 1]))
        normal, center = np.cross(first, second), first + second
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-12
        center /= np.linalg.norm(center, axis=-1, keepdims=True)
        axes = _room_axes(states).transpose(0, 2, 1)
        # The same turn of an edge about its middle turns its plane less against a direction that it points at.
        aside = np.sqrt(np.maximum(1 - (center @ axes) ** 2, 1e-4))
        return normal @ axes / aside

    def _densities(self, residual_rad: np.ndarray, wider: float) -> Float[np.ndarray, "states edges 3"]:
        sigma = wider * self.sigma_rad
        share = (1 - OUTLIERS) / 3 / math.sqrt(2 * math.pi)
        return share / sigma * np.exp(-0.5 * (residual_rad / sigma) ** 2)

    def _off_prior(self, states: np.ndarray) -> Float[np.ndarray, "states 5"]:
        off = states - self.expected
        off[:, _HEADING] = 0
        return off


def _undistorted(seen: np.ndarray, k1: np.ndarray) -> np.ndarray:
    """Points of Brown's model with one coefficient before the lens bent them."""
    straight = seen
    for _ in range(3):
        straight = seen / np.maximum(1 + k1 * (straight**2).sum(-1, keepdims=True), 0.3)
    return straight


def _room_axes(states: np.ndarray) -> Float[np.ndarray, "states 3 3"]:
    """Up and both headings in camera axes."""
    up = up_of(states[:, _PITCH], states[:, _ROLL])
    # Straight ahead made level; a camera that looks straight up or down has none, there the picture's up will do.
    ahead = np.array([0.0, 0.0, 1.0]) - up * up[:, 2:]
    above = np.array([0.0, -1.0, 0.0]) + up * up[:, 1:2]
    ahead = np.where(np.linalg.norm(ahead, axis=-1, keepdims=True) > 1e-3, ahead, above)
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    heading = states[:, _HEADING][:, None]
    first = np.cos(heading) * ahead + np.sin(heading) * np.cross(up, ahead)
    return np.stack([up, first, np.cross(up, first)], 1)
