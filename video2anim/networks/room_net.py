"""The project's own network for rooms: depth, normals, classes, instances and perspective field of one picture.

Tensor contract: input `picture` (1, 3, H, W) float32, RGB in 0 to 255, H and W multiples of 32; outputs at half that
size: `disparity` (1, 1, H/2, W/2) up to scale and offset, larger is nearer, `normal` (1, 3, ..) in camera axes, not
normalized, `classes` (1, 6, ..) logits of `CLASSES`, `cues` (1, 4, ..) logit of an object's middle, offset to the
middle (x, y in picture heights), logit of a boundary; at an eighth: `camera` (1, 5, H/8, W/8) up (x, y), latitude in
radians, logs of the expected errors of both in radians. Trained by `training/room_net.py` on renders of `video2anim
synth`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.geometry.perspective_field import PerspectiveField
from video2anim.networks.instance_grouping import Group, InstanceOffsets, grouped
from video2anim.networks.network import Network
from video2anim.networks.segmentation import CLASSES, SeenInstance, Segmentation

INPUT = "picture"
OUTPUTS = ("disparity", "normal", "classes", "cues", "camera")
CHANNELS = (1, 3, len(CLASSES), 4, 5)
AREA_PX = 256 * 192
"""Area of the network's input; the picture's ratio is kept."""
DEPTH_VIEWS = ((256 * 192, False), (256 * 192, True), (192 * 144, True))
"""Area of each look whose depth is averaged, and whether the picture is mirrored: a small look sees more of the room in
each cell."""
SEGMENT_VIEWS = ((256 * 192, False), (320 * 256, True))
"""Of looks at what objects are. These and the sizes for depth were tried on the
pictures of `benchmarks/room_net.py`."""
CAMERA_VIEWS = ((AREA_PX, False), (AREA_PX, True))
STRIDE = 32
_SIGMA_RANGE_RAD = (0.005, 1.5)
_MIN_PERSON = 0.003
"""Least share of the picture."""
_MIN_SCORE = 0.35
"""Furniture below this is left out: where precision and recall meet on renders of other rooms than it is tested on."""


@dataclass(frozen=True, slots=True, eq=False)
class RoomView:
    """One picture as the network sees it; maps at half the network's input size."""

    disparity: Float[np.ndarray, "rows columns"]
    """Up to scale and offset; larger is nearer."""
    normal_camera: Float[np.ndarray, "rows columns 3"]
    """Unit normals."""
    class_logits: Float[np.ndarray, "rows columns 6"]
    cues: InstanceOffsets
    field: PerspectiveField


class SceneNetwork:
    """All heads of one picture."""

    name = "room-net"

    def __init__(self, path: Path) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is no network of that contract.
        """
        self._network = Network(path, inputs=(INPUT,), outputs=OUTPUTS)

    def see(
        self, image: UInt8[np.ndarray, "height width 3"], looks: Sequence[tuple[int, bool]] = CAMERA_VIEWS
    ) -> RoomView:
        """Everything about one picture, the mean of some looks at it, in cells of the first.

        Args:
            image: RGB.
            looks: area of the network's input and whether it is mirrored, each.

        Raises:
            ModelMissingError: the network's outputs are not of the contract's shapes.
        """
        height, width = input_size(image.shape[0], image.shape[1], looks[0][0])
        # The ratio changes a little with the stride: directions are those of the picture, not of the input.
        stretch = (image.shape[1] / width, image.shape[0] / height)
        seen = [self._look(image, area_px, turned=turned) for area_px, turned in looks]
        maps = {name: np.mean([_resized(maps[name], seen[0][name].shape) for maps in seen], axis=0) for name in OUTPUTS}
        return _view_of(maps, stretch)

    def disparity(self, image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """Disparity at the picture's own size, the mean of `DEPTH_VIEWS`.

        Raises:
            ModelMissingError: as of `see`.
        """
        size = (image.shape[1], image.shape[0])
        looks = [self._look(image, area_px, turned=turned)["disparity"][0] for area_px, turned in DEPTH_VIEWS]
        return np.mean([cv2.resize(look, size, interpolation=cv2.INTER_LINEAR) for look in looks], axis=0)

    def _look(self, image: np.ndarray, area_px: int, *, turned: bool) -> dict[str, np.ndarray]:
        """The network's maps of a picture, shown mirrored if `turned` and the answer turned back."""
        height, width = input_size(image.shape[0], image.shape[1], area_px)
        shrinks = width < image.shape[1]
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        picture = np.ascontiguousarray(small.astype(np.float32).transpose(2, 0, 1)[None])
        if not turned:
            return self._run(picture)
        maps = self._run(np.ascontiguousarray(picture[..., ::-1]))
        return {name: value[..., ::-1] * _mirror_signs(name) for name, value in maps.items()}

    def _run(self, picture: np.ndarray) -> dict[str, np.ndarray]:
        found = self._network.run({INPUT: picture}, OUTPUTS)
        for name, channels in zip(OUTPUTS, CHANNELS, strict=True):
            step = 8 if name == "camera" else 2
            wanted = (1, channels, picture.shape[2] // step, picture.shape[3] // step)
            self._network.expect_shape(name, found[name], wanted)
        return {name: value[0] for name, value in found.items()}


def input_size(height: int, width: int, area_px: int = AREA_PX) -> tuple[int, int]:
    """Height and width of the network's input: about the area, the picture's ratio, multiples of the stride."""
    scale = (area_px / (height * width)) ** 0.5
    return _to_stride(height * scale), _to_stride(width * scale)


def _resized(maps: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(channels, rows, columns) at another size."""
    if maps.shape == shape:
        return maps
    return np.stack([cv2.resize(np.ascontiguousarray(m), shape[:0:-1], interpolation=cv2.INTER_LINEAR) for m in maps])


def _to_stride(length_px: float) -> int:
    return max(STRIDE, round(length_px / STRIDE) * STRIDE)


def _mirror_signs(name: str) -> np.ndarray:
    """Signs that undo a mirror, per channel."""
    signs = {"normal": (-1, 1, 1), "cues": (1, -1, 1, 1), "camera": (-1, 1, 1, 1, 1)}.get(name, (1,))
    return np.array(signs, np.float32)[:, None, None]


def _view_of(maps: dict[str, np.ndarray], stretch: tuple[float, float]) -> RoomView:
    normal = maps["normal"].transpose(1, 2, 0)
    up = maps["camera"][:2].transpose(1, 2, 0).astype(np.float64) * stretch
    sigma = np.clip(np.exp(np.clip(maps["camera"][3:5], -9, 3)), *_SIGMA_RANGE_RAD).astype(np.float64)
    return RoomView(
        disparity=maps["disparity"][0],
        normal_camera=normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6),
        class_logits=maps["classes"].transpose(1, 2, 0),
        cues=InstanceOffsets(
            _logistic(maps["cues"][0]), maps["cues"][1:3].transpose(1, 2, 0), _logistic(maps["cues"][3])
        ),
        field=PerspectiveField(
            up / np.maximum(np.linalg.norm(up, axis=-1, keepdims=True), 1e-9),
            maps["camera"][2].astype(np.float64),
            sigma[0],
            sigma[1],
        ),
    )


def _logistic(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(x, -30, 30)))


def _objects(view: RoomView, kind: str) -> list[Group]:
    """Furniture by its cues, or people as connected parts of their pixels."""
    logits, number = view.class_logits, CLASSES.index(kind)
    mask = logits.argmax(-1) == number
    weight = np.exp(logits - logits.max(-1, keepdims=True))
    probability = weight[..., number] / weight.sum(-1)
    if kind == "furniture":
        return [group for group in grouped(view.cues, mask, probability) if group.score > _MIN_SCORE]
    count, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    pieces = [parts == number for number in range(1, count)]
    return [Group(piece, float(probability[piece].mean())) for piece in pieces if piece.mean() > _MIN_PERSON]


class RoomDepth:
    """Slot `depth`: disparity."""

    kind = "disparity"
    name = "room-depth"

    def __init__(self, path: Path) -> None:
        """Load the weights; errors as of `SceneNetwork`."""
        self._net = SceneNetwork(path)

    def infer(self, image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """Disparity at the picture's own size, float32, up to scale and offset."""
        return self._net.disparity(image)


class RoomCamera:
    """Slot `camera`: perspective field."""

    name = "room-camera"

    def __init__(self, path: Path) -> None:
        """Load the weights; errors as of `SceneNetwork`."""
        self._net = SceneNetwork(path)

    def field(self, image: UInt8[np.ndarray, "height width 3"]) -> PerspectiveField:
        """Up and latitude in cells of an eighth of the network's input."""
        return self._net.see(image).field


class RoomSegment:
    """Slot `segment`: six classes, and instances of furniture and people."""

    name = "room-segment"

    def __init__(self, path: Path) -> None:
        """Load the weights; errors as of `SceneNetwork`."""
        self._net = SceneNetwork(path)

    def segment(self, image: UInt8[np.ndarray, "height width 3"]) -> Segmentation:
        """Classes and instances at the picture's own size."""
        view = self._net.see(image, SEGMENT_VIEWS)
        size = (image.shape[1], image.shape[0])
        logits = cv2.resize(view.class_logits, size, interpolation=cv2.INTER_LINEAR)
        semantic = logits.argmax(-1).astype(np.uint8)
        instances = []
        for kind in ("furniture", "person"):
            wanted = semantic == CLASSES.index(kind)
            for group in _objects(view, kind):
                near = cv2.resize(group.share, size, interpolation=cv2.INTER_LINEAR)
                instances.append(SeenInstance(kind, kind, group.score, (near > 0.5) & wanted))
        kept = [instance for instance in instances if instance.mask.any()]
        return Segmentation(semantic, tuple(sorted(kept, key=lambda instance: -instance.score)))
