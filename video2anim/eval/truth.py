"""The truth folder of a clip as the evaluation reads it (layout: docs/evaluation.md)."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from video2anim.artifacts.images import read_png
from video2anim.artifacts.motion_io import read_motion
from video2anim.errors import ArtifactError, InputError
from video2anim.types import BodyMotion, Intrinsics

FORMAT_VERSION = 1
_FIRST_PERSON_VALUE = 1000
"""Pixels of person p hold 1000 + p."""
_NEEDED = ("up_camera", "label_frame_index", "depth_mm", "instance", "background_depth_mm", "background_instance")
_FLOOR_LABELS = ("floor", "rug")


@dataclass(frozen=True, slots=True)
class TrueObject:
    """A thing of the true world."""

    object_id: int
    label: str
    is_furniture: bool
    is_moving: bool
    """Carried by somebody; its pose is that of the first frame."""
    T_world_object: Float[np.ndarray, "4 4"]
    file: Path
    visible_px: int
    """Pixels in the first background map."""

    @property
    def stands(self) -> bool:
        """Furniture proper: neither clutter nor carried."""
        return self.is_furniture and not self.is_moving


@dataclass(frozen=True, eq=False)
class Truth:
    """Everything known of a clip. Maps may be smaller than the clip; depth is z-depth, 0 = nothing was hit."""

    folder: Path
    name: str
    meta: dict[str, Any]
    people: tuple[BodyMotion, ...]
    """Main person first, in the true world."""
    up_camera: Float[np.ndarray, "frames 3"]
    label_frame_index: Int[np.ndarray, "maps"]
    depth_mm: UInt16[np.ndarray, "maps height width"]
    instance: UInt16[np.ndarray, "maps height width"]
    background_depth_m: Float[np.ndarray, "height width"]
    """First frame's camera, without people and carried things."""
    background_instance: Int[np.ndarray, "height width"]
    amodal: dict[int, Bool[np.ndarray, "height width"]]
    """Whole outline of each piece of furniture as if nothing hid it, by object."""
    person_box_px: Float[np.ndarray, "people frames 4"]
    """x0, y0, x1, y1 of visible pixels, NaN when unseen; the persons of `people`."""
    objects: tuple[TrueObject, ...]
    is_static: bool

    @property
    def main(self) -> BodyMotion:
        return self.people[0]

    @property
    def intrinsics(self) -> Intrinsics:
        return self.main.intrinsics

    @property
    def frame_time_s(self) -> Float[np.ndarray, "frames"]:
        return self.main.frame_time_s

    @property
    def fps(self) -> float:
        return float(self.meta.get("fps", 30.0))

    @property
    def duration_s(self) -> float:
        return len(self.frame_time_s) / self.fps

    @property
    def person_pixels(self) -> Bool[np.ndarray, "maps height width"]:
        return self.instance >= _FIRST_PERSON_VALUE

    @property
    def floor_mask(self) -> Bool[np.ndarray, "height width"]:
        """Visible floor without people; rugs lie on it and belong to it."""
        ids = [item.object_id for item in self.objects if item.label in _FLOOR_LABELS]
        return np.isin(self.background_instance, ids)

    @functools.cached_property
    def plate_rgb(self) -> UInt8[np.ndarray, "height width 3"]:
        """The first frame's camera without people.

        Raises:
            ArtifactError: absent or unreadable.
        """
        path = self.folder / "plate.png"
        if not path.is_file():
            raise ArtifactError(f"truth: want plate.png, found none in {self.folder}")
        return read_png(path, np.dtype(np.uint8))

    def furniture(self, least_px: float) -> tuple[TrueObject, ...]:
        """Standing furniture of which at least so many pixels of the clip are seen, free of people."""
        map_px = self.background_instance.size
        share = map_px / (self.intrinsics.width_px * self.intrinsics.height_px)
        return tuple(item for item in self.objects if item.stands and item.visible_px >= least_px * share)

    def mask(self, object_id: int) -> Bool[np.ndarray, "height width"]:
        """Visible pixels of an object in the background map."""
        return self.background_instance == object_id


def read_truth(folder: Path | str) -> Truth:
    """Read a truth folder.

    Raises:
        InputError: not a truth folder, of another format version, or damaged.
    """
    folder = Path(folder)
    for name in ("meta.json", "truth.npz"):
        if not (folder / name).is_file():
            raise InputError(f"{folder}: want the truth folder of a clip (made by `video2anim synth`), found no {name}")
    try:
        meta = json.loads((folder / "meta.json").read_text())
        version = meta["format_version"]
        if version != FORMAT_VERSION:
            raise InputError(
                f"{folder}: want a truth folder of format {FORMAT_VERSION}, got {version!r}; make the clip again"
            )
        truth = _truth_from(folder, meta, _arrays(folder / "truth.npz"))
        _expect_sound(truth)
        return truth
    except InputError:
        raise
    except (
        ArtifactError,
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        IndexError,
        RecursionError,
    ) as error:
        detail = f"key {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{folder}: damaged truth folder ({detail}); make the clip again") from error


def _expect_sound(truth: Truth) -> None:
    """What numbers are made from has to be finite and to belong together."""
    if not 0 < truth.fps < 1e6:
        raise ValueError(f"fps: want more than 0, got {truth.fps:g}")
    for item in truth.objects:
        if not np.isfinite(item.T_world_object).all():
            raise ValueError(f"object {item.object_id}: want a finite pose")
    index, frames = truth.label_frame_index, truth.main.frame_count
    if index.ndim != 1 or index.size == 0 or index.min() < 0 or index.max() >= frames:
        raise ValueError(f"label_frame_index: want frames from 0 to {frames - 1}")
    height, width = truth.background_depth_m.shape
    for name, maps, shape in (
        ("depth_mm", truth.depth_mm, (len(index), height, width)),
        ("instance", truth.instance, (len(index), height, width)),
        ("background_instance", truth.background_instance, (height, width)),
    ):
        if maps.shape != shape or maps.dtype.kind not in "iu":
            raise ValueError(f"{name}: want whole numbers of shape {shape}, got {maps.dtype} {maps.shape}")


def _arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except Exception as error:  # zipfile and zlib raise classes of their own
        raise ArtifactError(f"{path.name} is unreadable: {error}") from error


def _truth_from(folder: Path, meta: dict[str, Any], arrays: dict[str, np.ndarray]) -> Truth:
    for key in _NEEDED:
        if key not in arrays:
            raise KeyError(key)
    people = _people(folder, meta)
    seen = dict(zip(_list(arrays, "object_id"), _list(arrays, "object_visible_px"), strict=True))
    boxes_px = arrays.get("person_box_px", np.zeros((0, people[0].frame_count, 4)))
    rows = np.full((len(people), people[0].frame_count, 4), np.nan)
    rows[: min(len(boxes_px), len(people))] = boxes_px[: len(people)]
    return Truth(
        folder=folder,
        name=str(meta.get("name", folder.name)),
        meta=meta,
        people=people,
        up_camera=arrays["up_camera"],
        label_frame_index=arrays["label_frame_index"].astype(np.int64),
        depth_mm=arrays["depth_mm"],
        instance=arrays["instance"],
        background_depth_m=arrays["background_depth_mm"][0].astype(np.float32) / 1000,
        background_instance=arrays["background_instance"][0].astype(np.int64),
        amodal={
            number: mask.astype(bool)
            for number, mask in zip(_list(arrays, "amodal_object_id"), arrays.get("amodal", ()), strict=True)
        },
        person_box_px=rows,
        objects=tuple(_object(folder, entry, seen) for entry in meta["objects"]),
        is_static=bool(arrays.get("is_static", True)),
    )


def _people(folder: Path, meta: dict[str, Any]) -> tuple[BodyMotion, ...]:
    """Motions in the order of `meta["persons"]`, so that they fit the rows of `person_box_px`."""
    ids = [int(person["person_id"]) for person in meta["persons"]]
    people = []
    for number in ids:
        further = folder / f"truth_{number}.npz"
        people.append(read_motion(further if further.is_file() else folder / "truth.npz"))
    frames = {motion.frame_count for motion in people}
    if len(frames) != 1:
        raise ValueError(f"the persons have different numbers of frames: {sorted(frames)}")
    return tuple(people)


def _object(folder: Path, entry: dict[str, Any], seen: dict[int, int]) -> TrueObject:
    number = int(entry["object_id"])
    return TrueObject(
        object_id=number,
        label=str(entry["label"]),
        is_furniture=bool(entry["is_furniture"]),
        is_moving=bool(entry.get("is_moving", False)),
        T_world_object=np.asarray(entry["T_world_object"], dtype=np.float64).reshape(4, 4),
        file=folder / str(entry["file"]),
        visible_px=int(seen.get(number, 0)),
    )


def _list(arrays: dict[str, np.ndarray], key: str) -> list[int]:
    return [int(x) for x in arrays[key]] if key in arrays else []
