"""Every network and data product that decides a result: where it comes from, its digest, license and adapter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from video2anim.errors import UsageError
from video2anim.networks.entry import ModelEntry
from video2anim.networks.sources import (
    DependencySource,
    FileSource,
    HubSource,
    NpmSource,
    PipSource,
    ReleaseSource,
    UserSource,
    WheelSource,
)

PRIOR = "scenemi"
PRIOR_CHOICES = ("auto", "interpolation")
"""What `refine.prior` may be besides the prior's name and a file: the prior where its weights are present, and none."""
_PRIOR_SUFFIX = ".safetensors"
_MEDIAPIPE = "0.10.21"
_BRANCH = "main"
"""Revision of a hub repository whose commit could not be found: its maker publishes digests, and no commit. The digest
holds the file; should the branch move on, fetching fails and says so."""
_ROOM_NET = "727fd91764d60ae3f528eeffb35c966543ec1a17769072cdf34b72159508344d"
"""Digest of the room network: one file for three slots."""
_ROOM_NET_BYTES = 11_280_767

MODELS: tuple[ModelEntry, ...] = (
    ModelEntry(
        slot="person-detector",
        name="blazepose-detector",
        runtime="tflite",
        source=PipSource("mediapipe", _MEDIAPIPE, "mediapipe/modules/pose_detection/pose_detection.tflite"),
        sha256="9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
        size_bytes=2_959_046,
        license="Apache-2.0",
        verified="weights",
        adapter="video2anim.networks.blazepose_detector:BlazePoseDetector",
    ),
    ModelEntry(
        slot="pose",
        name="blazepose-heavy",
        runtime="tflite",
        source=NpmSource("@mediapipe/pose", "0.5.1675469404", "pose_landmark_heavy.tflite"),
        sha256="59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
        size_bytes=27_709_200,
        license="Apache-2.0",
        verified="weights",
        adapter="video2anim.networks.blazepose:BlazePose",
        requires=("blazepose-detector",),
    ),
    ModelEntry(
        slot="lifter",
        name="lifter",
        runtime="onnx",
        source=WheelSource("video2anim/networks/weights/lifter.onnx"),
        sha256="7df1975ed2e54fe08a4e5c70a6dfc8b328ed321d182685ce5ebe0d66dff2742c",
        size_bytes=13_811_068,
        license="Apache-2.0",
        verified="weights",
        adapter="video2anim.networks.lifter:Lifter",
    ),
    ModelEntry(
        slot="depth",
        name="room-depth",
        runtime="onnx",
        source=WheelSource("video2anim/networks/weights/room_net.onnx"),
        sha256=_ROOM_NET,
        size_bytes=_ROOM_NET_BYTES,
        license="Apache-2.0",
        verified="weights",
        adapter="video2anim.networks.room_net:RoomDepth",
    ),
    ModelEntry(
        slot="depth",
        name="moge-2-small",
        runtime="onnx",
        source=HubSource("Ruicheng/moge-2-vits-normal-onnx", "e50ffda41565591092adea54c6ac83d6212e1e23", "model.onnx"),
        sha256="24eacb5dc7a2c54c7bc98f7de085ffbed79ad006ea5b664c2c2cdc02ff3a52f0",
        size_bytes=140_852_051,
        license="MIT",
        verified="contract",
        adapter="video2anim.networks.moge:Moge",
        also=("camera",),
    ),
    ModelEntry(
        slot="camera",
        name="room-camera",
        runtime="onnx",
        source=WheelSource("video2anim/networks/weights/room_net.onnx"),
        sha256=_ROOM_NET,
        size_bytes=_ROOM_NET_BYTES,
        license="Apache-2.0",
        verified="weights",
        adapter="video2anim.networks.room_net:RoomCamera",
    ),
    ModelEntry(
        slot="camera",
        name="geocalib",
        runtime="onnx",
        source=ReleaseSource("colmap/colmap", "models-geocalib-v1.0.0", "geocalib_pinhole_v1.0.0.onnx"),
        sha256="977435752b3e12bf371ec756b1cfc2850d7b6c68df05fbf1ec107dcb5f1196b1",
        size_bytes=0,
        license="CC-BY-4.0",
        verified="contract",
        adapter="video2anim.networks.geocalib:GeoCalib",
    ),
    ModelEntry(
        slot="segment",
        name="room-segment",
        runtime="onnx",
        source=WheelSource("video2anim/networks/weights/room_net.onnx"),
        sha256=_ROOM_NET,
        size_bytes=_ROOM_NET_BYTES,
        license="Apache-2.0",
        verified="weights",
        adapter="video2anim.networks.room_net:RoomSegment",
    ),
    ModelEntry(
        slot="segment",
        name="eomt-small-coco",
        runtime="onnx",
        source=HubSource("jessolmstead/greycard-sky", _BRANCH, "eomt-s-coco-640.onnx"),
        sha256="805ed0fb363784811a7f3979335c2c64a7d40f91ae943326f79a56ff477f372d",
        size_bytes=96_025_182,
        license="MIT",
        verified="contract",
        adapter="video2anim.networks.eomt:Eomt",
    ),
    ModelEntry(
        slot="finder",
        name="objectron",
        runtime="tflite",
        source=NpmSource(
            "@mediapipe/objectron",
            "0.4.1675468480",
            "objectron_solution_packed_assets.data",
            first_byte=184,
            end_byte=9_987_912,
        ),
        sha256="d0a5255bf8c4f5a0bc4240741a76c41d5e939f7655078f945f50ab53a9375da6",
        size_bytes=9_987_728,
        license="Apache-2.0",
        verified="weights",
        adapter="video2anim.networks.objectron:ObjectFinder",
    ),
    ModelEntry(
        slot="completer",
        name="completer",
        runtime="onnx",
        source=UserSource("any network of the contract in video2anim/networks/mask_completer.py", why="none is public"),
        sha256="",
        size_bytes=0,
        license="that of your network",
        verified="contract",
        adapter="video2anim.networks.mask_completer:MaskCompleter",
    ),
    ModelEntry(
        slot="object-mesh",
        name="triposr",
        runtime="onnx",
        source=UserSource("export of github.com/VAST-AI-Research/TripoSR", why="no official export of it exists"),
        sha256="",
        size_bytes=0,
        license="MIT",
        verified="contract",
        adapter="video2anim.networks.triposr:TripoSR",
        files=("encoder.onnx", "field.onnx"),
    ),
    ModelEntry(
        slot="prior",
        name=PRIOR,
        runtime="torch",
        source=WheelSource("scenemi/weights/small.safetensors"),
        sha256="8a29ab44c18c098c525a7bab97797d34e339d0d9b7a2a47767f71928a63eb269",
        size_bytes=15_615_092,
        license="Apache-2.0",
        verified="weights",
        adapter="",
    ),
    ModelEntry(
        slot="body",
        name="anny",
        runtime="torch",
        source=DependencySource("anny"),
        sha256="",
        size_bytes=0,
        license="code Apache-2.0, data CC0",
        verified="weights",
        adapter="",
    ),
    ModelEntry(
        slot="motion-features",
        name="fid",
        runtime="torch",
        source=WheelSource("scenemi/weights/fid/features.safetensors"),
        sha256="5558cd8daa9210571cbf273dccfa10e6ec8a9f0b4ea5ec25c2b49e79be7cc9e1",
        size_bytes=322_000,
        license="Apache-2.0",
        verified="weights",
        adapter="",
    ),
    ModelEntry(
        slot="walking-styles",
        name="gait",
        runtime="arrays",
        source=WheelSource("video2anim/lab/synth/acting/gait.npz"),
        sha256="a4015f5679cafb8e9b90e018808493b6fdd0d99c8394d3ba0760bbd5c41ee432",
        size_bytes=17_768,
        license="Apache-2.0",
        verified="weights",
        adapter="",
    ),
)


def list_models() -> tuple[ModelEntry, ...]:
    """All rows; the first of a slot is its default."""
    return MODELS


def find_model(name_or_slot: str) -> ModelEntry:
    """The row of a name, or the first row of a slot.

    `NAME@PATH` is the row of NAME with weights of the user's own: source `file:`, no digest to hold them to. PATH may
    be the folder of a model of several files. What else `refine.prior` may be is the row of the prior: `auto`, and a
    path that ends in `.safetensors`, as that of weights of the user's own.

    Raises:
        UsageError: there is neither a model nor a slot of that name.
    """
    wanted, at, path = name_or_slot.partition("@")
    if not any(wanted in (m.name, m.slot) for m in MODELS) and name_or_slot.endswith(_PRIOR_SUFFIX):
        wanted, at, path = PRIOR, "@", name_or_slot
    if name_or_slot == "auto":
        wanted = PRIOR
    for entry in (
        *(m for m in MODELS if m.name == wanted),
        *(m for m in MODELS if m.slot == wanted),
    ):
        if not at:
            return entry
        own = Path(path).expanduser()
        if entry.files and own.name != entry.files[0]:
            own /= entry.files[0]
        return replace(entry, source=FileSource(own), sha256="", size_bytes=0, verified="contract")
    known = ", ".join(model.name for model in MODELS)
    raise UsageError(f"unknown model {name_or_slot!r}; known: {known}; or NAME@PATH for weights of your own")


OWN_FILE = "of the user's own file"


def weight_licenses(digests: Mapping[str, str]) -> dict[str, str]:
    """License of each model of `weight_digests`: that of the table where the file is the one that the table names."""
    found = {}
    for name, digest in digests.items():
        entry = find_model(name)
        ours = isinstance(entry.source, DependencySource) or (entry.sha256 and digest.startswith(entry.sha256))
        found[name] = entry.license if ours else OWN_FILE
    return found
