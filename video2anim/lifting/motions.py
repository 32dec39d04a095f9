"""Motion that the lifter learns from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from scenemi.data.container import MotionArchive
from scenemi.data.retarget import retarget
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.errors import InputError
from video2anim.fitting.lifter_input import CONTACT_INDEX
from video2anim.synth.acting import act
from video2anim.synth.compose import draw_shape
from video2anim.synth.library import NONCOMMERCIAL_SOURCES
from video2anim.synth.presets import ACTED
from video2anim.types import BodyShape

FEET = 4
"""Of the contacts, these come first; captured clips tell of no others."""


@dataclass(frozen=True, slots=True, eq=False)
class LiftingMotions:
    """Clips one after the other, 30 frames a second, +Y up."""

    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    translation_m: Float[np.ndarray, "frames 3"]
    contact: Bool[np.ndarray, "frames 8"]
    """In the order of `CONTACT_JOINTS`."""
    contact_known: Bool[np.ndarray, "frames 8"]
    start: Int[np.ndarray, "clips+1"]


def gather(
    archives: Sequence[Path],
    names: Sequence[str] | None,
    *,
    acted: int,
    seed: int,
    on_clip: Callable[[int], None] = lambda count: None,
) -> LiftingMotions:
    """Captured clips (of these names) on a middling adult, and acted ones, whose contacts are all known.

    Clips under non-commercial licences are left out.
    """
    wanted = None if names is None else set(names)
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    adult = shaped_body(BodyShape("anny", ADULT))
    for path in archives:
        archive = MotionArchive.read(path)
        for name, source in zip(archive.names, archive.sources, strict=True):
            if source in NONCOMMERCIAL_SOURCES or (wanted is not None and name not in wanted):
                continue
            clip = archive.clip(name)
            if len(clip.root_position_m) < 2:
                continue
            try:
                moved = retarget(clip, adult)
            except InputError:
                continue
            known = np.zeros((len(moved.contact), len(CONTACT_INDEX)), bool)
            known[:, :FEET] = not clip.uneven
            parts.append((moved.R_parent_joint, moved.translation_m, moved.contact[:, CONTACT_INDEX], known))
            on_clip(len(parts))
    for number in range(acted):
        rng = np.random.default_rng([seed, 0x11F7, number])
        motion = act(ACTED[number % len(ACTED)], shaped_body(draw_shape(rng)), rng)
        contact = motion.contact[:, CONTACT_INDEX]
        parts.append((motion.R_parent_joint, motion.translation_m, contact, np.ones_like(contact)))
        on_clip(len(parts))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    start = np.concatenate([[0], np.cumsum([len(part[0]) for part in parts])])
    return LiftingMotions(columns[0].astype(np.float32), columns[1].astype(np.float32), columns[2], columns[3], start)
