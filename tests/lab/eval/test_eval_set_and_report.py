"""Sets of clips, JSON, the page, and the two commands."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import typer
from scipy.stats import bootstrap
from tiny_truth import STAGES, Tiny, people_edit, shifted, walk, write_scene, write_truth
from typer.testing import CliRunner

from video2anim.cli.evaluate import eval_command, eval_set_command
from video2anim.errors import InputError
from video2anim.lab.eval.aggregate import evaluate_set, paired_folders, statistic
from video2anim.lab.eval.carried_rows import CARRIED
from video2anim.lab.eval.clip_rows import CAMERA, INGEST, TRACK
from video2anim.lab.eval.evaluate import evaluate
from video2anim.lab.eval.model import SetEvaluation
from video2anim.lab.eval.motion_rows import MOTION
from video2anim.lab.eval.object_rows import COMPLETE, OBJECTS, SEGMENT
from video2anim.lab.eval.picture_rows import BACKGROUND, DEPTH
from video2anim.lab.eval.report import better_text, render_html, to_json, verdict
from video2anim.lab.eval.scene_rows import BODY_IN_SCENE, SPACE
from video2anim.types import BodyTracks, DepthClip, RefinedMotion

REPOSITORY = Path(__file__).resolve().parents[3]
ALL_ROWS = {
    "ingest": INGEST, "track": TRACK, "camera": CAMERA, "motion": MOTION, "true_scene": BODY_IN_SCENE,
    "true_scene_laid": BODY_IN_SCENE, "own_scene": BODY_IN_SCENE,
    "background": BACKGROUND, "depth": DEPTH, "segment": SEGMENT, "complete": COMPLETE,
    "objects": OBJECTS, "carried": CARRIED, "space": SPACE,
}  # fmt: skip


class Folders:
    """Three clips whose raw motion is off by 0.1, 0.2 and 0.6 m, one without result and one that is damaged."""

    def __init__(self, root: Path) -> None:
        self.results, self.truth = root / "results", root / "truth"
        self.results.mkdir(parents=True)
        for name, off_m in (("a", 0.1), ("b", 0.2), ("c", 0.6)):
            tiny = Tiny()
            write_truth(self.truth / name, tiny)
            edit = {BodyTracks: people_edit(lambda person, off_m=off_m: shifted(person, [off_m, 0, 0]))}
            write_scene(self.results / name, tiny, edits=edit, leave_out=(DepthClip,) if name == "c" else ())
        write_truth(self.truth / "lost", Tiny())
        write_truth(self.truth / "broken", Tiny())
        write_scene(self.results / "broken", Tiny())
        (self.results / "broken" / "run.json").write_text("{")
        write_scene(self.results / "stranger", Tiny((walk(),)))

    def evaluate(self) -> SetEvaluation:
        pairs, _ = paired_folders(self.results, self.truth)
        return evaluate_set(pairs)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Folders:
    return Folders(tmp_path_factory.mktemp("set"))


@pytest.fixture(scope="module")
def whole_set(folders: Folders) -> SetEvaluation:
    return folders.evaluate()


def test_means_medians_and_failures(whole_set: SetEvaluation) -> None:
    assert whole_set.clips == ("a", "b", "c")
    assert [name for name, _ in whole_set.failures] == ["broken", "lost"]
    assert "damaged" in whole_set.failures[0][1]
    assert whole_set.failures[1][1].startswith("no result")
    assert whole_set.failure_ratio == pytest.approx(2 / 5)
    motion = next(group for group in whole_set.groups if group.key == "motion")
    root = next(row for row in motion.rows if row.key == "root_error")
    raw = root.statistics[motion.columns.index("raw")]
    assert raw is not None
    assert (raw.count, raw.mean, raw.median) == pytest.approx((3, 0.3, 0.2))
    assert 0.0999 < raw.low < raw.mean < raw.high < 0.6001
    assert root.values[0] == pytest.approx((0.1, 0.2, 0.6))
    assert ("c", "stage depth has not run") in whole_set.notes


def test_a_number_that_some_clips_lack_is_averaged_over_the_others(whole_set: SetEvaluation) -> None:
    depth = next(group for group in whole_set.groups if group.key == "depth")
    fitted = next(row for row in depth.rows if row.key == "abs_rel").statistics[0]
    assert fitted is not None
    assert fitted.count == 2


def test_results_without_truth_are_named(folders: Folders) -> None:
    pairs, strangers = paired_folders(folders.results, folders.truth)
    assert strangers == ["stranger"]
    assert [truth.name for _, truth in pairs] == ["a", "b", "broken", "c", "lost"]


def test_same_seed_same_bytes(folders: Folders, whole_set: SetEvaluation) -> None:
    assert to_json(folders.evaluate()) == to_json(whole_set)


def test_interval_against_scipy() -> None:
    values = np.random.default_rng(0).gamma(2.0, size=40)
    found = statistic(values.tolist())
    assert found is not None
    expected = bootstrap((values,), np.mean, method="percentile", n_resamples=20_000, rng=np.random.default_rng(1))
    spread = expected.confidence_interval.high - expected.confidence_interval.low
    assert found.low == pytest.approx(expected.confidence_interval.low, abs=0.05 * spread)
    assert found.high == pytest.approx(expected.confidence_interval.high, abs=0.05 * spread)
    assert found.mean == pytest.approx(values.mean())
    assert found.median == pytest.approx(np.median(values))


def test_interval_of_one_clip_is_a_point_and_of_none_is_none() -> None:
    one = statistic([0.4, None])
    assert one is not None
    assert (one.count, one.low, one.mean, one.high) == (1, 0.4, 0.4, 0.4)
    assert statistic([None, None]) is None


def test_verdicts() -> None:
    assert verdict("lower", 2.0, 1.0, None) == "better"
    assert verdict("higher", 2.0, 1.0, None) == "worse"
    assert verdict("near_1", 0.5, 1.9, None) == "better"
    assert verdict("near_truth", 900.0, 20.0, 80.0) == "better"
    assert verdict("near_truth", 90.0, 20.0, 80.0) == "worse"
    assert verdict("lower", 1.0, 1.0 + 1e-12, None) == "same"
    for nothing in (("none", 1.0, 2.0, None), ("lower", None, 1.0, None), ("near_truth", 1.0, 2.0, None)):
        assert verdict(*nothing) == ""  # type: ignore[arg-type]


def test_json_has_everything_and_no_nan(scene_dir: Path, truth_dir: Path, whole_set: SetEvaluation) -> None:
    evaluation = evaluate(scene_dir, truth_dir)
    data = json.loads(to_json(evaluation), parse_constant=lambda text: pytest.fail(f"{text} in JSON"))
    assert (data["kind"], data["format_version"], data["name"]) == ("clip", 2, "clip")
    found = {group["key"]: [row["qualities"][0]["key"] for row in group["rows"]] for group in data["groups"]}
    assert found == {key: [spec.key for spec in specs] for key, specs in ALL_ROWS.items()}
    mpjpe = data["groups"][3]["rows"][1]
    assert [quality["key"] for quality in mpjpe["qualities"]] == ["mpjpe"] * 3
    assert [quality["value"] for quality in mpjpe["qualities"]] == pytest.approx([0, 0, 0], abs=1e-9)
    person = data["people"][0]
    assert {q["person_id"] for group in person["groups"] for row in group["rows"] for q in row["qualities"]} == {
        person["person_id"]
    }
    assert data["people"][0]["curves"][0]["series"].keys() == {"raw", "keyframes", "refined"}
    assert json.loads(to_json(whole_set))["kind"] == "set"


class Page(HTMLParser):
    """Checks nesting and gathers what a page asks for from elsewhere."""

    VOID = ("meta", "img", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        self.sources += [text for name, text in attrs if name in ("src", "href") and text]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_page_of_a_clip_is_self_contained(scene_dir: Path, truth_dir: Path) -> None:
    page = Page(render_html(evaluate(scene_dir, truth_dir)))
    assert len(page.sources) == 5
    assert all(source.startswith("data:image/svg+xml;base64,") for source in page.sources)
    text = " ".join(page.words)
    for specs in ALL_ROWS.values():
        for spec in specs:
            assert spec.label in text
    assert not re.search(r"\bnan\b|\binf\b|None", text)


def test_page_names_what_is_missing(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    scene = write_scene(tmp_path / "scene", tiny, leave_out=(RefinedMotion,))
    text = " ".join(Page(render_html(evaluate(scene, truth_dir))).words)
    assert "refined: nothing: stage refine has not run" in text


def test_page_shows_hostile_names_as_text(tmp_path: Path, scene_dir: Path, tiny: Tiny) -> None:
    truth = write_truth(tmp_path / "truth", tiny, meta={"name": "<script>alert(1)</script>"})
    assert "<script>" not in render_html(evaluate(scene_dir, truth))


def test_page_of_a_set(whole_set: SetEvaluation) -> None:
    page = Page(render_html(whole_set))
    text = " ".join(page.words)
    assert "3 clips evaluated, 2 failed" in text
    assert "lost" in text
    assert "0.1 to 0.6, median 0.2" in text
    assert len(page.sources) == 4
    assert all(source.startswith("data:") for source in page.sources)


def test_page_of_a_set_in_which_all_failed(tmp_path: Path, truth_dir: Path) -> None:
    empty = evaluate_set([(tmp_path / "none", truth_dir)])
    assert "0 clips evaluated, 1 failed" in " ".join(Page(render_html(empty)).words)
    assert json.loads(to_json(empty))["groups"] == []


app = typer.Typer(pretty_exceptions_enable=False)
app.command("eval")(eval_command)
app.command("eval-set")(eval_set_command)
runner = CliRunner()


def test_eval_command(tmp_path: Path, scene_dir: Path, truth_dir: Path) -> None:
    json_file, html_file = tmp_path / "e.json", tmp_path / "e.html"
    words = ["eval", str(scene_dir), "--truth", str(truth_dir), "--json", str(json_file), "--html", str(html_file)]
    done = runner.invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0
    assert re.search(r"PA-MPJPE +\S+ +\S+ +\S+ +m +lower", done.output)
    assert "…" not in done.output
    assert json.loads(json_file.read_text())["kind"] == "clip"
    assert html_file.read_text().startswith("<!DOCTYPE html>")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["e.html", "e.json"]


def test_eval_command_on_an_unfinished_folder(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    later = tuple(kind for kind, folder in STAGES.items() if folder > "04")
    scene = write_scene(tmp_path / "scene", tiny, leave_out=later)
    done = runner.invoke(app, ["eval", str(scene), "--truth", str(truth_dir)], catch_exceptions=False)
    assert done.exit_code == 0
    assert "note: stage humans has not run" in done.output
    assert "n/a - nothing: stage humans has not run" in done.output


def test_eval_set_command(tmp_path: Path, folders: Folders) -> None:
    words = ["eval-set", str(folders.results), "--truth", str(folders.truth), "--json", str(tmp_path / "s.json")]
    done = runner.invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0
    assert "3 of 5 clips evaluated, 2 failed" in done.output
    assert "failed: lost: no result" in done.output
    assert "stranger has no truth folder" in done.output
    assert "0.3 [0.1, 0.6] 0.2" in done.output
    assert math.isclose(
        json.loads((tmp_path / "s.json").read_text())["groups"][3]["rows"][6]["statistics"][0]["mean"], 0.3
    )


@pytest.mark.parametrize("option", ["--json", "--html"])
def test_a_file_that_cannot_be_written_is_refused_before_the_work(
    tmp_path: Path, scene_dir: Path, truth_dir: Path, option: str
) -> None:
    words = ["eval", str(scene_dir), "--truth", str(truth_dir), option, str(tmp_path / "nowhere" / "x")]
    with pytest.raises(InputError, match="want a file in an existing folder"):
        runner.invoke(app, words, catch_exceptions=False)


def test_sets_that_cannot_be_evaluated(tmp_path: Path, folders: Folders) -> None:
    (tmp_path / "empty").mkdir()
    words = ["eval-set", str(tmp_path / "empty"), "--truth", str(folders.truth)]
    with pytest.raises(InputError, match=r"no clip of .* could be evaluated; the first, a: no result"):
        runner.invoke(app, words, catch_exceptions=False)
    with pytest.raises(InputError, match="want truth folders"):
        paired_folders(folders.results, tmp_path / "empty")
    with pytest.raises(InputError, match="want a folder with one folder per clip"):
        paired_folders(tmp_path / "nowhere", folders.truth)


def test_every_number_is_defined_in_the_documentation() -> None:
    text = (REPOSITORY / "docs" / "evaluation.md").read_text()
    for group, specs in ALL_ROWS.items():
        section = text.split(f"`{group}`", 1)
        assert len(section) == 2, f"docs/evaluation.md does not name group {group}"
        for spec in specs:
            assert f"| `{spec.key}` |" in text, f"docs/evaluation.md does not define {group}.{spec.key}"


def test_units_and_directions_in_the_documentation() -> None:
    lines = (REPOSITORY / "docs" / "evaluation.md").read_text().splitlines()
    table = {
        m[1]: (m[2].strip(), m[3].strip())
        for line in lines
        if (m := re.match(r"\| `(\w+)` \|([^|]*)\|([^|]*)\|", line))
    }
    for specs in ALL_ROWS.values():
        for spec in specs:
            expected = (spec.unit, better_text(spec.better))
            if spec.key in ("covered", "precision", "recall", "box_iou"):
                continue  # the same key in two groups
            assert table[spec.key] == expected, spec.key


def test_numbers_may_differ_between_persons(tmp_path: Path, two: Tiny) -> None:
    """The page shows each person's table when there are several."""
    truth = write_truth(tmp_path / "truth", two)
    edit = {BodyTracks: lambda v: replace(v, people=(v.people[0], shifted(v.people[1], [0.1, 0, 0])))}
    page = Page(render_html(evaluate(write_scene(tmp_path / "scene", two, edits=edit), truth)))
    text = " ".join(page.words)
    assert "Person 0" in text
    assert "Person 1" in text
    assert text.count("root error") == 3
    assert "Mean of 2 persons." in text
