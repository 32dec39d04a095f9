"""The scene network: depth, normals, classes, instances and perspective field of one image.

Tensor contract: input `picture` (1, 3, H, W) float32, RGB in 0 to 255, H and W multiples of 32; outputs at half that
size: `disparity` (1, 1, H/2, W/2) up to scale and offset, larger is nearer, `normal` (1, 3, ..) in camera axes, not
normalized, `classes` (1, 6, ..) logits of `CLASSES`, `cues` (1, 4, ..) logit of an object's center, offset to the
center (x, y in image heights), logit of a boundary; at an eighth: `camera` (1, 5, H/8, W/8) up (x, y), latitude in
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
from video2anim.networks.network import Network, sigmoid
from video2anim.networks.segmentation import CLASSES, MIN_INSTANCE_RATIO, SeenInstance, Segmentation

INPUT = "picture"
OUTPUTS = {"disparity": 1, "normal": 3, "classes": len(CLASSES), "cues": 4, "camera": 5}
"""Channels of each output."""
VIEWS = {
    "depth": ((256 * 192, False), (256 * 192, True), (192 * 144, True)),
    "segment": ((256 * 192, False), (320 * 256, True)),
    "camera": ((256 * 192, False), (256 * 192, True)),
}
"""Test-time views whose predictions are averaged, by slot: area of the network's input in px (the image's aspect ratio
is kept), and whether the image is mirrored. Chosen by `benchmarks/room_net.py`."""
STRIDE = 32
_SIGMA_RANGE_RAD = (0.005, 1.5)
_MIN_SCORE = 0.35
"""Furniture with a lower score is left out; precision equals recall there on renders of rooms kept for this choice."""


@dataclass(frozen=True, slots=True, eq=False)
class RoomView:
    """Predictions for one image; maps at half the network's input size."""

    disparity: Float[np.ndarray, "rows columns"]
    """Up to scale and offset; larger is nearer."""
    normal_camera: Float[np.ndarray, "rows columns 3"]
    """Unit normals."""
    class_logits: Float[np.ndarray, "rows columns 6"]
    instances: InstanceOffsets
    field: PerspectiveField


class SceneNetwork:
    """All heads of the network."""

    name = "room-net"

    def __init__(self, path: Path) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is no network of that contract.
        """
        self._network = Network(path, inputs=(INPUT,), outputs=tuple(OUTPUTS))

    def predict(
        self, image: UInt8[np.ndarray, "height width 3"], views: Sequence[tuple[int, bool]] = VIEWS["camera"]
    ) -> RoomView:
        """All heads, averaged over test-time views, in cells of the first view.

        Args:
            image: RGB.
            views: area of the network's input in px and whether it is mirrored, each.

        Raises:
            ModelMissingError: the network's outputs are not of the contract's shapes.
        """
        height, width = input_size(image.shape[0], image.shape[1], views[0][0])
        # Rounding to the stride changes the aspect ratio a little: directions are those of the image, not of the input.
        stretch = (image.shape[1] / width, image.shape[0] / height)
        found = [self._maps(image, area_px, mirrored=mirrored) for area_px, mirrored in views]
        maps = {
            name: np.mean([_resized(maps[name], found[0][name].shape) for maps in found], axis=0) for name in OUTPUTS
        }
        return _view_of(maps, stretch)

    def disparity(self, image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """Disparity at the image's own size, the mean over the views for depth.

        Raises:
            ModelMissingError: as of `predict`.
        """
        size = (image.shape[1], image.shape[0])
        maps = [self._maps(image, area_px, mirrored=mirrored)["disparity"][0] for area_px, mirrored in VIEWS["depth"]]
        return np.mean([cv2.resize(one, size, interpolation=cv2.INTER_LINEAR) for one in maps], axis=0)

    def _maps(self, image: np.ndarray, area_px: int, *, mirrored: bool) -> dict[str, np.ndarray]:
        """The network's outputs for one view; those of a mirrored image are mirrored back."""
        height, width = input_size(image.shape[0], image.shape[1], area_px)
        shrinks = width < image.shape[1]
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        picture = np.ascontiguousarray(small.astype(np.float32).transpose(2, 0, 1)[None])
        if not mirrored:
            return self._run(picture)
        maps = self._run(np.ascontiguousarray(picture[..., ::-1]))
        return {name: value[..., ::-1] * _mirror_signs(name) for name, value in maps.items()}

    def _run(self, picture: np.ndarray) -> dict[str, np.ndarray]:
        found = self._network.run({INPUT: picture}, tuple(OUTPUTS))
        for name, channels in OUTPUTS.items():
            step = 8 if name == "camera" else 2
            wanted = (1, channels, picture.shape[2] // step, picture.shape[3] // step)
            self._network.expect_shape(name, found[name], wanted)
        return {name: value[0] for name, value in found.items()}


def input_size(height: int, width: int, area_px: int = VIEWS["camera"][0][0]) -> tuple[int, int]:
    """Height and width of the network's input: about the area, the image's aspect ratio, multiples of the stride."""
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
        instances=InstanceOffsets(
            sigmoid(maps["cues"][0]), maps["cues"][1:3].transpose(1, 2, 0), sigmoid(maps["cues"][3])
        ),
        field=PerspectiveField(
            up / np.maximum(np.linalg.norm(up, axis=-1, keepdims=True), 1e-9),
            maps["camera"][2].astype(np.float64),
            sigma[0],
            sigma[1],
        ),
    )


def _objects(view: RoomView, kind: str) -> list[Group]:
    """Furniture by its center and offset heads, people as connected components of their pixels."""
    logits, number = view.class_logits, CLASSES.index(kind)
    mask = logits.argmax(-1) == number
    weight = np.exp(logits - logits.max(-1, keepdims=True))
    probability = weight[..., number] / weight.sum(-1)
    if kind == "furniture":
        return [group for group in grouped(view.instances, mask, probability) if group.score > _MIN_SCORE]
    count, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    pieces = [parts == number for number in range(1, count)]
    return [Group(piece, float(probability[piece].mean())) for piece in pieces if piece.mean() > MIN_INSTANCE_RATIO]


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
        return self._net.predict(image, VIEWS["camera"]).field


class RoomSegment:
    """Slot `segment`: six classes, and instances of furniture and people."""

    name = "room-segment"

    def __init__(self, path: Path) -> None:
        """Load the weights; errors as of `SceneNetwork`."""
        self._net = SceneNetwork(path)

    def segment(self, image: UInt8[np.ndarray, "height width 3"]) -> Segmentation:
        """Classes and instances at the picture's own size."""
        view = self._net.predict(image, VIEWS["segment"])
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
