"""From a clip specification to a shot: people and their motion, the room around them, and the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError
from video2anim.lab.synth.acting import ACTS, CARRIES, act, act_carry, joined
from video2anim.lab.synth.acting.curves import yaw_rotation
from video2anim.lab.synth.appearance import make_appearance
from video2anim.lab.synth.cameras import CameraRequest, place_camera
from video2anim.lab.synth.hiding import hidden_view
from video2anim.lab.synth.library import MotionDatabase
from video2anim.lab.synth.object_view import moved_object_view, swept_points
from video2anim.lab.synth.presets import ClipSpec, hiding_of
from video2anim.lab.synth.render.lens import covers_picture
from video2anim.lab.synth.rooms import build_room, penetration_m, split_items
from video2anim.lab.synth.world import (
    PICTURE_SIZE_PX,
    Actor,
    MovingObject,
    ProceduralMotion,
    Room,
    SceneObject,
    SensorModel,
    Shot,
)
from video2anim.types import BodyMotion, BodyShape, Intrinsics
from video2anim.types.clip import FPS
from video2anim.types.skeleton import forward_kinematics

MAX_PENETRATION_M = 0.01
"""No body vertex may lie deeper than this in any object."""
_ATTEMPTS = 8
_HIDING_STRIDE = 60
"""Whether somebody is hidden is decided on every 60th vertex of the skin."""
_SPACING_M = 0.06
"""Spacing of points on the box around a carried object."""
_APART_M = 0.3
"""Minimum distance between the bodies of two people."""


@dataclass(frozen=True, slots=True, eq=False)
class ComposeOptions:
    """Options that hold for all clips of a set."""

    width_px: int = PICTURE_SIZE_PX[0]
    height_px: int = PICTURE_SIZE_PX[1]
    room_size_m: tuple[float, float] | None = None
    meshes: tuple[SceneObject, ...] = ()
    library: MotionDatabase | None = None
    longest_s: float | None = None
    """Clips are cut to this length."""
    skin_stride: int = 1
    """Every n-th vertex of the skin is kept clear of objects; a larger n is faster and less exact."""


@dataclass(frozen=True, slots=True, eq=False)
class Performance:
    """The motion of one person with joints and skinned vertices in the world frame."""

    body: ShapedBody
    procedural: ProceduralMotion
    joints_m: Float[np.ndarray, "frames 22 3"]
    vertices_m: Float[np.ndarray, "frames vertices 3"]


class _Unsuitable(Exception):
    """This random draw is rejected; another one may be accepted."""


def compose(spec: ClipSpec, options: ComposeOptions) -> Shot:
    """Draw a shot. Rejected draws (bodies that touch, furniture in the way, no view) are repeated up to 8 times.

    Raises:
        InputError: all draws are rejected, for example because the given room is too small for the motion.
    """
    reason = ""
    for attempt in range(_ATTEMPTS):
        try:
            return _compose(spec, options, attempt)
        except _Unsuitable as error:
            reason = str(error)
        except InputError as error:
            if options.room_size_m is not None and attempt == _ATTEMPTS - 1:
                raise
            reason = str(error)
    raise InputError(f"clip {spec.name} (seed {spec.seed}): no suitable scene in {_ATTEMPTS} draws; last: {reason}")


def _compose(spec: ClipSpec, options: ComposeOptions, attempt: int) -> Shot:
    people = _performances(spec, options, attempt)
    rng = spec.rng("room", attempt)
    props = tuple(prop for person in people for prop in person.procedural.props)
    swept = np.concatenate(
        [_skin(people, options.skin_stride), *(swept_points(p.procedural, _SPACING_M) for p in people)]
    )
    furnished = build_room(
        rng, swept_m=swept, props=props, room_size_m=options.room_size_m,
        clutter=float(rng.uniform(0.2, 0.9)), meshes=options.meshes, prop_depth_m=0.8 * MAX_PENETRATION_M,
    )  # fmt: skip
    room, items = split_items(furnished)
    room = _without_obstacles(swept, room)
    request = CameraRequest(
        options.width_px, options.height_px, motion=spec.camera,
        height_m=(1.0, 2.2) if spec.preset in ("bench", "carried") else (0.8, 2.6),
    )  # fmt: skip
    joints = np.stack([person.joints_m for person in people])
    hiding, camera_rng = hiding_of(spec), spec.rng("camera", attempt)
    if spec.preset == "carried":
        first = people[0]
        lens, T_world_camera = moved_object_view(
            camera_rng, room, first.procedural, joints[0], first.vertices_m, first.body.faces, request
        )
    elif hiding is None:
        lens, T_world_camera = place_camera(camera_rng, room, joints, request)
    else:
        room, lens, T_world_camera = hidden_view(
            camera_rng, room, swept, joints[0], people[0].vertices_m[:, ::_HIDING_STRIDE], request, hiding
        )
    actors = []
    for number, person in enumerate(people):
        face_material, materials = make_appearance(person.body, spec.rng(f"looks {number}", attempt))
        motion, procedural = _body_motion(number, person, T_world_camera, lens), person.procedural
        actors.append(Actor(motion, face_material, materials, procedural.kind, procedural.source, procedural.name))
    facts: dict[str, str | float | int] = {"attempt": attempt, "kind": "+".join(spec.kinds)}
    return Shot(
        spec.name, room, tuple(actors), lens, T_world_camera, spec.camera == "static",
        draw_sensor(spec.rng("sensor", attempt), spec, lens), _carried(people, items, room), facts,
    )  # fmt: skip


def draw_shape(rng: np.random.Generator) -> BodyShape:
    """An adult of varied build."""
    woman = rng.random() < 0.5
    values = {
        "gender": rng.uniform(0.85, 1.0) if woman else rng.uniform(0.0, 0.15),
        "age": rng.uniform(0.6, 0.85),
        "muscle": rng.uniform(0.3, 0.75),
        "weight": rng.uniform(0.25, 0.75),
        "height": rng.uniform(0.2, 0.65),
        "proportions": rng.uniform(0.35, 0.75),
    }
    return BodyShape("anny", {**ADULT, **{name: round(float(value), 4) for name, value in values.items()}})


def _performances(spec: ClipSpec, options: ComposeOptions, attempt: int) -> list[Performance]:
    people = []
    for number, kind in enumerate(spec.kinds):
        rng = spec.rng(f"motion {number}", attempt)
        body = shaped_body(draw_shape(rng))
        people.append((body, _motion(kind, body, rng, spec, options.library)))
    frames = min(len(procedural.translation_m) for _, procedural in people)
    if frames < spec.duration_s[0] * FPS * 0.75:
        raise _Unsuitable(f"motion of {frames / FPS:.1f} s is too short")
    if options.longest_s is not None:
        frames = min(frames, max(int(options.longest_s * FPS), 2))
    performed = [_perform(body, _cut(procedural, frames)) for body, procedural in people]
    for person in performed:
        lowest_m = float(person.vertices_m[::2, :, 1].min())
        if lowest_m < -MAX_PENETRATION_M:
            raise _Unsuitable(f"the body is {-100 * lowest_m:.1f} cm under the floor")
    R = _facing_walls(performed[0].procedural)
    shift = -(R @ performed[0].procedural.translation_m[0]) * (1.0, 0.0, 1.0)
    placed = [_moved(performed[0], R, shift)]
    for number, other in enumerate(performed[1:], 1):
        placed.append(_beside(placed, other, spec.rng(f"place {number}", attempt)))
    return placed


def _motion(
    kind: str, body: ShapedBody, rng: np.random.Generator, spec: ClipSpec, library: MotionDatabase | None
) -> ProceduralMotion:
    """Captured motion if the database has the kind, else procedural motion, which may begin with a captured walk."""
    if kind in CARRIES:
        return act_carry(kind, body, rng)
    low, high = spec.duration_s
    if kind not in ACTS and library is not None:
        captured = library.draw("walk_turn" if kind == "turn" else kind, body, rng, min_s=low)
        if captured is not None:
            length = int(rng.uniform(low, high) * FPS)
            start = int(rng.integers(0, max(len(captured.translation_m) - length, 0) + 1))
            piece = slice(start, start + length)
            return ProceduralMotion(
                captured.name, captured.kind, captured.source, captured.translation_m[piece],
                captured.R_parent_joint[piece], captured.contact[piece],
            )  # fmt: skip
    if kind not in ACTS:
        kind = "walk"
    walk = library.draw("walk", body, rng) if library is not None and rng.random() < 0.6 else None
    if walk is None:
        return act(kind, body, rng, duration_s=spec.duration_s)
    length = min(len(walk.translation_m), int(3.0 * FPS))
    rest = max(low - length / FPS, 4.0 if kind == "walk" else 5.5)
    procedural = act(kind, body, rng, duration_s=(rest, max(rest + 0.5, high - length / FPS)))
    start = joined(walk.translation_m[:length], walk.R_parent_joint[:length], walk.contact[:length], procedural, body)
    return replace(start, name=f"{walk.name} > {procedural.name}", source=f"{walk.source} > synthetic")


def _cut(procedural: ProceduralMotion, frames: int) -> ProceduralMotion:
    pose = procedural.item_pose[:frames] if procedural.item_pose is not None else None
    held = procedural.item_held[:frames] if procedural.item_held is not None else None
    return replace(
        procedural, translation_m=procedural.translation_m[:frames], R_parent_joint=procedural.R_parent_joint[:frames],
        contact=procedural.contact[:frames], item_pose=pose, item_held=held,
    )  # fmt: skip


def _perform(body: ShapedBody, procedural: ProceduralMotion) -> Performance:
    joints, R_world = forward_kinematics(procedural.R_parent_joint, procedural.translation_m, body.rest_joints_m)
    return Performance(body, procedural, joints, body.vertices(R_world, joints))


def _moved(person: Performance, R: np.ndarray, shift: np.ndarray) -> Performance:
    """The performance with its props, rotated about +Y by `R` and then moved by `shift` (meters)."""
    procedural, yaw = person.procedural, float(np.arctan2(R[0, 2], R[2, 2]))
    rotations = procedural.R_parent_joint.copy()
    rotations[:, 0] = R @ rotations[:, 0]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, shift
    props = tuple(
        replace(prop, position_m=tuple(float(x) for x in R @ prop.position_m + shift), yaw_rad=prop.yaw_rad + yaw)
        for prop in procedural.props
    )
    moved = replace(
        procedural, translation_m=procedural.translation_m @ R.T + shift, R_parent_joint=rotations, props=props,
        item_pose=None if procedural.item_pose is None else T @ procedural.item_pose,
    )  # fmt: skip
    vertices = (person.vertices_m @ R.T.astype(np.float32) + shift.astype(np.float32)).astype(np.float32)
    return Performance(person.body, moved, person.joints_m @ R.T + shift, vertices)


def _facing_walls(procedural: ProceduralMotion) -> Float[np.ndarray, "3 3"]:
    """Rotation about +Y that makes a wall the motion leans on parallel to a wall of the room."""
    yaw = next((-prop.yaw_rad for prop in procedural.props if prop.kind == "wall"), 0.0)
    return yaw_rotation(yaw)


def _beside(placed: list[Performance], person: Performance, rng: np.random.Generator) -> Performance:
    """A person moved close to the others, but nowhere closer than `_APART_M`."""
    for distance in np.linspace(0.8, 4.0, 40):
        yaw, bearing = rng.uniform(-np.pi, np.pi, 2)
        R = yaw_rotation(float(yaw))
        center = np.mean([other.joints_m[:, 0].mean(0) for other in placed], 0)
        goal = center + distance * np.array([np.sin(bearing), 0, np.cos(bearing)])
        shift = (goal - R @ person.joints_m[:, 0].mean(0)) * (1.0, 0.0, 1.0)
        joints = person.joints_m @ R.T + shift
        if all(_apart(other.joints_m, joints) for other in placed) and _props_apart(placed, person, R, shift):
            return _moved(person, R, shift)
    raise _Unsuitable("two people come too close")


def _apart(a_m: np.ndarray, b_m: np.ndarray) -> bool:
    gaps = np.linalg.norm(a_m[:, :, None, [0, 2]] - b_m[:, None, :, [0, 2]], axis=-1)
    return bool(gaps.min() > _APART_M + 0.2)


def _props_apart(placed: list[Performance], person: Performance, R: np.ndarray, shift: np.ndarray) -> bool:
    """Whether a person's props are off the paths and the props of the others."""
    mine = np.array([R @ prop.position_m + shift for prop in person.procedural.props]).reshape(-1, 3)[:, [0, 2]]
    path = (person.joints_m[:, 0] @ R.T + shift)[:, [0, 2]]
    for other in placed:
        theirs = np.array([prop.position_m for prop in other.procedural.props]).reshape(-1, 3)[:, [0, 2]]
        walked = other.joints_m[:, 0][:, [0, 2]]
        for points, others in ((mine, walked), (theirs, path), (mine, theirs)):
            if len(points) and len(others):
                gap = np.linalg.norm(points[:, None] - others[None], axis=-1).min()
                if gap < 1.3:
                    return False
    return True


def _carried(people: list[Performance], items: dict[int, SceneObject], room: Room) -> tuple[MovingObject, ...]:
    """Objects that are moved, with their poses. `items`: objects of the room by the index of their prop."""
    moving, first, unused = [], 0, max(obj.object_id for obj in (*room.objects, *items.values())) + 1
    for person in people:
        procedural = person.procedural
        if procedural.item_pose is not None and procedural.item_held is not None:
            mine = [obj for number, obj in items.items() if first <= number < first + len(procedural.props)]
            if procedural.item is not None:
                mine.append(procedural.item.moved(procedural.item_pose[0], unused))
                unused += 1
            moving += [MovingObject(obj, procedural.item_pose, procedural.item_held) for obj in mine]
        first += len(procedural.props)
    return tuple(moving)


def _skin(people: list[Performance], stride: int) -> Float[np.ndarray, "points 3"]:
    """Skin points (world, meters) of every second frame."""
    return np.concatenate([person.vertices_m[::2, ::stride].reshape(-1, 3) for person in people]).astype(np.float64)


def _without_obstacles(points: Float[np.ndarray, "points 3"], room: Room) -> Room:
    """The room without furniture that a body enters; objects that the motion needs stay.

    Raises:
        _Unsuitable: a body is deeper than `MAX_PENETRATION_M` in a wall or in an object that the motion needs.
    """
    low, high = points.min(0), points.max(0)
    kept = []
    for obj in room.objects:
        vertices = obj.merged()[0]
        if (vertices.max(0) < low).any() or (vertices.min(0) > high).any():
            kept.append(obj)
            continue
        depth_m = float(penetration_m([obj], points).max())
        if depth_m <= MAX_PENETRATION_M:
            kept.append(obj)
        elif obj in room.structure or obj.note.startswith("prop "):
            raise _Unsuitable(f"the body is {100 * depth_m:.1f} cm inside {obj.label} {obj.object_id}")
    numbers = {obj.object_id for obj in kept}
    return replace(room, furniture=tuple(obj for obj in room.furniture if obj.object_id in numbers))


def _body_motion(number: int, person: Performance, T_world_camera: np.ndarray, lens: Intrinsics) -> BodyMotion:
    procedural = person.procedural
    frames = len(procedural.translation_m)
    T_world_root = np.tile(np.eye(4), (frames, 1, 1))
    T_world_root[:, :3, :3], T_world_root[:, :3, 3] = procedural.R_parent_joint[:, 0], procedural.translation_m
    return BodyMotion(
        person_id=number, frame_time_s=np.arange(frames) / FPS, valid=np.ones(frames, bool),
        T_world_root=T_world_root, R_parent_joint=procedural.R_parent_joint, T_world_camera=T_world_camera,
        intrinsics=lens, contact=procedural.contact.astype(np.float64), shape=person.body.shape,
        rest_joints_m=person.body.rest_joints_m, joints_world_m=person.joints_m,
    )  # fmt: skip


def draw_sensor(rng: np.random.Generator, spec: ClipSpec, lens: Intrinsics) -> SensorModel:
    """Random noise, blur, distortion and compression: mild, or mild to strong for a harsh clip."""
    tint = rng.normal(0, 0.03, 3)
    base = SensorModel(
        exposure=float(np.exp(rng.normal(0, 0.12))), noise_steps=float(rng.uniform(0.5, 2.5)),
        blur_s=float(rng.choice([0.0, 1 / 120, 1 / 60])), vignette=float(rng.uniform(0, 0.25)),
        white_balance=(float(np.exp(tint[0])), 1.0, float(np.exp(tint[2]))), crf=int(rng.integers(16, 24)),
    )  # fmt: skip
    if not spec.harsh:
        return base
    k1, k2 = float(rng.uniform(-0.12, 0.06)), float(rng.uniform(-0.02, 0.02))
    while not covers_picture(lens, k1, k2):
        k1, k2 = 0.8 * k1, 0.8 * k2
    return replace(
        base, exposure=float(np.exp(rng.normal(0, 0.35))), noise_steps=float(rng.uniform(1, 8)),
        blur_s=float(rng.uniform(0, 1 / 30)), k1=k1, k2=k2,
        jpeg_quality=int(rng.integers(40, 95)), crf=int(rng.integers(18, 32)),
    )  # fmt: skip
