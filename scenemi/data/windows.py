"""Training windows of 121 frames, drawn at random from retargeted clips.

    clips = MotionSet.build([folder], Split.read(split_json), "train", bodies=8)
    batch = clips.sample_batch(np.random.default_rng(0), 64)

Clips shorter than a window are held at their last pose with `valid` False.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from scenemi.data.adults import draw_adults
from scenemi.data.augment import MIRROR_QUATERNION, WarpConfig, random_times, restyled
from scenemi.data.balance import BalanceConfig, clip_probabilities
from scenemi.data.container import MotionArchive
from scenemi.data.interpolate import blended, cubic_taps, nearest_rows, unit
from scenemi.data.motion_store import (
    FPS,
    MotionStore,
    Progress,
    StoreConfig,
    build_store,
    load_store,
    save_store,
    store_digest,
)
from scenemi.data.sources import BROKEN_CLIPS
from scenemi.data.split import Part, Split
from scenemi.windows import WINDOW_FRAMES
from video2anim.body.anny_body import shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_quaternion
from video2anim.types import BodyShape
from video2anim.types.skeleton import JOINT_NAMES, MIRROR_JOINT

_OF_ARMS_AND_HEAD = ("neck", "head", "collar", "shoulder", "elbow", "wrist")
ARMS_AND_HEAD = np.array([i for i, name in enumerate(JOINT_NAMES) if name.endswith(_OF_ARMS_AND_HEAD)])
"""Joints above the trunk."""


@dataclass(frozen=True, slots=True)
class MotionSetConfig:
    """Which clips are used, and how windows are drawn from them."""

    noncommercial: bool = False
    """Also use clips whose license is not known to be free."""
    sources: tuple[str, ...] | None = None
    """Only these sources, whatever their license; None = all that the license rule allows."""
    kinds: tuple[str, ...] | None = None
    """Only these kinds."""
    store: StoreConfig = field(default_factory=StoreConfig)
    balance: BalanceConfig = field(default_factory=BalanceConfig)
    mirror: float = 0.5
    """Probability that a window is mirrored."""
    warp: float = 0.5
    """Probability that a window is played at another speed."""
    warping: WarpConfig = field(default_factory=WarpConfig)
    reverse: float = 0.0
    """Probability that a window runs backward in time."""
    mix: float = 0.0
    """Probability that a window gets the arms and the head of another window."""
    restyle: float = 0.0
    """Probability that a window's trunk, arms and head are restyled."""
    frames: int = WINDOW_FRAMES


@dataclass(frozen=True, slots=True, eq=False)
class WindowSample:
    """One window; world +Y up, floor at y = 0 (unless `uneven`), 30 fps."""

    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    translation_m: Float[np.ndarray, "frames 3"]
    contact: Bool[np.ndarray, "frames 22"]
    valid: Bool[np.ndarray, "frames"]
    body_index: int
    kind: str
    source: str
    name: str
    uneven: bool


@dataclass(frozen=True, slots=True, eq=False)
class WindowBatch:
    """Windows of equal length; float32."""

    R_parent_joint: Float[np.ndarray, "batch frames 22 3 3"]
    translation_m: Float[np.ndarray, "batch frames 3"]
    contact: Bool[np.ndarray, "batch frames 22"]
    valid: Bool[np.ndarray, "batch frames"]
    body_index: Int[np.ndarray, "batch"]
    """Row of `MotionSet.rest_joints_m`."""
    clip: Int[np.ndarray, "batch"]
    """Row of the tables of clips of `MotionSet.store`."""
    uneven: Bool[np.ndarray, "batch"]
    """The ground was not captured: y = 0 is no floor."""

    def __len__(self) -> int:
        return len(self.translation_m)


class MotionSet:
    """Clips of one part of the split on several bodies."""

    def __init__(self, store: MotionStore, shapes: Sequence[BodyShape], config: MotionSetConfig) -> None:
        self.store, self.shapes, self.config = store, tuple(shapes), config
        self.rest_joints_m: Float[np.ndarray, "bodies 22 3"] = np.stack(
            [shaped_body(shape).rest_joints_m for shape in self.shapes]
        ).astype(np.float32)
        clips = np.asarray(store.piece_clip)
        kinds, sources = np.asarray(store.clip_kind), np.asarray(store.clip_source)
        length = np.bincount(clips, store.piece_frames, minlength=len(kinds)) / FPS
        used = np.flatnonzero(length > 0)
        of_clip = np.zeros(len(kinds))
        of_clip[used] = clip_probabilities(kinds[used].tolist(), sources[used].tolist(), length[used], config.balance)
        self.piece_probability: Float[np.ndarray, "pieces"] = of_clip[clips] * store.piece_frames / FPS / length[clips]
        self._cumulative = np.cumsum(self.piece_probability)
        self._cumulative /= self._cumulative[-1]

    @classmethod
    def build(
        cls,
        paths: Sequence[str | Path],
        split: Split | None,
        part: Part | None,
        bodies: int | Sequence[BodyShape] = 8,
        config: MotionSetConfig | None = None,
        *,
        cache: str | Path | None = None,
        progress: Progress | None = None,
    ) -> MotionSet:
        """Retarget the clips of a part to bodies, or map them from the cache.

        Args:
            paths: archives, or folders of archives.
            split: which clip is in which part; None = by digests of names.
            part: None = all parts.
            bodies: shapes, or how many adults to draw.
            config: sources, kinds, augmentation.
            cache: folder for retargeted frames.
            progress: called with motions done and in all.

        Raises:
            InputError: a file is missing or broken, or no clip is left.
        """
        config = config or MotionSetConfig()
        shapes = draw_adults(bodies) if isinstance(bodies, int) else tuple(bodies)
        files = archives_of(paths)
        archives = [MotionArchive.read(path) for path in files]
        chosen = [chosen_clips(archive, split or Split(), part, config) for archive in archives]
        if not any(chosen):
            raise InputError(
                f"motion: no clip of part {part!r} in {', '.join(map(str, files))} passes the choice of sources and "
                f"kinds (clips not known to be free for commercial use: "
                f"{'used' if config.noncommercial else 'left out'}; --noncommercial)"
            )
        pairs = list(zip(archives, chosen, strict=True))
        if cache is None:
            return cls(build_store(pairs, shapes, config.store, progress), shapes, config)
        folder = Path(cache) / store_digest(files, chosen, shapes, config.store)
        if not folder.is_dir():
            save_store(folder, build_store(pairs, shapes, config.store, progress))
        return cls(load_store(folder), shapes, config)

    @property
    def minutes(self) -> float:
        """Minutes of different motion: each clip counts once, whatever the number of bodies."""
        _, first = np.unique(np.asarray(self.store.piece_clip) * (2**32) + self.store.piece_first, return_index=True)
        return float(self.store.piece_frames[first].sum() / FPS / 60)

    def body(self, index: int) -> ShapedBody:
        """A body by its row."""
        return shaped_body(self.shapes[index])

    def bodies(self) -> tuple[ShapedBody, ...]:
        """All bodies, by their rows."""
        return tuple(self.body(i) for i in range(len(self.shapes)))

    def sample(self, rng: np.random.Generator) -> WindowSample:
        """One random window."""
        return self.one(self.sample_batch(rng, 1), 0)

    def one(self, batch: WindowBatch, row: int) -> WindowSample:
        """One window of a batch, with its kind and source."""
        clip = int(batch.clip[row])
        return WindowSample(
            R_parent_joint=batch.R_parent_joint[row],
            translation_m=batch.translation_m[row],
            contact=batch.contact[row],
            valid=batch.valid[row],
            body_index=int(batch.body_index[row]),
            kind=str(self.store.clip_kind[clip]),
            source=str(self.store.clip_source[clip]),
            name=str(self.store.clip_name[clip]),
            uneven=bool(batch.uneven[row]),
        )

    def sample_batch(self, rng: np.random.Generator, count: int) -> WindowBatch:
        """`count` random windows, mirrored and warped as configured."""
        frames = self.config.frames
        pieces = np.searchsorted(self._cumulative, rng.random(count), side="right")
        length = self.store.piece_frames[pieces]
        warp = rng.random(count) < self.config.warp
        times = np.where(warp[:, None], random_times(rng, count, frames, self.config.warping), np.arange(frames))
        slack = np.maximum(length - 1 - np.ceil(times[:, -1]).astype(np.int64), 0)
        start = rng.integers(0, slack + 1)
        drawn = self._gathered(pieces, start[:, None] + times, warp, rng.random(count) < self.config.mirror)
        if self.config.reverse > 0:
            drawn = _reversed(drawn, rng.random(count) < self.config.reverse)
        if self.config.mix > 0:
            drawn = _mixed(drawn, rng.random(count) < self.config.mix, rng.permutation(count))
        if self.config.restyle > 0:
            chosen = np.flatnonzero(rng.random(count) < self.config.restyle)
            drawn.R_parent_joint[chosen] = restyled(drawn.R_parent_joint[chosen], rng)
        return drawn

    def fixed_windows(
        self, batch: int = 64, stride: int | None = None, *, full_only: bool = False, body: int | None = None
    ) -> Iterator[WindowBatch]:
        """Every window in order, as recorded: for statistics, validation and tests.

        Args:
            batch: windows at a time; the last batch may be smaller.
            stride: frames from window to window in a piece, by default no overlap.
            full_only: leave out what does not fill a window.
            body: only motions on this body.
        """
        frames, step = self.config.frames, stride or self.config.frames
        least = frames if full_only else min(frames, self.config.store.min_frames)
        pairs = [
            (piece, start)
            for piece, length in enumerate(self.store.piece_frames.tolist())
            if body is None or self.store.piece_body[piece] == body
            for start in range(0, max(length - least + 1, 0), step)
        ]
        for i in range(0, len(pairs), batch):
            pieces, start = np.array(pairs[i : i + batch]).T
            no = np.zeros(len(pieces), bool)
            yield self._gathered(pieces, start[:, None] + np.arange(frames, dtype=float), no, no)

    def _gathered(self, pieces: np.ndarray, position: np.ndarray, warp: np.ndarray, mirror: np.ndarray) -> WindowBatch:
        """Windows at (batch, frames) positions within pieces; `warp` marks those between frames."""
        store = self.store
        length = np.broadcast_to(store.piece_frames[pieces][:, None], position.shape)
        first = store.piece_start[pieces][:, None]
        nearest = first + nearest_rows(position, length)
        translation_m, quaternion = store.translation_m[nearest], store.quaternion_wxyz[nearest]
        if warp.any():
            rows, weights = cubic_taps(position[warp], length[warp])
            rows += first[warp][..., None]
            translation_m[warp] = blended(store.translation_m, rows, weights)
            quaternion[warp] = unit(blended(store.quaternion_wxyz, rows, weights))
        contact = store.contact[nearest]
        translation_m[mirror, :, 0] *= -1
        quaternion[mirror] = quaternion[mirror][:, :, MIRROR_JOINT] * MIRROR_QUATERNION
        contact[mirror] = contact[mirror][:, :, MIRROR_JOINT]
        return WindowBatch(
            R_parent_joint=matrix_from_quaternion(quaternion),
            translation_m=translation_m,
            contact=contact,
            valid=position <= length - 1 + 1e-6,
            body_index=np.asarray(store.piece_body[pieces]),
            clip=np.asarray(store.piece_clip[pieces]),
            uneven=np.asarray(store.clip_uneven[store.piece_clip[pieces]]),
        )


def _reversed(batch: WindowBatch, chosen: Bool[np.ndarray, "batch"]) -> WindowBatch:
    """Chosen windows backward in time, but for those that hold their last pose."""
    rows = np.flatnonzero(chosen & batch.valid.all(1))
    for values in (batch.R_parent_joint, batch.translation_m, batch.contact):
        values[rows] = values[rows, ::-1]
    return batch


def _mixed(batch: WindowBatch, chosen: Bool[np.ndarray, "batch"], donor: Int[np.ndarray, "batch"]) -> WindowBatch:
    """Chosen windows with arms and head of their donor: how these move hangs little on how the legs do, so there are
    many more combinations than were captured."""
    rows = np.flatnonzero(chosen & batch.valid[donor].all(1))
    for values in (batch.R_parent_joint, batch.contact):
        taken = values[donor[rows]][:, :, ARMS_AND_HEAD]
        values[rows[:, None], :, ARMS_AND_HEAD] = np.moveaxis(taken, 2, 1)
    return batch


def archives_of(paths: Sequence[str | Path]) -> list[Path]:
    """Archives, and those of folders.

    Raises:
        InputError: a folder has none.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        found = sorted(path.glob("*.npz")) if path.is_dir() else [path]
        if not found:
            raise InputError(f"{path}: want motion archives (.npz), found none in this folder")
        files += found
    return files


def chosen_clips(archive: MotionArchive, split: Split, part: Part | None, config: MotionSetConfig) -> list[str]:
    """Names of an archive's clips that are used."""
    return [
        name
        for name, kind, source, free in zip(archive.names, archive.kinds, archive.sources, archive.free, strict=True)
        if name not in BROKEN_CLIPS
        and (part is None or split.part_of(name) == part)
        and (config.kinds is None or kind in config.kinds)
        and (source in config.sources if config.sources is not None else config.noncommercial or free)
    ]


def barred_clips(paths: Sequence[str | Path]) -> Counter[tuple[str, str]]:
    """How many clips of archives are not known to be free for commercial use, by source and license."""
    found: Counter[tuple[str, str]] = Counter()
    for archive in map(MotionArchive.read, archives_of(paths)):
        rows = zip(archive.sources, archive.licenses, archive.free, strict=True)
        found.update((source, license_name) for source, license_name, free in rows if not free)
    return found
