"""The presets of `video2anim synth` and the clips that they consist of."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Literal

import numpy as np

from video2anim.errors import UsageError
from video2anim.lab.synth.cameras import CameraMotion

V2A_BENCH = "V2A-Bench 1"
"""Name and version of the frozen benchmark: preset `bench`, seed 0, 24 clips. If a clip changes, so does the
version."""
_BENCH: tuple[tuple[str, ...], ...] = (
    ("walk",), ("sit",), ("step_up",), ("pick_up",), ("turn",), ("lean",), ("walk", "sit"), ("walk",),
    ("sit",), ("step_up",), ("pick_up",), ("walk", "walk"), ("turn",), ("reach",), ("sit",), ("walk",),
    ("lean",), ("step_up",), ("pick_up", "walk"), ("walk",), ("lie",), ("turn",), ("sit", "reach"), ("walk",),
)  # fmt: skip
PROCEDURAL = ("walk", "sit", "lie", "step_up", "pick_up", "lean", "reach")
CAPTURED = ("walk", "walk_turn", "chore", "gesture", "pickup", "dance", "sport", "arms")
PRESETS = ("bench", "random", "hidden", "carried", "moving")
MAX_SEED = int(np.iinfo(np.int64).max)
"""Largest 64-bit integer, which every reader of `set.json` and `meta.json` can hold."""


@dataclass(frozen=True, slots=True)
class Hiding:
    """How the person of a clip of preset `hidden` goes out of sight."""

    behind: Literal["shelf", "cabinet"] | None
    """An object between camera and person; None = the person leaves the picture."""
    hidden_s: tuple[float, float]
    """Range of the length of the one hidden interval."""
    when: Literal["passing", "turning", "low"]
    """When the object is in front of the person: walking across the line of sight, turning round, or at its lowest."""
    width_m: tuple[float, float] = (0.0, 0.0)
    height_m: tuple[float, float] = (0.0, 0.0)
    camera_height_m: tuple[float, float] = (1.0, 2.2)


_TALL, _LOW = (1.8, 2.1), (0.9, 1.3)
"""Heights of objects, meters, that hide somebody who stands, and somebody who crouches."""
_LONG_S, _SHORT_S = (1.0, 3.0), (0.3, 0.95)
_HIDDEN: tuple[tuple[str, str, Hiding], ...] = (
    ("walk_behind_shelf", "walk", Hiding("shelf", _LONG_S, "passing", (0.8, 1.4), _TALL)),
    ("walk_behind_cabinet", "walk", Hiding("cabinet", _SHORT_S, "passing", (0.5, 1.0), _TALL)),
    ("crouch_behind_cabinet", "pick_up", Hiding("cabinet", (0.3, 3.0), "low", (1.2, 2.0), _LOW, (0.9, 1.25))),
    ("leave_briefly", "return", Hiding(None, _SHORT_S, "turning")),
    ("leave_and_return", "return", Hiding(None, _LONG_S, "turning")),
    ("return_behind_shelf", "return", Hiding("shelf", _LONG_S, "turning", (0.9, 1.7), _TALL)),
)
"""Name, kind of motion, how the person is hidden."""
_CARRIED: tuple[tuple[str, str], ...] = (
    ("pick_up_from_floor", "carry_from_floor"),
    ("carry_and_put_down", "carry_between"),
    ("carry_box", "carry_box"),
    ("drink_from_cup", "drink"),
    ("pull_chair", "pull_chair"),
    ("walk_with_bag", "carry_bag"),
)
"""Name and kind of motion."""
_MOVING: tuple[tuple[str, str, CameraMotion], ...] = (
    ("pan_walk", "walk", "pan"),
    ("pan_turn", "turn", "pan"),
    ("follow_walk", "walk", "follow"),
    ("follow_turn", "turn", "follow"),
    ("handheld_sit", "sit", "handheld"),
    ("handheld_step_up", "step_up", "handheld"),
)
"""Name, kind of motion of the person and of the camera."""


@dataclass(frozen=True, slots=True)
class ClipSpec:
    """The specification of one clip; everything else is drawn from `rng()`."""

    name: str
    preset: str
    seed: int
    index: int
    kinds: tuple[str, ...]
    """One per person: a procedural kind, `turn` (captured walk with turns), or a captured kind."""
    duration_s: tuple[float, float]
    camera: CameraMotion = "static"
    harsh: bool = False
    """Strong noise, blur, distortion and compression may occur."""

    def rng(self, label: str, attempt: int = 0) -> np.random.Generator:
        """Independent random generator for one purpose (`label`) and attempt."""
        return np.random.default_rng([self.seed, self.index, zlib.crc32(f"{self.preset}/{label}".encode()), attempt])


def clip_specs(preset: str, count: int | None, seed: int) -> tuple[ClipSpec, ...]:
    """The clips of a preset; `bench` has 24, `random` as many as asked (default 24), the others 6.

    Raises:
        UsageError: unknown preset, or a count that it does not have.
    """
    if preset not in PRESETS:
        raise UsageError(f"--preset: want one of {', '.join(PRESETS)}, got {preset!r}")
    make, max_count = {
        "bench": (_bench, len(_BENCH)), "hidden": (_hidden, len(_HIDDEN)), "carried": (_carried, len(_CARRIED)),
        "moving": (_moving, len(_MOVING)), "random": (_random, 1_000_000),
    }[preset]  # fmt: skip
    count = min(max_count, len(_BENCH)) if count is None else count
    expect_count_and_seed(count, seed, max_count)
    return tuple(make(seed, index) for index in range(count))


def hiding_of(spec: ClipSpec) -> Hiding | None:
    """How the person of a clip goes out of sight; None for clips of other presets."""
    return _HIDDEN[spec.index][2] if spec.preset == "hidden" else None


def expect_count_and_seed(count: int, seed: int, max_count: int) -> None:
    """Check the number of clips or images and the seed.

    Raises:
        UsageError: the count is not 1 to `max_count`, or the seed not 0 to `MAX_SEED`.
    """
    if not 1 <= count <= max_count:
        raise UsageError(f"--count: want 1 to {max_count}, got {count}")
    if not 0 <= seed <= MAX_SEED:
        raise UsageError(f"--seed: want 0 to {MAX_SEED}, got {seed}")


def _bench(seed: int, index: int) -> ClipSpec:
    kinds = _BENCH[index]
    return ClipSpec(f"{index:02d}_{'_and_'.join(kinds)}", "bench", seed, index, kinds, (6.0, 9.0))


def _hidden(seed: int, index: int) -> ClipSpec:
    name, kind, _ = _HIDDEN[index]
    return ClipSpec(f"{index:02d}_{name}", "hidden", seed, index, (kind,), (6.0, 9.0))


def _carried(seed: int, index: int) -> ClipSpec:
    name, kind = _CARRIED[index]
    return ClipSpec(f"{index:02d}_{name}", "carried", seed, index, (kind,), (5.0, 12.0))


def _moving(seed: int, index: int) -> ClipSpec:
    name, kind, camera = _MOVING[index]
    return ClipSpec(f"{index:02d}_{name}", "moving", seed, index, (kind,), (6.0, 9.0), camera)


def _random(seed: int, index: int) -> ClipSpec:
    rng = np.random.default_rng([seed, index, zlib.crc32(b"random")])
    people = 2 if rng.random() < 0.2 else 1
    kinds = tuple(str(rng.choice((*PROCEDURAL, *CAPTURED))) for _ in range(people))
    name = f"{index:05d}_{'_and_'.join(kinds)}"
    camera: CameraMotion = "handheld" if rng.random() < 0.2 else "static"
    return ClipSpec(name, "random", seed, index, kinds, (4.0, 12.0), camera, bool(rng.random() < 0.5))
