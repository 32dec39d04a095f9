"""Reads a scene folder for the evaluation: the value of each stage, or why there is none."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from video2anim.artifacts.codec import read_value
from video2anim.artifacts.folder import value_digest
from video2anim.artifacts.manifest import read_manifest
from video2anim.errors import ArtifactError, InputError
from video2anim.pipeline.scene_folder import read_record, stage_folder
from video2anim.types import (
    BackgroundImage,
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
    BackgroundImage: "background", DepthClip: "depth", MetricDepth: "metric", InstanceMasks: "segment",
    CompletedObjects: "complete", ObjectMeshes: "reconstruct", PlacedObjects: "place", SceneModel: "scene",
    KeyframedMotion: "keyframes", RefinedMotion: "refine",
}  # fmt: skip
"""Stage that makes each value."""
_KIND_OF = {kind.__name__: kind for kind in STAGE_OF}
"""Type of each value, by the name that manifests use."""
MOTION_STAGES: dict[str, type] = {"raw": BodyTracks, "keyframes": KeyframedMotion, "refined": RefinedMotion}


class SceneResult:
    """Values of a scene folder, read on first use. A stage that is missing, damaged or stale gives None and a reason.

    A value is stale if one of its inputs has changed since, or is stale itself. All values of `get` are consistent.
    """

    def __init__(self, scene_dir: Path | str) -> None:
        """Open a scene folder.

        Raises:
            InputError: not a scene folder, or no stage is finished.
        """
        self.scene_dir = Path(scene_dir)
        self.record = read_record(self.scene_dir)
        self._values: dict[type, Any] = {}
        self._reasons: dict[type, str] = {}
        self._stale: dict[type, str] = {}
        """Name of the earlier stage that changed, by value type."""
        self._digests: dict[type, str] = {}
        if self.get(VideoClip) is None:
            raise InputError(
                f"{self.scene_dir}: want a scene folder with at least its first stage, but {self.why(VideoClip)}"
            )

    def get(self, kind: type[Value]) -> Value | None:
        """Value of a type; None if its stage is missing, damaged or stale."""
        if kind not in self._values:
            self._values[kind] = self._read(kind)
        return self._values[kind]

    def why(self, *kinds: type) -> str:
        """Why the first missing value of these types is missing; empty if all exist."""
        for kind in kinds:
            if self.get(kind) is None:
                return self._reasons[kind]
        return ""

    @property
    def clip(self) -> VideoClip:
        clip = self.get(VideoClip)
        assert clip is not None  # checked by the constructor
        return clip

    def motions(self) -> dict[str, tuple[BodyMotion, ...]]:
        """People of every motion stage that has a value, all in the world frame of the calibrated camera."""
        found = {name: self.get(kind) for name, kind in MOTION_STAGES.items()}
        people = {name: value.people for name, value in found.items() if value is not None}
        if "raw" in people and (metric := self.get(MetricDepth)) is not None:
            T_world_camera = metric.bodies.main.T_world_camera
            people["raw"] = tuple(motion.in_world(T_world_camera) for motion in people["raw"])
        return people

    @property
    def bodies(self) -> BodyTracks | None:
        """The people after calibration (stage metric); without it, those of stage humans."""
        metric = self.get(MetricDepth)
        return self.get(BodyTracks) if metric is None else metric.bodies

    @property
    def scene(self) -> SceneModel | None:
        """The scene of the last motion stage: stage refine may move objects."""
        scene, refined = self.get(SceneModel), self.get(RefinedMotion)
        return scene if scene is None or refined is None else refined.scene

    def missing(self) -> list[str]:
        """The reasons of all stages without a value, in order of the stages."""
        return [self._reasons[kind] for kind in STAGE_OF if self.get(kind) is None]

    def _read(self, kind: type) -> Any:
        stage, folder = STAGE_OF[kind], self._folder(kind)
        if folder is None:
            self._reasons[kind] = f"stage {stage} has not run"
            return None
        try:
            inputs = read_manifest(folder).inputs
            value = read_value(kind, folder)
        except ArtifactError as error:
            self._reasons[kind] = f"stage {stage} is unreadable: {str(error).split(';')[0]}"
            return None
        changed = next(filter(None, (self._changed(name, digest) for name, digest in inputs.items())), None)
        if changed is not None:
            self._reasons[kind] = f"stage {stage} is stale, stage {changed} changed after it; run the pipeline again"
            self._stale[kind] = changed
            return None
        return value

    def _folder(self, kind: type) -> Path | None:
        folder = stage_folder(self.scene_dir, STAGE_OF[kind])
        return folder if folder.exists() else None

    def _changed(self, name: str, digest: str) -> str | None:
        """The stage that makes values with this input (type name and digest) stale; None if there is none.

        A missing or unreadable stage has no value, so it makes nothing stale.
        """
        kind = _KIND_OF.get(name)
        folder = None if kind is None else self._folder(kind)
        if kind is None or folder is None:
            return None
        if self.get(kind) is None:
            return self._stale.get(kind)
        if kind not in self._digests:
            self._digests[kind] = value_digest(folder)
        return STAGE_OF[kind] if self._digests[kind] != digest else None
