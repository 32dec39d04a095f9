"""Training samples from shards of labeled images: cropped, flipped, degraded, with targets for every head."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from video2anim.errors import InputError
from video2anim.lab.synth.render.lens import pixel_directions
from video2anim.lab.synth.world import FURNITURE_LABELS, LABELS
from video2anim.networks.segmentation import CLASSES, MIN_INSTANCE_RATIO
from video2anim.types import Intrinsics

CLASS_OF_LABEL: dict[str, str] = {
    "floor": "floor", "rug": "floor", "wall": "wall", "door": "wall", "window": "wall", "picture": "wall",
    "skirting": "wall", "ceiling": "ceiling", "person": "person", "mesh": "furniture",
    **{label: "furniture" for label in FURNITURE_LABELS if label != "lamp"},
}  # fmt: skip
"""Class of each label of the synthetic clips; all others are `other`."""
CLASS_TABLE = np.array([CLASSES.index(CLASS_OF_LABEL.get(label, "other")) for label in LABELS], np.uint8)
HEAT_SIGMA = 0.03
"""Standard deviation of the heat map around an object's center, in image heights."""
SHARP_SCALE = 1.2
"""Images that are reduced by more are smoothed before."""


@dataclass(frozen=True, slots=True)
class PictureBatch:
    """Images of one size and their targets; pixel labels at half that size, camera fields at 1/8."""

    picture: Float[Tensor, "batch 3 height width"]
    """RGB, 0 to 255."""
    disparity: Float[Tensor, "batch rows columns"]
    """1 / depth in 1 / meters; 0 for the sky."""
    normal: Float[Tensor, "batch 3 rows columns"]
    """Camera frame, unit; zero for the sky."""
    classes: Int[Tensor, "batch rows columns"]
    heat: Float[Tensor, "batch rows columns"]
    """Heat map: 1 at the centers of furniture instances, with a Gaussian falloff."""
    offset: Float[Tensor, "batch 2 rows columns"]
    """Offset from furniture pixels to the center of their instance (x, y), in image heights."""
    has_offset: Float[Tensor, "batch rows columns"]
    boundary: Float[Tensor, "batch rows columns"]
    up: Float[Tensor, "batch 2 coarse_rows coarse_columns"]
    latitude: Float[Tensor, "batch coarse_rows coarse_columns"]


@dataclass(frozen=True, slots=True, eq=False)
class _Shard:
    maps: dict[str, np.ndarray]
    intrinsics: np.ndarray
    distortion: np.ndarray
    up_camera: np.ndarray


class PictureShards:
    """Shards of `video2anim synth --frames-only`; `refresh` finds shards that are finished later."""

    def __init__(self, folders: Sequence[Path], *, seed: int = 0) -> None:
        self._folders, self._seed = tuple(folders), seed
        self._shards: dict[Path, _Shard] = {}
        self._index: list[tuple[_Shard, int]] = []
        self.refresh()
        if not self._index:
            raise InputError(f"no finished shards in {', '.join(map(str, folders))}; make them by `video2anim synth`")

    def __len__(self) -> int:
        return len(self._index)

    def refresh(self) -> None:
        """Add shards that were finished since the last call."""
        for folder in self._folders:
            for meta in sorted(folder.glob("shard_*/meta.json")):
                if meta.parent not in self._shards:
                    shard = _read_shard(meta.parent)
                    self._shards[meta.parent] = shard
                    self._index += [(shard, row) for row in range(len(shard.intrinsics))]

    def batch(self, step: int, count: int, size: tuple[int, int]) -> PictureBatch:
        """`count` augmented samples of a training step; `size` is (height, width)."""
        rng = np.random.default_rng([self._seed, step])
        rows = [self._sample(int(rng.integers(len(self._index))), size, rng) for _ in range(count)]
        return _stacked(rows)

    def plain(self, numbers: Sequence[int], size: tuple[int, int]) -> PictureBatch:
        """Samples without augmentation, for validation."""
        return _stacked([self._sample(number, size, None) for number in numbers])

    def _sample(self, number: int, size: tuple[int, int], rng: np.random.Generator | None) -> dict[str, np.ndarray]:
        shard, row = self._index[number]
        rgb = shard.maps["rgb"][row]
        zoom, flip = (1.0, False) if rng is None else (float(rng.uniform(0.72, 1.0)), bool(rng.random() < 0.5))
        x0, y0, width, height = _crop(rgb.shape[:2], size, zoom)
        picture = _resampled(rgb, (x0, y0, width, height), size)
        half = (size[0] // 2, size[1] // 2)
        rows = np.round(y0 + (np.arange(half[0]) + 0.5) * height / half[0] - 0.5).astype(int).clip(0, rgb.shape[0] - 1)
        columns = np.round(x0 + (np.arange(half[1]) + 0.5) * width / half[1] - 0.5).astype(int)
        at = np.ix_(rows, columns.clip(0, rgb.shape[1] - 1))
        depth_mm = shard.maps["depth_mm"][row][at].astype(np.float32)
        normal = shard.maps["normal_camera"][row][at].astype(np.float32)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1.0)
        label, instance = shard.maps["label"][row][at], shard.maps["instance"][row][at].astype(np.int64)
        values = {
            "disparity": np.where(depth_mm > 0, 1000.0 / np.maximum(depth_mm, 1.0), 0.0).astype(np.float32),
            "normal": normal.transpose(2, 0, 1),
            "classes": CLASS_TABLE[label].astype(np.int64),
            **camera_targets(shard, row, (x0, y0, width, height), (size[0] // 8, size[1] // 8), rgb.shape[:2]),
        }
        if flip:
            picture, instance = picture[:, ::-1], instance[:, ::-1]
            values = {name: value[..., ::-1].copy() for name, value in values.items()}
            values["normal"][0] *= -1
            values["up"][0] *= -1
        values |= instance_targets(instance, values["classes"])
        picture = picture if rng is None else degraded(np.ascontiguousarray(picture), rng)
        return {"picture": np.ascontiguousarray(picture.transpose(2, 0, 1)), **values}


def _read_shard(folder: Path) -> _Shard:
    maps = {
        name: np.load(folder / f"{name}.npy", allow_pickle=False)
        for name in ("rgb", "depth_mm", "normal_camera", "label", "instance")
    }
    facts = [np.load(folder / f"{name}.npy", allow_pickle=False) for name in ("intrinsics", "distortion", "up_camera")]
    return _Shard(maps, *facts)


def _crop(have: tuple[int, int], want: tuple[int, int], zoom: float) -> tuple[float, float, float, float]:
    """x0, y0, width, height of a centered crop with the aspect ratio of `want`; `zoom` 1 is the largest crop."""
    ratio = want[1] / want[0]
    height = min(have[0], have[1] / ratio) * zoom
    width = height * ratio
    return (have[1] - width) / 2, (have[0] - height) / 2, width, height


def _resampled(
    rgb: np.ndarray, crop: tuple[float, float, float, float], size: tuple[int, int]
) -> UInt8[np.ndarray, "height width 3"]:
    x0, y0, width, height = crop
    scale = width / size[1]
    matrix = np.array([[scale, 0, x0 + 0.5 * scale - 0.5], [0, height / size[0], y0 + 0.5 * height / size[0] - 0.5]])
    soft = cv2.GaussianBlur(rgb, (0, 0), 0.35 * scale) if scale > SHARP_SCALE else rgb
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(soft, matrix, (size[1], size[0]), flags=flags, borderMode=cv2.BORDER_REPLICATE)


def camera_targets(
    shard: _Shard,
    row: int,
    crop: tuple[float, float, float, float],
    cells: tuple[int, int],
    have: tuple[int, int],
) -> dict[str, np.ndarray]:
    """Up direction and latitude at the centers of the cells of a crop, for the lens without distortion."""
    x0, y0, width, height = crop
    x = x0 + (np.arange(cells[1]) + 0.5) * width / cells[1] - 0.5
    y = y0 + (np.arange(cells[0]) + 0.5) * height / cells[0] - 0.5
    fx, fy, cx, cy = (float(value) for value in shard.intrinsics[row])
    lens = Intrinsics(fx, fy, cx, cy, have[1], have[0])
    rays = pixel_directions(np.stack(np.meshgrid(x, y), -1), lens, *(float(k) for k in shard.distortion[row]))
    up = np.asarray(shard.up_camera[row], float)
    in_picture = up[:2] - rays[..., :2] * up[2]
    in_picture /= np.maximum(np.linalg.norm(in_picture, axis=-1, keepdims=True), 1e-9)
    latitude = np.arcsin(np.clip(rays @ up / np.linalg.norm(rays, axis=-1), -1, 1))
    return {"up": in_picture.transpose(2, 0, 1).astype(np.float32), "latitude": latitude.astype(np.float32)}


def instance_targets(instance: np.ndarray, classes: np.ndarray) -> dict[str, np.ndarray]:
    """Heat map of centers, offsets and boundaries of furniture instances (boundaries of people too)."""
    rows, columns = instance.shape
    furniture = classes == CLASSES.index("furniture")
    y, x = np.mgrid[:rows, :columns].astype(np.float32)
    heat, known = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
    offset = np.zeros((2, rows, columns), np.float32)
    for number in np.unique(instance[furniture]):
        mask = furniture & (instance == number)
        if mask.sum() < MIN_INSTANCE_RATIO * mask.size:
            continue
        center_x, center_y = float(x[mask].mean()), float(y[mask].mean())
        far2 = (x - center_x) ** 2 + (y - center_y) ** 2
        np.maximum(heat, np.exp(-0.5 * far2 / (HEAT_SIGMA * rows) ** 2), out=heat)
        offset[0][mask], offset[1][mask] = (center_x - x[mask]) / rows, (center_y - y[mask]) / rows
        known[mask] = 1
    obj = np.where(furniture | (classes == CLASSES.index("person")), instance, 0)
    boundary = np.zeros((rows, columns), np.float32)
    for axis in (0, 1):
        differs = np.diff(obj, axis=axis) != 0
        first, second = [slice(None)] * 2, [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        boundary[tuple(first)][differs] = 1
        boundary[tuple(second)][differs] = 1
    return {"heat": heat, "offset": offset, "has_offset": known, "boundary": boundary}


def degraded(rgb: UInt8[np.ndarray, "height width 3"], rng: np.random.Generator) -> UInt8[np.ndarray, "height width 3"]:
    """The image with random color, light, blur, noise and compression."""
    value = rgb.astype(np.float32) / 255
    gray = value.mean(-1, keepdims=True)
    value = gray + (value - gray) * float(0.0 if rng.random() < 0.05 else rng.uniform(0.4, 1.6))
    value = value * np.exp(rng.normal(0, 0.08, 3)).astype(np.float32)
    value = np.clip((value - 0.5) * float(rng.uniform(0.65, 1.35)) + 0.5 + float(rng.normal(0, 0.08)), 0, 1)
    value = value ** float(np.exp(rng.normal(0, 0.25)))
    if rng.random() < 0.25:
        hsv = cv2.cvtColor(value.astype(np.float32), cv2.COLOR_RGB2HSV)
        hsv[..., 0] = (hsv[..., 0] + float(rng.uniform(0, 360))) % 360
        value = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)
    if rng.random() < 0.4:
        value = cv2.GaussianBlur(value, (0, 0), float(rng.uniform(0.3, 1.3)))
    if rng.random() < 0.12:
        length = int(rng.integers(2, 6))
        kernel = np.eye(length, dtype=np.float32) if rng.random() < 0.5 else np.ones((1, length), np.float32)
        value = cv2.filter2D(value, -1, kernel / kernel.sum())
    if rng.random() < 0.5:
        value = value + rng.standard_normal(value.shape, dtype=np.float32) * float(rng.uniform(0, 0.05))
    stored = np.clip(255 * value, 0, 255).astype(np.uint8)
    if rng.random() < 0.35:
        _, data = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 95))])
        stored = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    return stored


def _stacked(rows: list[dict[str, np.ndarray]]) -> PictureBatch:
    tensors = {name: torch.from_numpy(np.stack([row[name] for row in rows])) for name in rows[0]}
    tensors["picture"] = tensors["picture"].float()
    return PictureBatch(**tensors)
