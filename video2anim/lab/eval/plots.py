"""Plots of the evaluation as SVG. Matplotlib's object interface: no global state, no display."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from video2anim.export.report_plots import STAGE_COLORS, data_uri
from video2anim.lab.eval.model import Curve, Plan, SetGroup, SetRow

COLORS = {"truth": "#1a7f4b", **STAGE_COLORS}
_WIDTH_IN = 8.0
_PANELS_ACROSS = 3


def curve_plot(curve: Curve) -> str:
    """Plot with one line per series over time, as a `data:` URL."""
    figure = Figure(figsize=(_WIDTH_IN, 2.4), layout="constrained")
    axes = _axes(figure.add_subplot(), "time (s)", curve.unit)
    lows = [0.0]
    for name, values in curve.series.items():
        series = np.array([np.nan if value is None else value for value in values])
        axes.plot(curve.time_s, series, color=COLORS.get(name), lw=1.2, label=name, zorder=3 if name != "raw" else 2)
        lows += [float(series[np.isfinite(series)].min())] if np.isfinite(series).any() else []
    if min(lows) >= 0:
        axes.set_ylim(bottom=0)
    else:
        axes.axhline(0, color="#c0392b", lw=0.8)
    _legend(axes)
    return _svg(figure)


def plan_plot(plan: Plan) -> str:
    """Plot of the floor plan, as a `data:` URL."""
    figure = Figure(figsize=(_WIDTH_IN, 4.2), layout="constrained")
    axes = _axes(figure.add_subplot(), "x (m)", "z (m)")
    for label, corners in plan.true_outlines_m:
        points = np.array(corners)
        axes.fill(points[:, 0], points[:, 1], color=COLORS["truth"], alpha=0.22, lw=0)
        axes.annotate(label, points.mean(0), ha="center", va="center", fontsize=8)
    for _, corners in plan.outlines_m:
        points = np.array([*corners, corners[0]])
        axes.plot(points[:, 0], points[:, 1], color=COLORS["refined"], lw=1.0, ls="--")
    for name, path in plan.paths_m.items():
        points = np.array(path).reshape(-1, 2)
        axes.plot(points[:, 0], points[:, 1], color=COLORS.get(name), lw=2.2 if name == "truth" else 1.2, label=name)
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_yaxis()
    _legend(axes)
    return _svg(figure)


def stages_plot(group: SetGroup, rows: Sequence[SetRow]) -> str:
    """One panel per number: a thin line per clip over the stages, the mean with its interval, and the truth."""
    down = -(-len(rows) // _PANELS_ACROSS)
    figure = Figure(figsize=(_WIDTH_IN, 2.3 * down), layout="constrained")
    places = np.arange(len(group.columns))
    for i, row in enumerate(rows):
        axes = _axes(figure.add_subplot(down, _PANELS_ACROSS, i + 1), "", "")
        axes.set_title(f"{row.label} ({row.unit})", fontsize=9)
        clips = np.array([[np.nan if v is None else v for v in column] for column in row.values]).T
        for line in clips:
            axes.plot(places, line, color="#8a8f98", lw=0.7, alpha=0.6, marker=".", ms=3)
        for place, column, found in zip(places, group.columns, row.statistics, strict=True):
            if found is not None:
                error = [[max(0.0, found.mean - found.low)], [max(0.0, found.high - found.mean)]]
                color = COLORS.get(column, COLORS["refined"])
                axes.errorbar(place, found.mean, error, fmt="o", color=color, ms=5, capsize=3, zorder=4)
        if row.truth_mean is not None:
            axes.axhline(row.truth_mean, color=COLORS["truth"], lw=1.2, ls="--")
        axes.set_xticks(places, group.columns, fontsize=8)
        axes.tick_params(axis="y", labelsize=8)
        axes.set_xlim(-0.4, len(places) - 0.6)
        if np.nanmin(clips, initial=0.0) >= 0:
            axes.set_ylim(bottom=0)
    return _svg(figure)


def _axes(axes: Axes, x_label: str, y_label: str) -> Axes:
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(color="#e3e6ea", lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def _legend(axes: Axes) -> None:
    """A legend above the plot, where it covers no line."""
    axes.legend(frameon=False, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=9, borderaxespad=0.1)


def _svg(figure: Figure) -> str:
    target = io.BytesIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "video2anim", "font.family": "sans-serif"}):
        figure.savefig(target, format="svg", metadata={"Date": None})
    return data_uri(target.getvalue(), "image/svg+xml")
