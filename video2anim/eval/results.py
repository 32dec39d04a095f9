"""A scene folder as the evaluation reads it: each stage's value, or why there is none."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from video2anim.artifacts.codec import read_value
from video2anim.errors import ArtifactError, InputError
from video2anim.pipeline.scene_folder import STAGES, read_record
from video2anim.types import (
    BackgroundPlate,
    BodyMotion,
    BodyTracks,
    CameraEstimate,
    CompletedObjects,
    DepthClip,
    InstanceMasks,
    KeyframedMotion,
    MetricDepth,
    ObjectMeshes,
    PersonTracks,
    PlacedObjects,
    RefinedMotion,
    SceneModel,
    VideoClip,
)

Value = TypeVar("Value")
STAGE_OF: dict[type, str] = {
    VideoClip: "ingest", PersonTracks: "track", CameraEstimate: "camera", BodyTracks: "humans",
    BackgroundPlate: "background", DepthClip: "depth", MetricDepth: "metric", InstanceMasks: "segment",
    CompletedObjects: "complete", ObjectMeshes: "reconstruct", PlacedObjects: "place", SceneModel: "scene",
    KeyframedMotion: "keyframes", RefinedMotion: "refine",
}  # fmt: skip
"""Stage that makes each value."""
MOTION_STAGES: dict[str, type] = {"raw": BodyTracks, "keyframes": KeyframedMotion, "refined": RefinedMotion}


class SceneResult:
    """Values of a scene folder, read on first use. A stage that is missing or damaged gives None and a reason."""

    def __init__(self, scene_dir: Path | str) -> None:
        """Open a scene folder.

        Raises:
            InputError: not a scene folder, or no stage is finished.
        """
        self.scene_dir = Path(scene_dir)
        self.record = read_record(self.scene_dir)
        self._values: dict[type, Any] = {}
        self._reasons: dict[type, str] = {}
        if self.get(VideoClip) is None:
            raise InputError(
                f"{self.scene_dir}: want a scene folder with at least its first stage, but {self.why(VideoClip)}"
            )

    def get(self, kind: type[Value]) -> Value | None:
        """Value of a type, None where its stage is missing or damaged."""
        if kind not in self._values:
            self._values[kind] = self._read(kind)
        return self._values[kind]

    def why(self, *kinds: type) -> str:
        """Why the first absent value of these is absent; empty where all are there."""
        for kind in kinds:
            if self.get(kind) is None:
                return self._reasons[kind]
        return ""

    @property
    def clip(self) -> VideoClip:
        clip = self.get(VideoClip)
        assert clip is not None  # the constructor saw to it
        return clip

    def motions(self) -> dict[str, tuple[BodyMotion, ...]]:
        """People of every motion stage that is there."""
        found = {name: self.get(kind) for name, kind in MOTION_STAGES.items()}
        return {name: value.people for name, value in found.items() if value is not None}

    def missing(self) -> list[str]:
        """Reasons of all stages without a value, in order."""
        return [self._reasons[kind] for kind in STAGE_OF if self.get(kind) is None]

    def _read(self, kind: type) -> Any:
        stage = STAGE_OF[kind]
        folders = sorted((self.scene_dir / STAGES).glob(f"[0-9][0-9]_{stage}"))
        if not folders:
            self._reasons[kind] = f"stage {stage} has not run"
            return None
        try:
            value = read_value(kind, folders[0])
        except ArtifactError as error:
            self._reasons[kind] = f"stage {stage} is unreadable: {str(error).split(';')[0]}"
            return None
        return value
