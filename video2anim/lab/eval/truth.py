"""Reads the truth folder of a clip (layout: docs/evaluation.md)."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16
from pydantic import Field, FiniteFloat, NonNegativeInt

from video2anim.artifacts.arrays import Archive, Axes, expect_content, opened_archive
from video2anim.artifacts.images import read_png
from video2anim.artifacts.motion_io import read_motion
from video2anim.artifacts.stage_files import member, read_json
from video2anim.errors import ArtifactError, InputError
from video2anim.lab.synth.world import PERSON_ID
from video2anim.types import BodyMotion, Intrinsics
from video2anim.types.checks import MAX_M
from video2anim.types.storage import Holds

"""Pixels of person p hold 1000 + p."""
_FLOOR_LABELS = ("floor", "rug")
_ARRAYS: dict[str, Any] = {
    "up_camera": Annotated[Float[np.ndarray, "frames 3"], Holds.DIRECTION],
    "is_static": Bool[np.ndarray, ""],
    "label_frame_index": Annotated[Int[np.ndarray, "maps"], Holds.FRAMES],
    "depth_mm": UInt16[np.ndarray, "maps height width"],
    "instance": UInt16[np.ndarray, "maps height width"],
    "background_depth_mm": Annotated[UInt16[np.ndarray, "backgrounds height width"], Holds.SOMETHING],
    "background_instance": UInt16[np.ndarray, "backgrounds height width"],
    "object_id": Int[np.ndarray, "objects"],
    "object_visible_px": Int[np.ndarray, "objects"],
    "amodal_object_id": Int[np.ndarray, "outlines"],
    "amodal": Bool[np.ndarray, "outlines height width"],
    "person_box_px": Annotated[Float[np.ndarray, "people frames 4"], Holds.GAPS],
}
"""Arrays of `truth.npz` that are read besides the main person's motion, with their types and checks."""
_MOVING: dict[str, Any] = {
    "moving_object_id": Int[np.ndarray, "moving"],
    "T_world_moving": Annotated[Float[np.ndarray, "moving frames 4 4"], Holds.RIGID],
    "moving_held": Bool[np.ndarray, "moving frames"],
    "moving_hands": Bool[np.ndarray, "moving 2"],
}
"""Arrays of moved objects; older truth folders lack them."""
_Place = Annotated[float, Field(ge=-MAX_M, le=MAX_M)]
_Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


@dataclass(frozen=True)
class _Person:
    person_id: NonNegativeInt
    kind: str = ""


@dataclass(frozen=True)
class _Object:
    object_id: int
    label: str
    is_furniture: bool
    T_world_object: tuple[_Row, _Row, _Row, _Row]
    file: str
    is_moving: bool = False


@dataclass(frozen=True)
class _Room:
    bounds_m: tuple[_Place, _Place, _Place, _Place]


@dataclass(frozen=True)
class _Meta:
    """The entries of `meta.json` that are read."""

    format_version: Literal[1]
    name: str
    preset: str
    fps: Annotated[float, Field(ge=1, le=1000)]
    frames: int
    persons: Annotated[tuple[_Person, ...], Field(min_length=1)]
    objects: tuple[_Object, ...]
    room: _Room


@dataclass(frozen=True, slots=True)
class TrueObject:
    """An object of the true world."""

    object_id: int
    label: str
    is_furniture: bool
    is_moving: bool
    """Whether somebody carries it; `T_world_object` is then the pose in the first frame."""
    T_world_object: Float[np.ndarray, "4 4"]
    file: Path
    visible_px: int
    """Pixels in the first background map."""
    T_world_object_frames: Float[np.ndarray, "frames 4 4"] | None = None
    """Pose in every frame; None if it does not move, or if the truth folder is older."""
    held: Bool[np.ndarray, "frames"] | None = None
    """Whether a hand holds it in each frame; None as above."""
    hands: tuple[bool, bool] = (False, False)
    """Whether the left and the right hand ever hold it."""

    @property
    def stands(self) -> bool:
        """Whether it is standing furniture: neither clutter nor carried."""
        return self.is_furniture and not self.is_moving


@dataclass(frozen=True, eq=False)
class Truth:
    """The ground truth of a clip. Maps may be smaller than the video; depth is z-depth, 0 = no surface."""

    folder: Path
    name: str
    preset: str
    kinds: tuple[str, ...]
    """Kind of motion of each person."""
    fps: float
    room_bounds_m: tuple[float, float, float, float]
    """x0, x1, z0, z1."""
    people: tuple[BodyMotion, ...]
    """Main person first, in the true world."""
    up_camera: Float[np.ndarray, "frames 3"]
    label_frame_index: Int[np.ndarray, "maps"]
    depth_mm: UInt16[np.ndarray, "maps height width"]
    instance: UInt16[np.ndarray, "maps height width"]
    background_depth_m: Float[np.ndarray, "height width"]
    """Depth from the first frame's camera, without people and carried objects."""
    background_instance: UInt16[np.ndarray, "height width"]
    amodal: dict[int, Bool[np.ndarray, "height width"]]
    """Amodal mask of each piece of furniture, by object ID."""
    person_box_px: Float[np.ndarray, "people frames 4"]
    """Box x0, y0, x1, y1 of the visible pixels of each person of `people`; NaN if not visible."""
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
    def duration_s(self) -> float:
        return len(self.frame_time_s) / self.fps

    @property
    def person_pixels(self) -> Bool[np.ndarray, "maps height width"]:
        return self.instance >= PERSON_ID

    @property
    def floor_mask(self) -> Bool[np.ndarray, "height width"]:
        """Visible floor without people; it includes rugs."""
        ids = [item.object_id for item in self.objects if item.label in _FLOOR_LABELS]
        return np.isin(self.background_instance, ids)

    @functools.cached_property
    def background_rgb(self) -> UInt8[np.ndarray, "height width 3"]:
        """The image of the first frame's camera without people.

        Raises:
            ArtifactError: the file is missing, unreadable or of another size.
        """
        size: Axes = {"height": self.intrinsics.height_px, "width": self.intrinsics.width_px}
        hint = UInt8[np.ndarray, "height width 3"]
        return read_png(self.folder / "plate.png", np.dtype(np.uint8), hint=hint, axes=size)

    def furniture(self, min_px: float) -> tuple[TrueObject, ...]:
        """Standing furniture with at least `min_px` visible pixels (in pixels of the video, without people)."""
        map_px = self.background_instance.size
        share = map_px / (self.intrinsics.width_px * self.intrinsics.height_px)
        return tuple(item for item in self.objects if item.stands and item.visible_px >= min_px * share)

    def mask(self, object_id: int) -> Bool[np.ndarray, "height width"]:
        """Visible pixels of an object in the background map."""
        return self.background_instance == object_id


def read_truth(folder: Path | str) -> Truth:
    """Read a truth folder.

    Raises:
        InputError: not a truth folder, of another format version, or damaged.
    """
    folder = Path(folder)
    try:
        return _truth(folder, read_json(folder / "meta.json", _Meta))
    except ArtifactError as error:
        raise InputError(
            f"truth: {error}; want the truth folder of a clip as `video2anim synth` makes it, make the clip again"
        ) from error


def _truth(folder: Path, meta: _Meta) -> Truth:
    axes: Axes = {"frames": meta.frames, "people": len(meta.persons)}
    ids = [person.person_id for person in meta.persons]
    people = tuple(
        read_motion(folder / name, axes) for name in ("truth.npz", *(f"truth_{number}.npz" for number in ids[1:]))
    )
    if [person.person_id for person in people] != ids:
        raise ArtifactError(f"persons: want {[person.person_id for person in people]}, got {ids} in {folder}")
    with opened_archive(folder / "truth.npz") as archive:
        found = {key: archive.read(key, hint, axes) for key, hint in _ARRAYS.items()}
        moved = _moved_objects(archive, axes)
    seen = dict(zip(found["object_id"].tolist(), found["object_visible_px"].tolist(), strict=True))
    return Truth(
        folder=folder,
        name=meta.name,
        preset=meta.preset,
        kinds=tuple(person.kind for person in meta.persons),
        fps=meta.fps,
        room_bounds_m=meta.room.bounds_m,
        people=people,
        up_camera=found["up_camera"],
        label_frame_index=found["label_frame_index"],
        depth_mm=found["depth_mm"],
        instance=found["instance"],
        background_depth_m=found["background_depth_mm"][0].astype(np.float32) / 1000,
        background_instance=found["background_instance"][0],
        amodal=dict(zip(found["amodal_object_id"].tolist(), found["amodal"], strict=True)),
        person_box_px=found["person_box_px"],
        objects=tuple(_object(folder, obj, seen, moved) for obj in meta.objects),
        is_static=bool(found["is_static"]),
    )


_Moved = tuple[Float[np.ndarray, "frames 4 4"], Bool[np.ndarray, "frames"], tuple[bool, bool]]


def _moved_objects(archive: Archive, axes: Axes) -> dict[int, _Moved]:
    """Poses, holding and hands of each object that moves."""
    if "moving_object_id" not in archive:
        return {}
    read = {key: archive.read(key, hint, axes) for key, hint in _MOVING.items()}
    return {
        int(number): (read["T_world_moving"][k], read["moving_held"][k], (bool(left), bool(right)))
        for k, (number, (left, right)) in enumerate(zip(read["moving_object_id"], read["moving_hands"], strict=True))
    }


def _object(folder: Path, obj: _Object, seen: dict[int, int], moved: dict[int, _Moved]) -> TrueObject:
    T, number = np.array(obj.T_world_object), obj.object_id
    expect_content(T, (Holds.RIGID,), {}, f"T_world_object of object {number}", folder / "meta.json")
    file = member(folder, obj.file)
    still = TrueObject(number, obj.label, obj.is_furniture, obj.is_moving, T, file, seen.get(number, 0))
    if number not in moved:
        return still
    frames, held, hands = moved[number]
    return replace(still, T_world_object_frames=frames, held=held, hands=hands)
