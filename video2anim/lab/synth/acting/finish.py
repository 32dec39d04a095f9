"""From solved scripts to procedural motions: heights of props measured on the mesh, and cutting to length."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from video2anim.lab.synth.acting.curves import yaw_rotation
from video2anim.lab.synth.acting.measure import BodyMeasure
from video2anim.lab.synth.acting.perform import SolvedMotion
from video2anim.lab.synth.world import ProceduralMotion, Prop
from video2anim.types.clip import FPS

GAP_M = 0.002
"""Gap between a surface and the lowest vertex that rests on it."""


def probes(
    done: SolvedMotion, size: BodyMeasure, frames: slice | np.ndarray = slice(None)
) -> Float[np.ndarray, "f p 3"]:
    """World positions of the probe vertices (`BodyMeasure.probe`) in some frames, meters."""
    return size.body.vertices(done.R_world_joint[frames], done.joints_m[frames], size.probe).astype(float)


def local_xz(points_m: np.ndarray, prop: Prop) -> tuple[np.ndarray, np.ndarray]:
    """x and z of world points in the prop's frame, meters."""
    off = points_m - np.array(prop.position_m)
    local = off.reshape(-1, 3) @ yaw_rotation(prop.yaw_rad)[:, [0, 2]]  # one product; a stack of them takes longer
    x, z = local.T.reshape(2, *points_m.shape[:-1])
    return x, z


def over(points_m: np.ndarray, prop: Prop, margin_m: float = 0.0) -> np.ndarray:
    """Which world points are within the prop's rectangle, seen from above, grown by a margin."""
    x, z = local_xz(points_m, prop)
    return (np.abs(x) < 0.5 * prop.size_m[0] + margin_m) & (np.abs(z) < 0.5 * prop.size_m[1] + margin_m)


def at_height(prop: Prop, height_m: float) -> Prop:
    """The prop with its surface at another height."""
    x, _, z = prop.position_m
    return replace(prop, position_m=(x, float(height_m), z))


def motion_of(
    kind: str,
    done: SolvedMotion,
    props: tuple[Prop, ...] = (),
    item_pose: Float[np.ndarray, "frames 4 4"] | None = None,
) -> ProceduralMotion:
    """The procedural motion of a solved script, its whole length."""
    return ProceduralMotion(
        f"procedural_{kind}", kind, "synthetic", done.translation_m, done.R_parent_joint, done.contact, props, item_pose
    )


def cut(motion: ProceduralMotion, first: int, stop: int) -> ProceduralMotion:
    """Frames [first, stop) of a motion. The frames of its props are shifted and clipped to the range."""
    props = tuple(
        replace(p, frames=tuple(int(np.clip(f - first, 0, stop - first - 1)) for f in p.frames))  # pyright: ignore[reportArgumentType]
        for p in motion.props
    )
    item = None if motion.item_pose is None else motion.item_pose[first:stop]
    held = None if motion.item_held is None else motion.item_held[first:stop]
    return replace(
        motion,
        translation_m=motion.translation_m[first:stop],
        R_parent_joint=motion.R_parent_joint[first:stop],
        contact=motion.contact[first:stop],
        props=props,
        item_pose=item,
        item_held=held,
    )


LEAD_S = {"sit": 2.6, "lie": 2.6}
"""Time kept before the first use of a prop, by kind: for turning and sitting down."""
_OTHER_LEAD_S = 0.9
_TAIL_S = 0.8


def fitted(motion: ProceduralMotion, rng: np.random.Generator, duration_s: tuple[float, float]) -> ProceduralMotion:
    """The motion cut to a random length within `duration_s` (minimum, maximum).

    Frames are cut from the walking before the first and after the last use of a prop, then from the end. A motion that
    is too short stays as it is.
    """
    count = len(motion.translation_m)
    low, high = (round(s * FPS) for s in duration_s)
    wanted = min(count, int(rng.integers(low, high + 1)))
    begin, end = count // 3, 2 * count // 3
    if motion.props:
        begin, end = min(p.frames[0] for p in motion.props), max(p.frames[1] for p in motion.props)
    before = max(0, begin - round(LEAD_S.get(motion.kind, _OTHER_LEAD_S) * FPS))
    after = max(0, count - end - round(_TAIL_S * FPS))
    spare = count - wanted
    first = min(before, round(spare * before / max(1, before + after)))
    stop = count - min(after, spare - first)
    return cut(motion, first, min(stop, first + high))
