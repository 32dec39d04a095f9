"""The report page: self-contained, honest about gaps, numbers equal to the metrics."""

from __future__ import annotations

import base64
import dataclasses
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from walk_scene import room, room_with_carried_box, walk

from scenemi import metrics
from video2anim.export.quality import measured_span, motion_quality, worst_moments
from video2anim.export.report import ModelRow, Picture, ReportInput, StageRow, format_number, render_report
from video2anim.export.report_plots import contact_plot
from video2anim.pipeline.stage import Quality
from video2anim.types import BodyMotion, CameraEstimate, Contact
from video2anim.viewer.contacts import touched_rgb

FRAMES = 40
PNG = b"\x89PNG\r\n\x1a\n"
VOID = {"meta", "img", "br"}


class Balanced(HTMLParser):
    """Fails on tags that are not closed in order; collects addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def shaken(motion: BodyMotion) -> BodyMotion:
    noise_m = np.random.default_rng(3).normal(0, 0.01, (motion.frame_count, 3))
    return motion.with_pose(
        translation_world_m=motion.T_world_root[:, :3, 3] + noise_m, R_parent_joint=motion.R_parent_joint
    )


@pytest.fixture(scope="module")
def page() -> str:
    motion = walk(FRAMES)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    camera = CameraEstimate(motion.intrinsics, "picture", 0.06, np.array([0, -1.0, 0]), 0.05, True, poses)
    stages = (
        StageRow("ingest", "ran", 1, 2.5, 210.0, (Quality("frames", 40, "count", "none"),), ("the camera <moves>",)),
        StageRow("refine", "cached", 3, 12.25, 1210.0),
    )
    return render_report(
        ReportInput(
            "clip & <b>.mp4", stages, (ModelRow("blazepose-heavy", "Apache-2.0"),), camera,
            {"raw": (shaken(motion),), "refined": (motion,)}, ("interpolation",), room(), (Picture("frame 3", PNG),),
            (Picture("deepest penetration: frame 5", PNG),),
        )
    )  # fmt: skip


def test_page_is_well_formed_and_self_contained(page: str) -> None:
    parser = Balanced()
    parser.feed(page)
    assert parser.open == []
    assert len(parser.addresses) == 6, "two pictures, and plots of jerk, toes, clearance and path"
    assert "deepest penetration: frame 5" in page
    assert all(address.startswith("data:image/") for address in parser.addresses)
    assert "<b>.mp4" not in page
    assert "clip &amp; &lt;b&gt;.mp4" in page
    assert "the camera &lt;moves&gt;" in page


def test_page_tells_camera_models_and_stages(page: str) -> None:
    assert "500 ± 30 px, from picture" in page
    assert "blazepose-heavy</td><td>Apache-2.0" in page
    assert re.search(r"refine <small>v3</small></td><td>cached</td><td class=\"n\">12\.2", page)
    assert "storage box" in page
    assert "in-betweening prior: interpolation" in page


def test_table_shows_the_metric_itself_and_the_verdict(page: str) -> None:
    motion = walk(FRAMES)
    before, after = (metrics.jerk_m_s3(m.joints_world_m, 30.0) for m in (shaken(motion), motion))
    row = re.search(
        r"<td>jerk</td><td class=\"n\">(.*?)</td><td class=\"n\">(.*?)</td>.*?(better|worse|same)</td></tr>", page
    )
    assert row is not None
    assert row.groups() == (format_number(before), format_number(after), "better")


def test_quality_covers_measured_frames_only() -> None:
    motion = walk(FRAMES)
    valid = motion.valid.copy()
    valid[:5] = False
    motion = dataclasses.replace(motion, valid=valid)
    span = measured_span(motion)
    assert span == slice(5, FRAMES)
    quality = motion_quality(motion, None, span, 30.0)
    assert len(quality.time_s) == FRAMES - 5
    assert np.nanmean(quality.jerk_m_s3) == pytest.approx(quality.numbers[0].value)
    assert np.isnan(quality.clearance_m).all()


def test_sunk_body_is_reported_as_penetration() -> None:
    motion = walk(FRAMES)
    sunk = motion.with_pose(
        translation_world_m=motion.T_world_root[:, :3, 3] - [0, 0.3, 0], R_parent_joint=motion.R_parent_joint
    )
    numbers = {q.key: q.value for q in motion_quality(sunk, room(), slice(0, FRAMES), 30.0).numbers}
    assert numbers["frames_in_collision"] == 1.0
    assert 0.25 < numbers["penetration_max"] < 0.45
    assert numbers["floating"] == 0.0


def test_worst_moments_are_the_frames_that_are_worst() -> None:
    """One frame 0.3 m under the floor, and a jump of 0.5 m to the side between two others."""
    motion = walk(FRAMES)
    root_m = motion.T_world_root[:, :3, 3].copy()
    root_m[12, 1] -= 0.3
    root_m[20:, 0] += 0.5
    bad = motion.with_pose(translation_world_m=root_m, R_parent_joint=motion.R_parent_joint)
    span = slice(4, FRAMES)
    moments = {moment.key: moment for moment in worst_moments(motion_quality(bad, room(), span, 30.0), span)}
    assert moments["penetration_max"].frame == 12
    assert 0.25 < moments["penetration_max"].value < 0.45
    assert abs(moments["jerk_max"].frame - 20) <= 2
    assert [m.key for m in worst_moments(motion_quality(motion, None, span, 30.0), span)].count(
        "penetration_max"
    ) == 0, "without a scene nothing is penetrated"


def test_skating_is_the_horizontal_speed_of_a_low_toe() -> None:
    """Somebody who stands and slides by 1 m/s; half a meter up the toes are not near the floor."""
    motion = walk(FRAMES)
    still = np.repeat(motion.R_parent_joint[:1], FRAMES, axis=0)
    root_m = np.repeat(motion.T_world_root[:1, :3, 3], FRAMES, axis=0)
    root_m[:, 0] += np.arange(FRAMES) / 30.0
    low_m = motion.joints_world_m[0, [10, 11], 1].min()
    on_floor, raised = (
        motion.with_pose(translation_world_m=root_m + np.array([0, lift - low_m, 0]), R_parent_joint=still)
        for lift in (0.01, 0.5)
    )
    found = motion_quality(on_floor, None, slice(0, FRAMES), 30.0).skating_m_s
    np.testing.assert_allclose(found[1:], 1.0, atol=1e-6)
    assert np.isnan(found[0])
    assert np.isnan(motion_quality(raised, None, slice(0, FRAMES), 30.0).skating_m_s).all()


def test_nobody_and_nothing_still_gives_a_page() -> None:
    page = render_report(ReportInput("empty.mp4", ()))
    assert "empty.mp4" in page
    assert "Person" not in page


def test_person_never_measured_is_said() -> None:
    motion = dataclasses.replace(walk(FRAMES), valid=np.zeros(FRAMES, bool))
    assert "Too few measured frames" in render_report(ReportInput("x", (), motions={"raw": (motion,)}))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (12.25, "12.2"),
        (1234.6, "1235"),
        (0.01234, "0.0123"),
        (0.5, "0.5"),
        (float("nan"), "n/a"),
        (1e-7, "1.00e-07"),
        (230.0, "230"),
    ],
)
def test_format_number(value: float, text: str) -> None:
    assert format_number(value) == text


def test_a_number_that_was_not_measured_is_not_a_zero() -> None:
    from video2anim.export.report import format_number

    assert format_number(None) == format_number(float("nan")) == "n/a"
    assert format_number(0.0) == "0"


def test_memory_that_was_not_measured_is_not_told() -> None:
    page = render_report(ReportInput("x.mp4", (StageRow("ingest", "ran", 1, 2.5, None),)))
    assert "at most" not in page
    assert re.search(r"ingest <small>v1</small></td><td>ran</td><td class=\"n\">2\.5</td><td class=\"n\">n/a", page)


def test_timeline_has_a_row_per_part_and_a_color_per_object() -> None:
    motion = walk(FRAMES)
    table = [Contact(motion.person_id, "left hand", 2, "table", where, 0.0, 1.0, 0.0, 0.0) for where in ("top", "side")]
    floor = Contact(motion.person_id, "left foot", None, "floor", "floor", 0.5, 1.0, 0.0, 0.0)
    uri = contact_plot([*table, floor], motion.frame_time_s)
    svg = base64.b64decode(uri.split(",")[1]).decode()
    words = re.findall(r">([^<>]+)</text>", svg)
    assert [words.count(word) for word in ("left hand", "left foot", "table 2", "floor")] == [1, 1, 1, 1]
    assert {"top", "side"} <= set(words), "both bars have room for their surface"
    colors = [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in (touched_rgb(2), touched_rgb(None))]
    assert [svg.count(f"fill: {color}") for color in colors] == [3, 2], "bars, and one in the legend"


def test_page_shows_the_timeline_of_the_person_who_touches() -> None:
    motion = walk(FRAMES)
    contact = Contact(motion.person_id, "left foot", None, "floor", "floor", 0.5, 1.0, 0.0, 0.0)
    report = ReportInput("clip.mp4", (), motions={"refined": (motion,)}, contacts=(contact,))
    title = "What touches what"
    assert title in render_report(report)
    assert title not in render_report(dataclasses.replace(report, contacts=()))
    others = dataclasses.replace(contact, person_id=motion.person_id + 1)
    assert title not in render_report(dataclasses.replace(report, contacts=(others,)))


def test_page_tells_who_moved_what_how_far() -> None:
    motion, scene = walk(FRAMES), room_with_carried_box(FRAMES)
    page = render_report(ReportInput("clip.mp4", (), motions={"refined": (motion,)}, scene=scene))
    (placed,) = scene.objects
    (hold,) = placed.holds
    way_m = np.linalg.norm(np.diff(placed.path[0].T_world_object[:, :3, 3], axis=0), axis=-1)
    row = re.search(
        r"<td>storage box 3</td><td>1</td><td>right hand</td>"
        r"<td class=\"n\">(.*?)</td><td class=\"n\">(.*?)</td><td class=\"n\">(.*?)</td></tr>",
        page,
    )
    assert row is not None
    start_s, end_s = motion.frame_time_s[[hold.first_frame, hold.last_frame]]
    held_m = way_m[hold.first_frame - 1 : hold.last_frame].sum()
    assert row.groups() == tuple(map(format_number, (start_s, end_s, held_m)))
    assert "Moved objects" not in render_report(ReportInput("clip.mp4", (), motions={"raw": (motion,)}, scene=room()))
