"""Training motion of the lifter: captured and procedural clips, cached in a folder and memory-mapped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from scenemi.data import rest_pose
from scenemi.data.container import MotionArchive
from scenemi.data.retarget import retarget
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.errors import InputError
from video2anim.geometry.rotations import rot6d_from_matrix
from video2anim.humans.lifter_input import CONTACT_INDEX
from video2anim.lab.lifter.contacts import PARTS
from video2anim.lab.lifter.store import has_arrays, read_arrays, write_arrays
from video2anim.lab.synth.acting import act
from video2anim.lab.synth.compose import draw_shape
from video2anim.lab.synth.presets import PROCEDURAL
from video2anim.types import BodyShape

FEET = 4
"""Number of foot contacts, which come first. Captured clips have labels for these only."""


@dataclass(frozen=True, slots=True, eq=False)
class LiftingMotions:
    """Concatenated clips at 30 fps, +Y up, meters. Clip i is rows `start[i]` to `start[i + 1]`."""

    rot6d: Float[np.ndarray, "frames 22 6"]
    """Local rotations; joint 0 is the root's orientation in the world."""
    translation_m: Float[np.ndarray, "frames 3"]
    contact: Bool[np.ndarray, "frames 8"]
    """In the order of `CONTACT_JOINTS`."""
    contact_known: Bool[np.ndarray, "frames 8"]
    start: Int[np.ndarray, "clips+1"]


def gather(
    archives: Sequence[Path],
    names: Sequence[str] | None,
    *,
    procedural: int,
    seed: int,
    on_clip: Callable[[int], None] = lambda count: None,
) -> LiftingMotions:
    """Captured clips on an average adult, and procedural clips, for which all contacts are known.

    Clips whose license forbids distributing weights trained on them are left out, and clips whose skeleton
    `scenemi.data` cannot read.

    Args:
        archives: Archives of captured motion.
        names: Names of the clips to take; all if None.
        procedural: Number of procedural clips.
        seed: Seed of the procedural clips.
        on_clip: Called with the number of clips so far.
    """
    wanted = None if names is None else set(names)
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    adult = shaped_body(BodyShape("anny", ADULT))
    for path in archives:
        archive = MotionArchive.read(path)
        for name, free in zip(archive.names, archive.free, strict=True):
            if not free or (wanted is not None and name not in wanted):
                continue
            clip = archive.clip(name)
            if len(clip.root_position_m) < 2:
                continue
            try:
                moved = retarget(clip, adult)
            except InputError:
                continue
            known = np.zeros((len(moved.contact), len(CONTACT_INDEX)), bool)
            known[:, PARTS["feet"]] = not clip.uneven
            rot6d = rot6d_from_matrix(moved.R_parent_joint)
            parts.append((rot6d, moved.translation_m, moved.contact[:, CONTACT_INDEX], known))
            on_clip(len(parts))
    for number in range(procedural):
        rng = np.random.default_rng([seed, 0x11F7, number])
        motion = act(PROCEDURAL[number % len(PROCEDURAL)], shaped_body(draw_shape(rng)), rng)
        contact = motion.contact[:, CONTACT_INDEX]
        rot6d = rot6d_from_matrix(motion.R_parent_joint)
        parts.append((rot6d, motion.translation_m, contact, np.ones_like(contact)))
        on_clip(len(parts))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    start = np.concatenate([[0], np.cumsum([len(part[0]) for part in parts])])
    return LiftingMotions(columns[0].astype(np.float32), columns[1].astype(np.float32), columns[2], columns[3], start)


def cached_motions(
    folder: Path, archives: Sequence[Path], split: Path, part: str, *, procedural: int, seed: int
) -> LiftingMotions:
    """`gather` for one part of the split file, cached in a folder.

    Which clips can be read depends on the skeletons that `scenemi.data.rest_pose` supports, so the key includes it.
    """
    digest = hashlib.sha256(Path(rest_pose.__file__).read_bytes() + split.read_bytes())
    for path in archives:
        digest.update(f"{path.name} {path.stat().st_size}".encode())
    key = {"part": part, "acted": procedural, "seed": seed, "sources": digest.hexdigest()}
    if not has_arrays(folder, key):
        write_arrays(
            gather(archives, json.loads(split.read_text())[part], procedural=procedural, seed=seed), folder, key
        )
    return read_arrays(LiftingMotions, folder)
