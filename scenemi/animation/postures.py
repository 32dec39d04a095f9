"""Whole poses from a small library of postures, put at objects: sitting, standing, a hand on top.

The library (`postures.json`, made by `tools/posture_library.py`) holds one frame of captured motion for
each posture. It is placed by the object's surface and the body's skin; the legs reach for the floor by inverse
kinematics; then the solve that ends `scenemi sample` brings the skin onto what it touches and out of all else.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scenemi.animation.named_objects import NamedObject, object_by_name
from scenemi.animation.partial_file import PostureWish
from scenemi.data.hinge_limb import LegBones, bend_leg
from scenemi.postprocess.in_scene import OBSERVED
from scenemi.postprocess.motion_solve import SceneMotion, solve_motions
from scenemi.postprocess.partial import MISS_M, PartialKeyframes
from scenemi.postprocess.solids import Solids
from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.grid import AROUND_M, distance_grid
from video2anim.body.legs import LEGS
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types.clip import FPS
from video2anim.types.skeleton import FEET, JOINT_INDEX, PARENTS, forward_kinematics

_LIBRARY = Path(__file__).with_name("postures.json")
_PELVIS = JOINT_INDEX["pelvis"]
_SITS_ON = (_PELVIS, *(leg.hip for leg in LEGS))
_CALF_M = 0.06
"""Behind the knee joint: so far before the edge of a seat a shin hangs free."""
_INSIDE_M = 0.06
"""Wrist from the edge of what the hand lies on: the palm, 0.1 m before it, lies well inside."""
_WRIST_M = 0.03
"""Wrist joint above what the hand lies on."""
_BENDS = replace(OBSERVED, trunk_rad=0.15, iterations=60)
"""A posture of the library stands upright; whoever puts a hand on a table bends. With 0.05 rad, the hand stays 4 to 6
cm from a table of 0.74 m, with this 6 mm after 16 iterations and less than 1 mm after 60."""


@dataclass(frozen=True, slots=True, eq=False)
class Posture:
    """A pose in the world, before or after the solve, and what it touches."""

    R_parent_joint: Float[np.ndarray, "22 3 3"]
    translation_m: Float[np.ndarray, "3"]
    contact: Float[np.ndarray, "22"]
    place_m: Float[np.ndarray, "22 3"]
    """Of joints that have to be somewhere; NaN for others."""


@functools.cache
def posture_library() -> dict[str, Float[np.ndarray, "22 3 3"]]:
    """Local rotations by name; the body faces +Z."""
    found = json.loads(_LIBRARY.read_text(encoding="utf-8"))["postures"]
    return {name: matrix_from_axis_angle(np.array(one["axis_angle"])) for name, one in found.items()}


def place(wish: PostureWish, objects: Sequence[NamedObject], body: ShapedBody, where: str) -> Posture:
    """A posture where it is wished, before the solve.

    Args:
        wish: posture and object.
        objects: of the scene.
        body: whose pose it is.
        where: of what the errors speak.

    Raises:
        InputError: no such object, or one without a surface for this.
    """
    if wish.sit_on is not None:
        return _sitting(object_by_name(objects, wish.sit_on, where), wish.heading_deg, body)
    name = wish.hand_on if wish.hand_on is not None else wish.stand_at
    if not isinstance(name, str):
        assert name is not None
        heading = _heading(0.0 if wish.heading_deg is None else wish.heading_deg)
        return standing(np.array(name, float), heading, body)
    return _standing_before(object_by_name(objects, name, where), wish, body)


def standing(at_m: Float[np.ndarray, "2"], heading: Float[np.ndarray, "2"], body: ShapedBody) -> Posture:
    """Standing over a place on the floor (x, z), facing along a unit vector."""
    R, joints_m, R_world = _turned("stand", heading, body)
    height_m = -float(_skin(body, joints_m, R_world)[:, 1].min())
    return Posture(R, np.array([at_m[0], height_m, at_m[1]]), _touching(*FEET), np.full((len(PARENTS), 3), np.nan))


def settled(posture: Posture, body: ShapedBody, scene: SceneGeometry, where: str) -> Posture:
    """The posture after the solve: skin touches what it should, and is outside of solids.

    Raises:
        InputError: a hand does not reach its place.
    """
    joints_m, _ = forward_kinematics(posture.R_parent_joint, posture.translation_m, body.rest_joints_m)
    field = distance_grid(scene, joints_m.min(0) - AROUND_M, joints_m.max(0) + AROUND_M)
    free = np.zeros(1, bool)
    partial = PartialKeyframes(posture.place_m[None], np.full((1, 2), np.nan))
    start = SceneMotion(
        posture.R_parent_joint[None], posture.translation_m[None], posture.contact[None], body.rest_joints_m, body, FPS,
        free, targets=partial.targets(joints_m[None], free),
    )  # fmt: skip
    solved = solve_motions([start], Solids(field, floor=False), _BENDS)
    R, translation_m = solved.R_parent_joint[0][0], solved.translation_world_m[0][0]
    joints_m, _ = forward_kinematics(R, translation_m, body.rest_joints_m)
    off_m = np.nan_to_num(np.linalg.norm(joints_m - posture.place_m, axis=-1)).max()
    if off_m > MISS_M["joint"]:
        raise InputError(f"{where}: the hand stays {off_m:.2f} m from its place, which is out of reach")
    return Posture(R, translation_m, posture.contact, posture.place_m)


def _sitting(seat_of: NamedObject, heading_deg: float | None, body: ShapedBody) -> Posture:
    """The hollows of the knees are at the front edge of the seat; on a seat that is less deep, the buttocks are at its
    rear."""
    heading = seat_of.front if heading_deg is None else _heading(heading_deg)
    forward, left = _axes(heading)
    seat_m = seat_of.seat().reshape(-1, 3)
    R, joints_m, R_world = _turned("sit", heading, body)
    part = body.vertex_part
    skin_m = _skin(body, joints_m, R_world)
    knees_m = float(np.mean([joints_m[leg.knee] @ forward for leg in LEGS]))
    behind_m = -float((skin_m[part == _PELVIS] @ forward).min())
    front_m, rear_m = (seat_m @ forward).max(), (seat_m @ forward).min()
    across_m = 0.5 * float((seat_m @ left).max() + (seat_m @ left).min())
    along_m = max(front_m + _CALF_M - knees_m, rear_m + behind_m)
    root_m = along_m * forward + across_m * left
    root_m[1] = seat_m[:, 1].max() - skin_m[np.isin(part, _SITS_ON), 1].min()
    R_world = _feet_down(R_world, joints_m + root_m, heading, body)
    R = R_world[PARENTS].swapaxes(-1, -2) @ R_world
    R[0] = R_world[0]
    return Posture(R, root_m, _touching(_PELVIS, *FEET), np.full((len(PARENTS), 3), np.nan))


def _standing_before(other: NamedObject, wish: PostureWish, body: ShapedBody) -> Posture:
    """Facing an object's front, or along a heading, just before it; with a hand on it, if wished."""
    heading = -other.front if wish.heading_deg is None else _heading(wish.heading_deg)
    forward, left = _axes(heading)
    surface_m = (other.triangles_m if wish.hand_on is None else other.top()).reshape(-1, 3)
    across_m = 0.5 * float((surface_m @ left).max() + (surface_m @ left).min())
    edge_m = float((surface_m @ forward).min())
    _, pose_m, R_world = _turned("stand", heading, body)
    root_m = across_m * left + (edge_m - float((_skin(body, pose_m, R_world) @ forward).max())) * forward
    posture = standing(root_m[[0, 2]], heading, body)
    if wish.hand_on is None:
        return posture
    wrist, shoulder = (JOINT_INDEX[f"{wish.hand}_{name}"] for name in ("wrist", "shoulder"))
    joints_m, _ = forward_kinematics(posture.R_parent_joint, posture.translation_m, body.rest_joints_m)
    posture.place_m[wrist] = (
        float(joints_m[shoulder] @ left) * left
        + (edge_m + _INSIDE_M) * forward
        + (float(surface_m[:, 1].max()) + _WRIST_M) * np.array([0.0, 1.0, 0.0])
    )
    posture.contact[wrist] = 1.0
    return posture


def _turned(name: str, heading: Float[np.ndarray, "2"], body: ShapedBody) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pose, joints about the pelvis and their orientations of a posture that faces along a heading."""
    R = posture_library()[name].copy()
    R[0] = matrix_from_axis_angle(np.array([0.0, np.arctan2(*heading), 0.0])) @ R[0]
    joints_m, R_world = forward_kinematics(R, np.zeros(3), body.rest_joints_m)
    return R, joints_m, R_world


def _feet_down(
    R_world: Float[np.ndarray, "22 3 3"], joints_m: Float[np.ndarray, "22 3"], heading: np.ndarray, body: ShapedBody
) -> Float[np.ndarray, "22 3 3"]:
    """Legs bent so that level soles are on the floor, as far as they reach."""
    rest_m = body.rest_joints_m
    level = np.tile(np.eye(3), (len(PARENTS), 1, 1))
    sole_m = float(_skin(body, rest_m, level)[:, 1].min())
    R_world = R_world.copy()
    for leg in LEGS:
        ankle_m = joints_m[leg.ankle].copy()
        ankle_m[1] = rest_m[leg.ankle, 1] - sole_m
        hip, knee = bend_leg(R_world[None, leg.hip], joints_m[None, leg.hip], ankle_m[None], LegBones.of(rest_m, leg))
        R_world[leg.hip], R_world[leg.knee] = hip[0], knee[0]
        R_world[[leg.ankle, leg.toe]] = matrix_from_axis_angle(np.array([0.0, np.arctan2(*heading), 0.0]))
    return R_world


def _skin(body: ShapedBody, joints_m: np.ndarray, R_world: np.ndarray) -> Float[np.ndarray, "vertices 3"]:
    return body.vertices(R_world[None], joints_m[None])[0].astype(np.float64)


def _heading(degrees: float) -> Float[np.ndarray, "2"]:
    return np.array([np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])


def _axes(heading: Float[np.ndarray, "2"]) -> tuple[np.ndarray, np.ndarray]:
    """Forward and left."""
    return np.array([heading[0], 0.0, heading[1]]), np.array([heading[1], 0.0, -heading[0]])


def _touching(*joints: int) -> Float[np.ndarray, "22"]:
    contact = np.zeros(len(PARENTS))
    contact[list(joints)] = 1.0
    return contact
