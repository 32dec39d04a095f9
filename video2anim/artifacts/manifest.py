"""The manifest of a stage folder: what was made, from what, how, and how well."""

from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, ConfigDict
from typing_extensions import TypedDict

from video2anim.artifacts.stage_files import read_json
from video2anim.errors import ArtifactError
from video2anim.types.quality import Better, Unit

MANIFEST_NAME = "manifest.json"


class QualityRow(TypedDict):
    """One quality number: the fields of `video2anim.types.quality.Quality`."""

    key: str
    value: float
    unit: Unit
    better: Better
    person_id: int | None
    object_id: int | None


def _with_keys(rows: Any) -> Any:
    """Without rows as they were before keys (until 2026-11): they explain a result, which is read without them."""
    before = {"name", "value", "unit", "better"}
    return (
        [row for row in rows if not isinstance(row, dict) or row.keys() != before] if isinstance(rows, list) else rows
    )


@dataclass(frozen=True, slots=True)
class Manifest:
    """Everything that explains one stage's output."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    stage: str
    version: int
    key: str
    """sha256 over name, version, result-changing config, inputs, weights and seed."""
    config: dict[str, Any]
    inputs: dict[str, str]
    """Digest of each input value, by type name."""
    weights: dict[str, str]
    """sha256 of each model file used, by model name."""
    seed: int
    output_digest: str
    """Digest of the payload as it was written; another one now means an edit by hand."""
    wall_time_s: float
    peak_memory_mb: float | None
    """Largest resident set of the process during the stage; None where the system does not tell."""
    qualities: Annotated[list[QualityRow], BeforeValidator(_with_keys)]
    warnings: list[str]
    versions: dict[str, str]
    licenses: dict[str, str] = dataclasses.field(default_factory=dict)
    """License of each of `weights`, by model name."""
    device: str = ""
    """cpu or cuda. Not part of the key: results agree to rounding, and a folder made on a GPU opens on a laptop."""
    kept_for: str = ""
    """Key for which an output that was edited by hand was kept (`--keep-edits`)."""

    def write(self, folder: Path) -> None:
        aside = folder / f".{MANIFEST_NAME}"
        aside.write_text(json.dumps(dataclasses.asdict(self), indent=1) + "\n")
        os.replace(aside, folder / MANIFEST_NAME)


def read_manifest(folder: Path) -> Manifest:
    """Read a manifest.

    Raises:
        ArtifactError: damaged or of another layout.
    """
    try:
        return read_json(folder / MANIFEST_NAME, Manifest)
    except ArtifactError as error:
        raise ArtifactError(
            f"manifest: want one as written by a stage, got {error}; delete the folder {folder} and run again"
        ) from error
