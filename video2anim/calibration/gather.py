"""Evidence of the fit from the results of the stages before."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import lowest_points, posed_vertices
from video2anim.calibration.evidence import (
    FLOOR,
    ROOM,
    Evidence,
    ObjectEvidence,
    PersonEvidence,
    PixelEvidence,
    PointEvidence,
    SkinEvidence,
)
from video2anim.calibration.fit import MIN_CAMERA_M, USUAL_HEIGHT_M
from video2anim.calibration.line import first_line, metric_depth
from video2anim.geometry.line_of_sight import visible_vertices
from video2anim.geometry.masks import shrunk
from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.humans.ground import SUPPORT_WINDOW_S
from video2anim.types import BackgroundImage, BodyMotion, BodyTracks, CameraEstimate, DepthClip, InstanceMasks

USUAL_OFFSET = {"room-depth": (1.25, 0.6)}
"""Offset of depth over scale times the median absolute value, and its standard deviation, by network: of the shipped
one in the rooms of V2A-Bench (geometric mean 1.22)."""
_OTHER_DEPTH, _OTHER_DISPARITY = (0.0, 0.3), (0.5, 5.0)
"""The same of unknown networks, for depth and disparity. The zero of disparity may be right behind the farthest wall,
which may have the median value."""
_POINTS, _MIN_PIXELS = 300, 40
"""Points of skin and depth in a frame that enter (and of the floor), and how many there must be of either."""
_OUTLIER_RATIO = 0.05
"""Share of an object's pixels that are outliers of its mask, and are left out before an extreme is taken: of its lower
ends, which are above the floor between the legs, and of its heights."""
_MIN_COLUMNS, _MIN_SHARE = 6, 0.15
"""Least number of an object's columns that end on the floor, and their least share."""
_MIN_STOOD = 2
"""Least number of soles that stood on an object: a single one may be an error of the mask."""


def person_evidence(body: BodyMotion, fps: float, body_height_sigma_m: float) -> PersonEvidence:
    """What supports one person, in the camera frame of the first frame."""
    shaped = shaped_body(body.shape)
    frames = np.flatnonzero(body.valid)
    _, lowest_m = lowest_points(body, shaped, frames)
    windows = np.array_split(np.arange(len(frames)), max(1, round(len(frames) / max(1.0, SUPPORT_WINDOW_S * fps))))
    # The tenth percentile: the lowest is the worst outlier.
    low = [some[np.argsort(lowest_m[some, 1])[len(some) // 10]] for some in windows if len(some)]
    T_first_world = invert_rigid(body.view().T_world_camera)
    return PersonEvidence(
        person_id=body.person_id,
        body_height_sigma=body_height_sigma_m / float(np.ptp(shaped.rest_vertices_m[:, 1])),
        support_m=transform_points(T_first_world, lowest_m[low].reshape(-1, 3)),
        camera_m=transform_points(T_first_world, body.T_world_camera[frames[low], :3, 3].reshape(-1, 3)),
    )


def picture_evidence(
    depth: DepthClip,
    background: BackgroundImage,
    bodies: BodyTracks,
    floor: Bool[np.ndarray, "height width"],
    fps: float,
    rng: np.random.Generator,
) -> Evidence:
    """All evidence except objects; `floor` has the size of the depth map."""
    main = bodies.main
    pairs = zip(bodies.people, bodies.quality, strict=True)
    people = tuple(person_evidence(body, fps, judged.body_height_sigma_m) for body, judged in pairs)
    other = _OTHER_DEPTH if depth.kind == "depth" else _OTHER_DISPARITY
    usual, spread = USUAL_OFFSET.get(depth.provider, other)
    return Evidence(
        focal_px=main.intrinsics.fx_px,
        up=main.view().T_world_camera[1, :3],
        people=people,
        kind=depth.kind,
        skin=skin_evidence(depth, background, main, rng),
        floor=_floor_pixels(depth, main, people, floor),
        objects=(),
        usual_offset=usual,
        usual_offset_sigma=spread,
        median_value=_median_size(depth.background_value),
        path_log_sigma=bodies.path_log_sigma,
    )


def _median_size(value: Float[np.ndarray, "height width"]) -> float:
    """Median absolute value; the largest one where the median is 0, and 1 where all are 0."""
    size = np.abs(value)
    return float(np.median(size)) or float(size.max()) or 1.0


def with_points(
    evidence: Evidence, depth: DepthClip, camera: CameraEstimate, main: BodyMotion, masks: InstanceMasks
) -> Evidence:
    """The evidence with the points that a traveling camera has passed, where the first frame shows them."""
    first, paths = camera.points.in_first_frame, (main.T_world_camera, camera.T_first_camera)
    if not (camera.travels and first.any()):
        return evidence
    length_m, length = (np.linalg.norm(T[:, :3, 3] - T[0, :3, 3], axis=1).max() for T in paths)
    point_m = camera.points.place[first] * length_m / length
    shape = depth.background_value.shape
    row, column, inside = _pixels_of(point_m, main, shape)
    inside &= depth.background_valid[row, column]
    if not inside.any():
        return evidence
    surface = np.full(shape, ROOM)
    surface[shrunk(masks.floor_mask, shape)] = FLOOR
    for number, one in enumerate(masks.instances):
        surface[shrunk(one.mask, shape)] = number
    row, column = row[inside], column[inside]
    seen = PixelEvidence(point_m[inside] / point_m[inside, 2:], depth.background_value[row, column].astype(np.float64))
    log_sigma = camera.points.log_sigma[first][inside]
    return replace(evidence, points=PointEvidence(seen, point_m[inside, 2], log_sigma, surface[row, column]))


def with_objects(evidence: Evidence, depth: DepthClip, main: BodyMotion, masks: InstanceMasks) -> Evidence:
    """The evidence with that of the objects."""
    depth_m = first_depth_m(evidence, depth, main)
    floor = shrunk(masks.floor_mask, depth_m.shape)
    measurer = _ObjectMeasurer(
        depth.background_value, depth_m, depth.background_valid & np.isfinite(depth_m), floor, main
    )
    own = [(one, shrunk(one.mask, depth_m.shape)) for one in masks.instances]
    seen = (measurer.object(one.object_id, one.label, mask, evidence.people[0]) for one, mask in own)
    return replace(evidence, objects=tuple(seen))


def first_depth_m(evidence: Evidence, depth: DepthClip, main: BodyMotion) -> Float[np.ndarray, "height width"]:
    """Depth of the background image in meters by the initial line and the camera of stage humans; NaN where unknown."""
    line = first_line(evidence, max(float(main.view().T_world_camera[1, 3]), MIN_CAMERA_M))
    return metric_depth(depth.kind, depth.background_value, *line)


def skin_evidence(
    depth: DepthClip, background: BackgroundImage, body: BodyMotion, rng: np.random.Generator
) -> tuple[SkinEvidence, ...]:
    """Skin and depth in frames that have the main person's body and enough valid pixels of it."""
    reliable = background.of_frames(depth.frame_index).selected_mask & depth.valid
    samples = np.flatnonzero((reliable.sum((1, 2)) >= _MIN_PIXELS) & body.valid[depth.frame_index])
    if not len(samples):
        return ()
    shaped, found = shaped_body(body.shape), []
    skins_m = posed_vertices(body, shaped, None, depth.frame_index[samples])
    for sample, skin_world_m in zip(samples, skins_m, strict=True):
        frame = depth.frame_index[sample]
        T = invert_rigid(body.T_world_camera[frame])
        skin_m = transform_points(T, skin_world_m)
        seen = np.flatnonzero(visible_vertices(skin_m, shaped.faces, body.intrinsics))
        if len(seen) < _MIN_PIXELS:
            continue
        rows, columns = rng.permutation(np.argwhere(reliable[sample]))[:_POINTS].T
        found.append(
            SkinEvidence(
                skin_m[rng.permutation(seen)[:_POINTS]],
                _rays(rows, columns, body, depth.value.shape[1:]),
                depth.value[sample, rows, columns].astype(np.float64),
            )
        )
    return tuple(found)


def _pixels_of(
    points_m: np.ndarray, body: BodyMotion, shape: tuple[int, ...]
) -> tuple[Int[np.ndarray, "points"], Int[np.ndarray, "points"], Bool[np.ndarray, "points"]]:
    """Row and column of points in an image of a shape, and whether they are in it; 0 if not."""
    column, row = np.round(project(points_m, body.intrinsics.resized(shape[1], shape[0]))).astype(int).T
    inside = (points_m[:, 2] > 0.1) & (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    return np.where(inside, row, 0), np.where(inside, column, 0), inside


def _rays(rows: Any, columns: Any, body: BodyMotion, shape: tuple[int, ...]) -> np.ndarray:
    """(..., 3) viewing rays of unit z-depth of the pixels of an image of a shape."""
    k = body.intrinsics.resized(shape[1], shape[0])
    x, y = (columns - k.cx_px) / k.fx_px, (rows - k.cy_px) / k.fy_px
    return np.stack([x, y, np.ones_like(x)], -1)


def _floor_pixels(
    depth: DepthClip, main: BodyMotion, people: tuple[PersonEvidence, ...], floor: Bool[np.ndarray, "height width"]
) -> PixelEvidence:
    """Pixels inside of segmented floor, evenly spread over the logarithm of distance, and those under standing feet."""
    shape = depth.background_value.shape
    sure = cv2.erode(floor.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    for person in people:
        row, column, inside = _pixels_of(person.support_m, main, shape)
        sure[row[inside], column[inside]] = True
    rows, columns = np.nonzero(sure & depth.background_valid)
    ray = _rays(rows, columns, main, shape)
    T = main.view().T_world_camera
    down = -ray @ T[1, :3]
    reach_m = max(float(T[1, 3]), MIN_CAMERA_M) / np.maximum(down, 1e-6)
    usable = np.flatnonzero(down > 0.02)
    if len(usable) > _POINTS:
        order = usable[np.argsort(reach_m[usable])]
        log = np.log(reach_m[order])
        wanted = np.linspace(log[0], log[-1], _POINTS)
        usable = order[np.unique(np.searchsorted(log, wanted).clip(0, len(order) - 1))]
    value = depth.background_value[rows[usable], columns[usable]].astype(np.float64)
    return PixelEvidence(ray[usable], value)


class _ObjectMeasurer:
    """Measures objects in the background image."""

    def __init__(
        self, value: np.ndarray, depth_m: np.ndarray, known: np.ndarray, floor: np.ndarray, main: BodyMotion
    ) -> None:
        T = main.view().T_world_camera
        self.value, self.depth_m, self.known, self.floor, self.main = value, depth_m, known, floor, main
        rows, columns = np.indices(value.shape)
        self.ray = _rays(rows, columns, main, value.shape)
        self.up, self.height_m = T[1, :3], float(T[1, 3])
        self.rise = self.ray @ self.up

    def object(
        self,
        object_id: int,
        label: str,
        own: Bool[np.ndarray, "height width"],
        main: PersonEvidence,
    ) -> ObjectEvidence:
        """Evidence of one object."""
        foot, cut = self._foot(own)
        soles = self._under_feet(own, main)
        # What people stand on may be the floor, but not above the camera.
        if soles is not None and (soles.skin_m @ self.up < 0).any():
            foot = None
        top = self._top(own) if foot is not None and label in USUAL_HEIGHT_M and not own[0].any() else None
        return ObjectEvidence(object_id, label, foot, cut, top, soles)

    def _under_feet(self, own: np.ndarray, main: PersonEvidence) -> SkinEvidence | None:
        """What stood inside the object's mask, where the background image shows the object."""
        inner = cv2.erode(own.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & self.known
        row, column, inside = _pixels_of(main.support_m, self.main, own.shape)
        inside &= inner[row, column]
        if inside.sum() < _MIN_STOOD:
            return None
        row, column, sole_m = row[inside], column[inside], main.support_m[inside]
        value = self.value[row, column].astype(np.float64)
        # From below its top is hidden, and the pixel is at its edge, where depth may be that of what is behind.
        value[sole_m @ self.up > 0] = np.median(self.value[inner])
        return SkinEvidence(sole_m, self.ray[row, column], value)

    def _at(self, row: int, column: int) -> PixelEvidence:
        return PixelEvidence(self.ray[[row], [column]], self.value[[row], [column]].astype(np.float64))

    def _foot(self, own: np.ndarray) -> tuple[PixelEvidence | None, bool]:
        """Its lowest pixel on the floor, and whether the image border cuts it."""
        cut = bool(own[-1].any() or own[:, 0].any() or own[:, -1].any())
        inner = cv2.erode(own.astype(np.uint8), np.ones((2, 2), np.uint8)).astype(bool) & self.known
        columns = np.flatnonzero(own.any(0) & inner.any(0))
        if not len(columns) or self.height_m <= 0.1:
            return None, cut
        rows = len(own)
        lowest = rows - 1 - np.argmax(own[::-1, columns], axis=0)
        inside = rows - 1 - np.argmax(inner[::-1, columns], axis=0)
        on_floor = self.floor[np.minimum(lowest + 2, rows - 1), columns]
        rise = self.rise[lowest, columns]
        stands = np.flatnonzero((lowest < rows - 2) & on_floor & (rise < -0.02) & (lowest - inside < 4))
        if len(stands) < max(_MIN_COLUMNS, _MIN_SHARE * len(columns)):
            return None, cut
        ratio = np.log(self.height_m / -rise[stands] / self.depth_m[inside[stands], columns[stands]])
        chosen = stands[np.argsort(ratio)[int(_OUTLIER_RATIO * len(stands))]]
        at = self._at(int(inside[chosen]), int(columns[chosen]))
        return PixelEvidence(self.ray[[lowest[chosen]], [columns[chosen]]], at.value), cut

    def _top(self, own: np.ndarray) -> PixelEvidence | None:
        rows, columns = np.nonzero(own & self.known)
        if len(rows) < _MIN_PIXELS:
            return None
        height_m = self.height_m + self.depth_m[rows, columns] * self.rise[rows, columns]
        chosen = np.argsort(height_m)[int((1 - _OUTLIER_RATIO) * len(rows))]
        return self._at(int(rows[chosen]), int(columns[chosen]))
