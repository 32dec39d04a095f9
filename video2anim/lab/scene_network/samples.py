"""Training samples from shards of labeled images: cropped, flipped, degraded, with targets for every head.

All images of a batch are made at once on one device. Images stay in its memory as bytes, 0.6 MB each of 256x192 pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, Int8, UInt8
from torch import Tensor
from torch.nn import functional

from video2anim.errors import InputError
from video2anim.lab.scene_network.degrade import degraded
from video2anim.lab.synth.world import FURNITURE_LABELS, LABELS
from video2anim.networks.segmentation import CLASSES, MIN_INSTANCE_RATIO

CLASS_OF_LABEL: dict[str, str] = {
    "floor": "floor", "rug": "floor", "wall": "wall", "door": "wall", "window": "wall", "picture": "wall",
    "skirting": "wall", "ceiling": "ceiling", "person": "person", "mesh": "furniture",
    **{label: "furniture" for label in FURNITURE_LABELS if label != "lamp"},
}  # fmt: skip
"""Class of each label of the synthetic clips; all others are `other`."""
CLASS_TABLE = np.array([CLASSES.index(CLASS_OF_LABEL.get(label, "other")) for label in LABELS], np.uint8)
FURNITURE, PERSON = CLASSES.index("furniture"), CLASSES.index("person")
_HEAT_SIGMA = 0.03
"""Standard deviation of the heat map around an object's center, in image heights."""
_SHARP_SCALE = 1.2
"""Images that are reduced by more are smoothed."""
_MIN_ZOOM = 0.72
"""Smallest crop, as a share of the largest that has the wanted aspect ratio."""
_MAX_INSTANCES = 64
"""Pieces of furniture and people of one image that are told apart."""
_UNDISTORT_STEPS = 6
"""Newton steps on the radius. On 64 images they agree with the twelve of `render.lens.undistort` to 2e-6 rad."""
_JOINED = 1024
"""Shards are joined until they have so many images: a batch reads few arrays then."""


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
    instance: Int[Tensor, "batch rows columns"]
    """Pieces of furniture numbered from 1 in each image; 0 elsewhere, and for pieces that are too small."""
    heat: Float[Tensor, "batch rows columns"]
    """Heat map: 1 at the centers of furniture instances, with a Gaussian falloff."""
    offset: Float[Tensor, "batch 2 rows columns"]
    """Offset from furniture pixels to the center of their instance (x, y), in image heights."""
    has_offset: Float[Tensor, "batch rows columns"]
    boundary: Float[Tensor, "batch rows columns"]
    up: Float[Tensor, "batch 2 coarse_rows coarse_columns"]
    latitude: Float[Tensor, "batch coarse_rows coarse_columns"]


class _Images(NamedTuple):
    """Images of one size with their labels."""

    rgb: UInt8[Tensor, "n height width 3"]
    disparity: Float[Tensor, "n height width"]
    normal: Int8[Tensor, "n height width 3"]
    """127 for 1."""
    classes: UInt8[Tensor, "n height width"]
    instance: UInt8[Tensor, "n height width"]
    """Furniture and people, numbered from 1 in each image; 0 elsewhere."""
    camera: Float[Tensor, "n 9"]
    """fx, fy, cx, cy in pixels, k1, k2, up in camera axes."""

    def of(self, rows: Tensor) -> _Images:
        """Some of the images."""
        return _Images(*(part[rows] for part in self))


class PictureShards:
    """Shards of `video2anim synth --frames-only`; `refresh` takes shards that are finished later."""

    def __init__(self, folders: Sequence[Path], *, seed: int = 0, device: str = "cpu") -> None:
        self._folders, self._seed, self._device = tuple(folders), seed, torch.device(device)
        self._random = torch.Generator(self._device)
        self._reader = ThreadPoolExecutor(1)
        self._read: dict[Path, Future[_Images] | None] = {}
        self._images: list[_Images] = []
        self.refresh(wait=True)
        if not len(self):
            raise InputError(f"no finished shards in {', '.join(map(str, folders))}; make them by `video2anim synth`")

    def __len__(self) -> int:
        return sum(len(images.rgb) for images in self._images)

    def refresh(self, *, wait: bool = False) -> None:
        """Begin to read shards that were finished since the last call; take those that are read (all, with `wait`)."""
        for folder in self._folders:
            for meta in sorted(folder.glob("shard_*/meta.json")):
                if meta.parent not in self._read:
                    self._read[meta.parent] = self._reader.submit(_read_shard, meta.parent)
        for path, future in self._read.items():
            if future is not None and (wait or future.done()):
                self._take(_Images(*(part.to(self._device) for part in future.result())))
                self._read[path] = None

    def _take(self, images: _Images) -> None:
        size = images.rgb.shape[1:3]
        loose = [k for k, other in enumerate(self._images) if other.rgb.shape[1:3] == size and len(other.rgb) < _JOINED]
        if loose:
            images = _Images(*map(torch.cat, zip(self._images.pop(loose[0]), images, strict=True)))
        self._images.append(images)

    def batch(self, step: int, count: int, size: tuple[int, int]) -> PictureBatch:
        """`count` augmented samples of a training step; `size` is (height, width)."""
        rng = np.random.default_rng([self._seed, step])
        self._random.manual_seed(int(rng.integers(2**62)))
        numbers = np.sort(rng.integers(len(self), size=count))
        zoom, flip = rng.uniform(_MIN_ZOOM, 1.0, count), rng.random(count) < 0.5
        values = self._samples(numbers, size, torch.from_numpy(zoom).float(), torch.from_numpy(flip))
        return PictureBatch(**values | {"picture": degraded(values["picture"], self._random)})

    def plain(self, numbers: Sequence[int], size: tuple[int, int]) -> PictureBatch:
        """Samples without augmentation, for validation; `numbers` rise."""
        count = len(numbers)
        return PictureBatch(
            **self._samples(np.asarray(numbers), size, torch.ones(count), torch.zeros(count, dtype=torch.bool))
        )

    def _samples(
        self, numbers: Int[np.ndarray, "batch"], size: tuple[int, int], zoom: Tensor, flip: Tensor
    ) -> dict[str, Tensor]:
        parts, first = [], 0
        for images in self._images:
            here = torch.from_numpy((numbers >= first) & (numbers < first + len(images.rgb)))
            if here.any():
                rows = torch.from_numpy(numbers)[here].to(self._device) - first
                parts.append(_cropped(images.of(rows), size, zoom[here].to(self._device), flip[here].to(self._device)))
            first += len(images.rgb)
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def _read_shard(folder: Path) -> _Images:
    names = ("rgb", "depth_mm", "normal_camera", "label", "instance", "intrinsics", "distortion", "up_camera")
    maps = {name: np.load(folder / f"{name}.npy", allow_pickle=False) for name in names}
    depth_m = maps["depth_mm"].astype(np.float32) / 1000
    disparity = np.where(depth_m > 0, 1 / np.maximum(depth_m, 1e-3), 0)
    classes = CLASS_TABLE[maps["label"]]
    instance = np.zeros(classes.shape, np.uint8)
    for row, shown in enumerate(np.isin(classes, (FURNITURE, PERSON))):
        raw = maps["instance"][row]
        for number, value in enumerate(np.unique(raw[shown])[: _MAX_INSTANCES - 1], 1):
            instance[row][shown & (raw == value)] = number
    camera = np.concatenate([maps["intrinsics"], maps["distortion"], maps["up_camera"]], 1).astype(np.float32)
    arrays = (maps["rgb"], disparity, maps["normal_camera"], classes, instance, camera)
    return _Images(*(torch.from_numpy(array) for array in arrays))


class _Crop(NamedTuple):
    """Where samples are in their images, in pixels."""

    x0: Float[Tensor, "batch"]
    y0: Float[Tensor, "batch"]
    width: Float[Tensor, "batch"]
    height: Float[Tensor, "batch"]

    def centers(self, rows: int, columns: int) -> tuple[Float[Tensor, "batch columns"], Float[Tensor, "batch rows"]]:
        """x and y of the centers of cells."""
        y, x = (torch.arange(n, device=self.x0.device) + 0.5 for n in (rows, columns))
        return (
            self.x0[:, None] + x * self.width[:, None] / columns - 0.5,
            self.y0[:, None] + y * self.height[:, None] / rows - 0.5,
        )


def _cropped(images: _Images, size: tuple[int, int], zoom: Float[Tensor, "batch"], flip: Tensor) -> dict[str, Tensor]:
    """Centered crops with their targets, some of them mirrored; `zoom` 1 is the largest crop."""
    height, width = images.rgb.shape[1:3]
    ratio = size[1] / size[0]
    tall = min(height, width / ratio) * zoom
    box = _Crop((width - ratio * tall) / 2, (height - tall) / 2, ratio * tall, tall)
    x, y = box.centers(size[0] // 2, size[1] // 2)
    rows, columns = y.round().long().clamp(0, height - 1), x.round().long().clamp(0, width - 1)
    at = (torch.arange(len(zoom), device=zoom.device)[:, None, None], rows[:, :, None], columns[:, None, :])
    normal = images.normal[at].float()
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1.0)
    values = {
        "picture": _resampled(images.rgb, box, size),
        "disparity": images.disparity[at].float(),
        "normal": normal.permute(0, 3, 1, 2),
        "classes": images.classes[at].long(),
        "instance": images.instance[at].long(),
        **camera_targets(images.camera, *box.centers(size[0] // 8, size[1] // 8)),
    }
    for name, value in values.items():
        mirrored = value.flip(-1)
        if name in ("normal", "up"):
            mirrored[:, 0] *= -1
        values[name] = torch.where(flip.reshape(-1, *[1] * (value.ndim - 1)), mirrored, value)
    return values | instance_targets(values["instance"], values["classes"])


def _resampled(rgb: Tensor, box: _Crop, size: tuple[int, int]) -> Float[Tensor, "batch 3 height width"]:
    """Bilinear; the mean of four samples to a pixel where the image is reduced by more than `_SHARP_SCALE`."""
    height, width = rgb.shape[1:3]
    picture, sampled = rgb.permute(0, 3, 1, 2).float(), []
    for finer in (1, 2):
        x, y = box.centers(finer * size[0], finer * size[1])
        x, y = (2 * x + 1) / width - 1, (2 * y + 1) / height - 1
        grid = torch.stack(torch.broadcast_tensors(x[:, None, :], y[:, :, None]), -1)
        found = functional.grid_sample(picture, grid, padding_mode="border", align_corners=False)
        sampled.append(functional.avg_pool2d(found, finer))
    reduced = box.width / size[1] > _SHARP_SCALE
    return torch.where(reduced[:, None, None, None], sampled[1], sampled[0]).round()


def camera_targets(
    camera: Float[Tensor, "batch 9"], x: Float[Tensor, "batch columns"], y: Float[Tensor, "batch rows"]
) -> dict[str, Tensor]:
    """Up direction and latitude (radians) at pixels x, y, for the lens without distortion."""
    fx, fy, cx, cy, k1, k2, *up = (camera[:, k, None, None] for k in range(9))
    seen_x, seen_y = torch.broadcast_tensors((x[:, None, :] - cx) / fx, (y[:, :, None] - cy) / fy)
    seen = torch.hypot(seen_x, seen_y)
    radius = seen
    for _ in range(_UNDISTORT_STEPS):
        r2 = radius * radius
        error = radius * (1 + r2 * (k1 + k2 * r2)) - seen
        radius = radius - error / (1 + r2 * (3 * k1 + 5 * k2 * r2)).clamp_min(0.05)
    scale = radius / seen.clamp_min(1e-12)
    ray_x, ray_y = seen_x * scale, seen_y * scale
    along = torch.stack([up[0] - ray_x * up[2], up[1] - ray_y * up[2]], 1)
    sine = (ray_x * up[0] + ray_y * up[1] + up[2]) / torch.sqrt(ray_x**2 + ray_y**2 + 1)
    return {
        "up": along / along.norm(dim=1, keepdim=True).clamp_min(1e-9), "latitude": torch.arcsin(sine.clamp(-1, 1)),
    }  # fmt: skip


def instance_targets(
    instance: Int[Tensor, "batch rows columns"], classes: Int[Tensor, "batch rows columns"]
) -> dict[str, Tensor]:
    """Heat map of centers, offsets and boundaries of furniture instances (boundaries of people too).

    Args:
        instance: Furniture and people numbered from 1 to `_MAX_INSTANCES` - 1 in each image; 0 elsewhere.
        classes: Numbers of `CLASSES`.
    """
    batch, rows, columns = instance.shape
    furniture = torch.where(classes == FURNITURE, instance, 0)
    index = furniture.flatten(1)
    axes = [torch.arange(n, device=index.device, dtype=torch.float32) for n in (columns, rows)]
    x, y = axes[0].expand(rows, -1), axes[1][:, None].expand(-1, columns)
    none = torch.zeros(batch, _MAX_INSTANCES, device=index.device)
    area = none.scatter_add(1, index, torch.ones_like(x).flatten().expand(batch, -1))
    center = [none.scatter_add(1, index, v.flatten().expand(batch, -1)) / area.clamp_min(1) for v in (x, y)]
    counts = area >= MIN_INSTANCE_RATIO * rows * columns
    counts[:, 0] = False
    known = counts.gather(1, index).reshape(instance.shape)
    goal = torch.stack([c.gather(1, index).reshape(instance.shape) for c in center], 1)
    near = [
        torch.exp(-0.5 * ((v - c[..., None]) / (_HEAT_SIGMA * rows)) ** 2) for v, c in zip(axes, center, strict=True)
    ]
    heat = torch.zeros(batch, rows, columns, device=index.device)
    for number in torch.nonzero(counts.any(0)).flatten().tolist():
        blob = near[1][:, number, :, None] * near[0][:, number, None, :]
        heat = torch.maximum(heat, blob * counts[:, number, None, None])
    return {
        "instance": torch.where(known, furniture, 0), "heat": heat, "boundary": _boundaries(instance),
        "offset": (goal - torch.stack([x, y])) * known[:, None] / rows, "has_offset": known.float(),
    }  # fmt: skip


def _boundaries(instance: Int[Tensor, "batch rows columns"]) -> Float[Tensor, "batch rows columns"]:
    """1 on both sides of where instances meet or end."""
    found = torch.zeros(instance.shape, device=instance.device)
    for axis in (1, 2):
        differs = instance.diff(dim=axis) != 0
        for side in (0, 1):
            found.narrow(axis, side, differs.shape[axis]).masked_fill_(differs, 1)
    return found
