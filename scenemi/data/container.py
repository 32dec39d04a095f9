"""Motion clips on the skeletons of their sources: one numpy archive, read lazily, written byte for byte alike.

Meters, +Y up, quaternions w x y z. Rotations are stored as 16-bit integers (steps of 0.004 degrees). Two tables say
which source joint stands for each of the 22 SMPL joints: the one that lies nearest (`smpl_position`) and the one whose
orientation it follows (`smpl_rotation`); -1 where the source has none. `clip_license` is there where a clip has another
license than its source is known to have (`scenemi.data.sources`).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int16

from scenemi.data.plain_files import read_arrays, read_json_value
from scenemi.data.source_clip import MAX_FPS, MIN_FPS, SourceClip, SourceSkeleton
from scenemi.data.sources import is_free, license_of
from video2anim.errors import InputError
from video2anim.types.skeleton import JOINT_NAMES

__all__ = ["FORMAT_VERSION", "MotionArchive", "SourceClip", "SourceSkeleton", "read_split", "write_archive"]

FORMAT_VERSION = 1
_WHAT = "motion archive"
SPLIT_PARTS = ("train", "val", "test")
_UNIT = float(np.iinfo(np.int16).max)
_ROUNDING_PASSES = 10
"""Without a limit a rotation between two steps could go back and forth (not measured)."""
_ROTATION, _ROOT, _LICENSE = "rot", "root_pos", "clip_license"
_TEXTS = ("clip_name", "clip_source", "clip_kind", "clip_desc", "clip_origin", "skel_name", "skel_joint")
_NUMBERS = (
    "clip_fps", "clip_source_fps", "clip_frames", "clip_start", "clip_rot_start", "clip_skel", "clip_floor_shift",
    "clip_uneven", "clip_glitch_frames", "skel_start", "skel_parent", "skel_offset", "skel_smpl_pos", "skel_smpl_rot",
)  # fmt: skip
_TEXTS_READ = (*_TEXTS, _LICENSE, "smpl_names")
_INDICES = (
    "clip_frames", "clip_start", "clip_rot_start", "clip_skel", "skel_start", "skel_parent", "skel_smpl_pos",
    "skel_smpl_rot",
)  # fmt: skip
"""Numbers that point at rows of other tables."""
ARRAYS = ("format_version", "smpl_names", *_TEXTS, *_NUMBERS, _LICENSE, _ROOT, _ROTATION)
"""All that an archive may hold."""


class MotionArchive:
    """Clips of one archive file. The index is read at once, frames when the first clip is asked for."""

    def __init__(self, path: Path, tables: dict[str, np.ndarray]) -> None:
        self._path, self._tables = path, tables
        self._frames: dict[str, np.ndarray] = {}
        self.names: tuple[str, ...] = tuple(str(name) for name in tables["clip_name"])
        self.kinds: tuple[str, ...] = tuple(str(kind) for kind in tables["clip_kind"])
        self.sources: tuple[str, ...] = tuple(str(source) for source in tables["clip_source"])
        given = tables.get(_LICENSE, np.full(len(self.names), "")).tolist()
        self.licenses: tuple[str, ...] = tuple(
            license_name or license_of(source) for license_name, source in zip(given, self.sources, strict=True)
        )
        self.free: tuple[bool, ...] = tuple(map(is_free, self.licenses))
        self.frame_counts: tuple[int, ...] = tuple(int(count) for count in tables["clip_frames"])
        self._index = {name: i for i, name in enumerate(self.names)}
        self._skeletons = tuple(self._skeleton(s) for s in range(len(tables["skel_name"])))

    @classmethod
    def read(cls, path: str | Path) -> MotionArchive:
        """Open an archive.

        Raises:
            InputError: the file is missing, unreadable, of another format or version, inconsistent, or has no clips.
        """
        path = Path(path)
        needed = ("format_version", "smpl_names", *_TEXTS, *_NUMBERS)
        tables = read_arrays(path, (_LICENSE,), _WHAT, needed=needed)
        version = tables["format_version"]
        if version.tolist() != FORMAT_VERSION:
            told = str(version)[:40]
            raise InputError(f"{path}: motion archive of version {told}, want {FORMAT_VERSION}; convert it again")
        if tables["smpl_names"].tolist() != list(JOINT_NAMES):
            raise InputError(f"{path}: smpl_names are not the 22 SMPL joints in order; convert it again")
        if tables["clip_name"].size == 0:
            raise InputError(f"{path}: motion archive without clips; choose another one")
        _expect_consistent(path, tables)
        return cls(path, tables)

    def clip(self, name: str) -> SourceClip:
        """One clip.

        Raises:
            InputError: no such clip, or its numbers are broken.
        """
        if name not in self._index:
            raise InputError(f"{self._path}: no clip {name!r} among {len(self.names)} (first: {self.names[0]!r})")
        if not self._frames:
            found = read_arrays(self._path, (), _WHAT, needed=(_ROOT, _ROTATION))
            if any(array.ndim != 2 or array.dtype.kind not in "if" for array in found.values()):
                raise InputError(
                    f"{self._path}: {_ROOT} and {_ROTATION} want rows of numbers; convert the archive again"
                )
            self._frames = found
        t, i = self._tables, self._index[name]
        skeleton = self._skeletons[int(t["clip_skel"][i])]
        frames = int(t["clip_frames"][i])
        start, rotation_start = int(t["clip_start"][i]), int(t["clip_rot_start"][i])
        rows = slice(rotation_start, rotation_start + frames * len(skeleton.names))
        root_m = np.asarray(self._frames[_ROOT][start : start + frames], np.float64)
        rotation = np.asarray(self._frames[_ROTATION][rows], np.float64)
        if root_m.shape != (frames, 3) or rotation.shape != (frames * len(skeleton.names), 4):
            raise InputError(f"{self._path}: clip {name!r} is cut off; copy or download the file again")
        with np.errstate(over="ignore"):
            length = np.linalg.norm(rotation, axis=-1, keepdims=True)
        if not np.isfinite(root_m).all() or not np.isfinite(length).all() or not (length > 0).all():
            raise InputError(f"{self._path}: clip {name!r} holds NaN or rotations of length zero; leave it out")
        return SourceClip(
            name=name,
            source=self.sources[i],
            kind=self.kinds[i],
            description=str(t["clip_desc"][i]),
            origin=str(t["clip_origin"][i]),
            fps=float(t["clip_fps"][i]),
            uneven=bool(t["clip_uneven"][i]),
            skeleton=skeleton,
            root_position_m=root_m,
            rotation_wxyz=(rotation / length).reshape(frames, len(skeleton.names), 4),
            source_fps=float(t["clip_source_fps"][i]),
            floor_shift_m=float(t["clip_floor_shift"][i]),
            glitch_frames=int(t["clip_glitch_frames"][i]),
            license=self.licenses[i] if self.licenses[i] != license_of(self.sources[i]) else "",
        )

    def _skeleton(self, number: int) -> SourceSkeleton:
        t = self._tables
        rows = slice(int(t["skel_start"][number]), int(t["skel_start"][number + 1]))
        return SourceSkeleton(
            str(t["skel_name"][number]),
            tuple(str(name) for name in t["skel_joint"][rows]),
            np.asarray(t["skel_parent"][rows], np.int64),
            np.asarray(t["skel_offset"][rows], np.float64),
            np.asarray(t["skel_smpl_pos"][number], np.int64),
            np.asarray(t["skel_smpl_rot"][number], np.int64),
        )


def write_archive(path: str | Path, clips: Sequence[SourceClip]) -> None:
    """Write clips, equal clips to equal bytes. The file is written aside and renamed: it is whole or absent.

    Raises:
        InputError: no clips, a name used twice, broken numbers, or a folder that cannot be written to.
    """
    path = Path(path)
    if not clips:
        raise InputError(f"{path}: want at least one clip to write, got none")
    seen: set[str] = set()
    for clip in clips:
        if clip.name in seen:
            raise InputError(f"{path}: clip name {clip.name!r} comes twice; names must be unique")
        seen.add(clip.name)
        _expect_sound(path, clip)
    tables: dict[str, Any] = {**_skeleton_tables(_distinct_skeletons(clips)), **_clip_tables(clips)}
    aside = path.with_name(f"{path.name}.part")
    try:
        with aside.open("wb") as stream:
            np.savez_compressed(stream, **tables)
        os.replace(aside, path)
    except OSError as error:
        aside.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot write the motion archive: {error.strerror or error}") from error


def read_split(path: str | Path) -> dict[str, tuple[str, ...]]:
    """Clip names of `train`, `val` and `test`.

    Raises:
        InputError: the file is missing, not such a table, or names a clip twice.
    """
    table = read_json_value(Path(path), "split file")
    if not isinstance(table, dict) or set(table) != set(SPLIT_PARTS):
        raise InputError(f"{path}: split file wants exactly the lists {', '.join(SPLIT_PARTS)}")
    for part, names in table.items():
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{path}: {part!r} wants a list of clip names")
    everything = [name for part in SPLIT_PARTS for name in table[part]]
    if len(set(everything)) != len(everything):
        twice = next(name for name, count in Counter(everything).items() if count > 1)
        raise InputError(f"{path}: clip {twice!r} comes twice; the parts of a split must not overlap")
    return {part: tuple(table[part]) for part in SPLIT_PARTS}


def _expect_consistent(path: Path, t: dict[str, np.ndarray]) -> None:
    """InputError unless all tables fit each other."""
    for name in t:
        kinds = "U" if name in _TEXTS_READ else "iu" if name in _INDICES else "biuf"
        if t[name].dtype.kind not in kinds:
            raise InputError(f"{path}: {name} has values of another type ({t[name].dtype}); convert the archive again")
    clips, skeletons, joints = t["clip_name"].size, t["skel_name"].size, t["skel_joint"].size
    wanted: dict[str, tuple[int, ...]] = {name: (clips,) for name in (*_TEXTS, *_NUMBERS) if name.startswith("clip_")}
    wanted |= {"clip_start": (clips + 1,), "clip_rot_start": (clips + 1,), "skel_start": (skeletons + 1,)}
    wanted |= {"skel_name": (skeletons,), "skel_joint": (joints,)} | ({_LICENSE: (clips,)} if _LICENSE in t else {})
    wanted |= {"skel_parent": (joints,), "skel_offset": (joints, 3)}
    wanted |= {"skel_smpl_pos": (skeletons, 22), "skel_smpl_rot": (skeletons, 22)}
    for name, shape in wanted.items():
        if t[name].shape != shape:
            raise InputError(f"{path}: {name} wants shape {shape}, got {t[name].shape}; convert the archive again")
    if len(set(t["clip_name"].tolist())) != clips:
        raise InputError(f"{path}: clip names are not unique; convert the archive again")
    t |= {name: t[name].astype(np.int64) for name in _INDICES}
    counts = np.diff(t["skel_start"])
    good = t["skel_start"][0] == 0 and t["skel_start"][-1] == joints and (counts > 0).all()
    good = good and ((t["clip_skel"] >= 0) & (t["clip_skel"] < skeletons)).all() and (t["clip_frames"] > 0).all()
    good = good and np.array_equal(np.diff(t["clip_start"]), t["clip_frames"])
    good = good and np.array_equal(np.diff(t["clip_rot_start"]), t["clip_frames"] * counts[t["clip_skel"]])
    if good:
        within = np.arange(joints) - np.repeat(t["skel_start"][:-1], counts)
        good = ((t["skel_parent"] < within) & ((t["skel_parent"] < 0) == (within == 0))).all()
        for table in (t["skel_smpl_pos"], t["skel_smpl_rot"]):
            good = good and ((table >= -1) & (table < counts[:, None])).all()
    good = good and np.isfinite(t["skel_offset"]).all() and np.isfinite(t["clip_floor_shift"]).all()
    if not good or not ((t["clip_fps"] >= MIN_FPS) & (t["clip_fps"] <= MAX_FPS)).all():
        raise InputError(f"{path}: clip and skeleton tables contradict each other; convert the archive again")


def _expect_sound(path: Path, clip: SourceClip) -> None:
    """InputError unless the clip can be written."""
    joints = len(clip.skeleton.names)
    if clip.root_position_m.ndim != 2 or len(clip.root_position_m) == 0:
        raise InputError(f"{path}: clip {clip.name!r} has no frames")
    frames = len(clip.root_position_m)
    if clip.root_position_m.shape != (frames, 3) or clip.rotation_wxyz.shape != (frames, joints, 4):
        shapes = f"{clip.root_position_m.shape} and {clip.rotation_wxyz.shape}"
        raise InputError(f"{path}: clip {clip.name!r} wants (T, 3) and (T, {joints}, 4), got {shapes}")
    length = np.linalg.norm(clip.rotation_wxyz, axis=-1)
    if not np.isfinite(clip.root_position_m).all() or not np.isfinite(length).all() or not (length > 0).all():
        raise InputError(f"{path}: clip {clip.name!r} holds NaN or rotations of length zero")


def _distinct_skeletons(clips: Sequence[SourceClip]) -> list[tuple[SourceSkeleton, list[int]]]:
    """Skeletons of different content, in order of first use, with the clips that use them."""
    found: dict[tuple[Any, ...], tuple[SourceSkeleton, list[int]]] = {}
    for number, clip in enumerate(clips):
        s = clip.skeleton
        tables = (s.parents, s.smpl_position, s.smpl_rotation)
        numbers = (np.asarray(s.offsets_m, np.float32), *(np.asarray(table, np.int32) for table in tables))
        key = (s.name, s.names, *(array.tobytes() for array in numbers))
        found.setdefault(key, (s, []))[1].append(number)
    return list(found.values())


def _skeleton_tables(found: list[tuple[SourceSkeleton, list[int]]]) -> dict[str, np.ndarray]:
    skeletons = [skeleton for skeleton, _ in found]
    return {
        "format_version": np.array(FORMAT_VERSION, np.int32),
        "smpl_names": np.array(JOINT_NAMES),
        "skel_name": np.array([s.name for s in skeletons]),
        "skel_start": np.cumsum([0, *(len(s.names) for s in skeletons)]).astype(np.int32),
        "skel_joint": np.array([name for s in skeletons for name in s.names]),
        "skel_parent": np.concatenate([s.parents for s in skeletons]).astype(np.int32),
        "skel_offset": np.concatenate([s.offsets_m for s in skeletons]).astype(np.float32),
        "skel_smpl_pos": np.stack([s.smpl_position for s in skeletons]).astype(np.int32),
        "skel_smpl_rot": np.stack([s.smpl_rotation for s in skeletons]).astype(np.int32),
    }


def _clip_tables(clips: Sequence[SourceClip]) -> dict[str, np.ndarray]:
    of_clip = np.zeros(len(clips), np.int32)
    for number, (_, users) in enumerate(_distinct_skeletons(clips)):
        of_clip[users] = number
    frames = np.array([len(clip.root_position_m) for clip in clips])
    rows = frames * [len(clip.skeleton.names) for clip in clips]
    licenses = {_LICENSE: np.array([clip.license for clip in clips])} if any(clip.license for clip in clips) else {}
    return {
        **licenses,
        "clip_name": np.array([clip.name for clip in clips]),
        "clip_source": np.array([clip.source for clip in clips]),
        "clip_kind": np.array([clip.kind for clip in clips]),
        "clip_desc": np.array([clip.description for clip in clips]),
        "clip_origin": np.array([clip.origin for clip in clips]),
        "clip_fps": np.array([clip.fps for clip in clips], np.float32),
        "clip_source_fps": np.array([clip.source_fps for clip in clips], np.float32),
        "clip_frames": frames.astype(np.int32),
        "clip_start": np.concatenate([[0], np.cumsum(frames)]).astype(np.int64),
        "clip_rot_start": np.concatenate([[0], np.cumsum(rows)]).astype(np.int64),
        "clip_skel": of_clip,
        "clip_floor_shift": np.array([clip.floor_shift_m for clip in clips], np.float32),
        "clip_uneven": np.array([clip.uneven for clip in clips], bool),
        "clip_glitch_frames": np.array([clip.glitch_frames for clip in clips], np.int32),
        _ROOT: np.concatenate([clip.root_position_m for clip in clips]).astype(np.float32),
        _ROTATION: np.concatenate([_steps(clip.rotation_wxyz.reshape(-1, 4)) for clip in clips]),
    }


def _steps(rotation_wxyz: Float[np.ndarray, "rows 4"]) -> Int16[np.ndarray, "rows 4"]:
    """Quaternions in 16-bit steps. Rounding is repeated until reading and writing them again changes nothing."""
    steps = np.asarray(rotation_wxyz, np.float64)
    for _ in range(_ROUNDING_PASSES):
        rounded = np.rint(steps / np.linalg.norm(steps, axis=-1, keepdims=True) * _UNIT)
        if np.array_equal(rounded, steps):
            break
        steps = rounded
    return steps.astype(np.int16)
