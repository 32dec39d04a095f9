"""The camera of the clip `gvhmr_tennis` by the lines of the tennis court, the truth that `real_clips.py` compares with.

    python benchmarks/court_camera.py [SCENE_DIR ...]

Points on lines were read off the first frame to half a pixel; where the lines are is in the Rules of Tennis of the
International Tennis Federation (appendix IX: 23.77 m long, 10.97 m wide, singles sidelines 1.37 m inside, service lines
6.40 m from the net, all to the outer edge). Focal length, pose and radial distortion are fitted by least squares of the
image distance between points and lines. Prints the focal length with its standard deviation, the camera's height, and
what is left; and for scene folders of the clip, what their cameras say of the same: focal length, gravity, height, and
two lengths on the ground, both as shares of the true ones.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from video2anim.lab.eval.results import SceneResult
from video2anim.types import BodyMotion, MetricDepth

SIZE_PX = np.array([812, 720])
HALF_LENGTH_M, HALF_WIDTH_M, SINGLES_M, SERVICE_M, HALF_LINE_M = 11.885, 5.485, 4.115, 6.40, 0.025
ACROSS = {
    -HALF_LENGTH_M: [(5, 649), (200, 657), (400, 663), (600, 668), (700, 670), (805, 672)],
    -SERVICE_M - HALF_LINE_M: [(270, 449.5), (300, 450.5), (500, 451.5), (650, 452.5), (750, 452)],
    SERVICE_M: [(552.5, 304.8)],
    HALF_LENGTH_M - HALF_LINE_M: [(523.5, 279.5), (610.8, 279.5), (700, 279.2)],
}
"""Points (pixels) on lines parallel to the net, by how far behind it they are (m): the outer edge of the near baseline,
and centers of lines."""
ALONG = {
    0.0: [(726, 672), (807, 452.7)],
    HALF_LINE_M - SINGLES_M: [
        (5, 528.5), (40, 514.5), (80, 497.5), (120, 480.5), (160, 464.5), (610.8, 279.5), (552.5, 304.8),
    ],
    HALF_LINE_M - HALF_WIDTH_M: [(5, 449.5), (40, 437.5), (80, 424.5), (120, 411.5), (160, 398.5), (523.5, 279.5)],
}  # fmt: skip
"""Points on lines along the court, by how far to the right of its middle they are (m)."""
LENGTHS = {
    "baseline to service line": ((726, 672), (807, 452.7), HALF_LENGTH_M - SERVICE_M - HALF_LINE_M),
    "service line to the other": ((200.3, 449.3), (552.5, 304.8), 2 * SERVICE_M + HALF_LINE_M),
}
"""Two points (pixels) on the center line or a sideline, and how far apart they are (m)."""


@dataclass(frozen=True, slots=True, eq=False)
class CourtCamera:
    """What the lines say of the camera."""

    focal_px: float
    focal_sigma_px: float
    center_m: Float[np.ndarray, "3"]
    """x to the right, y from the net to the far side, z up, from the middle of the court."""
    up_camera: Float[np.ndarray, "3"]
    """Unit vector against gravity in camera axes."""
    off_px: float
    """Root mean square distance of points from their lines."""


def court_camera() -> CourtCamera:
    """The camera of the first frame."""
    pixel = np.array([point for lines in (ACROSS, ALONG) for points in lines.values() for point in points])
    axis = np.repeat([1, 0], [sum(map(len, ACROSS.values())), sum(map(len, ALONG.values()))])
    at_m = np.array([at for lines in (ACROSS, ALONG) for at, points in lines.items() for _ in points])
    centered = pixel - (SIZE_PX - 1) / 2
    radius = np.linalg.norm(centered / SIZE_PX.max(), axis=1, keepdims=True)

    def off_px(state: np.ndarray) -> np.ndarray:
        focal_px, k1, R, center_m = np.exp(state[0]), state[1], Rotation.from_rotvec(state[2:5]).as_matrix(), state[5:]
        seen = centered * (1 + k1 * radius**2)
        ray = np.c_[seen / focal_px, np.ones(len(seen))] @ R
        ground = center_m - ray * (center_m[2] / ray[:, 2:])
        on_line, rows = ground.copy(), np.arange(len(ground))
        on_line[rows, axis] = at_m
        further = on_line.copy()
        further[rows, 1 - axis] += 0.1
        a, b = (focal_px * x[:, :2] / x[:, 2:] for x in ((on_line - center_m) @ R.T, (further - center_m) @ R.T))
        normal = (b - a)[:, ::-1] * [-1, 1]
        return ((seen - a) * normal).sum(1) / np.linalg.norm(normal, axis=1)

    # Level, behind the near baseline, looking over the net.
    level = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).as_rotvec()
    start = np.r_[np.log(2 * SIZE_PX.max()), 0.0, level, 0.0, -18.0, 2.0]
    fit = least_squares(off_px, start, x_scale="jac")
    variance = 2 * fit.cost / (len(pixel) - len(start))
    focal_px = float(np.exp(fit.x[0]))
    sigma = float((np.linalg.inv(fit.jac.T @ fit.jac)[0, 0] * variance) ** 0.5)
    up = Rotation.from_rotvec(fit.x[2:5]).as_matrix()[:, 2]
    return CourtCamera(focal_px, focal_px * sigma, fit.x[5:], up, float(np.sqrt(np.mean(fit.fun**2))))


def of_scene(body: BodyMotion, truth: CourtCamera) -> str:
    """What the camera of a scene says, against the truth."""
    k, T = body.intrinsics, body.T_world_camera[0]

    def on_ground(pixel: tuple[float, float]) -> np.ndarray:
        ray = T[:3, :3] @ [(pixel[0] - k.cx_px) / k.fx_px, (pixel[1] - k.cy_px) / k.fy_px, 1.0]
        return T[:3, 3] - ray * (T[1, 3] / ray[1])

    off = np.degrees(np.arccos(np.clip(truth.up_camera @ T[1, :3], -1, 1)))
    lengths = [
        f"{name} {np.linalg.norm(on_ground(first) - on_ground(second)) / true_m:.2f}"
        for name, (first, second, true_m) in LENGTHS.items()
    ]
    return (
        f"focal length {k.fx_px / truth.focal_px:.2f}, gravity {off:.1f} degrees off, height "
        f"{T[1, 3] / truth.center_m[2]:.2f}, {', '.join(lengths)}"
    )


def main() -> None:
    """Print the camera, and what scenes say of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*", help="scene folders of the clip")
    options = parser.parse_args()
    camera = court_camera()
    x, y, z = camera.center_m
    sys.stdout.write(
        f"focal length {camera.focal_px:.0f} +- {camera.focal_sigma_px:.0f} px, camera {z:.2f} m high, "
        f"{-y - HALF_LENGTH_M:.2f} m behind the baseline, {x:.2f} m right of the middle; "
        f"points are {camera.off_px:.1f} px from their lines\n"
    )
    for folder in options.scenes:
        metric = SceneResult(folder).get(MetricDepth)
        if metric is None:
            raise SystemExit(f"{folder}: no result of stage metric")
        sys.stdout.write(f"{folder}: {of_scene(metric.bodies.main, camera)}\n")


if __name__ == "__main__":
    main()
