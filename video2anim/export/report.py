"""`report.html`: one self-contained page that explains a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from video2anim import __version__
from video2anim.export import report_plots
from video2anim.export.quality import VERTEX_STRIDE, MotionQuality, measured_span, motion_quality
from video2anim.types import BodyMotion, CameraEstimate, Contact, SceneModel
from video2anim.types.clip import FPS
from video2anim.types.motion import main_person
from video2anim.types.quality import Quality

STAGE_ORDER = ("raw", "keyframes", "refined")


@dataclass(frozen=True, slots=True)
class StageRow:
    """One stage as its manifest tells it."""

    name: str
    state: str
    """`ran`, `cached` or `not run`."""
    version: int
    wall_time_s: float
    peak_memory_mb: float | None
    qualities: tuple[Quality, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ModelRow:
    """A model that the run used."""

    name: str
    license: str
    source: str = ""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture with its caption."""

    caption: str
    png: bytes


@dataclass(frozen=True, slots=True)
class FoundPerson:
    """A tracked person as the page lists them."""

    person_id: int
    png: bytes
    """Thumbnail."""
    valid_share: float
    mean_score: float
    used: bool
    """Whether the later stages work on this person."""
    doubts: tuple[str, ...] = ()
    """Reasons not to trust the fitted motion."""


@dataclass(frozen=True, slots=True, eq=False)
class ReportInput:
    """Everything the page shows. What is absent is left out of the page, not made up."""

    title: str
    """Name of the input."""
    stages: tuple[StageRow, ...]
    models: tuple[ModelRow, ...] = ()
    camera: CameraEstimate | None = None
    motions: Mapping[str, tuple[BodyMotion, ...]] = field(default_factory=dict)
    """People by stage: any of `raw`, `keyframes`, `refined`, the same persons in the same order."""
    priors: tuple[str, ...] = ()
    """In-betweening prior of each person of `refined`, and the share of the frames that it shaped."""
    scene: SceneModel | None = None
    pictures: tuple[Picture, ...] = ()
    moments: tuple[Picture, ...] = ()
    """The worst moments of the refined motion."""
    made_with: Mapping[str, str] = field(default_factory=dict)
    """Seed, device, and versions of what decides results, by name."""
    found: tuple[FoundPerson, ...] = ()
    contacts: tuple[Contact, ...] = ()
    """What the people of `refined` touch."""


def render_report(report: ReportInput) -> str:
    """The page as HTML text, with pictures and plots inside."""
    environment = Environment(
        loader=PackageLoader("video2anim.export"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["number"] = format_number
    return environment.get_template("report.html.j2").render(
        version=__version__,
        report=report,
        camera=_camera_facts(report.camera),
        people=[_person(report, index) for index in range(_person_count(report))],
        pictures=[(picture.caption, report_plots.data_uri(picture.png, "image/png")) for picture in report.pictures],
        moments=[(moment.caption, report_plots.data_uri(moment.png, "image/png")) for moment in report.moments],
        found=[(person, report_plots.data_uri(person.png, "image/png")) for person in report.found],
        moved=_moved_objects(report),
        total_s=sum(stage.wall_time_s for stage in report.stages),
        peak_mb=max((stage.peak_memory_mb for stage in report.stages if stage.peak_memory_mb), default=None),
        warnings=[(stage.name, text) for stage in report.stages for text in stage.warnings],
        vertex_stride=VERTEX_STRIDE,
    )


def format_number(value: float | None) -> str:
    """Three significant digits without an exponent for everyday sizes; `n/a` for None and NaN."""
    if value is None or not math.isfinite(value):
        return "n/a"
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        digits = 0 if value == 0 else max(0, 2 - math.floor(math.log10(abs(value))))
        text = f"{value:.{digits}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    return f"{value:.2e}"


def _person_count(report: ReportInput) -> int:
    return max((len(people) for people in report.motions.values()), default=0)


def _person(report: ReportInput, index: int) -> dict[str, Any]:
    """Table and plots of one person."""
    motions = {name: report.motions[name][index] for name in STAGE_ORDER if len(report.motions.get(name, ())) > index}
    first = next(iter(motions.values()))
    span = measured_span(first)
    facts = {
        "id": first.person_id,
        "prior": report.priors[index] if index < len(report.priors) else "",
        "frames": first.frame_count,
        "unmeasured": int((~first.valid).sum()),
        "stages": list(motions),
        "rows": [],
        "plots": [],
    }
    if span is None:
        return facts
    qualities = {name: motion_quality(motion, report.scene, span, FPS) for name, motion in motions.items()}
    facts["rows"] = _comparison(qualities)
    facts["plots"] = [
        ("Jerk over time", report_plots.jerk_plot(qualities)),
        ("Feet near the floor: speed over time (over the line: skating)", report_plots.skating_plot(qualities)),
    ]
    if report.scene is not None:
        facts["plots"].append(("Body against scene", report_plots.clearance_plot(qualities)))
    contacts = [contact for contact in report.contacts if contact.person_id == first.person_id]
    if contacts:
        facts["plots"].append(
            ("What touches what, refined motion", report_plots.contact_plot(contacts, first.frame_time_s))
        )
    facts["plots"].append(("Path of the pelvis from above", report_plots.path_plot(motions, report.scene)))
    return facts


def _comparison(qualities: Mapping[str, MotionQuality]) -> list[dict[str, Any]]:
    """One row per number: its value at each stage, and whether the last is better than the first."""
    rows = []
    for numbers in zip(*(quality.numbers for quality in qualities.values()), strict=True):
        first, last = numbers[0], numbers[-1]
        sign = {"lower": -1.0, "higher": 1.0, "none": 0.0}[first.better]
        gain = sign * (last.value - first.value)
        verdict = "better" if gain > 0 else "worse" if gain < 0 else "same"
        rows.append(
            {
                "name": first.label,
                "unit": first.unit,
                "better": first.better,
                "values": [number.value for number in numbers],
                "verdict": verdict if math.isfinite(gain) and len(numbers) > 1 else "",
            }
        )
    return rows


def _moved_objects(report: ReportInput) -> list[dict[str, Any]]:
    """One row per stretch in which somebody has an object in hand: who, with which hand, when, and how far it went."""
    people = next(iter(report.motions.values()), ())
    if report.scene is None or not people:
        return []
    time_s, rows = main_person(people).frame_time_s, []
    for placed in report.scene.objects:
        for hold in placed.holds:
            held = slice(max(0, hold.first_frame - 1), hold.last_frame + 1)
            way_m = placed.path[0].T_world_object[held, :3, 3]
            rows.append(
                {
                    "name": f"{placed.label} {placed.object_id}",
                    "person": hold.person_id,
                    "hand": hold.hand,
                    "start_s": float(time_s[hold.first_frame]),
                    "end_s": float(time_s[hold.last_frame]),
                    "way_m": float(np.linalg.norm(np.diff(way_m, axis=0), axis=-1).sum()),
                }
            )
    return sorted(rows, key=lambda row: row["start_s"])


def _camera_facts(camera: CameraEstimate | None) -> list[tuple[str, str]]:
    if camera is None:
        return []
    lens = camera.intrinsics
    fov_y_deg = math.degrees(2.0 * math.atan2(0.5 * lens.height_px, lens.fy_px))
    sigma_px = camera.focal_sigma_ratio * lens.fy_px
    return [
        ("focal length", f"{lens.fy_px:.0f} ± {sigma_px:.0f} px, from {camera.focal_source}"),
        ("vertical field of view", f"{fov_y_deg:.1f}°"),
        ("picture", f"{lens.width_px} x {lens.height_px} px"),
        ("up direction", f"± {math.degrees(camera.up_sigma_rad):.1f}°"),
        ("motion", "static" if camera.is_static else "moving"),
    ]
