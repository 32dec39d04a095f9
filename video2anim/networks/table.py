"""Every network and data product that decides a result: where it comes from, its digest, license and adapter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from video2anim.errors import UsageError
from video2anim.networks.entry import ModelEntry
from video2anim.networks.sources import (
    DependencySource,
    ExternalData,
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
_OBJECTRON = ("@mediapipe/objectron", "0.4.1675468480")
_OBJECTRON_BYTES = 9_987_728
"""Size of its detector, which lies behind a list of labels in one file."""
_BRANCH = "main"
"""Revision of two hub repositories whose commit could not be found: their makers publish digests, and no commit. The
digest holds the file; should the branch move on, fetching fails and says so."""
_ROOM_NET = "727fd91764d60ae3f528eeffb35c966543ec1a17769072cdf34b72159508344d"
"""Digest of the room network: one file for three slots."""
_ROOM_NET_BYTES = 11_280_767
_BLAZEPOSE = "video2anim.networks.blazepose:BlazePose"

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
        adapter="video2anim.networks.blazepose_detector:BlazePoseDetector",
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
        source=WheelSource("video2anim/networks/weights/lifter.onnx"),
        sha256="bb69b67bfada205f9b4e79410cb5ab5179693a9221978086a4ffaaaa1f62bb9d",
        size_bytes=6_647_918,
        licence="Apache-2.0",
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
        licence="Apache-2.0",
        verified="weights",
        adapter="video2anim.networks.room_net:RoomDepth",
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
        adapter="video2anim.networks.depth_anything:DepthAnything",
    ),
    ModelEntry(
        slot="depth",
        name="depth-anything-v2-metric-indoor-small",
        runtime="onnx",
        source=UserSource(
            "ONNX export of hub depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf",
            why="no public export of it has a known digest",
        ),
        sha256="",
        size_bytes=0,
        licence="Apache-2.0",
        verified="contract",
        adapter="video2anim.networks.depth_anything:DepthAnythingMetric",
    ),
    ModelEntry(
        slot="depth",
        name="moge-2-small",
        runtime="onnx",
        source=HubSource("Ruicheng/moge-2-vits-normal-onnx", "e50ffda41565591092adea54c6ac83d6212e1e23", "model.onnx"),
        sha256="24eacb5dc7a2c54c7bc98f7de085ffbed79ad006ea5b664c2c2cdc02ff3a52f0",
        size_bytes=140_852_051,
        licence="MIT",
        verified="contract",
        adapter="video2anim.networks.moge:Moge",
        also=("camera",),
    ),
    ModelEntry(
        slot="depth",
        name="depth-anything-3-small",
        runtime="onnx",
        source=HubSource(
            "onnx-community/depth-anything-v3-small",
            "0b6a7f3bf5595f9950b91389e0da3a0de130324c",
            "onnx/model.onnx",
            ExternalData("onnx/model.onnx_data", "802bb24741e67f5bb2b369fc64d40afe11439cc895d676d658d65cfb75c9860f"),
        ),
        sha256="396008798244a074297fd88e450433b1357fc687f534939375c804ded86e7b2a",
        size_bytes=640_691 + 104_702_464,
        licence="Apache-2.0",
        verified="contract",
        adapter="video2anim.networks.depth_anything_3:DepthAnything3",
        also=("camera",),
    ),
    ModelEntry(
        slot="camera",
        name="room-camera",
        runtime="onnx",
        source=WheelSource("video2anim/networks/weights/room_net.onnx"),
        sha256=_ROOM_NET,
        size_bytes=_ROOM_NET_BYTES,
        licence="Apache-2.0",
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
        licence="CC-BY-4.0",
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
        licence="Apache-2.0",
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
        licence="MIT",
        verified="contract",
        adapter="video2anim.networks.maskformer:Eomt",
    ),
    ModelEntry(
        slot="segment",
        name="rf-detr-seg-small",
        runtime="onnx",
        source=HubSource("besit/rfdetr-onnx", _BRANCH, "rfdetr-seg-small.onnx"),
        sha256="6e9ac79e34143c8cbd63b5e1c653c3108ea944ab08153433c761f72d7fef641c",
        size_bytes=0,
        licence="Apache-2.0",
        verified="contract",
        adapter="video2anim.networks.rf_detr_seg:RfDetrSeg",
    ),
    ModelEntry(
        slot="segment",
        name="maskformer-swin-small-ade",
        runtime="onnx",
        source=UserSource("hub onnx-community/maskformer-swin-small-ade, onnx/model.onnx, 260 MB"),
        sha256="",
        size_bytes=0,
        licence="code and weights CC-BY-NC-4.0: non-commercial",
        verified="contract",
        adapter="video2anim.networks.maskformer:MaskFormer",
    ),
    ModelEntry(
        slot="finder",
        name="objectron",
        runtime="tflite",
        source=NpmSource(
            *_OBJECTRON, "objectron_solution_packed_assets.data", first_byte=184, end_byte=184 + _OBJECTRON_BYTES
        ),
        sha256="d0a5255bf8c4f5a0bc4240741a76c41d5e939f7655078f945f50ab53a9375da6",
        size_bytes=_OBJECTRON_BYTES,
        licence="Apache-2.0",
        verified="weights",
        adapter="video2anim.networks.objectron:ObjectFinder",
        requires=("objectron-chair",),
    ),
    ModelEntry(
        slot="chair-box",
        name="objectron-chair",
        runtime="tflite",
        source=NpmSource(*_OBJECTRON, "object_detection_3d_chair.tflite"),
        sha256="190e4ea49ba891ed242ddc73703e03d70164c27f3da07492d7010379e24f2a6b",
        size_bytes=5_222_528,
        licence="Apache-2.0",
        verified="weights",
        adapter="video2anim.networks.objectron_chair:ChairBoxes",
    ),
    ModelEntry(
        slot="completer",
        name="completer",
        runtime="onnx",
        source=UserSource("any network of the contract in video2anim/networks/mask_completer.py", why="none is public"),
        sha256="",
        size_bytes=0,
        licence="that of your network",
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
        licence="MIT",
        verified="contract",
        adapter="video2anim.networks.triposr:TripoSR",
        files=("encoder.onnx", "field.onnx"),
    ),
    ModelEntry(
        slot="prior",
        name=PRIOR,
        runtime="torch",
        source=WheelSource("scenemi/weights/small.safetensors"),
        sha256="fbf5c3d54c89af8cdee5360e50fb6b395d4235aca9fcb7071671da2fac671178",
        size_bytes=15_614_780,
        licence="Apache-2.0",
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
        licence="code Apache-2.0, data CC0",
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
        licence="Apache-2.0",
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
        licence="Apache-2.0",
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
        found[name] = entry.licence if ours else OWN_FILE
    return found
