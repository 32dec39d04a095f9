"""Plots of the report as SVG pictures. Uses matplotlib's object interface: no global state, no display."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from scenemi.metrics import GMD_SPEED_M_S
from video2anim.export.frames import CENTIMETERS_PER_METER
from video2anim.export.quality import MotionQuality
from video2anim.types import BodyMotion, Contact, SceneModel
from video2anim.viewer.contacts import touched_name, touched_rgb
from video2anim.viewer.drawing import world_vertices

STAGE_COLORS = {"raw": "#8a8f98", "keyframes": "#d9822b", "refined": "#1f6fb2"}
_WIDTH_IN, _HEIGHT_IN = 8.0, 2.5
_ROW_IN, _FRAME_IN = 0.32, 1.1
"""Height of a row of the timeline, and of its axis and legend."""
_BAR = 0.8
"""Share of its row that a bar, or bars of one time together, fill."""
_LETTER = 0.011
"""Width of a small letter as a share of the plot's: a bar names its surface where there is room."""


def data_uri(content: bytes, media_type: str) -> str:
    """A `data:` address that carries the content itself."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode('ascii')}"


def jerk_plot(qualities: Mapping[str, MotionQuality]) -> str:
    """Jerk over time, one line per stage, as a `data:` address."""
    figure, axes = _figure("jerk (m/s³)", "time (s)")
    for stage, quality in qualities.items():
        axes.plot(quality.time_s, quality.jerk_m_s3, color=STAGE_COLORS[stage], lw=1.2, label=stage)
    axes.set_ylim(bottom=0)
    return _finish(figure, axes)


def clearance_plot(qualities: Mapping[str, MotionQuality]) -> str:
    """Distance of the body's nearest vertex to the scene over time; below zero the body is inside something."""
    figure, axes = _figure("distance (cm)", "time (s)")
    axes.axhspan(-1e3, 0, color="#c0392b", alpha=0.07, lw=0)
    axes.axhline(0, color="#c0392b", lw=0.8)
    lows, highs = [0.0], [0.0]
    for stage, quality in qualities.items():
        clearance_cm = quality.clearance_m * CENTIMETERS_PER_METER
        axes.plot(quality.time_s, clearance_cm, color=STAGE_COLORS[stage], lw=1.2, label=stage)
        finite = clearance_cm[np.isfinite(clearance_cm)]
        lows += finite.tolist()
        highs += finite.tolist()
    margin = 0.08 * (max(highs) - min(lows)) + 0.5
    axes.set_ylim(min(lows) - margin, max(highs) + margin)
    return _finish(figure, axes)


def skating_plot(qualities: Mapping[str, MotionQuality]) -> str:
    """Speed of the toes near the floor over time; gaps where neither foot is near it."""
    figure, axes = _figure("toe speed (m/s)", "time (s)")
    axes.axhline(GMD_SPEED_M_S, color="#c0392b", lw=0.8)
    for stage, quality in qualities.items():
        axes.plot(quality.time_s, quality.skating_m_s, color=STAGE_COLORS[stage], lw=1.2, label=stage)
    axes.set_ylim(bottom=0)
    return _finish(figure, axes)


def path_plot(motions: Mapping[str, BodyMotion], scene: SceneModel | None) -> str:
    """The pelvis from above with the outlines of the objects (convex) where they are at first, and the ways of those
    that somebody moves, dotted."""
    figure, axes = _figure("z (m), towards the viewer", "x (m)", height_in=4.0)
    for placed in scene.objects if scene is not None else ():
        vertices_m = world_vertices(placed)
        if len(vertices_m):
            outline = _hull(vertices_m[:, [0, 2]])
            axes.fill(outline[:, 0], outline[:, 1], color="#4b5563", alpha=0.25, lw=0)
            axes.annotate(placed.label, outline.mean(0), ha="center", va="center", fontsize=8)
        if placed.path:
            way_m = placed.path[0].T_world_object[:, :3, 3]
            axes.plot(way_m[:, 0], way_m[:, 2], color="#4b5563", lw=1, ls=":")
    for stage, motion in motions.items():
        pelvis_m = np.where(motion.valid[:, None], motion.joints_world_m[:, 0], np.nan)
        axes.plot(pelvis_m[:, 0], pelvis_m[:, 2], color=STAGE_COLORS[stage], lw=1.3, label=stage)
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_yaxis()
    return _finish(figure, axes)


def contact_plot(contacts: Sequence[Contact], frame_time_s: np.ndarray) -> str:
    """When the parts of one body touch what: a row per part, bars in the colors of the objects, with their surfaces."""
    parts = list(dict.fromkeys(contact.body_part for contact in contacts))
    figure, axes = _figure("", "time (s)", height_in=_FRAME_IN + _ROW_IN * len(parts))
    last_s = float(frame_time_s[-1])
    frame_s = float(np.median(np.diff(frame_time_s))) if len(frame_time_s) > 1 else 1.0 / 30.0
    shown: set[str] = set()
    for row, part in enumerate(parts):
        bars = [contact for contact in contacts if contact.body_part == part]
        lanes = _lanes(bars)
        height = _BAR / (max(lanes) + 1)
        for contact, lane in zip(bars, lanes, strict=True):
            name, color = touched_name(contact), np.array(touched_rgb(contact.object_id)) / 255.0
            width_s, center = contact.end_s - contact.start_s + frame_s, row - 0.5 * _BAR + (lane + 0.5) * height
            label = None if name in shown else name
            axes.barh(center, width_s, height, contact.start_s, color=color, ec="white", lw=0.5, label=label)
            shown.add(name)
            if contact.surface != name and width_s > _LETTER * len(contact.surface) * (last_s + frame_s):
                at_s = contact.start_s + 0.5 * width_s
                axes.text(at_s, center, contact.surface, color="white", fontsize=7, ha="center", va="center")
    axes.set_yticks(range(len(parts)), parts)
    axes.grid(visible=False, axis="y")
    axes.set_xlim(min(0.0, float(frame_time_s[0])), last_s + frame_s)
    axes.set_ylim(len(parts) - 0.5, -0.5)
    axes.legend(frameon=False, ncols=5, loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize=9)
    return _saved(figure)


def _lanes(bars: Sequence[Contact]) -> list[int]:
    """Lane of each bar, so that none of one time share one."""
    ends_s: list[float] = []
    lanes = []
    for bar in bars:
        lane = next((number for number, end_s in enumerate(ends_s) if end_s < bar.start_s), len(ends_s))
        ends_s[lane : lane + 1] = [bar.end_s]
        lanes.append(lane)
    return lanes


def _figure(y_label: str, x_label: str, height_in: float = _HEIGHT_IN) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(_WIDTH_IN, height_in), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(color="#e3e6ea", lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _finish(figure: Figure, axes: Axes) -> str:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, ncols=3, loc="upper right", fontsize=9)
    return _saved(figure)


def _saved(figure: Figure) -> str:
    target = io.BytesIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "video2anim", "font.family": "sans-serif"}):
        figure.savefig(target, format="svg", metadata={"Date": None})
    return data_uri(target.getvalue(), "image/svg+xml")


def _hull(points: np.ndarray) -> np.ndarray:
    """Convex outline of 2D points; the points themselves where they span no area."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        return points
