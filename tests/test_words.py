"""Replaced names stay out of the code, coined words and British spellings out of README and docs."""

from __future__ import annotations

import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
CODE = ("video2anim", "stages", "scenemi", "training", "benchmarks", "tools")
PROSE = ("README.md", "CONTRIBUTING.md", "docs/*.md", "video2anim/networks/weights/*.md", "scenemi/weights/*.md")

NAMES = {
    "SeenThing": "Detection", "ThingLifter": "ObjectBackprojector", "LiftedThing": "BackprojectedObject",
    "thing_pixels": "foreground_mask", "BackgroundPlate": "BackgroundImage", "plate_rgb": "background_rgb",
    "stature_m": "body_height_m", "PseudoScenes": "SyntheticScenes",
    "BodyBalls": "BodySpheres", "MotionLibrary": "MotionDatabase", "ActedMotion": "ProceduralMotion",
    "WindowJudge": "WindowEvaluator", "choose_prior": "load_prior_by_name", "whole_or_absent": "atomic_directory",
    "place_results": "publish_results",
    "Performed": "SolvedMotion", "Caster": "RayCaster", "sheet_of": "trace_gbuffer", "lamp_reach": "light_visibility",
    "Sighting": "SimulatedWindow", "Sightings": "SimulatedLandmarks", "kept_motions": "cached_motions",
    "kept_clip": "finished_clip", "DEEPEST_M": "MAX_PENETRATION_M", "showing_view": "moved_object_view",
    "laid_along": "aligned_on_floor", "normalised_convolutions": "normalized_convolutions",
}  # fmt: skip
"""Replaced identifier -> the present one."""
EXTREMES = {"least": "min", "smallest": "min", "most": "max", "largest": "max"}
"""Replaced part of an identifier -> the present one."""
ALLOWED = ("least_squares", "_smallest_rotation", "_smallest_turn", "largest_distance_m")
"""Scipy's name, names of rotations, and a key of run.json that users' files have."""

WORDS = {
    r"(?<!clean )plates?": "background image",
    r"statures?": "body height",
    r"middling": "average",
    r"pseudo-scenes?": "synthetic scene",
    r"acted": "procedural",
    r"askew": "rolled",
    r"middles?": "center",
    r"rivals?": "baseline",
    r"sightings?": "simulated landmarks",
    r"spoil(?:t|ed|ing|s)?": "damaged or degraded",
    r"things?": "object",
    r"told": "reported",
    r"(?:centi|milli|kilo)?metres?": "meter",
    r"colour\w*": "color",
    r"neighbour\w*": "neighbor",
    r"behaviour\w*": "behavior",
    r"centre[sd]?": "center",
    r"grey\w*": "gray",
    r"licence[sd]?": "license",
    r"catalogue[sd]?": "catalog",
    r"labell(?:ed|ing)": "labeled",
    r"modell(?:ed|ing)": "modeled",
    r"(?:recogn|optim|normal|initial|random|general|organ|visual|minim|maxim|real)is(?:e[sdr]?|ing|ation)": "-iz-",
    r"analys(?:ed?|er|ing)": "analyze",
}  # fmt: skip
"""Pattern of a word that prose does not use -> the word in its place. File names and code do not count."""


def replaced_name(name: str) -> str | None:
    """The present form of a replaced identifier; None for all others."""
    if name in ALLOWED:
        return None
    if name in NAMES:
        return NAMES[name]
    parts = name.split("_")
    changed = [EXTREMES.get(part.lower(), part) for part in parts[:-1]]
    return None if changed == parts[:-1] else "_".join([*changed, parts[-1]])


def identifiers(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of every name in a source file."""
    with tokenize.open(path) as stream:
        for token in tokenize.generate_tokens(stream.readline):
            if token.type == tokenize.NAME:
                yield token.start[0], token.string


def prose(path: Path) -> Iterator[tuple[int, str]]:
    """Line number and text outside blocks and spans of code, links' targets and quoted file names."""
    fenced = False
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif not fenced and not line.startswith("    "):
            yield number, re.sub(r"`[^`]*`|\]\([^)]*\)", " ", line)


@pytest.mark.parametrize("package", CODE)
def test_replaced_names_are_gone(package: str) -> None:
    wrong = [
        f"{path.relative_to(REPOSITORY)}:{line}: {name}, write {better}"
        for path in sorted((REPOSITORY / package).rglob("*.py"))
        for line, name in identifiers(path)
        if (better := replaced_name(name)) is not None
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("pattern", PROSE)
def test_prose_uses_the_terms_of_the_field(pattern: str) -> None:
    paths = sorted(REPOSITORY.glob(pattern))
    assert paths, pattern
    wrong = [
        f"{path.relative_to(REPOSITORY)}:{line}: {found[0]!r}, write {better!r}"
        for path in paths
        for line, text in prose(path)
        for word, better in WORDS.items()
        for found in re.finditer(rf"\b{word}\b", text, re.IGNORECASE)
    ]
    assert not wrong, "\n".join(wrong)


def test_what_counts_as_replaced() -> None:
    assert replaced_name("largest_yaw_deg") == "max_yaw_deg"
    assert replaced_name("_LEAST_FRAMES") == "_min_FRAMES"
    assert replaced_name("plate_rgb") == "background_rgb"
    kept = (*ALLOWED, "almost_there", "largest", "at_most")
    assert [replaced_name(name) for name in kept] == [None] * len(kept)


def test_what_counts_as_prose(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("A plate and `plate.png`.\n\n    plate\n\n   ```\n   plate\n   ```\n[clean plate](plate.md)\n")
    assert [text for _, text in prose(page) if "plate" in text] == ["A plate and  .", "[clean plate "]
    assert [re.findall(next(iter(WORDS)), text) for _, text in prose(page) if text] == [["plate"], []]
