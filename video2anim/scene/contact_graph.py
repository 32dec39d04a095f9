"""The contact graph: which part of a body touches which surface of which object, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import LIKELY, NEAR_M, SLOW_M_S, posed_vertices, skin_of, speed_m_s
from video2anim.body.shaped_body import ShapedBody
from video2anim.geometry.mesh_query import MeshQuery
from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.geometry.runs import runs, without_short_runs
from video2anim.geometry.scene_mesh import world_mesh
from video2anim.scene.supports import LEVEL_COSINE
from video2anim.types.contact import FLOOR, Contact
from video2anim.types.motion import BodyMotion
from video2anim.types.scene import PlacedObject, SceneModel
from video2anim.types.skeleton import JOINT_INDEX, TOUCHING_PARTS

RESTING_PARTS: dict[str, tuple[int, ...]] = {
    name: (JOINT_INDEX[joint],)
    for name, joint in {
        "head": "head",
        "left forearm": "left_elbow", "right forearm": "right_elbow",
        "left thigh": "left_hip", "right thigh": "right_hip",
        "left shin": "left_knee", "right shin": "right_knee",
    }.items()
}  # fmt: skip
"""Parts without a contact probability. They touch only surfaces that they rest on: after the solve has removed
penetration, a motion touches sides of objects by accident."""
BODY_PARTS = TOUCHING_PARTS | RESTING_PARTS
STAY_M = 0.05
"""Between two frames within `NEAR_M` a part touches while it stays this near: the gap of a standing foot varies by
2 cm."""
SHORTEST_S = 0.1
"""Minimum duration of gaps and contacts; the stance of a runner lasts 0.2 s."""
_RESTING_M, _RESTING_STAY_M = 0.01, 0.03
"""The same distances of `RESTING_PARTS`, which have no contact probability: a part that passes 3 cm above a seat does
not rest on it."""
_RESTING_SHARE = 0.06
"""Minimum share of a limb's skin within that distance: kneeling shins have 0.09 to 0.26, sitting thighs 0.08 to 0.32,
shins whose knee meets the edge of a seat up to 0.057."""
_SAME_M = 0.01
"""Surfaces whose gap exceeds the smallest by less are touched together: residual of the solve."""
_MAX_SKIN = 200
"""Maximum skin points per part: 90 % of the skin of hands and feet is within 1.5 cm of one, of other parts within 3 cm.
Gaps are up to 5 mm too large."""
_LOOKS = ("top", "side", "underside")
_USUAL = {
    "seat": "top", "top": "top", "arm": "top", "bed": "top", "tread": "top", "back": "side", "leg": "side",
    "board": "side",
}  # fmt: skip
"""By name of a part: the face that the name alone stands for."""
_WHOLE = "body"
"""Name of the only part of a box, left out of names of surfaces."""


@dataclass(frozen=True, slots=True, eq=False)
class _Solid:
    """An object in the world, its faces grouped into surfaces; a moved object is in its first pose."""

    placed: PlacedObject
    triangles_m: Float[np.ndarray, "faces 3 3"]
    names: tuple[str, ...]
    """Of the surfaces."""
    carries: Bool[np.ndarray, "surfaces"]
    """Whether a surface faces up."""
    surface: Int[np.ndarray, "faces"]
    """Number of each face's surface."""


@dataclass(frozen=True, slots=True, eq=False)
class _Gaps:
    """Distances of the parts of a body from surfaces; the first surface is the floor."""

    gap_m: Float[np.ndarray, "surfaces parts frames"]
    """Signed distance of the nearest or deepest skin; infinite beyond `STAY_M`, and where the part cannot touch."""
    share: Float[np.ndarray, "surfaces parts frames"]
    """Share of the part's skin within `_RESTING_STAY_M` of the surface."""


def contact_graph(motion: BodyMotion, scene: SceneModel) -> tuple[Contact, ...]:
    """Contacts of one person with the floor and the objects, by part of the body and start.

    Hands, feet, seat and back touch where their contact probability is over 0.5 and skin is within 3 cm of a surface.
    Head, forearms, thighs and shins, which have no probability, touch where they rest on a surface that faces up:
    within 1 cm, and slower than 0.4 m/s. Surfaces that face up within 5 cm take precedence over sides: a foot on the
    floor beside a chair does not touch the chair.

    Moved objects are touched at their place in each frame; their surfaces are named by their first pose. A hand that
    holds one touches it whatever its probability, and nothing else.

    Args:
        motion: in the scene, best that of stage refine, whose contacts are computed from its skin.
        scene: as the motion fits it (`RefinedMotion.scene`).
    """
    solids = [_solid(placed) for placed in scene.objects]
    owners: list[tuple[int | None, str, str]] = [(None, FLOOR, FLOOR)]
    for one in solids:
        owners += [(one.placed.object_id, one.placed.label, name) for name in one.names]
    carries = np.concatenate([[True], *(one.carries for one in solids)])
    gaps = _gaps(motion, shaped_body(motion.shape), solids)
    shortest = round(SHORTEST_S / float(np.median(np.diff(motion.frame_time_s)))) if motion.frame_count > 1 else 1
    found = []
    for part, name in enumerate(BODY_PARTS):
        gap_m = gaps.gap_m[:, part]
        touched = _touched(name, gap_m, gaps.share[:, part], carries, shortest)
        for surface, start, stop in ((one, *run) for one, row in enumerate(touched) for run in runs(row)):
            distance_m = gap_m[surface, start:stop]
            distance_m = distance_m[np.isfinite(distance_m)]
            found.append(
                Contact(
                    motion.person_id, name, *owners[surface], float(motion.frame_time_s[start]),
                    float(motion.frame_time_s[stop - 1]), float(distance_m.mean()),
                    float(distance_m[np.abs(distance_m).argmax()]),
                )
            )  # fmt: skip
    order = list(BODY_PARTS)
    return tuple(sorted(found, key=lambda one: (order.index(one.body_part), one.start_s)))


def scene_contacts(people: Sequence[BodyMotion], scene: SceneModel) -> tuple[Contact, ...]:
    """Contacts of everybody, person by person."""
    return tuple(contact for motion in people for contact in contact_graph(motion, scene))


def _solid(placed: PlacedObject) -> _Solid:
    """Surfaces of an object: faces of one part on one side."""
    whole = world_mesh(placed.mesh, placed.pose(0), placed.scale)
    triangles_m = whole.vertices_m[whole.faces]
    normals = np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])
    up = normals[:, 1] / np.maximum(np.linalg.norm(normals, axis=-1), 1e-300)
    looks = np.where(up > LEVEL_COSINE, 0, np.where(up < -LEVEL_COSINE, 2, 1))
    parts = np.zeros_like(looks)
    for number, part in enumerate(placed.parts, start=1):
        parts[part.first_face : part.first_face + part.face_count] = number
    kinds, surface = np.unique(len(_LOOKS) * parts + looks, return_inverse=True)
    named = ["", *(part.name for part in placed.parts)]
    names = tuple(_surface_name(named[kind // len(_LOOKS)], _LOOKS[kind % len(_LOOKS)]) for kind in kinds)
    return _Solid(placed, triangles_m, names, kinds % len(_LOOKS) == 0, surface)


def _surface_name(part: str, look: str) -> str:
    if not part or part == _WHOLE:
        return look
    return part if _USUAL.get(part) == look else f"{part} {look}"


def _gaps(motion: BodyMotion, body: ShapedBody, solids: Sequence[_Solid]) -> _Gaps:
    """Distances of all parts in all frames in which they may touch."""
    held = np.array([_held_in(name, one.placed, motion) for one in solids for name in BODY_PARTS], bool)
    held = held.reshape(len(solids), len(BODY_PARTS), motion.frame_count)
    points, parts, frames, counts = [], [], [], []
    for part, (name, joints) in enumerate(BODY_PARTS.items()):
        skin = skin_of(body, joints)
        skin = skin[:: -(-len(skin) // _MAX_SKIN)]
        may = np.flatnonzero(_may_touch(motion, name) | held[:, part].any(0))
        points.append(posed_vertices(motion, body, skin, may).reshape(-1, 3))
        parts.append(np.full(len(points[-1]), part))
        frames.append(np.repeat(may, len(skin)))
        counts.append(len(skin))
    point_m, part, frame = np.concatenate(points), np.concatenate(parts), np.concatenate(frames)
    size = 1 + sum(len(one.names) for one in solids), len(BODY_PARTS), motion.frame_count
    gap_m, near = np.full(size, np.inf), np.zeros(size)

    def meet(surface: Int[np.ndarray, "hits"], hit: Int[np.ndarray, "hits"], distance_m: np.ndarray) -> None:
        where = surface, part[hit], frame[hit]
        np.minimum.at(gap_m, where, distance_m)
        np.add.at(near, where, np.abs(distance_m) < _RESTING_STAY_M)

    low = np.flatnonzero(point_m[:, 1] < STAY_M)
    meet(np.zeros_like(low), low, point_m[low, 1])
    first = 1
    for one in solids:
        own_m = _beside_first(point_m, frame, one.placed)
        found = MeshQuery.of(one.triangles_m).nearest(own_m, STAY_M)
        hit = np.flatnonzero(found.face >= 0)
        meet(first + one.surface[found.face[hit]], hit, found.distance_m[hit])
        first += len(one.names)
    # A hand that holds one object touches no other.
    owner = np.repeat(np.arange(-1, len(solids)), [1, *(len(one.names) for one in solids)])
    others = held.any(0) & ~np.concatenate([np.zeros((1, *held.shape[1:]), bool), held])[owner + 1]
    return _Gaps(np.where(others, np.inf, gap_m), np.where(others, 0.0, near / np.array(counts)[:, None]))


def _held_in(part: str, placed: PlacedObject, motion: BodyMotion) -> Bool[np.ndarray, "frames"]:
    """Frames in which a part of the body is a hand that holds the object."""
    held = np.zeros(motion.frame_count, bool)
    for hold in placed.holds:
        both = hold.hand == "both hands" and part.endswith("hand")
        if hold.person_id == motion.person_id and (both or hold.hand == part):
            held[hold.first_frame : hold.last_frame + 1] = True
    return held


def _beside_first(
    point_m: Float[np.ndarray, "points 3"], frame: Int[np.ndarray, "points"], placed: PlacedObject
) -> Float[np.ndarray, "points 3"]:
    """Points relative to the object's pose in their frame, in the world with the object in its first pose."""
    if not placed.path:
        return point_m
    T_first_frame = placed.pose(0) @ invert_rigid(np.asarray(placed.path[0].T_world_object))
    own_m, order = np.empty_like(point_m), np.argsort(frame, kind="stable")
    starts = np.searchsorted(frame[order], np.arange(1, len(T_first_frame)))
    for T, rows in zip(T_first_frame, np.split(order, starts), strict=True):
        own_m[rows] = transform_points(T, point_m[rows])
    return own_m


def _may_touch(motion: BodyMotion, part: str) -> Bool[np.ndarray, "frames"]:
    """Frames with a high contact probability; of parts without one, those in which the part is slow."""
    joints = BODY_PARTS[part]
    if part in TOUCHING_PARTS:
        return motion.contact[:, list(joints)].max(1) > LIKELY
    return speed_m_s(motion, joints[0]) < SLOW_M_S


def _touched(
    part: str,
    gap_m: Float[np.ndarray, "surfaces frames"],
    share: Float[np.ndarray, "surfaces frames"],
    carries: Bool[np.ndarray, "surfaces"],
    shortest: int,
) -> Bool[np.ndarray, "surfaces frames"]:
    """Frames in which a part touches each surface.

    Args:
        part: its name.
        gap_m: of the part.
        share: of its skin near each surface.
        carries: surfaces that face up.
        shortest: frames of the shortest gap and contact that count.
    """
    rests = part in RESTING_PARTS
    near_m, stay_m = (_RESTING_M, _RESTING_STAY_M) if rests else (NEAR_M, STAY_M)
    near, stays = np.abs(gap_m) < near_m, np.abs(gap_m) < stay_m
    if rests:
        enough = carries[:, None] & ((share >= _RESTING_SHARE) | (part == "head"))
        near, stays = near & enough, stays & enough
    elif part != "back":  # Backs lean against sides.
        near[~carries] &= ~(stays & carries[:, None]).any(0)
    # Skin inside a solid touches like skin on it.
    open_m = np.where(near, np.maximum(gap_m, 0.0), np.inf)
    near &= open_m <= open_m.min(0, initial=np.inf) + _SAME_M
    touched = np.stack([without_short_runs(_held(*one), shortest) for one in zip(near, stays, strict=True)])
    if part != "back":
        beside = touched[~carries] & ~touched[carries].any(0)
        touched[~carries] = np.stack([without_short_runs(one, shortest) for one in beside]) if len(beside) else beside
    return touched


def _held(near: Bool[np.ndarray, "frames"], stays: Bool[np.ndarray, "frames"]) -> Bool[np.ndarray, "frames"]:
    """Near frames, and frames between two of them throughout which the part stays."""
    held = near.copy()
    for start, stop in runs(near | stays):
        inside = start + np.flatnonzero(near[start:stop])
        if len(inside):
            held[inside[0] : inside[-1] + 1] = True
    return held
