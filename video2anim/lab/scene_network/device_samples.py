"""Training samples on a GPU: the same targets as `samples`, made for a whole batch at once.

The images stay in the GPU's memory as bytes (0.5 MB each). Cropping, flipping, degrading and the targets of all heads
take a few milliseconds for a batch there; on the processor `samples` takes that long for one image.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from video2anim.lab.scene_network.degrade import degraded_batch
from video2anim.lab.scene_network.samples import CLASS_TABLE, HEAT_SIGMA, SHARP_SCALE, PictureBatch
from video2anim.networks.segmentation import CLASSES, MIN_INSTANCE_RATIO

MAX_INSTANCES = 64
"""Objects and people of one image that are told apart."""
UNDISTORT_STEPS = 6
"""Newton steps on the radius; the lenses of the images need three."""
FURNITURE, PERSON = CLASSES.index("furniture"), CLASSES.index("person")


class Images(NamedTuple):
    """Images of one size with their labels, as arrays or tensors."""

    rgb: Any
    """(n, height, width, 3) uint8."""
    disparity: Any
    """(n, height, width) half precision, 1/m, 0 for the sky."""
    normal: Any
    """(n, height, width, 3) int8, camera frame, 127 for 1."""
    classes: Any
    """(n, height, width) uint8, numbers of `CLASSES`."""
    instance: Any
    """(n, height, width) uint8: furniture and people, numbered from 1 in each image; 0 elsewhere."""
    facts: Any
    """(n, 9) single precision: fx, fy, cx, cy in pixels, k1, k2, up in camera axes."""


def compact(folder: Path) -> Images:
    """A shard of `video2anim synth --frames-only` as arrays that `DeviceSamples` takes."""
    maps = {p.stem: np.load(p, allow_pickle=False) for p in sorted(folder.glob("*.npy"))}
    depth_m = maps["depth_mm"].astype(np.float32) / 1000
    classes = CLASS_TABLE[maps["label"]]
    instance = np.zeros(classes.shape, np.uint8)
    for row, raw in enumerate(maps["instance"]):
        shown = np.isin(classes[row], (FURNITURE, PERSON))
        numbers = np.unique(raw[shown])[: MAX_INSTANCES - 1]
        for number, value in enumerate(numbers, 1):
            instance[row][shown & (raw == value)] = number
    facts = np.concatenate([maps["intrinsics"], maps["distortion"], maps["up_camera"]], 1)
    disparity = np.where(depth_m > 0, 1 / np.maximum(depth_m, 1e-3), 0)
    return Images(
        maps["rgb"], disparity.astype(np.float16), maps["normal_camera"], classes, instance, facts.astype(np.float32)
    )


class DeviceSamples:
    """Images in the device's memory, in groups of one size each, from which batches are drawn."""

    def __init__(self, device: torch.device, seed: int) -> None:
        self._device = device
        self._held: dict[tuple[int, int], tuple[Images, int]] = {}
        self._random = torch.Generator(device).manual_seed(seed)
        self._draw = np.random.default_rng(seed)

    def __len__(self) -> int:
        return sum(count for _, count in self._held.values())

    def add(self, images: Images) -> None:
        """Take a shard; the memory of its size is doubled when it is full."""
        size, more = images.rgb.shape[1:3], len(images.rgb)
        held, count = self._held.get(size, (None, 0))
        if held is None or count + more > len(held.rgb):
            room = max(2 * (count + more), 1024)
            grown = Images(
                *(torch.empty((room, *a.shape[1:]), dtype=_tensor(a).dtype, device=self._device) for a in images)
            )
            if held is not None:
                for new, old in zip(grown, held, strict=True):
                    new[:count] = old[:count]
            held = grown
        for kept, array in zip(held, images, strict=True):
            kept[count : count + more] = _tensor(array).to(self._device, non_blocking=True)
        self._held[size] = held, count + more

    def batch(self, count: int, size: tuple[int, int]) -> tuple[PictureBatch, Int[Tensor, "batch rows columns"]]:
        """`count` augmented samples of (height, width) pixels, and the numbers of their furniture."""
        groups = list(self._held.values())
        sizes = np.array([held for _, held in groups], float)
        counts = self._draw.multinomial(count, sizes / sizes.sum())
        parts = []
        for (images, held), part in zip(groups, counts.tolist(), strict=True):
            chosen = torch.randint(held, (part,), device=self._device, generator=self._random)
            zoom = torch.empty(part, device=self._device).uniform_(0.72, 1.0, generator=self._random)
            flip = torch.rand(part, device=self._device, generator=self._random) < 0.5
            if part:
                parts.append(crop(Images(*(a[chosen] for a in images)), size, zoom, flip))
        joined = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        joined["picture"] = degraded_batch(joined["picture"], self._random)
        instance = joined.pop("instance")
        return PictureBatch(**joined), instance

    def plain(self, size: tuple[int, int]) -> PictureBatch:
        """All images without augmentation, for validation."""
        parts = []
        for images, held in self._held.values():
            whole = torch.ones(held, device=self._device)
            parts.append(crop(Images(*(a[:held] for a in images)), size, whole, whole < 0))
        joined = {name: torch.cat([part[name] for part in parts]) for name in PictureBatch.__slots__}
        return PictureBatch(**joined)


def _tensor(array: Any) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array))


def crop(images: Images, size: tuple[int, int], zoom: Float[Tensor, "batch"], flip: Tensor) -> dict[str, Tensor]:
    """Centered crops of (height, width) pixels with their targets, in the fields of `PictureBatch` and `instance`.

    Args:
        images: A batch of images.
        size: Of the samples.
        zoom: Share of the largest crop with that aspect ratio.
        flip: Whether to mirror left and right.
    """
    height, width = images.rgb.shape[1:3]
    ratio = size[1] / size[0]
    tall = min(height, width / ratio) * zoom
    wide = tall * ratio
    box = ((width - wide) / 2, (height - tall) / 2, wide, tall)
    half = (size[0] // 2, size[1] // 2)
    x, y = _centers(box, half)
    rows, columns = y.round().long().clamp(0, height - 1), x.round().long().clamp(0, width - 1)
    numbers = torch.arange(len(zoom), device=zoom.device)[:, None, None]
    at = (numbers, rows[:, :, None], columns[:, None, :])
    normal = images.normal[at].float()
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1.0)
    up, latitude = camera_fields(images.facts, *_centers(box, (size[0] // 8, size[1] // 8)))
    values = {
        "picture": _resampled(images.rgb, box, size),
        "disparity": images.disparity[at].float(),
        "normal": normal.permute(0, 3, 1, 2),
        "classes": images.classes[at].long(),
        "up": up,
        "latitude": latitude,
        "instance": images.instance[at].long(),
    }
    for name, value in values.items():
        turned = value.flip(-1)
        if name in ("normal", "up"):
            turned[:, 0] *= -1
        values[name] = torch.where(flip.reshape(-1, *(1,) * (value.ndim - 1)), turned, value)
    targets, furniture = instance_targets(values["instance"], values["classes"])
    return values | targets | {"instance": furniture}


def _centers(box: tuple[Tensor, Tensor, Tensor, Tensor], cells: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """x (batch, columns) and y (batch, rows) of cells of a crop, in pixels of the image."""
    x0, y0, wide, tall = box
    rows, columns = (torch.arange(n, device=x0.device) + 0.5 for n in cells)
    return (
        x0[:, None] + columns * wide[:, None] / cells[1] - 0.5,
        y0[:, None] + rows * tall[:, None] / cells[0] - 0.5,
    )


def _resampled(rgb: Tensor, box: tuple[Tensor, Tensor, Tensor, Tensor], size: tuple[int, int]) -> Tensor:
    """Bilinear crops; where they reduce the image by more than `SHARP_SCALE`, the mean of four samples."""
    height, width = rgb.shape[1:3]
    sampled = []
    for finer in (1, 2):
        x, y = _centers(box, (finer * size[0], finer * size[1]))
        grid = torch.stack(torch.broadcast_tensors(
            ((2 * x + 1) / width - 1)[:, None, :], ((2 * y + 1) / height - 1)[:, :, None]
        ), -1)  # fmt: skip
        picture = rgb.permute(0, 3, 1, 2).float()
        found = functional.grid_sample(picture, grid, padding_mode="border", align_corners=False)
        sampled.append(functional.avg_pool2d(found, finer))
    reduced = box[2] / size[1] > SHARP_SCALE
    return torch.where(reduced[:, None, None, None], sampled[1], sampled[0])


def camera_fields(
    facts: Float[Tensor, "batch 9"], x: Float[Tensor, "batch columns"], y: Float[Tensor, "batch rows"]
) -> tuple[Float[Tensor, "batch 2 rows columns"], Float[Tensor, "batch rows columns"]]:
    """Up direction and latitude (radians) at pixels, for the lens without distortion: `samples.camera_targets`."""
    fx, fy, cx, cy, k1, k2 = (facts[:, i, None, None] for i in range(6))
    up = facts[:, 6:9, None, None]
    seen_x = ((x[:, None, :] - cx) / fx).expand(-1, y.shape[1], -1)
    seen_y = ((y[:, :, None] - cy) / fy).expand(-1, -1, x.shape[1])
    seen = torch.sqrt(seen_x**2 + seen_y**2)
    radius = seen.clone()
    for _ in range(UNDISTORT_STEPS):
        r2 = radius * radius
        error = radius * (1 + r2 * (k1 + k2 * r2)) - seen
        radius = radius - error / (1 + r2 * (3 * k1 + 5 * k2 * r2)).clamp_min(0.05)
    scale = radius / seen.clamp_min(1e-12)
    ray_x, ray_y = seen_x * scale, seen_y * scale
    along = torch.stack([up[:, 0] - ray_x * up[:, 2], up[:, 1] - ray_y * up[:, 2]], 1)
    height = ray_x * up[:, 0] + ray_y * up[:, 1] + up[:, 2]
    sine = height / torch.sqrt(ray_x**2 + ray_y**2 + 1)
    return along / along.norm(dim=1, keepdim=True).clamp_min(1e-9), torch.arcsin(sine.clamp(-1, 1))


def instance_targets(
    instance: Int[Tensor, "batch rows columns"], classes: Int[Tensor, "batch rows columns"]
) -> tuple[dict[str, Tensor], Int[Tensor, "batch rows columns"]]:
    """`samples.instance_targets` for a batch, and the numbers of the furniture that counts (0 elsewhere)."""
    batch, rows, columns = instance.shape
    furniture = torch.where(classes == FURNITURE, instance, 0)
    index = furniture.flatten(1)
    y, x = (
        v.float()
        for v in torch.meshgrid(*(torch.arange(n, device=index.device) for n in (rows, columns)), indexing="ij")
    )
    area = torch.zeros(batch, MAX_INSTANCES, device=index.device).scatter_add(
        1, index, torch.ones_like(index, dtype=torch.float)
    )
    center = [
        torch.zeros_like(area).scatter_add(1, index, v.flatten().expand(batch, -1)) / area.clamp_min(1) for v in (x, y)
    ]
    counts = area >= MIN_INSTANCE_RATIO * rows * columns
    counts[:, 0] = False
    known = counts.gather(1, index).reshape(instance.shape)
    offset = torch.stack(
        [c.gather(1, index).reshape(instance.shape) - v for c, v in zip(center, (x, y), strict=True)], 1
    )
    spread = [
        torch.exp(-0.5 * ((torch.arange(n, device=index.device) - c[..., None]) / (HEAT_SIGMA * rows)) ** 2)
        for c, n in zip(center, (columns, rows), strict=True)
    ]
    across, down = spread[0] * counts[..., None], spread[1]
    heat = torch.zeros(batch, rows, columns, device=index.device)
    for number in range(int(torch.nonzero(counts.any(0)).max()) + 1 if bool(counts.any()) else 0):
        heat = torch.maximum(heat, down[:, number, :, None] * across[:, number, None, :])
    boundary = torch.zeros_like(heat)
    for axis in (1, 2):
        differs = instance.diff(dim=axis) != 0
        length = instance.shape[axis]
        boundary.narrow(axis, 0, length - 1).masked_fill_(differs, 1)
        boundary.narrow(axis, 1, length - 1).masked_fill_(differs, 1)
    targets = {
        "heat": heat, "offset": offset * known[:, None] / rows, "has_offset": known.float(), "boundary": boundary,
    }  # fmt: skip
    return targets, torch.where(known, furniture, 0)
