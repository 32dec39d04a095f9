"""Retargeted frames of many clips on several bodies, in flat arrays that can be mapped from disk."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import shutil
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from scenemi.data.augment import resampled
from scenemi.data.bend import MIN_WAY_M, bent, way_m
from scenemi.data.container import MotionArchive
from scenemi.data.import_clip import GLITCH_M_S2
from scenemi.data.retarget import RetargetedMotion, retarget
from video2anim.body.anny_body import shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.digest import file_digest
from video2anim.errors import InputError
from video2anim.geometry.rotations import continuous_quaternions, quaternion_from_matrix
from video2anim.geometry.runs import runs
from video2anim.types import BodyShape
from video2anim.types.clip import FPS
from video2anim.types.skeleton import forward_kinematics

_VERSION = 2
"""Raised when retargeting gives other motions, so that old caches are not read."""

Progress = Callable[[int, int], None]
"""Called with how many motions are done, and of how many."""


@dataclass(frozen=True, slots=True)
class StoreConfig:
    """What is kept of the clips."""

    bodies_per_clip: int = 4
    """Each clip is put on so many of the bodies, in turn."""
    min_frames: int = 30
    """Shorter pieces are dropped."""
    glitch_m_s2: float = GLITCH_M_S2
    """Frames in which a joint's acceleration exceeds this are cut out, with `glitch_margin` frames at each side."""
    glitch_margin: int = 2
    uneven: bool = True
    """Keep clips whose ground was not captured."""
    bends: int = 0
    """Each clip that goes somewhere is also kept bent along so many random curves (`scenemi.data.bend`)."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionStore:
    """Pieces of motion; a piece is a stretch of one clip on one body without glitches.

    Arrays of F frames, then of P pieces, then of C clips.
    """

    translation_m: Float[np.ndarray, "frames 3"]
    quaternion_wxyz: Float[np.ndarray, "frames 22 4"]
    """Local rotations, signs continuous in time within a piece."""
    contact: Bool[np.ndarray, "frames 22"]
    piece_start: Int[np.ndarray, "pieces"]
    piece_frames: Int[np.ndarray, "pieces"]
    piece_clip: Int[np.ndarray, "pieces"]
    piece_body: Int[np.ndarray, "pieces"]
    piece_first: Int[np.ndarray, "pieces"]
    """Frame of the clip at which the piece begins."""
    clip_name: Shaped[np.ndarray, "clips"]
    clip_kind: Shaped[np.ndarray, "clips"]
    clip_source: Shaped[np.ndarray, "clips"]
    clip_uneven: Bool[np.ndarray, "clips"]


def build_store(
    archives: Sequence[tuple[MotionArchive, Sequence[str]]],
    shapes: Sequence[BodyShape],
    config: StoreConfig,
    progress: Progress | None = None,
) -> MotionStore:
    """Retarget clips to bodies.

    Args:
        archives: archives with the names of the clips to take from each.
        shapes: bodies; clip i gets bodies i, i + 1, ... up to `bodies_per_clip`.
        config: what is kept.
        progress: called after each motion.

    Raises:
        InputError: no clip is left.
    """
    clips = [(archive, name, bend) for archive, names in archives for name in names for bend in range(1 + config.bends)]
    per_clip = min(config.bodies_per_clip, len(shapes))
    pieces: list[tuple[RetargetedMotion, int, int, int, int]] = []
    uneven = np.zeros(len(clips), bool)
    total = len(clips) * per_clip
    done = 0
    for number, shape in enumerate(shapes):
        body = shaped_body(shape)
        for i, (archive, name, bend) in enumerate(clips):
            if (number - i) % len(shapes) >= per_clip:
                continue
            clip = archive.clip(name)
            uneven[i] = clip.uneven
            done += 1
            if progress:
                progress(done, total)
            if (clip.uneven and not config.uneven) or len(clip.root_position_m) < 2:
                continue
            if bend:
                if clip.uneven or way_m(clip) < MIN_WAY_M:
                    continue
                clip = bent(clip, np.random.default_rng([zlib.crc32(name.encode()), bend]))
            motion = resampled(retarget(clip, body), clip.fps, FPS)
            pieces += [(motion, i, number, start, stop) for start, stop in _sound_spans(motion, body, config)]
    if not pieces:
        raise InputError(f"motion: none of {len(clips)} clips has {config.min_frames} sound frames; give other clips")
    clip_of = [archive.names.index(name) for archive, name, _ in clips]
    return _packed(
        pieces,
        names=[name for _, name, _ in clips],
        kinds=[archive.kinds[k] for (archive, *_), k in zip(clips, clip_of, strict=True)],
        sources=[archive.sources[k] for (archive, *_), k in zip(clips, clip_of, strict=True)],
        uneven=uneven,
    )


def _sound_spans(motion: RetargetedMotion, body: ShapedBody, config: StoreConfig) -> list[tuple[int, int]]:
    """[start, stop) of stretches without glitches that are long enough."""
    joints_m, _ = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    glitch = np.zeros(len(joints_m), bool)
    if len(joints_m) > 2:
        speed_up = np.linalg.norm(np.diff(joints_m, n=2, axis=0), axis=-1).max(1) * FPS**2
        glitch[1:-1] = speed_up > config.glitch_m_s2
    reach = 2 * config.glitch_margin + 1
    wide = np.convolve(glitch, np.ones(reach), mode="full")[config.glitch_margin :][: len(glitch)] > 0
    return [(start, stop) for start, stop in runs(~wide) if stop - start >= config.min_frames]


def _packed(
    pieces: list[tuple[RetargetedMotion, int, int, int, int]],
    *,
    names: list[str],
    kinds: list[str],
    sources: list[str],
    uneven: np.ndarray,
) -> MotionStore:
    frames = np.array([stop - start for *_, start, stop in pieces])
    return MotionStore(
        translation_m=np.concatenate([m.translation_m[a:b] for m, _, _, a, b in pieces]).astype(np.float32),
        quaternion_wxyz=np.concatenate(
            [continuous_quaternions(quaternion_from_matrix(m.R_parent_joint[a:b])) for m, _, _, a, b in pieces]
        ).astype(np.float32),
        contact=np.concatenate([m.contact[a:b] for m, _, _, a, b in pieces]),
        piece_start=np.concatenate([[0], np.cumsum(frames)[:-1]]).astype(np.int64),
        piece_frames=frames.astype(np.int64),
        piece_clip=np.array([clip for _, clip, *_ in pieces]),
        piece_body=np.array([body for _, _, body, *_ in pieces]),
        piece_first=np.array([start for *_, start, _ in pieces]),
        clip_name=np.array(names),
        clip_kind=np.array(kinds),
        clip_source=np.array(sources),
        clip_uneven=uneven,
    )


def store_digest(
    paths: Sequence[Path], names: Sequence[Sequence[str]], shapes: Sequence[BodyShape], config: StoreConfig
) -> str:
    """What a store depends on, as a short digest."""
    content = {
        "version": _VERSION,
        "archives": [_digest_at(path, path.stat().st_mtime_ns) for path in paths],
        "names": [list(group) for group in names],
        "bodies": [(shape.model, sorted(shape.parameters.items())) for shape in shapes],
        "config": asdict(config),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


@functools.lru_cache(maxsize=64)
def _digest_at(path: Path, _: int) -> str:
    """Of a file at a time of change."""
    return file_digest(path)


def save_store(folder: Path, store: MotionStore) -> None:
    """Write a store as one .npy file per array; the folder is whole or absent.

    Raises:
        InputError: the folder cannot be written.
    """
    aside = folder.with_name(f"{folder.name}.{os.getpid()}.part")
    try:
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir(parents=True)
        for entry in fields(MotionStore):
            np.save(aside / f"{entry.name}.npy", getattr(store, entry.name), allow_pickle=False)
        if not folder.exists():
            os.replace(aside, folder)
    except OSError as error:
        if not folder.exists():
            raise InputError(f"{folder}: cannot write the motion cache: {error.strerror or error}") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def load_store(folder: Path) -> MotionStore:
    """Map a store from disk; frames are read when they are needed.

    Raises:
        InputError: files are missing or broken.
    """
    try:
        arrays = {
            entry.name: np.asarray(np.load(folder / f"{entry.name}.npy", mmap_mode="r", allow_pickle=False))
            for entry in fields(MotionStore)
        }
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: broken motion cache ({error}); delete the folder") from error
    return MotionStore(**arrays)
