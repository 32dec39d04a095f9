"""The kinds of procedural motion, each a function from a fresh `Script` to a finished motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import UsageError
from video2anim.lab.synth.acting.climb import act_step_up
from video2anim.lab.synth.acting.curves import yaw_rotation
from video2anim.lab.synth.acting.finish import fitted, motion_of
from video2anim.lab.synth.acting.hold import act_lean, act_pick_up, act_reach
from video2anim.lab.synth.acting.lie import act_lie
from video2anim.lab.synth.acting.measure import measure
from video2anim.lab.synth.acting.perform import perform
from video2anim.lab.synth.acting.script import Script
from video2anim.lab.synth.acting.sit import act_sit
from video2anim.lab.synth.acting.walking import bezier, random_pace, walk
from video2anim.lab.synth.world import ProceduralMotion


def act_walk(script: Script) -> ProceduralMotion:
    """Walk along two curved paths with a stop between them."""
    rng = script.rng
    for _ in range(2):
        yaw = script.yaw_rad + rng.uniform(-1.2, 1.2)
        ahead = yaw_rotation(script.yaw_rad + rng.uniform(-0.6, 0.6)) @ np.array([0.0, 0.0, rng.uniform(2.0, 3.0)])
        goal = script.center_m + ahead
        walk(script, bezier(script.center_m, script.yaw_rad, goal, yaw), random_pace(script))
        script.keyed.key(script.now_s - 0.3, 0.7, neck_twist=rng.uniform(-0.5, 0.5))
        script.wait(rng.uniform(0.5, 1.0))
        script.keyed.rest(script.now_s - 0.2, 0.7, "neck_twist")
    return motion_of("walk", perform(script))


def act_return(script: Script) -> ProceduralMotion:
    """Walk away, turn round along a small arc and come back."""
    rng, size = script.rng, script.size
    out = script.yaw_rad + rng.uniform(-0.15, 0.15)
    far = script.center_m + yaw_rotation(out) @ np.array([0.0, 0.0, rng.uniform(2.2, 3.0)])
    aside = rng.choice([-1.0, 1.0]) * rng.uniform(0.7, 1.0) * size.scale
    turned_round = far + yaw_rotation(out) @ np.array([aside, 0.0, 0.0])
    back = out + np.pi + rng.uniform(-0.15, 0.15)
    home = turned_round + yaw_rotation(back) @ np.array([0.0, 0.0, 3.0])
    legs = (
        bezier(script.center_m, script.yaw_rad, far, out),
        bezier(far, out, turned_round, out + np.pi, bend=0.7),
        bezier(turned_round, out + np.pi, home, back),
    )
    path_m = np.concatenate([legs[0], legs[1][1:], legs[2][1:]])
    walk(script, path_m, random_pace(script), close=False)
    return motion_of("return", perform(script))


ACTS: dict[str, Callable[[Script], ProceduralMotion]] = {
    "walk": act_walk,
    "return": act_return,
    "sit": act_sit,
    "lie": act_lie,
    "step_up": act_step_up,
    "pick_up": act_pick_up,
    "lean": act_lean,
    "reach": act_reach,
}


def act(
    kind: str, body: ShapedBody, rng: np.random.Generator, *, duration_s: tuple[float, float] = (6.0, 9.0)
) -> ProceduralMotion:
    """A motion of one of the kinds in `ACTS` for a body, with the props it needs. It starts near the world's origin.

    Raises:
        UsageError: unknown kind.
    """
    if kind not in ACTS:
        raise UsageError(f"procedural motion: want one of {', '.join(ACTS)}, got {kind!r}")
    return fitted(ACTS[kind](Script.standing(measure(body), rng)), rng, duration_s)
